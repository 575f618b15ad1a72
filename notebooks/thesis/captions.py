"""The captions of all tables, figures and texts, and what figures show in words.

They stand in captions.json. An artefact is a dict with kind ("figure", "table",
"text"), name (of its files), title and caption; those that a study has, too, have the study's.
Optional keys: constant: true if it shows no data. needs: the variable that a run on real frames
must set to make it. thesis: what the thesis reports, a dict of data and two Jinja templates, text
and here (for this run's numbers).
"""

import json
from pathlib import Path
from typing import Any

from keypoint_study.report.comparison import CAPTIONS as OF_STUDIES

_CAPTIONS = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
# the 36 figures and 5 tables of the thesis in its order, {chapter: artefacts}
CHAPTERS = _CAPTIONS["chapters"]
_OF_STUDIES = {
    ("figure", "comparison"): OF_STUDIES["ratios_drawn"],
    ("table", "comparison"): OF_STUDIES["ratios"],
    ("table", "widths"): OF_STUDIES["widths"],
    ("text", "findings"): ("What the runs show", ""),
}
# artefacts that are not in the thesis
ADDED = [
    dict(zip(("title", "caption"), _OF_STUDIES.get((artefact["kind"], artefact["name"]), ())))
    | artefact
    for artefact in _CAPTIONS["added"]
]
# what is to be seen, {name of a figure, or id of a notebook's cell: alternative text}
SEEN = _CAPTIONS["seen"]
OF_THESIS = [artefact for artefacts in CHAPTERS.values() for artefact in artefacts]
THESIS = [artefact["name"] for artefact in OF_THESIS]
CONSTANT = [artefact["name"] for artefact in OF_THESIS if artefact.get("constant")]


def number(artefact: dict[str, Any]) -> str | None:
    """Return the number of a figure or table in the thesis: "Figure 4.7" for figure_4_07."""
    if artefact["name"] not in THESIS:
        return None
    kind, chapter, count = artefact["name"].split("_")
    return f"{kind.capitalize()} {chapter.upper()}.{int(count)}"
