"""Bad input by the real command line: one line that names the file or option and the remedy, and nothing left behind.

With `--torture` each command is a process of its own; the quick selection calls it in the tests' own process.
"""

import json
import pickle
import struct
import subprocess
import sys
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import trials

from thesis_repro.cli import build_parser, main
from thesis_repro.masks import forget_edges

ROOT = trials.ROOT
FRAME, POSES, CALIB, TIMES = ("kitti/sequences/00/image_0/000002.png", "kitti/poses/00.txt",
                              "kitti/sequences/00/calib.txt", "kitti/sequences/00/times.txt")
ODOMETRY = "odometry --kitti kitti --sequence 00 --output out/path.txt"
LABELLED = f"{ODOMETRY} --labels labels --dilation 3"
MASKED = f"{ODOMETRY} --masks masks"
STUDY = "study --kitti kitti --labels labels --repetitions 1 --jobs 1 --output out"
PREDICT = "predict --images kitti/sequences/00 --output out"


@pytest.fixture
def folder(tmp_path, tiny_kitti, tiny_cityscapes):
    """kitti, cityscapes, label maps and masks of sequence 00 by hand, and a file that is somebody's."""
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
def run(request, command, folder, monkeypatch, capfd):
    """Runs the command line in `folder`, see conftest's `command`; in this process where the trials are the quick ones.
    """
    if request.config.getoption("--torture"):
        return command

    def inside(*words, **environment):
        monkeypatch.chdir(folder)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        seen = trials.snapshot(folder)
        forget_edges()  # another test's file may have had the same path
        capfd.readouterr()
        try:
            code = main(list(map(str, words)))
        except SystemExit as ended:
            code = ended.code
        told = capfd.readouterr()
        left = sorted(map(str, trials.changed(seen, trials.snapshot(folder))))
        return trials.Result(code, told.out, told.err, left)

    return inside


# How files are harmed: functions of the folder


def text(name, content):
    return lambda folder: (folder / name).write_text(content)


def data(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def gone(name):
    return lambda folder: (folder / name).unlink()


def cut(name, count=30):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-count])


def image(name, picture, ending=".png"):
    return lambda folder: (folder / name).write_bytes(cv2.imencode(ending, np.asarray(picture))[1].tobytes())


def as_folder(name):
    def harm(folder):
        (folder / name).unlink()
        (folder / name).mkdir()
    return harm


def broken_link(name):
    def harm(folder):
        (folder / name).unlink()
        (folder / name).symlink_to("/nowhere/000002.png")
    return harm


def every_frame(picture):
    return lambda folder: [image(path.relative_to(folder), picture)(folder) for path in frames(folder)]


def frames(folder):
    return sorted((folder / FRAME).parent.glob("*.png"))


def png(width, height, bits, colour, body, interlaced=0, palette=b""):
    """A PNG file of any kind, its chunks' checksums right."""
    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, interlaced)
    chunks = [(b"IHDR", head), *([(b"PLTE", palette)] if palette else []), (b"IDAT", body), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*one) for one in chunks)


NOISE = np.random.default_rng(0).integers(0, 256, (48, 64), np.uint8)
ROWS = b"".join(b"\0" + row.tobytes() for row in NOISE)
BOMB = png(60_000, 60_000, 8, 0, zlib.compress(bytes(100_000)))
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@dataclass
class Case:
    """words: of the command. says: what its line must hold: the file or option, and a word of the remedy."""

    name: str
    words: str
    says: tuple
    harm: object = None
    left: tuple = ()
    short: bool = True  # whether the quick selection has it
    environment: tuple = ()


def briefly(words):
    """A command line without what most have in common."""
    for common in (LABELLED, MASKED, ODOMETRY, STUDY, PREDICT):
        words = words.replace(common, f"{common.split()[0]} ...")
    return words.replace(str(ROOT), "")


def of_kind(kind, words, *cases, **options):
    """Cases of one kind of file: (name, harm, says, ...)."""
    return [Case(f"{kind}: {name}", words, says, harm, **options) for name, harm, *says in cases]


def archive(parts):
    def harm(folder):
        with zipfile.ZipFile(folder / "a.keras", "w") as file:
            for name, content in parts.items():
                file.writestr(name, content)
    return harm


def hdf5(config):
    def harm(folder):
        with h5py.File(folder / "a.h5", "w") as file:
            if config:
                file.attrs["model_config"] = config
    return harm


def harmed_model(change):
    """The model in the package with other weights, in a whole archive."""
    def harm(folder):
        with zipfile.ZipFile(ROOT / SHIPPED) as whole:
            parts = {name: whole.read(name) for name in whole.namelist()}
        parts["model.weights.h5"] = change(parts["model.weights.h5"])
        archive(parts)(folder)
    return harm


def other_network(classes, size, value=0.0):
    """A network of one layer, made by Keras in a process of its own."""
    make = (f"import keras; a = keras.Input(({size}, {size}, 1)); "
            f"b = keras.layers.Conv2D({classes}, 1, kernel_initializer=keras.initializers.Constant({value}))(a); "
            "keras.Model(a, b).save('a.keras')").replace("(nan)", "(float('nan'))")
    return lambda folder: subprocess.run([sys.executable, "-c", make], cwd=folder, check=True, capture_output=True)


SHIPPED = "thesis_repro/segmentation/weights/streets.keras"

LAMBDA = {"metadata.json": "{}", "model.weights.h5": "", "config.json": json.dumps(
    {"module": "keras", "class_name": "Sequential", "config": {"layers": [
        {"module": "keras.layers", "class_name": "Lambda", "config": {"function": {"class_name": "__lambda__"}}}]}})}
FOREIGN = LAMBDA | {"config.json": json.dumps({"module": "os", "class_name": "system", "config": "touch harmed"})}
GRAY = np.zeros((48, 64), np.uint8)
CASES = [
    *of_kind(
        "image", ODOMETRY,
        ("truncated", cut(FRAME), FRAME, "truncated", "copy"),
        ("zero bytes", data(FRAME, b""), FRAME, "is empty", "copy"),
        ("text", text(FRAME, "hello"), FRAME, "not a PNG or JPEG", "copy"),
        ("16 bits", image(FRAME, NOISE.astype(np.uint16) * 256), FRAME, "16 bits", "convert"),
        ("a folder named like a frame", as_folder(FRAME), FRAME, "Is a directory", "check the file"),
        ("a broken link", broken_link(FRAME), FRAME, "/nowhere/000002.png, which does not exist", "check"),
        ("a decompression bomb", data(FRAME, BOMB), FRAME, "60000x60000", "take it away"),
        ("1x1, all of them", every_frame([[7]]), "000000.png", "1x1 pixels are too few", "needs 16 or more"),
        ("1x1, one of them", image(FRAME, [[7]]), FRAME, "1x1 pixels", "all frames must have one size"),
        ("another size midway", image(FRAME, np.zeros((20, 20), np.uint8)), FRAME, "20x20", "one size"),
        ("a flipped bit", lambda folder: data(FRAME, (raw := bytearray((folder / FRAME).read_bytes()), raw.__setitem__(
            500, raw[500] ^ 1))[0])(folder), FRAME, "truncated or corrupt", "copy"),
        ("another format under its name", image(FRAME, NOISE, ".bmp"), FRAME, "not a PNG or JPEG", "copy"),
        ("garbage with the right checksums", data(FRAME, png(64, 48, 8, 0, b"garbage" * 99)), FRAME, "corrupt", "copy"),
        ("no pixels", data(FRAME, png(0, 0, 8, 0, b"")), FRAME, "0x0 pixels", "take it away"),
        ("half a head", cut(FRAME, -20), FRAME, "copy"),
        ("no frame at all", lambda folder: [path.unlink() for path in frames(folder)], "image_0", "no PNG or JPEG"),
        ("PNG and JPEG", image("kitti/sequences/00/image_0/000004.jpg", GRAY, ".jpg"), "image_0", "move the others"),
    ),
    *of_kind(
        "numbering", ODOMETRY,
        ("a gap", gone(FRAME), FRAME, "is missing between 000001.png and 000003.png", "copy"),
        ("the first missing", gone("kitti/sequences/00/image_0/000000.png"), "000000.png", "one line a frame"),
        ("the last missing", gone("kitti/sequences/00/image_0/000003.png"), "000003.png", "one line a frame"),
        ("two of one number", image("kitti/sequences/00/image_0/2.png", GRAY), "000002.png", "take one of them away"),
    ),
    Case("numbering: a gap, masks", "masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output out",
         (FRAME, "is missing between"), gone(FRAME)),
    Case("numbering: a gap, study", STUDY, (FRAME, "is missing between"), gone(FRAME)),
    Case("numbering: a gap, plan", "plan --kitti kitti", (FRAME, "is missing between"), gone(FRAME)),
    Case("numbering: a gap, boresight", "boresight --kitti kitti --sequences 00", (FRAME, "is missing"), gone(FRAME)),
    Case("numbering: a gap, predict", PREDICT, (FRAME, "is missing between"), gone(FRAME), short=False),
    Case("numbering: a gap, check-data", "check-data --kitti kitti", ("000002.png is missing", "copy"), gone(FRAME)),
    Case("numbering: a gap, check-data --deep", "check-data --kitti kitti --deep", ("000002.png is missing", "copy"),
         gone(FRAME)),
    *of_kind(
        "label maps", LABELLED,
        ("one missing", gone("labels/000002.png"), "labels/000002.png", "every frame needs one"),
        ("all missing", lambda folder: [path.unlink() for path in (folder / "labels").iterdir()], "labels/000000.png",
         "4 of 4"),
        ("16 bits", image("labels/000002.png", np.full((9, 9), 7, np.uint16)), "labels/000002.png", "16 bits", "to 8"),
        ("colours", image("labels/000002.png", np.full((9, 9, 3), (9, 7, 3), np.uint8)), "labels/000002.png", "colours",
         "save the ids"),
        ("a palette", data("labels/000002.png", png(64, 48, 8, 3, zlib.compress(b"".join(
            b"\0" + bytes([1] * 64) for _ in range(48))), palette=bytes(range(9)))), "labels/000002.png", "palette",
         "save them"),
        ("one bit", data("labels/000002.png", png(64, 48, 1, 0, zlib.compress(bytes(9 * 48)))), "labels/000002.png",
         "1 bits a pixel", "save them"),
        ("ids out of range", image("labels/000002.png", np.full((9, 9), 200, np.uint8)), "labels/000002.png",
         "label id 200", "must hold Cityscapes label ids"),
        ("a JPEG under its name", image("labels/000002.png", np.full((9, 9), 7, np.uint8), ".jpg"), "labels/000002.png",
         "no PNG file", "8-bit gray PNG"),
        ("truncated", cut("labels/000002.png"), "labels/000002.png", "truncated", "copy"),
        ("empty", data("labels/000002.png", b""), "labels/000002.png", "is empty", "copy"),
    ),
    Case("label maps: no folder", LABELLED.replace("labels", "nowhere").replace("--nowhere", "--labels"),
         ("nowhere: no such folder", "one label map for each frame")),
    Case("label maps: one of them damaged, masks", "masks --kitti kitti --sequence 00 --labels labels --dilation 3 "
         "--output out", ("labels/000002.png", "truncated"), cut("labels/000002.png"), ("out", "out/*")),
    Case("label maps: the first out of range, study", STUDY, ("labels/000000.png", "label id 200"),
         image("labels/000000.png", np.full((9, 9), 200, np.uint8))),
    *of_kind(
        "calibration", ODOMETRY,
        ("missing", gone(CALIB), CALIB, "no such file", "copy"),
        ("no P0", text(CALIB, "P1: 50 0 32 0 0 50 24 0 0 0 1 0\n"), CALIB, "no line 'P0:'", "copy"),
        ("a short line", text(CALIB, "P0: 50 0 32\n"), CALIB, "12 finite numbers", "copy"),
        ("text", text(CALIB, "P0: a b c d e f g h i j k l\n"), CALIB, "12 finite numbers", "copy"),
        ("zeros", text(CALIB, "P0:" + " 0" * 12), CALIB, "positive focal lengths", "copy"),
        ("NaN", text(CALIB, "P0: nan 0 32 0 0 50 24 0 0 0 1 0\n"), CALIB, "12 finite numbers", "copy"),
        ("negative focal length", text(CALIB, "P0: -50 0 32 0 0 50 24 0 0 0 1 0\n"), CALIB, "positive", "copy"),
        ("skew", text(CALIB, "P0: 50 3 32 0 0 50 24 0 0 0 1 0\n"), CALIB, "without distortion and skew", "copy"),
        ("another camera's", text(CALIB, "P0: 718.8 0 607.2 0 0 718.8 185.2 0 0 0 1 0\n"), CALIB,
         "frames of 64x48", "take the file of these frames"),
        ("focal lengths in metres", text(CALIB, "P0: 0.004 0 32 0 0 0.004 24 0 0 0 1 0\n"), CALIB, "frames of 64x48",
         "take the file"),
        ("bytes", data(CALIB, bytes(range(256))), CALIB, "cannot be read as text", "check the file"),
        ("a folder", as_folder(CALIB), CALIB, "Is a directory", "check the file"),
    ),
    Case("calibration: another camera's, check-data", "check-data --kitti kitti", (CALIB, "take the file"),
         text(CALIB, "P0: 718.8 0 607.2 0 0 718.8 185.2 0 0 0 1 0\n")),
    *of_kind(
        "poses", ODOMETRY,
        ("NaN", text(POSES, IDENTITY.replace("1", "nan") * 4), POSES, "line 1", "12 finite numbers"),
        ("a short line", text(POSES, IDENTITY * 3 + "1 0 0\n"), POSES, "line 4", "12 finite numbers"),
        ("too few", text(POSES, IDENTITY * 3), POSES, "3 lines for 4 frames", "one line a frame"),
        ("too many", text(POSES, IDENTITY * 5), POSES, "5 lines for 4 frames", "000004.png", "one line a frame"),
        ("not rigid", text(POSES, IDENTITY * 2 + "2 0 0 0 0 1 0 0 0 0 1 0\n" * 2), POSES, "line 3", "no rotation",
         "damaged or in another form"),
        ("zeros", text(POSES, "0 0 0 0 0 0 0 0 0 0 0 0\n" * 4), POSES, "line 1", "no rotation"),
        ("left-handed", text(POSES, "-1 0 0 0 0 1 0 0 0 0 1 0\n" * 4), POSES, "left-handed", "x points to the right"),
        ("text", text(POSES, "here and there\n" * 4), POSES, "line 1", "12 finite numbers", "copy"),
        ("empty", text(POSES, ""), POSES, "is empty", "one line a frame"),
        ("in TUM's form", text(POSES, "0.0 0 0 0 0 0 0 1\n" * 4), POSES, "line 1", "12 finite numbers"),
        ("beyond the stars", text(POSES, "1 0 0 1e300 0 1 0 0 0 0 1 0\n" * 4), POSES, "no position", "damaged"),
        ("bytes", data(POSES, b"\xff\xfe" * 99), POSES, "cannot be read as text", "check the file"),
    ),
    *of_kind(
        "trajectory", "evaluate --kitti kitti --sequence 00 path.txt",
        ("missing", gone("path.txt"), "path.txt", "no such file", "check its name"),
        ("NaN", text("path.txt", IDENTITY.replace("1", "nan") * 4), "path.txt", "line 1", "12 finite numbers"),
        ("wrong count", text("path.txt", IDENTITY), "path.txt", "1 poses", "one a frame is needed"),
        ("left-handed", text("path.txt", "-1 0 0 0 0 1 0 0 0 0 1 0\n" * 4), "path.txt", "left-handed"),
        ("a folder", as_folder("path.txt"), "path.txt", "Is a directory", "check"),
        ("no truth", gone(POSES), POSES, "no such file", "without true poses"),
    ),
    *of_kind(
        "times", ODOMETRY,
        ("not rising", text(TIMES, "0\n0.1\n0.1\n0.2\n"), TIMES, "line 3", "does not increase", "copy"),
        ("text", text(TIMES, "0\nsoon\n1\n2\n"), TIMES, "line 2", "1 finite number", "copy"),
        ("too few", text(TIMES, "0\n1\n"), TIMES, "2 lines for 4 frames", "one line a frame"),
        ("NaN", text(TIMES, "0\nnan\n1\n2\n"), TIMES, "line 2", "1 finite number"),
        ("two columns", text(TIMES, "0 0\n1 1\n2 2\n3 3\n"), TIMES, "line 1", "1 finite number"),
        ("empty", text(TIMES, "\n\n"), TIMES, "is empty", "one line a frame"),
    ),
    *of_kind(
        "masks", MASKED,
        ("one missing", gone("masks/000002.png"), "masks/000002.png", "every frame needs one"),
        ("wrong size", image("masks/000002.png", np.zeros((9, 9), np.uint8)), "masks/000002.png", "9x9",
         "must have the size of the frames"),
        ("colour", image("masks/000002.png", np.dstack([NOISE, NOISE.T.reshape(48, 64), NOISE])), "masks/000002.png",
         "different values", "a mask has 0 and 255"),
        ("label maps", image("masks/000002.png", NOISE % 30), "masks/000002.png", "30 different values", "--labels"),
        ("16 bits", image("masks/000002.png", NOISE.astype(np.uint16)), "masks/000002.png", "16 bits", "convert"),
        ("truncated", cut("masks/000002.png"), "masks/000002.png", "truncated", "copy"),
    ),
    Case("masks: no folder", MASKED.replace("masks masks", "masks nowhere"), ("nowhere: no such folder", "one mask")),
    Case("masks: wrong size, study", STUDY.replace("labels", "masks"), ("masks/000002.png", "9x9"),
         image("masks/000002.png", np.zeros((9, 9), np.uint8))),
    # settings: the environment's variables, which make sets
    *[Case(f"setting: {name}={value[:20]}", "plan --kitti kitti", (name, remedy),
           environment=((f"THESIS_REPRO_{name}", value),))
      for name, value, remedy in (
          ("PROFILE", "huge", "choose one of smoke"), ("JOBS", "0", "1 or more"), ("JOBS", "²", "whole number"),
          ("JOBS", "999999999", "at most"), ("IMAGE_SIZE", "100", "multiple of 16"), ("IMAGE_SIZE", "9" * 30, "most"),
          ("BASE_FILTERS", "nan", "whole number"), ("BATCH_SIZE", "-1", "1 or more"), ("EPOCHS", "9" * 5000, "at most"),
          ("EPOCHS", "1.5", "whole number"), ("FRAMES", "4", "5 or more"), ("WIDTHS", "1-1000000000", "at most"),
          ("WIDTHS", "5-1", "such as 5,10"), ("WIDTHS", ",", "such as 5,10"), ("REPETITIONS", "0", "1 or more"),
          ("KITTI", "/nowhere", "no such folder"), ("CITYSCAPES", "mine/letter.txt", "no such folder"),
          ("EPOCH", "3", "unknown setting"))],
    # what single options may be
    *[Case(f"value: {briefly(words)}", words, says) for words, *says in (
        (f"{ODOMETRY} --labels labels --dilation 0", "dilation width 0", "1 or more"),
        (f"{ODOMETRY} --labels labels --dilation -5", "dilation width -5", "1 or more"),
        (f"{ODOMETRY} --labels labels --dilation 1000000000", "dilation width 1000000000", "at most"),
        (f"{ODOMETRY} --labels labels", "--labels", "needs --dilation"),
        (f"{ODOMETRY} --dilation 3", "--dilation", "needs --labels"),
        (f"{ODOMETRY} --labels labels --masks masks", "--masks", "not allowed with"),
        (f"{LABELLED} --margin -1", "margin=-1", "0 or more"),
        (f"{LABELLED} --margin 24", "margin=24", "at most 23"),
        (f"{LABELLED} --without-movable -1", "movable=-1", "0 or more"),
        (f"{LABELLED} --without-movable 1000000", "movable=1000000", "at most"),
        (f"{LABELLED} --classes motorway", "'motorway' is no label", "known are"),
        (f"{ODOMETRY} --margin 3", "--margin", "need --labels"),
        (f"{ODOMETRY} --max-keypoints -1", "max_keypoints: -1", "give 0 or more"),
        (f"{ODOMETRY} --max-keypoints 9999999999", "max_keypoints: 9999999999", "give less"),
        (f"{ODOMETRY} --estimator best", "pose: 'best'", "choose one of"),
        (f"{ODOMETRY} --detector sift", "detector: 'sift'", "choose one of"),
        (f"{ODOMETRY} --camera image_9", "camera 'image_9'", "choose one of"),
        (f"{ODOMETRY} --camera image_3", "image_3: no such folder", "must hold its frames there"),
        (f"{ODOMETRY} --speed 5", "speed", "give none"),
        (f"{ODOMETRY} --plot out/path.doc", "path.doc", "must end in one of"),
        (f"{ODOMETRY} --video out/path.avi", "path.avi", "must end in .mp4"),
        (f"{ODOMETRY} --tum out/path.txt", "--tum out/path.txt", "give each its own"),
        (f"{ODOMETRY} --tum mine", "mine: is a folder", "name a file"),
        (f"{ODOMETRY} --tum path.txt/path.tum", "path.txt is a file", "name another"),
        (f"{ODOMETRY} --tum kitti/poses/00.txt", "--tum kitti/poses/00.txt", "name another"),
        (f"{ODOMETRY} --tum {CALIB}", CALIB, "is an input", "name another"),
        (f"{ODOMETRY} --plot kitti/sequences/00/image_0/path.png", "--plot", "among the inputs", "another folder"),
        ("odometry --kitti kitti --sequence 77", "sequences/77", "must hold its frames"),
        ("odometry --kitti kitti --sequence ../00", "'../00'", "give one, such as 00"),
        ("odometry --kitti nowhere --sequence 00", "nowhere/sequences/00", "no such folder"),
        ("odometry --kitti path.txt --sequence 00", "path.txt/sequences/00", "no such folder"),
        ("odometry --sequence mine", "mine: holds no PNG or JPEG", "is empty"),
        ("masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output labels", "--output labels",
         "is the input", "another folder"),
        ("masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output kitti", "--output kitti",
         "holds the input", "another folder"),
        ("masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output mine", "mine", "did not make",
         "empty or new folder"),
        ("masks --kitti kitti --sequence 00 --labels labels --dilation 3 --output path.txt", "path.txt: is a file",
         "name a folder"),
        ("masks --kitti kitti --sequence 00 --labels labels --dilation 0 --output out", "dilation width 0", "1 or"),
        (f"{STUDY} --widths 0", "--widths 0", "1 or more"),
        (f"{STUDY} --widths 5000", "--widths 5000", "at most"),
        (f"{STUDY} --widths 500", "dilation width 500", "at most 128"),
        (f"{STUDY} --controls -3", "--controls -3", "1 or more"),
        (f"{STUDY} --controls 0", "--controls 0", "1 or more"),
        ("study --kitti kitti --labels labels --repetitions 0 --output out", "--repetitions 0", "1 or more"),
        ("study --kitti kitti --labels labels --repetitions 99999999 --output out", "--repetitions 99999999", "most"),
        (f"{STUDY} --frames 0", "--frames 0", "3 or more"),
        (f"{STUDY} --frames -1", "--frames -1", "3 or more"),
        ("study --kitti kitti --labels labels --jobs 0 --output out", "--jobs 0", "1 or more"),
        ("study --kitti kitti --labels labels --jobs 1000000 --output out", "--jobs 1000000", "at most"),
        (f"{STUDY} --sequences 00 00", "--sequences", "named twice"),
        (f"{STUDY} --sequences 77", "sequences/77", "no such folder"),
        (f"{STUDY} --sequences ../../00", "'../../00'", "give one, such as 00"),
        (f"{STUDY} --name a/b", "--name a/b", "may have letters"),
        (f"{STUDY} --name a --name b", "--name b", "one --name for each"),
        (f"{STUDY} --masks masks/../labels", "--name", "its own"),
        ("study --kitti kitti --output out", "no masks", "--labels or"),
        ("study --kitti kitti --labels nowhere --output out", "nowhere: no such folder", "must hold"),
        ("study --kitti kitti --masks masks --widths 3 --output out", "--widths", "only masks from label maps"),
        ("study --kitti kitti --labels labels --output labels", "--output", "is the input", "another folder"),
        ("study --kitti kitti --labels labels --output mine", "mine", "did not make", "empty or new folder"),
        ("study --kitti mine --labels labels --output out", "mine: holds no folder 'sequences'", "must name"),
        ("evaluate --kitti kitti --sequence 77 path.txt", "poses/77.txt", "no such file"),
        ("evaluate --kitti kitti --sequence 00 path.txt --plot path.doc", "path.doc", "must end in one of"),
        ("evaluate --kitti kitti --sequence 00 path.txt --plot mine/letter.txt/a.png", "letter.txt is a", "another"),
        ("boresight --kitti kitti --sequences 77", "sequences/77", "no such folder"),
        ("boresight --kitti nowhere --sequences 00", "nowhere", "no such folder"),
        ("plan --kitti kitti", "kitti", "too short", "6 frames or more"),
        ("plan --kitti kitti --cityscapes nowhere", "nowhere: no such folder", "must name"),
        ("synthesize path.txt", "path.txt: is a file", "name a folder"),
        ("synthesize mine --profile smoke", "mine", "did not make", "empty or new folder"),
        ("check-data", "nothing to check", "--kitti"),
        ("check-data --kitti path.txt", "path.txt", "holds no folder 'sequences'"),
        ("check-data --cityscapes mine", "mine: holds neither", "README"),
        ("check-data --kitti-semantic nowhere", "nowhere: no such folder", "must name"),
        ("nonsense", "'nonsense'", "choose from"),
        ("--nonsense", "COMMAND", "--help"),
        (f"{ODOMETRY} --nonsense", "--nonsense", "--help"),
    )],
    *[Case(f"value: {briefly(words)}{note}", words, says, harm, left=("out", "out/*"), short=not note)
      for words, note, harm, *says in (
        ("predict --images nowhere --output out", "", None, "nowhere: no such folder", "must name a folder"),
        ("predict --images path.txt --output out", "", None, "path.txt: no such folder", "must name a folder"),
        ("predict --images mine --output out", "", None, "mine: holds no PNG or JPEG"),
        ("predict --images labels mine/../labels --output out", "", None, "--images", "two commands"),
        ("predict --images labels --output labels", "", None, "--output labels", "is the input", "another folder"),
        ("predict --images kitti/sequences/00 --output kitti", "", None, "--output kitti", "holds the input"),
        (f"{PREDICT} --model nowhere.keras", "", None, "nowhere.keras", "no such model", "name another"),
        (f"{PREDICT} --model mine", "", None, "mine", "no such model", "name another"),
        (f"{PREDICT} --model out/a.keras", "", text("a.keras", ""), "out/a.keras", "holds the input"),
        (f"{PREDICT} --model empty.keras", "", data("empty.keras", b""), "empty.keras", "is empty", "copy it again"),
        (f"{PREDICT} --model path.txt", "", None, "path.txt", "neither an archive nor HDF5", "copy it again"),
        (f"{PREDICT} --model a.keras", "", data("a.keras", pickle.dumps({"a": 1})), "a.keras", "neither an archive"),
        (f"{PREDICT} --model a.keras", "", archive({"config.json": "{}"}), "a.keras", "metadata.json", "copy it again"),
        (f"{PREDICT} --model a.keras", "", archive(FOREIGN), "a.keras", "system of os", "not part of Keras"),
        (f"{PREDICT} --model a.keras", "", archive(LAMBDA), "a.keras", "holds code", "build the network without it"),
        (f"{PREDICT} --model a.h5", "", hdf5(LAMBDA["config.json"]), "a.h5", "holds code", "without it"),
        (f"{PREDICT} --model a.h5", "", hdf5(None), "a.h5", "not a model", "copy it again"),
        ("predict --images labels --output mine", " ", None, "mine", "did not make", "empty or new"),
        ("predict --images labels --output out --dask tcp://127.0.0.1:9", " ", None, "none answers there", "dask sche"),
        (PREDICT, ", cut", cut(FRAME), FRAME, "truncated", "copy"),
        (PREDICT, ", 16 bits", image(FRAME, NOISE.astype(np.uint16)), FRAME, "16 bits", "convert"),
        (f"{PREDICT} --model a.keras", ", truncated weights", harmed_model(lambda weights: weights[:-5000]), "a.keras",
         "not a model", "copy it again"),
        (f"{PREDICT} --model a.keras", ", of another network", other_network(10, 64), "a.keras", "(None, 64, 64, 10)",
         "name another model"),
        (f"{PREDICT} --model a.keras", ", not finite", other_network(35, 64, np.nan), "a.keras", "not finite", "anew"),
        (f"{PREDICT} --model a.keras {ROOT / SHIPPED}", ", of two sizes", other_network(35, 64), "take", "one"),
    )],
    *[Case(f"predict: a scheduler {address}", f"predict --images labels --output out --dask {address}",
           ("Dask scheduler", "tcp://host:port")) for address in ("nonsense", "inproc://1", "path.txt", "tcp://a:b")],
    Case("study: a scheduler that is none", f"{STUDY.replace(' --jobs 1', '')} --dask nonsense",
         ("Dask scheduler nonsense", "tcp://host:port"), left=("out", "out/*")),
]


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name, marks=[pytest.mark.short] * case.short)
                                  for case in CASES])
def test_bad_input_is_one_clear_line(case, folder, run, ledger):
    with ledger("bad inputs", case.name):
        if case.harm:
            case.harm(folder)
        result = run(*case.words.split(), **dict(case.environment))
        if case.words.startswith("check-data"):
            assert result.stderr.startswith(("wrong: ", "error: "))
        trials.clear(result, *case.says, left=case.left)


def parser_cases():
    """Each option of each command with what its kind of value cannot be: (words, says)."""
    commands = next(action for action in build_parser()._actions if action.dest == "command").choices
    for command, parser in commands.items():
        for action in parser._actions:
            if not action.option_strings or action.dest == "help":
                continue
            option = action.option_strings[-1]
            values = {int: ("many", "1.5", "nan", "1" + 30 * "0"), float: ("fast", "nan", "-inf")}.get(action.type, ())
            if action.type is Path:
                values = ("", " ")
            if action.choices:
                values = ("nonsense",)
            for value in values:
                yield [command, option, value], (option, )
            if action.nargs == 0:
                yield [command, f"{option}=yes"], (option,)
            elif action.nargs != "?":
                yield [command, option], (option, "expected")
            if type(action).__name__ == "_Once":
                value = next(iter(action.choices or ["3"]))
                count = action.nargs if isinstance(action.nargs, int) else 1
                yield [command, *([option, *[value] * count] * 2)], (option, "given twice")


@pytest.mark.short
def test_every_option_of_every_command_refuses_what_it_cannot_be(run, ledger):
    tried = list(parser_cases())
    assert len(tried) > 100
    for words, says in tried:
        with ledger("bad inputs", " ".join(words)):
            result = run(*words)
            assert result.returncode == 2
            trials.clear(result, *says, "--help")
