"""Bad input: an exit code that is not 0, one line that names the file or option, and nothing left behind.

The commands are called in the tests' own process.
"""

import json
import os
import pickle
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import trials

from thesis_repro.cli import build_parser, main
from thesis_repro.masks import forget_edges

pytestmark = pytest.mark.slow

FRAMES = "kitti/sequences/00/image_0"
FRAME, POSES, CALIB, TIMES = (f"{FRAMES}/000002.png", "kitti/poses/00.txt", "kitti/sequences/00/calib.txt",
                              "kitti/sequences/00/times.txt")
LABEL, MASK, IDENTITY = "labels/000002.png", "masks/000002.png", "1 0 0 0 0 1 0 0 0 0 1 0\n"
ODOMETRY = "odometry --kitti kitti --sequence 00 --output out/path.txt"
LABELLED, MASKED = f"{ODOMETRY} --labels labels --dilation 3", f"{ODOMETRY} --masks masks"
MASKS = "masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output out"
STUDY, STUDY_ALL = "study --kitti kitti --labels labels --output out", "study --kitti kitti --output out"
EVALUATE, PREDICT = "evaluate --kitti kitti --sequence 00 path.txt", "predict --images kitti/sequences/00 --output out"
MODEL = f"{PREDICT} --model a.keras"
NOISE = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)


@pytest.fixture
def inside(folder, monkeypatch, capfd):
    """Runs the command line in `folder` and in this process; returns a `trials.Result`."""
    def run(words):
        monkeypatch.chdir(folder)
        before = trials.snapshot(folder)
        forget_edges()  # another test's file may have had the same path
        capfd.readouterr()
        try:
            code = main(words)
        except SystemExit as ended:
            code = ended.code
        return trials.Result(code, *capfd.readouterr(), trials.changes(before, trials.snapshot(folder)))

    return run


# How a file is harmed: functions of its path


def cut(path):
    path.write_bytes(path.read_bytes()[:-30])


def as_folder(path):
    path.unlink()
    path.mkdir()


def as_pipe(path):
    path.unlink()
    os.mkfifo(path)


def broken_link(path):
    path.unlink()
    path.symlink_to("/nowhere/000002.png")


def holding(content):
    return lambda path: path.write_bytes(content if isinstance(content, bytes) else content.encode())


def image(picture, ending=".png"):
    return holding(cv2.imencode(ending, np.asarray(picture))[1].tobytes())


def archive(**parts):
    def harm(path):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            for name, content in parts.items():
                file.writestr(name.replace("_json", ".json"), content)
    return harm


def nan_model(path):
    import keras

    images = keras.Input((64, 64, 1))
    nan = keras.initializers.Constant(float("nan"))
    keras.Model(images, keras.layers.Conv2D(35, 1, kernel_initializer=nan)(images)).save(path)


def layer(module, name, **config):
    return json.dumps({"module": module, "class_name": name, "config": config})


# (command, file, {what is broken: how}); the error names the file. What else a file may hold: tests of each reader
BROKEN = [
    (ODOMETRY, FRAME, {
        "truncated": cut, "16 bits": image(NOISE.astype(np.uint16)), "a BMP": image(NOISE, ".bmp"),
        "a folder": as_folder, "a broken link": broken_link, "a pipe": as_pipe,
        "another size": image(np.zeros((20, 20), np.uint8)),
        "a bomb": holding(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\xea\x60\0\0\xea\x60\x08\0\0\0\0\xc5\xa4\x12\x7e")}),
    *[(words, FRAME, {"missing": Path.unlink})
      for words in (ODOMETRY, MASKS, STUDY, "plan --kitti kitti", "boresight --kitti kitti --sequences 00", PREDICT)],
    (ODOMETRY, f"{FRAMES}/000000.png", {"missing": Path.unlink, "1x1": image([[7]])}),
    (ODOMETRY, f"{FRAMES}/000003.png", {"missing": Path.unlink}),
    (ODOMETRY, f"{FRAMES}/2.png", {"a number twice": image(NOISE)}),
    (LABELLED, LABEL, {
        "missing": Path.unlink, "16 bits": image(np.full((9, 9), 7, np.uint16)), "truncated": cut,
        "colours": image(np.full((9, 9, 3), (9, 7, 3), np.uint8)), "unknown ids": image(np.full((9, 9), 200, np.uint8)),
        "a JPEG": image(NOISE % 30, ".jpg")}),
    (MASKED, MASK, {"missing": Path.unlink, "a label map": image(NOISE % 30), "truncated": cut}),
    (STUDY_ALL + " --masks masks", MASK, {"another size": image(np.zeros((9, 9), np.uint8))}),
    (ODOMETRY, CALIB, {
        "missing": Path.unlink, "no P0": holding("P1: 1\n"), "a folder": as_folder, "bytes": holding(bytes(range(256))),
        "another camera's": holding("P0: 718.8 0 607.2 0 0 718.8 24 0 0 0 1 0\n")}),
    (ODOMETRY, POSES, {
        "too few": holding(IDENTITY * 3), "too many": holding(IDENTITY * 5), "left-handed": holding("-" + IDENTITY * 4),
        "TUM's form": holding("0.0 0 0 0 0 0 0 1\n" * 4),
        "beyond the stars": holding("1 0 0 1e300 0 1 0 0 0 0 1 0\n" * 4)}),
    (EVALUATE, "path.txt", {"missing": Path.unlink, "too few": holding(IDENTITY)}),
    (EVALUATE, POSES, {"missing": Path.unlink}),
    (ODOMETRY, TIMES, {"too few": holding("0\n1\n"), "two columns": holding("0 0\n1 1\n2 2\n3 3\n")}),
    (MODEL, "a.keras", {
        "no numbers": nan_model,
        "a pickle": holding(pickle.dumps({"a": 1})),
        "code": archive(metadata_json="{}", config_json=layer("keras.layers", "Lambda", function="x")),
        "a bomb": archive(metadata_json="{}", config_json="{}", weights=bytes(300_000_000)),
        "foreign": archive(metadata_json="{}", config_json=layer("os", "system", command="touch harmed"))}),
]
# (command, what the error names): the folder is sound
REFUSED = [line.split(" -> ") for line in f"""
{ODOMETRY} --labels labels -> --labels
{ODOMETRY} --dilation 3 -> --dilation
{ODOMETRY} --masks nowhere -> nowhere
{LABELLED} --classes motorway -> 'motorway'
{ODOMETRY} --max-keypoints -1 -> max_keypoints: -1
{ODOMETRY} --estimator best -> 'best'
{ODOMETRY} --camera image_9 -> 'image_9'
{ODOMETRY} --speed 5 -> speed
{ODOMETRY} --plot out/path.doc -> path.doc
{ODOMETRY} --video out/path.avi -> path.avi
{ODOMETRY} --tum out/path.txt -> --tum out/path.txt
{ODOMETRY} --tum path.txt/path.tum -> path.txt
{ODOMETRY} --tum {POSES} -> --tum {POSES}
{ODOMETRY} --plot {FRAMES}/path.png -> --plot
odometry --kitti kitti --sequence 77 -> sequences/77
odometry --kitti kitti --sequence ../00 -> '../00'
{MASKS[:-3]}labels -> --output labels
{MASKS[:-3]}mine -> mine
{STUDY} --widths 5000 -> 5000
{STUDY} --dask nonsense -> nonsense
{STUDY[:-3]}mine -> mine
{STUDY_ALL} -> --labels
plan --kitti kitti --cityscapes nowhere -> nowhere
synthesize mine --profile smoke -> mine
predict --images mine --output out -> mine
predict --images labels mine/../labels --output out -> --images
predict --images labels --output labels -> --output labels
predict --images labels --output out --dask inproc://1 -> inproc://1
{PREDICT} --model nowhere.keras -> nowhere.keras
""".strip().splitlines()]


@pytest.mark.parametrize("words, path, harm", [
    pytest.param(words, path, harm, id=f"{words.split()[0]} {path} {what}")
    for words, path, harms in BROKEN for what, harm in harms.items()])
def test_a_broken_file_is_named(words, path, harm, folder, inside):
    harm(folder / path)
    trials.refused(inside(words.split()), Path(path).name, left=["out", "out/*"] if words in (MASKS, MODEL) else [])


@pytest.mark.parametrize("words, named", REFUSED)
def test_what_cannot_be_run_is_named(words, named, inside):
    trials.refused(inside(words.split()), named)


def test_every_option_of_every_command_refuses_what_it_cannot_be(inside):
    """Exit code 2, and the option is named: without its value, and with what its kind of value cannot be."""
    commands = next(action for action in build_parser()._actions if action.dest == "command").choices
    options = [(command, action) for command, parser in commands.items() for action in parser._actions
               if action.option_strings and action.dest != "help"]
    assert len(options) > 40
    for command, action in options:
        option, wrong = action.option_strings[-1], {int: "1.5", float: "fast", Path: ""}.get(action.type, "nonsense")
        cases = [[command, f"{option}=yes" if action.nargs == 0 else option]] if action.nargs != "?" else []
        if action.choices or action.type in (int, float, Path):
            cases.append([command, option, wrong])
        for words in cases:
            trials.refused(inside(words), option, code=2)
    for words, named in ((["nonsense"], "'nonsense'"), (f"{LABELLED} --masks masks".split(), "--masks"),
                         (f"{STUDY} --jobs 0".split(), "--jobs")):
        trials.refused(inside(words), named, code=2)
