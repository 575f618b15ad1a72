"""The odometry against PySLAM's own runs, its rules for bad frames, and its named choices."""

from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError, keypoints, metrics, odometry, pose
from thesis_repro.files import read_gray
from thesis_repro.kitti import Sequence
from thesis_repro.odometry import PYSLAM_2024, THESIS, Odometry

CAMERA = np.array([[350.0, 0, 160], [0, 350.0, 60], [0, 0, 1]])
COUNTS = {"points": "n_kps_to_lk", "detected": "n_detected", "tracked": "n_tracked", "inliers": "n_inliers_E",
          "pose_inliers": "n_inliers_recoverPose"}


class Masks:
    def __init__(self, folder):
        self.folder = folder

    def __getitem__(self, index):
        return read_gray(self.folder / f"{index:06d}.png")


# Real frames against PySLAM


@pytest.mark.real
@pytest.mark.parametrize("run, sequence, frames, rmse, mae", [
    ("00", "00", 200, 1.700609, 0.705170), ("00_masked", "00", 200, 1.811076, 0.794264),
    ("06", "06", 51, 0.357133, 0.146225)])
def test_agrees_with_pyslam_on_every_frame(kitti_real, reference, run, sequence, frames, rmse, mae):
    expected = pd.read_csv(reference / f"{run}.csv")
    kitti = Sequence(kitti_real, sequence)
    masks = Masks(reference / "masks_00") if "masked" in run else None
    result = odometry.run(kitti, THESIS, masks)
    assert len(result.frames) == len(expected) == frames
    for ours, theirs in COUNTS.items():
        np.testing.assert_array_equal(result.frames[ours].to_numpy(float, na_value=np.nan), expected[theirs])
    rotation = [f"r{i}{j}" for i in range(3) for j in range(3)]
    np.testing.assert_allclose(result.frames[["x", "y", "z", *rotation]],
                               expected[["x", "y", "z", *rotation]], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.frames["scale"][1:], expected["gt_scale"][1:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(result.frames["updated"][1:], expected["pose_updated"][1:] == 1)
    assert metrics.rmse(result.poses, kitti.poses) == pytest.approx(rmse, abs=5e-7)
    assert metrics.mae(result.poses, kitti.poses) == pytest.approx(mae, abs=5e-7)
    assert result.flagged.empty


@pytest.mark.real
def test_agrees_with_the_later_pyslam(kitti_real):
    kitti = Sequence(kitti_real, "06")
    result = odometry.run(kitti, PYSLAM_2024)
    assert metrics.rmse(result.poses, kitti.poses, PYSLAM_2024.alignment) == pytest.approx(0.267954, abs=5e-7)


@pytest.mark.real
def test_an_excerpt_starts_where_the_truth_does(kitti_real):
    kitti = Sequence(kitti_real, "05")
    result = odometry.run(kitti)
    np.testing.assert_array_equal(result.poses[0], kitti.poses[0])
    assert metrics.rmse(result.poses, kitti.poses) == pytest.approx(0.1935, abs=5e-5)
