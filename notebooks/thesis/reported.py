"""The numbers that the thesis reports, in its tables and in its text."""

import json
from pathlib import Path

REPORTED = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
