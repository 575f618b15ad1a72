"""What nobody used repeats nothing: own copies of the packages get new entries, and changes."""

import json
import subprocess
import sys

import pytest
from trials import copy_project

pytestmark = pytest.mark.slow

# The records of a run of each kind, of each copy of the packages in a process of its own, which
# begins with what they import.
SHOW = """
import json, os, sys
from pathlib import Path
import cv2, joblib, matplotlib.pyplot, numba, pandas, scipy.spatial, scipy.stats, tqdm

world, labels, *copies = map(Path, sys.argv[1:])
for copy in copies:
    if os.fork():
        assert os.wait()[1] == 0
        continue
    os.chdir(copy)
    sys.path.insert(0, str(copy))
    from keypoint_study import jobs, runner
    from keypoint_study.sources import Source
    from thesis_repro.data.sequence import Sequence

    sequence, source = Sequence(world / "kitti", "00").subset(3), Source(labels)
    shown = {"runs": runner._versions(runner.PATH, sequence)["code"]}
    names = jobs.first_jobs([sequence], {"refined": (5,)}, tested=5)
    names.append(jobs.Job("00", "spread-anywhere", max_keypoints=100))
    for job, run in jobs.runs_of(names, [sequence], [source]).items():
        shown[job.method] = runner.record_of(run)["code"]
    print(json.dumps(shown), flush=True)
    os._exit(0)
"""
NEW = {
    "thesis_repro/odometry/keypoints.py": "def mine(frame, settings, mask=None):\n    return frame\n"
    "\n\nDETECTORS['mine'] = mine\n",
    "thesis_repro/data/mine.py": "LAYOUT = 'mine'\n\n\ndef is_mine(folder):\n    return False\n",
    "thesis_repro/odometry/mine.py": "import cv2\n",
}
TABLES = {
    "thesis_repro/data/layout.py": (
        ("import euroc, ", "import euroc, mine, "),
        ("= kitti_raw, ", "= kitti_raw, mine, "),
    ),
    "thesis_repro/odometry/keypoints.py": (("(orb, ", "(orb, mine, "),),
    "keypoint_study/methods.py": (
        ("METHODS = {", "METHODS = {'mine': Method('mine', CONTROL, all_keypoints),"),
    ),
}


# (file, an old and a new text, the records that change)
CHANGES = [
    ("thesis_repro/odometry/loop.py", "MIN_MATCHES = 5", "MIN_MATCHES = 6", "runs"),
    ("thesis_repro/data/kitti_odometry.py", '"times.txt"', '"time.txt"', "runs"),
    ("thesis_repro/odometry/refined/fit.py", "eq=False", "eq=True", "masked"),
    ("thesis_repro/odometry/keypoints.py", "middle = int(", "middle = round(", "spread-anywhere"),
    ("keypoint_study/controls.py", "flip(masks", "transpose(masks", "mirrored random-lines"),
    ("thesis_repro/masks/kinds.py", "2 * pixels + 1", "2 * pixels", "masked mirrored"),
]


def exchange(path, *changes):
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)


def add_what_nobody_uses(copy):
    for file, changes in TABLES.items():
        exchange(copy / file, *changes)
    for file, text in NEW.items():
        place = copy / file
        old = place.read_text() if place.exists() else ""
        first, table, last = old.partition("# {name: detector}")  # before the table
        place.write_text(f"{first}{text.split('DETECTORS')[0]}\n\n{table}{last}")


def test_a_change_repeats_what_used_it_and_a_new_entry_nothing(small_world, small_labels, tmp_path):
    copies = [tmp_path / str(number) for number in range(len(CHANGES) + 2)]
    for copy in copies:
        copy_project(("thesis_repro", "keypoint_study", "opencv_exact"), copy)
    add_what_nobody_uses(copies[1])
    for copy, (file, old, new, _) in zip(copies[2:], CHANGES, strict=True):
        exchange(copy / file, (old, new))
    words = map(str, (small_world, small_labels, *copies))
    done = subprocess.run(
        [sys.executable, "-c", SHOW, *words], check=True, capture_output=True, text=True
    )
    before, unused, *changed = map(json.loads, done.stdout.splitlines())
    assert unused == before
    for (file, _, _, repeated), after in zip(CHANGES, changed, strict=True):
        different = {name for name in before if before[name] != after[name]}
        assert set(repeated.split()) <= different, file
        if file.endswith("keypoints.py"):  # of one class alone
            assert different == set(repeated.split()), file
