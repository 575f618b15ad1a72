"""What draws the figures of the thesis, one module a chapter, for the notebooks beside it."""

from pathlib import Path

from keypoint_study.report import texts

# the templates here are found beside those of the package
texts.LOADER.searchpath.append(str(Path(__file__).parent / "templates"))
