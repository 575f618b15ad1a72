"""Kills, faults and bad input, tried on real commands.

Trials marked `torture` are run by `make torture` alone.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from trials import thesis

ROOT = Path(__file__).parents[2]
# the training of tests/segmentation/test_training.py as a command
TRAINING = f"""
import sys
sys.path[:0] = {[str(ROOT / "tests/segmentation"), str(ROOT / "tools")]!r}
from thesis_repro.running import messages, results
from thesis_repro.segmentation import training
import test_training
def main():
    folder = results.stage(sys.argv[1], **training.made_from(*test_training.prepared()))
    test_training.train(folder, 3, pause=0.1)
messages.run_main(main)
"""


@pytest.fixture
def words(small_world, small_labels, small_model):
    """Give words(name, output), which returns a command that writes `output`.

    The ending of "odometry.png" says which output it is.
    """
    kitti = small_world / "kitti"
    options = {".txt": "--output", ".png": "--plot", ".webm": "--video"}

    def command(name, output="out"):
        if name.startswith("odometry"):
            return thesis(
                "odometry",
                "--kitti",
                kitti,
                "--sequence",
                "00",
                options[Path(name).suffix],
                f"{output}{Path(name).suffix}",
            )
        return {
            "synthesize": thesis("synthesize", output, "--profile", "smoke"),
            "training": [sys.executable, "-c", TRAINING, output],
            "predict": thesis(
                "predict",
                "--images",
                kitti / "sequences/00",
                "--model",
                small_model,
                "--output",
                output,
            ),
            "study": thesis(
                "study",
                "--kitti",
                kitti,
                "--labels",
                small_labels,
                "--widths",
                5,
                "--repetitions",
                1,
                "--jobs",
                2,
                "--output",
                output,
            ),
        }[name]

    return command


@pytest.fixture
def folder(tmp_path, tiny_kitti, tiny_cityscapes):
    """A folder with data and results of sequence 00, and with a letter of the user's own."""
    for name, picture in (
        ("labels", np.repeat([[7], [23]], 16, axis=0).repeat(40, axis=1)),
        ("masks", np.repeat([[0, 255]], 48, axis=0).repeat(32, axis=1)),
    ):
        (tmp_path / name).mkdir()
        for index in range(4):
            cv2.imwrite(str(tmp_path / name / f"{index:06d}.png"), picture.astype(np.uint8))
    (tmp_path / "path.txt").write_text((tiny_kitti / "poses/00.txt").read_text())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("mine")
    return tmp_path
