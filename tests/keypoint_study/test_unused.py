"""What nobody used repeats nothing: an own copy of the packages gets new entries, and changes."""

import json
import shutil
import subprocess
import sys

import pytest
from trials import ROOT

pytestmark = pytest.mark.slow

# the records of a run of each kind, and of the worth
SHOW = """
import json, sys
from pathlib import Path
from keypoint_study import jobs, runner, worth_runs
from keypoint_study.sources import Source
from thesis_repro.data.kitti import Sequence

world, labels = map(Path, sys.argv[1:])
sequence, source = Sequence(world / "kitti", "00").subset(3), Source(labels)
shown = {"runs": runner._versions(runner.PATH, sequence)["code"]}
shown["worth"] = runner._versions(worth_runs.WORTH, sequence)["code"]
names = jobs.first_jobs([sequence], {"refined": (5,)}, tested=5)
names.append(jobs.Job("00", "spread-anywhere", max_keypoints=100))
for job, run in jobs.runs_of(names, [sequence], [source]).items():
    shown[job.method] = runner.record_of(run)["code"]
print(json.dumps(shown))
"""
NEW = {
    "thesis_repro/odometry/keypoints.py": "def mine(frame, settings, mask=None):\n    return frame\n"
    "\n\nDETECTORS['mine'] = mine\n",
    "thesis_repro/data/mine.py": "LAYOUT = 'mine'\n\n\ndef is_mine(folder):\n    return False\n",
    "thesis_repro/data/ids/mine.csv": "1,road\n",
    "thesis_repro/odometry/mine.py": "import cv2\n",
}
TABLES = {
    "thesis_repro/data/layout.py": (
        ("import euroc, ", "import euroc, mine, "),
        ("= kitti_raw, ", "= kitti_raw, mine, "),
    ),
    "thesis_repro/odometry/keypoints.py": (("(orb, ", "(orb, mine, "),),
    "keypoint_study/methods.py": (
        ("METHODS = {", "METHODS = {'mine': Method('mine', CONTROL, all_keypoints, IF_NAMED),"),
    ),
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    root = tmp_path_factory.mktemp("copy")
    for name in ("thesis_repro", "keypoint_study", "opencv_exact"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    return root


@pytest.fixture(scope="module")
def before(copy, small_world, small_labels):
    return shown(copy, small_world, small_labels)


def shown(copy, world, labels):
    """All records, in a process of their own."""
    code = f"import sys; sys.path.insert(0, {str(copy)!r})\n{SHOW}"
    command = [sys.executable, "-c", code, *map(str, (world, labels))]
    done = subprocess.run(command, cwd=copy, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def test_a_new_entry_that_nobody_used_repeats_nothing(
    copy, before, small_world, small_labels, tmp_path
):
    changed = tmp_path / "changed"
    shutil.copytree(copy, changed)
    for file, changes in TABLES.items():
        text = (changed / file).read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (changed / file).write_text(text)
    for file, text in NEW.items():
        place = changed / file
        old = place.read_text() if place.exists() else ""
        first, table, last = old.partition("# {name: detector}")  # before the table
        place.write_text(f"{first}{text.split('DETECTORS')[0]}\n\n{table}{last}")
    after = shown(changed, small_world, small_labels)
    assert after == before


@pytest.mark.parametrize(
    "file, old, new, repeated",
    [
        ("thesis_repro/odometry/loop.py", "MIN_MATCHES = 5", "MIN_MATCHES = 6", "runs worth"),
        ("thesis_repro/data/kitti_odometry.py", '"times.txt"', '"time.txt"', "runs worth"),
        ("thesis_repro/odometry/refined/fit.py", "eq=False", "eq=True", "masked worth"),
        (
            "thesis_repro/odometry/keypoints.py",
            "middle = int(",
            "middle = round(",
            "spread-anywhere",
        ),
        ("keypoint_study/controls.py", "flip(masks", "transpose(masks", "mirrored random-lines"),
        ("thesis_repro/masks/kinds.py", "2 * pixels + 1", "2 * pixels", "masked mirrored"),
        ("keypoint_study/worth.py", "SPLITS, SEED = 12", "SPLITS, SEED = 13", "worth"),
    ],
)
def test_a_change_of_what_was_used_repeats_it(
    copy, before, small_world, small_labels, tmp_path, file, old, new, repeated
):
    changed = tmp_path / "changed"
    shutil.copytree(copy, changed)
    text = (changed / file).read_text()
    assert old in text
    (changed / file).write_text(text.replace(old, new, 1))
    after = shown(changed, small_world, small_labels)
    different = {name for name in before if before[name] != after[name]}
    assert set(repeated.split()) <= different
    if file.endswith(("keypoints.py", "worth.py")):  # of one class or measure alone
        assert different == set(repeated.split())
