"""Bad input ends with an exit code, one line that names the file or option, and no new files.

The commands are called in the process of the tests.
"""

import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import trials

from thesis_repro.command.cli import main

pytestmark = pytest.mark.slow

FRAMES, POSES = "kitti/sequences/00/image_0", "kitti/poses/00.txt"
CALIB, TIMES = "kitti/sequences/00/calib.txt", "kitti/sequences/00/times.txt"
ODOMETRY = "odometry --kitti kitti --sequence 00 --output out/path.txt"
LABELLED, MASKED = f"{ODOMETRY} --labels labels --dilation 3", f"{ODOMETRY} --masks masks"
MASKS = "masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output out"
STUDY = "study --kitti kitti --labels labels --output out"
PREDICT = "predict --images kitti/sequences/00 --output out"
NOISE = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)


def picture(pixels, ending=".png"):
    return cv2.imencode(ending, np.asarray(pixels))[1].tobytes()


MISSING = {"missing": None}
# (command, file, {fault: its content, None if it is missing}); the error names the file. More
# contents are in tests/data, tests/running and tests/segmentation
BROKEN = [
    (ODOMETRY, f"{FRAMES}/000002.png", {"16 bits": picture(NOISE.astype(np.uint16))}),
    (ODOMETRY, f"{FRAMES}/000002.png", {"another size": picture(NOISE[:20])}),
    (ODOMETRY, f"{FRAMES}/000000.png", {"1x1": picture([[7]])}),
    (LABELLED, "labels/000002.png", {**MISSING, "a JPEG": picture(NOISE % 30, ".jpg")}),
    (LABELLED, "labels/000002.png", {"colours": picture(np.uint8([[[9, 7, 3]]]))}),
    (MASKED, "masks/000002.png", {**MISSING, "a label map": picture(NOISE % 30)}),
    (ODOMETRY, CALIB, {**MISSING, "another's": b"P0: 718 0 607 0 0 718 24 0 0 0 1 0\n"}),
    (ODOMETRY, POSES, {"too few": b"1 0 0 0 0 1 0 0 0 0 1 0\n" * 3}),
    (ODOMETRY, TIMES, {"too few": b"0\n1\n"}),
    (f"{PREDICT} --model a.keras", "a.keras", {"a picture": picture(NOISE)}),
]
# command -> what the error names; the files are sound
REFUSED = f"""
{ODOMETRY} --labels labels -> --labels
{ODOMETRY} --dilation 3 -> --dilation
{LABELLED} --invert -> --invert
{ODOMETRY} --camera image_9 -> 'image_9'
{ODOMETRY} --plot out/path.doc -> path.doc
{ODOMETRY} --tum {POSES} -> {POSES}
{LABELLED} --masks masks -> --masks
{ODOMETRY} --plot {FRAMES}/../new.png -> new.png
{ODOMETRY} --tum kitti/sequences/00/../new.txt -> ../new.txt
{MASKS[:-3]}kitti/masks -> kitti/masks
study --kitti kitti --labels labels --output labels/study -> labels/study
odometry --kitti kitti --sequence 77 -> sequences/77
odometry --kitti kitti --sequence ../00 -> ../00
{STUDY} --widths 900 -> 900
{ODOMETRY} --fps 25 -> times.txt
check-data -> --kitti
check-data --kitti nowhere -> nowhere
synthesize mine --profile smoke -> mine
"""
# the same for options that are not those of the parser
MISUSED = f"""
nonsense -> 'nonsense'
odometry --kitti -> --kitti
odometry --frames=1.5 -> --frames
odometry --speed fast -> --speed
odometry --symmetric=yes -> --symmetric
study --widths 5-1 -> --widths
{STUDY} --jobs 0 -> --jobs
"""


@pytest.fixture
def check(folder, monkeypatch, capfd):
    """Give check(words, named), which runs a command in `folder` that must be refused."""

    def run(words, named, code=1, left=()):
        monkeypatch.chdir(folder)
        before = trials.snapshot(folder)
        capfd.readouterr()
        try:
            ended = main(shlex.split(words))
        except SystemExit as error:
            ended = error.code
        after = trials.changes(before, trials.snapshot(folder))
        trials.refused(trials.Result(ended, *capfd.readouterr(), after), named, code, left)

    return run


@pytest.mark.parametrize(
    "words, path, content",
    [
        pytest.param(words, path, content, id=f"{words.split()[0]} {path} {fault}")
        for words, path, faults in BROKEN
        for fault, content in faults.items()
    ],
)
def test_a_broken_file_is_named(words, path, content, folder, check):
    (folder / path).unlink(missing_ok=True)
    if content is not None:
        (folder / path).write_bytes(content)
    check(words, Path(path).name, left=["out", "out/*"])


@pytest.mark.parametrize("code, cases", [(1, REFUSED), (2, MISUSED)])
def test_a_wrong_option_is_named(code, cases, check):
    for case in cases.strip().splitlines():
        check(*case.split(" -> "), code)
