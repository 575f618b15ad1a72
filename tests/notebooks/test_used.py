"""Which notebooks are executed again: contents decide, not times."""

import os
import shutil
import sys

import pytest
from cells import NOTEBOOKS, executed_by
from trials import PACKAGES, copy_project, succeed


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A copy of the code with `run`, in which every notebook was executed."""
    root = tmp_path_factory.mktemp("project")
    copy_project([*PACKAGES, "notebooks", "Makefile"], root)
    (root / "run/notebooks").mkdir(parents=True)
    record(root, root / "run")
    for name in ("checked", "drives", *(f"notebooks/{name}" for name in NOTEBOOKS)):
        (root / "run" / name).touch()
    return root


def record(root, run):
    code = f"from pathlib import Path; from thesis import used; used.record(Path({str(run)!r}))"
    succeed([sys.executable, "-c", code], root, PYTHONPATH=f"{root}:{root}/notebooks")


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes, again",
    [
        ([("notebooks/06_keypoint_masks.ipynb", "import", " import")], "06 07 08 09"),
        ([("thesis_repro/masks/filter.py", "cv2.Canny(", "cv2.Canny(*")], "06 07 08 09"),
        ([("street_world/raster.py", "- 0.5", "- 0.25")], "01 02 04 05 06 07 08 09"),
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
    planned = succeed(["make", "-n", "notebooks", f"RUN={run}"], project).stdout
    for path, text in before.items():
        path.write_text(text)
    assert executed_by(planned) == again.split()
