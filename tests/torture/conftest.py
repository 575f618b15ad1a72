"""Kills, faults and bad input, tried on real commands.

Trials marked `torture` are run by `make torture` alone.
"""

import cv2
import numpy as np
import pytest
from trials import ROOT, thesis


@pytest.fixture
def words(small_world, small_labels, tmp_path):
    """Give words(name, output), which returns a command that writes `output`."""
    kitti = small_world / "kitti"
    odometry = "odometry", "--kitti", kitti, "--sequence", "00"
    study = "study", "--kitti", kitti, "--labels", small_labels, "--widths", 5, "--jobs", 2
    make = "make", "-C", ROOT, "-o", "setup", "figures", "PROFILE=smoke"

    def command(name, output="out"):
        folder = tmp_path / output
        return {
            "path": thesis(*odometry, "--output", f"{output}/path.txt"),
            "study": thesis(*study, "--repetitions", 1, "--output", output),
            "figures": [*make, f"BUILD={folder}/build", f"FIGURES={folder}/figures"],
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
