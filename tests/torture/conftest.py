"""Torture: kills, faults and bad input tried on purpose, by real commands run as processes.

`make test` runs the quick trials; those marked `torture` are run by `make torture` alone.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from trials import thesis

# the fit of notebook 4 on a few made-up images, as a command
TRAINING = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[1] / "segmentation")!r})
from thesis_repro import longrun, stages
from thesis_repro.segmentation import training
import test_training
try:
    folder = stages.stage(sys.argv[1], **training.made_from(*test_training.prepared()))
    test_training.train(folder, 3, pause=0.1)
except Exception as error:
    sys.exit(longrun.report_error(error))
"""


@pytest.fixture(scope="session")
def small_model(tmp_path_factory):
    """The thesis's network at 64x64 with 4 filters, untrained, as a file."""
    from thesis_repro.cityscapes import N_CLASSES
    from thesis_repro.segmentation.unet import build_unet

    path = tmp_path_factory.mktemp("model") / "model.keras"
    build_unet((64, 64, 1), N_CLASSES, 4).save(path)
    return path


@pytest.fixture
def words(small_world, small_labels, small_model):
    """words(name, output): a command that writes into `output`. "odometry.png" writes a plot there, and so on."""
    kitti = ["--kitti", small_world / "kitti"]
    frames = [*kitti, "--sequence", "00"]

    def command(name, output="out", labels=small_labels):
        options = {".txt": "--output", ".tum": "--tum", ".svg": "--plot", ".png": "--plot", ".mp4": "--video"}
        if name.startswith("odometry"):
            return thesis("odometry", *frames, options[name[-4:]], f"{output}{name[-4:]}")
        return {
            "synthesize": thesis("synthesize", output, "--profile", "smoke"),
            "training": [sys.executable, "-c", TRAINING, output],
            "predict": thesis("predict", "--images", small_world / "kitti/sequences/00", "--model", small_model,
                              "--output", output),
            "masks": thesis("masks", *frames, "--labels", small_labels / "00", "--dilation", 5, "--output", output),
            "study": thesis("study", *kitti, "--labels", labels, "--widths", 5, "--repetitions", 1, "--jobs", 2,
                            "--output", output)}[name]

    return command


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
