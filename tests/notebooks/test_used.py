"""Which notebooks are executed again: contents decide, not times."""

import os
import re
import shutil

import pytest
from cells import NOTEBOOKS
from trials import succeed

from thesis import used
from thesis.settings import ROOT

EXECUTED = re.compile(r"--output \.(\d\d)_")  # in the output of make


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the code with `run`, in which every notebook was executed."""
    root = tmp_path_factory.mktemp("project")
    for name in ("thesis_repro", "keypoint_study", "street_world", "opencv_exact", "notebooks"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "Makefile", root)
    (root / "run/notebooks").mkdir(parents=True)
    used.record(root / "run", root)
    for name in ("checked", "drives", *(f"notebooks/{name}" for name in NOTEBOOKS)):
        (root / "run" / name).touch()
    return root


@pytest.mark.slow
@pytest.mark.parametrize(
    "changed, again",
    [
        ("notebooks/06_keypoint_masks.ipynb", "06 07 08 09"),
        ("notebooks/07_visual_odometry.ipynb", "07"),
        ("thesis_repro/masks/folders.py", "05 06 07 08 09"),
        ("street_world/street.py", "01 02 03 04 05 06 07 08 09"),
        ("notebooks/thesis/domain_gap.py", "05 06 07 08 09"),
        ("notebooks/thesis/audit.json", "08 09"),
        ("notebooks/thesis/page.py", ""),
        ("thesis_repro/odometry/new_detector.py", ""),  # that nothing imports
        ("notebooks/06_keypoint_masks-Copy1.ipynb", ""),
    ],
)
def test_what_has_other_contents_is_executed_again(project, tmp_path, changed, again):
    """The file keeps its date, as after rsync -a, tar or cp -p."""
    run = shutil.copytree(project / "run", tmp_path / "run")
    path = project / changed
    before = path.read_bytes() if path.exists() else b""
    path.write_bytes(before + b"\n")
    os.utime(path, (0, 0))
    used.record(run, project)
    planned = succeed(["make", "-n", "notebooks", f"RUN={run}"], project).stdout
    path.write_bytes(before)
    assert sorted(EXECUTED.findall(planned)) == again.split()
