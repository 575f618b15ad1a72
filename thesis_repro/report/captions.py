"""What every table, figure and text shows (captions.json), and the numbers that the thesis reports (reported.json).

An artefact is a dict: kind ("figure", "table", "text"), name (of its files), title, caption; constant, where it is the
same for all data; needs, the variable without which a run on real frames cannot make it; thesis, what the thesis
reports in words: data, text, and a template for this run's numbers, here. Both texts are Jinja templates.
"""

import json
from pathlib import Path

_HERE = Path(__file__).parent
REPORTED = json.loads((_HERE / "reported.json").read_text(encoding="utf-8"))
_CAPTIONS = json.loads((_HERE / "captions.json").read_text(encoding="utf-8"))
CHAPTERS = _CAPTIONS["chapters"]  # the 36 figures and 5 tables of the thesis in its order, {chapter: artefacts}
ADDED = _CAPTIONS["added"]  # artefacts that are not in the thesis
OF_STUDIES = _CAPTIONS["of_studies"]  # what studies alone show
OF_EVIDENCE = _CAPTIONS["of_evidence"]  # what the evidence on real frames alone shows
CONSTANT = [artefact["name"] for artefacts in CHAPTERS.values() for artefact in artefacts if artefact.get("constant")]
THESIS = [artefact["name"] for artefacts in CHAPTERS.values() for artefact in artefacts]
CARD = "thesis_repro/segmentation/weights/README.md"  # of the model in the package
