"""Which code each notebook uses: its contents, not its times, decide what is executed again."""

import json
import os
import re
import subprocess
import time
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

    folder: of the run. Then the files get dates by which make executes again what was made from
    other contents: a clock may have been wrong.
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
    (folder / "done").mkdir(exist_ok=True)
    now = time.time()
    results = sorted((folder / "notebooks").glob("*.ipynb"))
    for path in (folder / "checked", folder / "drives", *(folder / "code").iterdir()):
        if path.exists():
            os.utime(path, (now, now))
    for path in results:
        date = now if _is_of_these_contents(folder, path.stem) else 0
        os.utime(path, (date, date))


def _is_of_these_contents(folder: Path, name: str) -> bool:
    """Return whether a notebook was made from what the folder of the run holds now."""
    done = folder / "done" / name
    if not done.is_file():
        return False
    recorded = done.read_text(encoding="utf-8")
    names = [line.split()[-1] for line in recorded.splitlines()]
    today = subprocess.run(["cksum", *names], cwd=folder, capture_output=True, text=True).stdout
    return bool(names) and today == recorded
