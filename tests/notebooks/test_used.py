"""Which notebooks are executed again: contents decide, not times."""

import os
import re
import shutil
import sys
import time

import pytest
from cells import NOTEBOOKS, executed_by
from trials import PACKAGES, copy_project, finish, start, succeed

from thesis import used
from thesis.settings import ROOT

OUTPUT = '"outputs": [{"output_type": "stream", "name": "stdout", "text": ["shown"]}]'
ALL = "01 02 03 04 05 06 07 08 09"
SENTENCE = [("notebooks/01_load_images_and_labels.ipynb", "## The data", "## All data")]


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the code with `run`, in which every notebook was executed."""
    root = tmp_path_factory.mktemp("project")
    copy_project([*PACKAGES, "notebooks", "Makefile"], root)
    run = root / "run"
    (run / "notebooks").mkdir(parents=True)
    (run / "checked").touch()
    record(root, run)
    recipes = plan(root, run)
    for name in NOTEBOOKS:
        text = (root / "notebooks" / name).read_text()
        (run / "notebooks" / name).write_text(text.replace('"outputs": []', OUTPUT))
    (run / "drives").touch()
    for command, name in re.findall(r"&& (cksum [^>]*) >done/\.(\w+)", recipes):
        (run / "done" / name).write_text(succeed(command.split(), run).stdout)
    return root


def plan(root, run):
    """What make would do, as text."""
    return succeed(["make", "-n", "notebooks", f"RUN={run}"], root).stdout


def record(root, run):
    code = f"from pathlib import Path; from thesis import used; used.record(Path({str(run)!r}))"
    succeed([sys.executable, "-c", code], root, PYTHONPATH=f"{root}:{root}/notebooks")


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes, again",
    [
        ([("notebooks/06_keypoint_masks.ipynb", "import", " import")], "06 07 08 09"),
        (SENTENCE, ""),
        # a notebook counts all modules that its own import
        ([("thesis_repro/masks/filter.py", "cv2.Canny(", "cv2.Canny(*")], ALL),
        ([("street_world/raster.py", "- 0.5", "- 0.25")], ALL),
        ([("keypoint_study/report/comparison.py", "import pandas", "import  pandas")], "08 09"),
        ([("notebooks/thesis/audit.json", "{", " {")], "09"),
        (
            [
                ("notebooks/thesis/book.py", "return", "return 1 and "),
                ("thesis_repro/odometry/new_detector.py", "", "import cv2"),  # that nothing uses
                ("notebooks/06_keypoint_masks-Copy1.ipynb", "", "{}"),
            ],
            "",
        ),
    ],
)
def test_what_uses_other_contents_is_executed_again(project, tmp_path, changes, again):
    """The files keep their dates, as after rsync -a, tar or cp -p."""
    run = shutil.copytree(project / "run", tmp_path / "run")
    before = {}
    for name, old, new in changes:
        path = project / name
        before[path] = path.read_text() if path.exists() else ""
        assert old in before[path]
        path.write_text(before[path].replace(old, new))
        os.utime(path, (0, 0))
    record(project, run)
    planned = plan(project, run)
    for path, text in before.items():
        path.write_text(text)
    assert executed_by(planned) == again.split()
    executed = (run / "notebooks" / NOTEBOOKS[0]).read_text()
    assert executed.count('"shown"') > 5 and ("## All data" in executed) == (changes is SENTENCE)


HOURS = 3600


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [-2 * HOURS, 2 * HOURS])
def test_a_clock_that_was_wrong_changes_nothing(project, tmp_path, monkeypatch, ahead):
    """Results and records get other dates; then 04 was made again, and 09 was changed.

    The packages are those of the copy, so this process knows them.
    """
    monkeypatch.setattr(used, "ROOT", project)
    run = shutil.copytree(project / "run", tmp_path / "run")

    def planned():
        for number, path in enumerate(sorted(run.rglob("*"))):
            date = time.time() + ahead + number % 7
            os.utime(path, (date, date))
        used.record(run)
        return executed_by(plan(project, run))

    assert planned() == []
    training = run / "notebooks/04_training.ipynb"
    first = training.read_text()
    training.write_text(first.replace('"shown"', '"another training"'))
    assert planned() == ["05", "06", "07", "08", "09"]
    training.write_text(first)
    assert planned() == []
    notebook = project / "notebooks/09_audit.ipynb"
    before = notebook.read_text()
    notebook.write_text(before.replace("import", " import"))
    plans = [planned(), planned()]
    notebook.write_text(before)
    assert plans == [["09"], ["09"]] and planned() == []
    (run / "done/02_augmentation").unlink()  # of an earlier version
    assert planned() == ["02", "04", "05", "06", "07", "08", "09"]


# In place of nbconvert: 08 ends at once or after 09, which it lets begin by writing a table.
NBCONVERT = """#!/bin/bash
for word; do case $word in notebooks/0*) name=${word#notebooks/0};; esac; done
case $name in
  8*) test $ENDS = early && exit 1
      sleep 1.1
      : >run/shuffled_runs.csv
      for _ in {1..200}; do test -e run/begun || sleep 0.1; done
      test -e run/begun;;
  9*) : >run/begun;;
esac && : >run/notebooks/.0$name
"""


@pytest.mark.parametrize("ends, made", [("late", "08 09"), ("early", "")])
def test_09_begins_when_08_has_written_its_tables(tmp_path, ends, made):
    """A table of an earlier run stands there, and results of all notebooks before 08."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/python").write_text(NBCONVERT)
    (tmp_path / "bin/python").chmod(0o755)
    run = tmp_path / "run"
    for name in ("notebooks", "code", "done"):
        (run / name).mkdir(parents=True)
    names = [name.removesuffix(".ipynb") for name in NOTEBOOKS]
    files = ["checked", "shuffled_runs.csv", *(f"code/{name}" for name in names)]
    files += ["drives", *(f"notebooks/{name}.ipynb" for name in names[:7])]
    files += [f"done/{name}" for name in names]
    for name in files:
        (run / name).touch()
        os.utime(run / name, (1, 1))
    command = ["make", "-k", "-j2", "-f", ROOT / "Makefile", "notebooks", "RUN=run", "BIN=bin"]
    command.append("LAST=shuffled_runs.csv")
    result = finish(start(command, tmp_path, ENDS=ends, MAKEFLAGS=None, MFLAGS=None))
    left = sorted(path.name[:2] for path in (run / "notebooks").glob("*.ipynb"))
    assert left == [name[:2] for name in names[:7]] + made.split(), result
    assert result.returncode == (0 if made else 2)
