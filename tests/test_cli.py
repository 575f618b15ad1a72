import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

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
    commands = ("synthesize", "check-data", "predict", "masks", "odometry", "boresight", "evaluate", "study", "plan")
    assert all(command in text.stdout for command in commands)


def test_the_console_script_is_the_same_and_tells_its_version():
    script = Path(sys.executable).with_name("thesis-repro")
    assert script.is_file(), "install the package: make setup"
    told = [subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
            for command in ([script], [sys.executable, "-m", "thesis_repro"])]
    assert told[0] == told[1] == f"thesis-repro {metadata.version('thesis-repro')}\n"


def test_written_masks_are_read_by_the_odometry_and_give_the_same_path(small_world, small_labels, tmp_path, capsys):
    where = ["--kitti", small_world / "kitti", "--sequence", "00"]
    labels = ["--labels", small_labels / "00"]

    def masks(*options):
        return main(["masks", *map(str, [*where, *labels, *options])])

    assert masks("--dilation", 5, "--output", tmp_path / "mask5") == 0
    assert sorted(path.name for path in (tmp_path / "mask5").glob("*.png")) == [f"{n:06d}.png" for n in range(12)]
    assert odometry(*where, "--masks", tmp_path / "mask5", "--output", tmp_path / "one.txt") == 0
    assert odometry(*where, *labels, "--dilation", 5, "--output", tmp_path / "two.txt") == 0
    assert (tmp_path / "one.txt").read_bytes() == (tmp_path / "two.txt").read_bytes()
    assert masks("--dilation", 1, 2, "--boundaries", "exact", "--output", tmp_path / "both") == 0
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == ["mask1", "mask2"]
    corrected = ["--boundaries", "exact", "--symmetric", "--without-movable", "--classes", "road", "--margin", 4]
    assert masks("--dilation", 5, *corrected, "--output", tmp_path / "corrected") == 0
    assert odometry(*where, "--masks", tmp_path / "corrected", "--output", tmp_path / "one.txt") == 0
    assert odometry(*where, *labels, "--dilation", 5, *corrected, "--output", tmp_path / "three.txt") == 0
    assert (tmp_path / "one.txt").read_bytes() == (tmp_path / "three.txt").read_bytes()
    assert (tmp_path / "one.txt").read_bytes() != (tmp_path / "two.txt").read_bytes()
    capsys.readouterr()
    assert masks("--dilation", *range(1, 1000), "--output", tmp_path / "many") == 1
    assert "999 widths of 12 frames would be 11,988 files" in capsys.readouterr().err
    assert not (tmp_path / "many").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("mine")
    assert masks("--dilation", 5, "--output", tmp_path / "mine") == 1
    assert "did not make" in capsys.readouterr().err


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
    (["--sequence", "00", "--symmetric"], "--margin: need --labels"),
    (["--sequence", "00", "--labels", "somewhere", "--dilation", "3", "--margin", "-1"], "margin=-1: must be 0 or"),
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


def test_jpeg_frames_without_truth_run_with_masks_named_png(tiny_kitti, tmp_path, capsys):
    (tiny_kitti / "poses/00.txt").unlink()
    labels = tmp_path / "labels"
    labels.mkdir()
    for path in sorted((tiny_kitti / "sequences/00/image_0").glob("*.png")):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)))
        cv2.imwrite(str(labels / path.name), np.repeat([[7], [23]], 24, axis=0).repeat(64, axis=1).astype(np.uint8))
        path.unlink()
    where = ["--kitti", tiny_kitti, "--sequence", "0"]
    assert main(["masks", *map(str, where), "--labels", str(labels), "--dilation", "9", "--output",
                 str(tmp_path / "masks")]) == 0
    assert odometry(*where, "--masks", tmp_path / "masks", "--plot", tmp_path / "path.png", "--tum",
                    tmp_path / "path.tum") == 0
    told = capsys.readouterr().out
    assert "no truth to compare with" in told and "steps of 1 m a frame are assumed" in told and "RMSE" not in told
    assert cv2.imread(str(tmp_path / "path.png")) is not None
    assert odometry(*where, "--speed", 7, "--json", "--frames-csv", tmp_path / "frames.csv") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["rmse_m"] is None and summary["mae_m"] is None
    assert pd.read_csv(tmp_path / "frames.csv")["scale"].tolist() == pytest.approx([0, 0.7, 0.7, 0.7])


def test_a_wrong_ending_stops_the_run_before_it_begins(tiny_kitti, tmp_path, capsys):
    for option, says in (("--plot", "must end in one of"), ("--video", "must end in .mp4")):
        assert odometry("--kitti", tiny_kitti, "--sequence", "00", option, tmp_path / "out.doc") == 1
        assert says in capsys.readouterr().err


def test_the_shell_is_told_what_could_come_next(tmp_path):
    line = "thesis-repro evaluate --al"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "told"), "COMP_LINE": line,
             "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    subprocess.run([sys.executable, "-m", "thesis_repro"], env=os.environ | asked, check=True)
    assert (tmp_path / "told").read_text().strip() == "--align"


@pytest.mark.real
def test_the_errors_of_pyslam_on_real_frames(kitti_real, capsys):
    assert odometry("--kitti", kitti_real, "--sequence", "06", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert (round(summary["rmse_m"], 6), round(summary["mae_m"], 6)) == (0.357133, 0.146225)


def test_synthesize_refuses_a_folder_that_is_something_else(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("precious")
    assert main(["synthesize", str(tmp_path), "--profile", "smoke"]) == 1
    assert str(tmp_path) in capsys.readouterr().err and (tmp_path / "mine.txt").read_text() == "precious"
