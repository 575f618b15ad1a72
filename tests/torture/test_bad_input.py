"""Bad input: an exit code that is not 0, one line that names the file or option, and nothing left behind.

What takes a process of its own (models that TensorFlow loads) is long; all else is called in the tests' own process.
"""

import json
import pickle
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import trials

from thesis_repro.cli import build_parser, main
from thesis_repro.masks import forget_edges

FRAMES = "kitti/sequences/00/image_0"
FRAME, POSES, CALIB, TIMES = (f"{FRAMES}/000002.png", "kitti/poses/00.txt", "kitti/sequences/00/calib.txt",
                              "kitti/sequences/00/times.txt")
LABEL, MASK, IDENTITY = "labels/000002.png", "masks/000002.png", "1 0 0 0 0 1 0 0 0 0 1 0\n"
ODOMETRY = "odometry --kitti kitti --sequence 00 --output out/path.txt"
LABELLED, MASKED = f"{ODOMETRY} --labels labels --dilation 3", f"{ODOMETRY} --masks masks"
MASKS = "masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output out"
STUDY, STUDY_ALL = "study --kitti kitti --labels labels --output out", "study --kitti kitti --output out"
EVALUATE, PREDICT = "evaluate --kitti kitti --sequence 00 path.txt", "predict --images kitti/sequences/00 --output out"
MODEL, CHECK = f"{PREDICT} --model a.keras", "check-data --kitti kitti"
NOISE = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)


@pytest.fixture
def folder(tmp_path, tiny_kitti, tiny_cityscapes):
    """kitti, cityscapes, label maps and masks of sequence 00, and a file that is somebody's."""
    for name, picture in (("labels", np.repeat([[7], [23]], 16, axis=0).repeat(40, axis=1)),
                          ("masks", np.repeat([[0, 255]], 48, axis=0).repeat(32, axis=1))):
        (tmp_path / name).mkdir()
        for index in range(4):
            cv2.imwrite(str(tmp_path / name / f"{index:06d}.png"), picture.astype(np.uint8))
    (tmp_path / "path.txt").write_text((tiny_kitti / "poses/00.txt").read_text())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("mine")
    return tmp_path


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


def flipped(path):
    data = bytearray(path.read_bytes())
    data[500] ^= 1
    path.write_bytes(data)


def as_folder(path):
    path.unlink()
    path.mkdir()


def broken_link(path):
    path.unlink()
    path.symlink_to("/nowhere/000002.png")


def holding(content):
    return lambda path: path.write_bytes(content if isinstance(content, bytes) else content.encode())


def image(picture, ending=".png"):
    return holding(cv2.imencode(ending, np.asarray(picture))[1].tobytes())


def archive(**parts):
    def harm(path):
        with zipfile.ZipFile(path, "w") as file:
            for name, content in parts.items():
                file.writestr(name.replace("_json", ".json"), content)
    return harm


def layer(module, name, **config):
    return json.dumps({"module": module, "class_name": name, "config": config})


def calibration(fx="50", skew="0", u="32", fy="50"):
    return holding(f"P0: {fx} {skew} {u} 0 0 {fy} 24 0 0 0 1 0\n")


# (command, file, {what is broken: how}); the error names the file
BROKEN = [
    (ODOMETRY, FRAME, {
        "truncated": cut, "empty": holding(""), "text": holding("hello"), "a flipped bit": flipped,
        "16 bits": image(NOISE.astype(np.uint16)), "a BMP": image(NOISE, ".bmp"), "a folder": as_folder,
        "a broken link": broken_link, "another size": image(np.zeros((20, 20), np.uint8)), "missing": Path.unlink,
        "a bomb": holding(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\xea\x60\0\0\xea\x60\x08\0\0\0\0\xc5\xa4\x12\x7e")}),
    *[(words, FRAME, {"missing": Path.unlink})
      for words in (MASKS, STUDY, "plan --kitti kitti", "boresight --kitti kitti --sequences 00", CHECK, PREDICT)],
    (ODOMETRY, f"{FRAMES}/000000.png", {"missing": Path.unlink, "1x1": image([[7]])}),
    (ODOMETRY, f"{FRAMES}/000003.png", {"missing": Path.unlink}),
    (ODOMETRY, f"{FRAMES}/2.png", {"a number twice": image(NOISE)}),
    (LABELLED, LABEL, {
        "missing": Path.unlink, "16 bits": image(np.full((9, 9), 7, np.uint16)), "truncated": cut, "empty": holding(""),
        "colours": image(np.full((9, 9, 3), (9, 7, 3), np.uint8)), "unknown ids": image(np.full((9, 9), 200, np.uint8)),
        "a JPEG": image(NOISE % 30, ".jpg")}),
    (MASKED, MASK, {
        "missing": Path.unlink, "another size": image(np.zeros((9, 9), np.uint8)), "a label map": image(NOISE % 30),
        "16 bits": image(NOISE.astype(np.uint16)), "truncated": cut}),
    (STUDY_ALL + " --masks masks", MASK, {"another size": image(np.zeros((9, 9), np.uint8))}),
    (ODOMETRY, CALIB, {
        "missing": Path.unlink, "no P0": holding("P1: 1\n"), "short": holding("P0: 50 0 32\n"), "a folder": as_folder,
        "NaN": calibration("nan"), "negative": calibration("-50"), "skew": calibration(skew="3"),
        "another camera's": calibration("718.8", u="607.2", fy="718.8"), "bytes": holding(bytes(range(256)))}),
    (CHECK, CALIB, {"another camera's": calibration("718.8", u="607.2", fy="718.8")}),
    (ODOMETRY, POSES, {
        "NaN": holding(IDENTITY.replace("1", "nan") * 4), "too few": holding(IDENTITY * 3), "empty": holding(""),
        "too many": holding(IDENTITY * 5), "not rigid": holding(IDENTITY.replace("1", "2") * 4),
        "left-handed": holding("-" + IDENTITY * 4), "TUM's form": holding("0.0 0 0 0 0 0 0 1\n" * 4),
        "beyond the stars": holding("1 0 0 1e300 0 1 0 0 0 0 1 0\n" * 4), "bytes": holding(b"\xff\xfe" * 99)}),
    (EVALUATE, "path.txt", {"missing": Path.unlink, "too few": holding(IDENTITY)}),
    (EVALUATE, POSES, {"missing": Path.unlink}),
    (ODOMETRY, TIMES, {
        "not rising": holding("0\n0.1\n0.1\n0.2\n"), "text": holding("0\nsoon\n1\n2\n"), "too few": holding("0\n1\n"),
        "two columns": holding("0 0\n1 1\n2 2\n3 3\n"), "empty": holding("\n\n")}),
    (MODEL, "a.keras", {
        "empty": holding(""), "a pickle": holding(pickle.dumps({"a": 1})), "half": archive(config_json="{}"),
        "code": archive(metadata_json="{}", config_json=layer("keras.layers", "Lambda", function="x")),
        "foreign": archive(metadata_json="{}", config_json=layer("os", "system", command="touch harmed"))}),
]
# (command, what the error names): the folder is sound
REFUSED = [line.split(" -> ") for line in f"""
{ODOMETRY} --labels labels --dilation 0 -> width 0
{ODOMETRY} --labels labels -> --labels
{ODOMETRY} --dilation 3 -> --dilation
{ODOMETRY} --margin 3 -> --margin
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
odometry --sequence mine -> mine
{MASKS[:-3]}labels -> --output labels
{MASKS[:-3]}kitti -> --output kitti
{MASKS[:-3]}mine -> mine
{STUDY} --widths 5000 -> 5000
{STUDY} --sequences 00 00 -> --sequences
{STUDY} --dask nonsense -> nonsense
{STUDY[:-3]}mine -> mine
{STUDY_ALL} -> --labels
boresight --kitti nowhere --sequences 00 -> nowhere
plan --kitti kitti --cityscapes nowhere -> nowhere
synthesize mine --profile smoke -> mine
check-data -> --kitti
predict --images nowhere --output out -> nowhere
predict --images mine --output out -> mine
predict --images labels mine/../labels --output out -> --images
predict --images labels --output labels -> --output labels
predict --images labels --output out --dask inproc://1 -> inproc://1
{PREDICT} --model nowhere.keras -> nowhere.keras
""".strip().splitlines()]


@pytest.mark.short
@pytest.mark.parametrize("words, path, harm", [
    pytest.param(words, path, harm, id=f"{words.split()[0]} {path} {what}")
    for words, path, harms in BROKEN for what, harm in harms.items()])
def test_a_broken_file_is_named(words, path, harm, folder, inside, ledger):
    with ledger("bad inputs", f"{words}: {path}"):
        harm(folder / path)
        trials.refused(inside(words.split()), Path(path).name, left=["out", "out/*"] if words == MASKS else [])


@pytest.mark.short
@pytest.mark.parametrize("words, named", REFUSED)
def test_what_cannot_be_run_is_named(words, named, inside, ledger):
    with ledger("bad inputs", words):
        trials.refused(inside(words.split()), named)


@pytest.mark.parametrize("words, path, harm", [
    (PREDICT, FRAME, cut), (MODEL, "a.keras", "10, 64"), (MODEL, "a.keras", "35, 64, float('nan')")])
def test_what_takes_tensorflow_to_notice_is_named(words, path, harm, folder, ledger):
    make = ("import keras; classes, size, *value = {}; start = keras.initializers.Constant(*value); "
            "a = keras.Input((size, size, 1)); b = keras.layers.Conv2D(classes, 1, kernel_initializer=start)(a); "
            "keras.Model(a, b).save('a.keras')")
    if callable(harm):
        harm(folder / path)
    else:
        trials.succeed([sys.executable, "-c", make.format(harm)], folder)
    with ledger("bad inputs", f"{words}: {path}"):
        trials.refused(trials.run(trials.thesis(*words.split()), folder), path, left=["out", "out/*"])


def misused_options():
    """Each option of each command with what its kind of value cannot be: (words, option)."""
    commands = next(action for action in build_parser()._actions if action.dest == "command").choices
    for command, parser in commands.items():
        for action in parser._actions:
            if not action.option_strings or action.dest == "help":
                continue
            option, values = action.option_strings[-1], ()
            if action.choices or action.type in (int, float, Path):
                values = {int: ("many", "1.5"), float: ("fast",), Path: ("",)}.get(action.type, ("nonsense",))
            yield from (([command, option, value], option) for value in values)
            if action.nargs != "?":
                yield [command, f"{option}=yes" if action.nargs == 0 else option], option
    yield from ((words.split(), named) for words, named in (
        ("nonsense", "'nonsense'"), (f"{ODOMETRY} --nonsense", "--nonsense"), (f"{LABELLED} --masks masks", "--masks"),
        (f"{STUDY} --jobs 0", "--jobs")))


@pytest.mark.short
def test_every_option_of_every_command_refuses_what_it_cannot_be(inside, ledger):
    cases = list(misused_options())
    assert len(cases) > 80
    for words, option in cases:
        with ledger("bad inputs", " ".join(words)):
            trials.refused(inside(words), option, code=2)
