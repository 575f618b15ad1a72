"""Bad input ends with an exit code, one line that names the file or option, and no new files.

The commands are called in the process of the tests.
"""

import io
import json
import pickle
import shlex
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import trials

from thesis_repro.command.cli import main

pytestmark = pytest.mark.slow

FRAMES = "kitti/sequences/00/image_0"
FRAME, POSES, CALIB, TIMES = (
    f"{FRAMES}/000002.png",
    "kitti/poses/00.txt",
    "kitti/sequences/00/calib.txt",
    "kitti/sequences/00/times.txt",
)
LABEL, MASK, IDENTITY = "labels/000002.png", "masks/000002.png", b"1 0 0 0 0 1 0 0 0 0 1 0\n"
ODOMETRY = "odometry --kitti kitti --sequence 00 --output out/path.txt"
LABELLED, MASKED = f"{ODOMETRY} --labels labels --dilation 3", f"{ODOMETRY} --masks masks"
MASKS = "masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output out"
STUDY = "study --kitti kitti --labels labels --output out"
PREDICT = "predict --images kitti/sequences/00 --output out"
MODEL = f"{PREDICT} --model a.keras"
NOISE = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)


@pytest.fixture
def inside(folder, monkeypatch, capfd):
    """Give inside(words), which runs a command in `folder` and returns a `trials.Result`."""

    def run(words):
        monkeypatch.chdir(folder)
        before = trials.snapshot(folder)
        capfd.readouterr()
        try:
            code = main(words)
        except SystemExit as ended:
            code = ended.code
        return trials.Result(
            code, *capfd.readouterr(), trials.changes(before, trials.snapshot(folder))
        )

    return run


def picture(pixels, ending=".png"):
    return cv2.imencode(ending, np.asarray(pixels))[1].tobytes()


def archive(config, weights=b""):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in (
            ("metadata.json", "{}"),
            ("config.json", json.dumps(config)),
            ("weights", weights),
        ):
            file.writestr(name, content)
    return buffer.getvalue()


def nan_model(path):
    import keras

    images = keras.Input((64, 64, 1))
    nan = keras.initializers.Constant(float("nan"))
    keras.Model(images, keras.layers.Conv2D(35, 1, kernel_initializer=nan)(images)).save(path)


# (command, file, {fault: content of the file, None if it is missing, or a function that makes it});
# the error names the file. More contents are in tests/test_readers.py and tests/test_files.py
BROKEN = [
    (
        ODOMETRY,
        FRAME,
        {
            "16 bits": picture(NOISE.astype(np.uint16)),
            "a folder": Path.mkdir,
            "a broken link": lambda path: path.symlink_to("/nowhere/000002.png"),
            "another size": picture(np.zeros((20, 20), np.uint8)),
        },
    ),
    (ODOMETRY, f"{FRAMES}/000000.png", {"1x1": picture([[7]])}),
    (
        LABELLED,
        LABEL,
        {
            "missing": None,
            "a JPEG": picture(NOISE % 30, ".jpg"),
            "colours": picture(np.full((9, 9, 3), (9, 7, 3), np.uint8)),
        },
    ),
    (MASKED, MASK, {"missing": None, "a label map": picture(NOISE % 30)}),
    (
        ODOMETRY,
        CALIB,
        {"missing": None, "another camera's": b"P0: 718.8 0 607.2 0 0 718.8 24 0 0 0 1 0\n"},
    ),
    (
        ODOMETRY,
        POSES,
        {
            "too few": IDENTITY * 3,
            "too many": IDENTITY * 5,
        },
    ),
    (ODOMETRY, TIMES, {"too few": b"0\n1\n"}),
    (
        MODEL,
        "a.keras",
        {
            "no numbers": nan_model,
            "a pickle": pickle.dumps({"a": 1}),
            "code": archive(
                {"module": "keras.layers", "class_name": "Lambda", "config": {"function": "x"}}
            ),
            "foreign": archive(
                {"module": "os", "class_name": "system", "config": {"command": "touch harmed"}}
            ),
        },
    ),
]
# command -> what the error names; the files are sound
REFUSED = [
    line.split(" -> ")
    for line in f"""
{ODOMETRY} --labels labels -> --labels
{ODOMETRY} --dilation 3 -> --dilation
{LABELLED} --invert -> --invert
{ODOMETRY} --camera image_9 -> 'image_9'
{ODOMETRY} --plot out/path.doc -> path.doc
{ODOMETRY} --tum {POSES} -> {POSES}
{LABELLED} --masks masks -> --masks
{ODOMETRY} --plot {FRAMES}/../new.png -> new.png
{ODOMETRY} --tum kitti/sequences/00/../new.txt -> ../new.txt
{MASKED} --video masks/new.mp4 -> masks/new.mp4
{MASKS[:-3]}kitti/masks -> kitti/masks
predict --images kitti/sequences/00 --output kitti/sequences/99 -> kitti/sequences/99
study --kitti kitti --labels labels --output labels/study -> labels/study
odometry --kitti kitti --sequence 77 -> sequences/77
odometry --kitti kitti --sequence ../00 -> ../00
{STUDY} --widths 900 -> 900
{ODOMETRY} --fps 25 -> times.txt
check-data -> --kitti
check-data --kitti nowhere -> nowhere
synthesize mine --profile smoke -> mine
odometry --kitti kitti --sequence 00 --spread 9 --max-keypoints 9 -> --spread
{LABELLED} --ids ids.csv -> ids.csv
""".strip().splitlines()
]
# command -> what the error names; the options are not those of the parser
MISUSED = [
    ("nonsense", "'nonsense'"),
    ("odometry --kitti", "--kitti"),
    ("odometry --frames=1.5", "--frames"),
    ("odometry --speed fast", "--speed"),
    ("odometry --symmetric=yes", "--symmetric"),
    ("study --widths 5-1", "--widths"),
    (f"{STUDY} --jobs 0", "--jobs"),
]


@pytest.mark.parametrize(
    "words, path, content",
    [
        pytest.param(words, path, content, id=f"{words.split()[0]} {path} {fault}")
        for words, path, faults in BROKEN
        for fault, content in faults.items()
    ],
)
def test_a_broken_file_is_named(words, path, content, folder, inside):
    (folder / path).unlink(missing_ok=True)
    if callable(content):
        content(folder / path)
    elif content is not None:
        (folder / path).write_bytes(content)
    trials.refused(
        inside(words.split()),
        Path(path).name,
        left=["out", "out/*"] if words in (MASKS, MODEL) else [],
    )


@pytest.mark.parametrize(
    "words, named, code", [*((*case, 1) for case in REFUSED), *((*case, 2) for case in MISUSED)]
)
def test_a_wrong_option_is_named(words, named, code, inside):
    trials.refused(inside(shlex.split(words)), named, code)
