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
from keypoint_study import jobs, runner, worth
from keypoint_study.sources import Source
from thesis_repro.data.kitti import Sequence
from thesis_repro.running import provenance

world, labels, out = map(Path, sys.argv[1:])
sequence, source = Sequence(world / "kitti", "00").subset(3), Source(labels)
shown = {"runs": runner._versions(sequence)["code"]}
names = jobs.first_jobs([sequence], {"refined": (5,)}, tested=5)
for job, run in jobs.runs_of(names, [sequence], [source]).items():
    shown[job.method] = runner.record_of(*run[1:], provenance.digest_of_files)["code"]
worth.open_pool = None  # its record is written before the first call
try:
    worth.worths_of([sequence], [source], 5, out)
except TypeError:
    shown |= json.loads((out / "00/made-from.json").read_text())
print(json.dumps(shown))
"""
NEW = {
    "thesis_repro/odometry/keypoints.py": "def mine(frame, settings, mask=None):\n    return frame\n"
    "\n\nDETECTORS['mine'] = mine\n",
    "thesis_repro/data/mine.py": "LAYOUT = 'mine'\n\n\ndef is_mine(folder):\n    return False\n",
    "thesis_repro/data/ids/mine.csv": "1,road\n",
    "keypoint_study/controls.py": "class Mine(Mirrored):\n    pass\n",
    "keypoint_study/methods.py": "def mine(sequence, source, width):\n    return THESIS, None\n",
}
TABLES = {
    "thesis_repro/data/layout.py": (
        ("import euroc, ", "import euroc, mine, "),
        ("= kitti_raw, ", "= kitti_raw, mine, "),
    ),
    "thesis_repro/odometry/keypoints.py": (("(orb, ", "(orb, mine, "),),
    "keypoint_study/methods.py": (
        ("METHODS = {", "METHODS = {'mine': Method('mine', CONTROL, mine, every_study=False),"),
    ),
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    root = tmp_path_factory.mktemp("copy")
    for name in ("thesis_repro", "keypoint_study", "opencv_exact"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    return root


@pytest.fixture(scope="module")
def before(copy, small_world, small_labels, tmp_path_factory):
    return shown(copy, small_world, small_labels, tmp_path_factory.mktemp("out"))


def shown(copy, world, labels, out):
    """All records, in a process of their own."""
    code = f"import sys; sys.path.insert(0, {str(copy)!r})\n{SHOW}"
    command = [sys.executable, "-c", code, *map(str, (world, labels, out))]
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
        # before the table that names it
        first, table, last = old.partition(
            "# {name: detector}" if "keypoints" in file else "class Method("
        )
        place.write_text(f"{first}{text.split('DETECTORS')[0]}\n\n{table}{last}")
    after = shown(changed, small_world, small_labels, tmp_path / "out")
    assert after == before


@pytest.mark.parametrize(
    "file, old, new, repeated",
    [
        ("thesis_repro/odometry/loop.py", "MIN_MATCHES = 5", "MIN_MATCHES = 6", "runs code"),
        ("thesis_repro/data/kitti_odometry.py", '"times.txt"', '"time.txt"', "runs code"),
        ("thesis_repro/odometry/refined/fit.py", "eq=False", "eq=True", "masked code"),
        ("thesis_repro/odometry/keypoints.py", "middle = int(", "middle = round(", "choices"),
        ("keypoint_study/controls.py", "flip(self", "transpose(self", "mirrored choices"),
        ("thesis_repro/masks/kinds.py", "2 * pixels + 1", "2 * pixels", "masked choices"),
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
    after = shown(changed, small_world, small_labels, tmp_path / "out")
    different = {name for name in before if before[name] != after[name]}
    assert set(repeated.split()) <= different
    if "mirrored" in repeated or file.endswith("keypoints.py"):  # of one class or function alone
        assert different == set(repeated.split())
