"""Which code each notebook uses: its contents, not its times, decide what is executed again.

An edited sentence executes nothing: it is put into the executed notebook.
"""

import hashlib
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


def cells_of(notebook: Path) -> list[dict]:
    """Return the cells of a notebook."""
    return json.loads(notebook.read_text(encoding="utf-8"))["cells"]


def is_code(cell: dict) -> bool:
    """Return whether a cell is executed."""
    return cell["cell_type"] == "code"


def record(folder: Path) -> None:
    """Write for each notebook a file with digests of its code and of what this uses, if changed.

    folder: of the run. The sentences of a notebook with the same code are put into what it made.
    Then the files get dates by which make executes again what was made from other contents: a clock
    may have been wrong.
    """
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        try:
            code = {
                cell["id"]: "".join(cell["source"]) for cell in filter(is_code, cells_of(notebook))
            }
            used = digest_of_code(re.sub("(?m)^[%!].*", "", "\n".join(code.values())))
            digests = [hashlib.sha256(json.dumps(code).encode()).hexdigest(), used]
        except (ValueError, KeyError, SyntaxError):  # is told when the notebook is executed
            digests = [digest_of_file(notebook), "damaged"]
        if notebook.stem in DATA:
            digests.append(digest_of_file(ROOT / DATA[notebook.stem]))
        if notebook.stem in TIMED:
            times = [*ROOT.glob("figures/timings/*"), *ROOT.glob("figures/*_excerpts/timings/*")]
            digests += map(digest_of_file, sorted(times))
        path, text = folder / "code" / notebook.stem, "\n".join(digests)
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)
        elif (folder / "notebooks" / notebook.name).is_file() and "damaged" not in digests:
            _put_sentences(notebook, folder)
    (folder / "done").mkdir(exist_ok=True)
    now = time.time()
    results = sorted((folder / "notebooks").glob("*.ipynb"))
    for path in (folder / "checked", folder / "drives", *(folder / "code").iterdir()):
        if path.exists():
            os.utime(path, (now, now))
    for path in results:
        date = now if _is_of_these_contents(folder, path.stem) else 0
        os.utime(path, (date, date))


def _put_sentences(notebook: Path, folder: Path) -> None:
    """Give what a notebook made its sentences, and tell the records of what was made from it."""
    executed = folder / "notebooks" / notebook.name
    made = json.loads(executed.read_text(encoding="utf-8"))
    ran = {cell["id"]: cell for cell in made["cells"]}
    cells = [ran.get(cell["id"], cell) if is_code(cell) else cell for cell in cells_of(notebook)]
    if cells == made["cells"]:
        return
    before = _sums(folder, [f"notebooks/{notebook.name}"])
    write_text(executed, json.dumps(made | {"cells": cells}, indent=1, ensure_ascii=False) + "\n")
    after = _sums(folder, [f"notebooks/{notebook.name}"])
    for done in (folder / "done").glob("[0-9]*"):
        text = done.read_text(encoding="utf-8")
        if before in text:
            write_text(done, text.replace(before, after))


def _is_of_these_contents(folder: Path, name: str) -> bool:
    """Return whether a notebook was made from what the folder of the run holds now."""
    done = folder / "done" / name
    if not done.is_file():
        return False
    recorded = done.read_text(encoding="utf-8")
    names = [line.split()[-1] for line in recorded.splitlines()]
    return bool(names) and _sums(folder, names) == recorded


def _sums(folder: Path, names: list[str]) -> str:
    """Return a line of sum, size and name for each file, as the Makefile records them."""
    return subprocess.run(["cksum", *names], cwd=folder, capture_output=True, text=True).stdout
