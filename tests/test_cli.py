import json
import subprocess
import sys

import cv2
import numpy as np
import pandas as pd
import pytest

from thesis_repro.__main__ import main
from thesis_repro.kitti import read_poses


def odometry(*options):
    return main(["odometry", *map(str, options)])


def test_help_lists_the_commands():
    text = subprocess.run([sys.executable, "-m", "thesis_repro", "--help"], capture_output=True, text=True, check=True)
    assert all(command in text.stdout for command in ("synthesize", "check-data", "predict", "odometry"))


def test_odometry_writes_one_row_and_one_pose_a_frame(small_world, tmp_path, capsys):
    assert odometry("--kitti", small_world / "kitti", "--sequence", "00", "--json", "--output", tmp_path / "poses.txt",
                    "--frames-csv", tmp_path / "frames.csv") == 0
    summary = json.loads(capsys.readouterr().out)
    frames = pd.read_csv(tmp_path / "frames.csv")
    columns = ["frame", "detected", "tracked", "inliers", "scale", "x", "y", "z",
               *(f"r{i}{j}" for i in range(3) for j in range(3))]
    assert set(columns) <= set(frames.columns) and len(frames) == summary["frames"] == 12
    poses = read_poses(tmp_path / "poses.txt")
    assert np.array_equal(poses[:, :3, 3], frames[["x", "y", "z"]])
    assert summary["rmse_m"] > 0 and summary["mean_keypoints"] == frames["detected"].mean()


def test_limited_and_masked_runs_use_fewer_keypoints(small_world, tmp_path, capsys):
    kitti, numbers = small_world / "kitti", []
    labels = kitti / "sequences" / "00" / "labels_0"
    masks = tmp_path / "masks"
    masks.mkdir()
    for path in labels.glob("*.png"):
        half = np.zeros(cv2.imread(str(path), 0).shape, np.uint8)
        half[:, :half.shape[1] // 2] = 255
        cv2.imwrite(str(masks / path.name), half)
    for options in ((), ("--labels", labels, "--dilation", 3), ("--masks", masks), ("--max-keypoints", 50)):
        assert odometry("--kitti", kitti, "--sequence", "00", "--json", *options) == 0
        numbers.append(json.loads(capsys.readouterr().out)["mean_keypoints"])
    assert numbers[0] > max(numbers[1:3]) and numbers[3] == 50


@pytest.mark.parametrize("options, says", [
    (["--sequence", "77"], "77/image_0: no such folder"),
    (["--sequence", "00", "--labels", "somewhere"], "--labels: needs --dilation"),
    (["--sequence", "00", "--dilation", "3"], "--dilation: needs --labels"),
    (["--sequence", "00", "--masks", "nowhere"], "nowhere: no such folder"),
    (["--sequence", "00", "--max-keypoints", "-3"], "max_keypoints: -3 is below"),
])
def test_bad_input_is_one_line_and_nothing_is_written(small_world, tmp_path, capsys, options, says):
    output = tmp_path / "poses.txt"
    assert odometry("--kitti", small_world / "kitti", *options, "--output", output) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ") and says in error and "\n" not in error and not output.exists()


def test_a_damaged_frame_stops_the_run_before_anything_is_written(tiny_kitti, tmp_path, capsys):
    path = tiny_kitti / "sequences/00/image_0/000003.png"
    path.write_bytes(path.read_bytes()[:-20])
    assert odometry("--kitti", tiny_kitti, "--sequence", "00", "--frames-csv", tmp_path / "frames.csv") == 1
    assert "000003.png: the image is truncated" in capsys.readouterr().err and not (tmp_path / "frames.csv").exists()


@pytest.mark.real
def test_the_errors_of_pyslam_on_real_frames(kitti_real, capsys):
    assert odometry("--kitti", kitti_real, "--sequence", "06", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert (round(summary["rmse_m"], 6), round(summary["mae_m"], 6)) == (0.357133, 0.146225)


def test_synthesize_refuses_a_folder_that_is_something_else(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("precious")
    assert main(["synthesize", str(tmp_path), "--profile", "smoke"]) == 1
    assert str(tmp_path) in capsys.readouterr().err and (tmp_path / "mine.txt").read_text() == "precious"
