"""Which code each notebook uses: its contents, not its times, decide what is executed again."""

import json
import re
from pathlib import Path

from thesis.settings import ROOT
from thesis_repro.running.code_used import digest_of_code
from thesis_repro.running.files import write_text
from thesis_repro.running.provenance import digest_of_file

# data of the project that a notebook reads
DATA = {
    "05_prediction": "thesis_repro/segmentation/weights/streets.keras",
    "09_audit": "notebooks/thesis/audit.json",
}
TIMED = "08_results", "09_audit"  # show the times in git, see `timing`


def code_of(notebook: Path) -> str:
    """Return a digest of the code that the cells of a notebook use."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    return digest_of_code(re.sub("^[%!].*", "", code, flags=re.MULTILINE))


def record(folder: Path) -> None:
    """Write for each notebook a file with digests of it and of what it uses, if they have changed.

    folder: of the run. The Makefile executes a notebook again if this file is new.
    """
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        digests = [digest_of_file(notebook)]
        try:
            digests.append(code_of(notebook))
        except (ValueError, KeyError, SyntaxError):  # is told when the notebook is executed
            digests.append("damaged")
        if notebook.stem in DATA:
            digests.append(digest_of_file(ROOT / DATA[notebook.stem]))
        if notebook.stem in TIMED:
            times = [*ROOT.glob("figures/timings/*"), *ROOT.glob("figures/*_excerpts/timings/*")]
            digests += map(digest_of_file, sorted(times))
        path, text = folder / "code" / notebook.stem, "\n".join(digests)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)
