"""What draws the figures of the thesis, one module a chapter, for the notebooks beside it."""

import json
from pathlib import Path

from keypoint_study.report import texts

# what the thesis reports, in its tables and in its text
REPORTED = json.loads((Path(__file__).parent / "reported.json").read_text(encoding="utf-8"))
# the templates here are found beside those of the package
texts.LOADER.searchpath.append(str(Path(__file__).parent / "templates"))
