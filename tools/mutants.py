"""Change one operator or constant at a time, and see whether the tests notice it: `make mutants`.

tools/mutants.txt lists the changes by file, with the tests that have to notice them. Each change is
made in a temporary copy of the project, so the checkout stays as it is. A change that no test
notices survives: either tests are missing, or the list says below it, indented, why nothing can
notice it. The exit status is 1 if another change survives, or if the list fits the code no longer.
"""

import multiprocessing
import os
import resource
import shlex
import shutil
import sys
import tempfile
from multiprocessing.connection import wait
from pathlib import Path
from typing import NamedTuple

import pytest

# what the tests import is loaded once, and only the project's own modules anew for each change
from keypoint_study import comparisons  # noqa: F401
from thesis.settings import ROOT
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import progress

LIST = Path(__file__).with_suffix(".txt")
PROCESSES = 2
LIMIT = 300  # seconds of a processor for the tests of one change: an endless loop is noticed
COPIED = ("thesis_repro", "keypoint_study", "opencv_exact", "street_world", "notebooks", "tests")
COPIED += ("tools", "pyproject.toml", "Makefile")
FORK = multiprocessing.get_context("fork")


class Change(NamedTuple):
    """A change of the one place of a file that has a text. reason: why nothing can notice it."""

    file: str
    tests: str
    old: str = ""
    new: str = ""
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.file}: {self.old} => {self.new}"


def read_changes(text):
    """Return the changes of a list, and raise InputError for one that does not fit the code."""
    changes = []
    for line in filter(None, text.splitlines()):
        if line.startswith("# "):
            file, tests = line[2:].split(": ")
            code = (ROOT / file).read_text(encoding="utf-8")
        elif line.startswith(" "):
            changes[-1] = changes[-1]._replace(reason=line.strip())
        else:
            old, new = line.replace(r"\n", "\n").split(" => ")
            changes.append(Change(file, tests, old, new))
            if code.count(old) != 1:
                raise InputError(f"{LIST.name}: {file} has {code.count(old)} times: {old}")
    return changes


def run_tests(clean, change):
    """Run the tests of a change in a copy of a clean folder, and end with pytest's exit status."""
    program.leave_ctrl_c_to_parent()
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT))
    folder = clean
    if change.old:
        folder = clean.with_name(f"copy{os.getpid()}")
        shutil.copytree(clean, folder)
        path = folder / change.file
        path.write_text(path.read_text("utf-8").replace(change.old, change.new), "utf-8")
    for name in [name for name in sys.modules if name.partition(".")[0] in (*COPIED, "thesis")]:
        del sys.modules[name]
    ours = [str(folder), str(folder / "notebooks")]
    theirs = {str(ROOT / name) for name in (".", "notebooks", "tools")}
    sys.path[:] = ours + [path for path in sys.path if path not in theirs]
    os.chdir(folder)
    with open(folder / "output.txt", "w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        status = pytest.main(["-q", "-x", "-p", "no:cacheprovider", *shlex.split(change.tests)])
    if change.old:
        shutil.rmtree(folder)
    os._exit(status)


def tried(changes, clean):
    """Yield (change, exit status of its tests), PROCESSES at a time."""
    waiting, running = list(reversed(changes)), {}
    try:
        while waiting or running:
            while waiting and len(running) < PROCESSES:
                process = FORK.Process(target=run_tests, args=(clean, waiting[-1]))
                process.start()
                running[process.sentinel] = process, waiting.pop()
            for sentinel in wait(running, timeout=0.1):
                process, change = running.pop(sentinel)
                process.join()
                yield change, process.exitcode
            program.check_stop()
    finally:
        for process, _ in running.values():
            process.kill()
            process.join()


def main():
    """Try all changes, or those whose line or file has the text of the first argument."""
    changes = read_changes(LIST.read_text(encoding="utf-8"))
    changes = [change for change in changes if "".join(sys.argv[1:]) in str(change)]
    with tempfile.TemporaryDirectory() as folder:
        clean = Path(folder) / "clean"
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            clean.mkdir(exist_ok=True)
            copy(ROOT / name, clean / name)
        rooms = {change.tests: change._replace(old="") for change in changes}
        for room, status in progress(tried(list(rooms.values()), clean), "unchanged", len(rooms)):
            if status:
                raise InputError(f"{room.tests}: fails without a change; run it with pytest")
        survived = []
        for change, status in progress(tried(changes, clean), "changes", len(changes), "change"):
            if status == 0:
                survived.append(change)
                program.log.info(f"survived: {change} ({change.reason or 'not explained'})")
            elif change.reason:
                program.log.warning(f"noticed, though the list says that nothing can: {change}")
    print(f"{len(changes) - len(survived)} of {len(changes)} changes were noticed")
    return any(not change.reason for change in survived)


if __name__ == "__main__":
    program.run_main(main)
