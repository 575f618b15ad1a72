import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from thesis_repro.cli import build_parser, main
from thesis_repro.kitti import read_poses


def run(command, *options):
    return main([command, *map(str, options)])


def printed(capsys):
    return json.loads(capsys.readouterr().out)


def test_the_console_script_is_the_same_and_tells_its_version():
    script = Path(sys.executable).with_name("thesis-repro")
    assert script.is_file(), "install the package: make setup"
    outputs = [subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
               for command in ([script], [sys.executable, "-m", "thesis_repro"])]
    assert outputs[0] == outputs[1] == f"thesis-repro {metadata.version('thesis-repro')}\n"


def test_an_option_counts_only_in_full():
    commands = next(action for action in build_parser()._actions if action.dest == "command").choices
    assert not any(parser.allow_abbrev for parser in (build_parser(), *commands.values()))


def test_written_masks_are_read_by_the_odometry_and_give_the_same_path(small_world, small_labels, tmp_path):
    where = ["--kitti", small_world / "kitti", "--sequence", "00"]
    labels = ["--labels", small_labels / "00"]
    corrected = ["--boundaries", "exact", "--symmetric", "--without-movable", "--classes", "road", "--margin", 4]
    paths = []
    for name, options in (("thesis", []), ("corrected", corrected), ("inverse", ["--keep", "inverse"])):
        files = [tmp_path / f"{name}-{source}.txt" for source in ("masks", "labels")]
        assert run("masks", *where, *labels, "--dilation", 5, *options, "--output", tmp_path / name) == 0
        assert run("odometry", *where, "--masks", tmp_path / name, "--output", files[0]) == 0
        assert run("odometry", *where, *labels, "--dilation", 5, *options, "--output", files[1]) == 0
        assert files[0].read_bytes() == files[1].read_bytes()
        paths.append(files[0].read_bytes())
    assert len(set(paths)) == len(paths)
    assert sorted(path.name for path in (tmp_path / "thesis").glob("*.png")) == [f"{n:06d}.png" for n in range(12)]
    assert run("masks", *where, *labels, "--dilation", 1, 2, "--output", tmp_path / "both") == 0
    assert sorted(path.name for path in (tmp_path / "both").iterdir()) == ["mask1", "mask2"]


def test_odometry_writes_and_prints_one_path(small_world, tmp_path, capsys):
    poses, tum = tmp_path / "poses.txt", tmp_path / "path.tum"
    assert run("odometry", "--kitti", small_world / "kitti", "--sequence", "00", "--json", "--output", poses, "--tum",
               tum) == 0
    summary = printed(capsys)
    assert summary["frames"] == len(read_poses(poses)) == 12 and summary["rmse_m"] > 0
    positions = pd.read_csv(tum, sep=" ", header=None).to_numpy()[:, 1:4]
    assert np.array_equal(read_poses(poses)[:, :3, 3], positions)


def test_limited_and_masked_runs_use_fewer_keypoints(small_world, tmp_path, capsys):
    kitti, numbers = small_world / "kitti", []
    labels = kitti / "sequences" / "00" / "labels_0"
    (tmp_path / "masks").mkdir()
    for path in labels.glob("*.png"):
        half = np.zeros(cv2.imread(str(path), 0).shape, np.uint8)
        half[:, :half.shape[1] // 2] = 255
        cv2.imwrite(str(tmp_path / "masks" / path.name), half)
    for options in ((), ("--labels", labels, "--dilation", 3), ("--masks", tmp_path / "masks"),
                    ("--max-keypoints", 50)):
        assert run("odometry", "--kitti", kitti, "--sequence", "00", "--json", *options) == 0
        numbers.append(printed(capsys)["mean_keypoints"])
    assert numbers[0] > max(numbers[1:3]) and numbers[3] == 50


def test_jpeg_frames_without_truth_run_with_masks_named_png(tiny_kitti, tmp_path, capsys):
    (tiny_kitti / "poses/00.txt").unlink()
    (tmp_path / "labels").mkdir()
    for path in sorted((tiny_kitti / "sequences/00/image_0").glob("*.png")):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)))
        label_map = np.repeat([[7], [23]], 24, axis=0).repeat(64, axis=1).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "labels" / path.name), label_map)
        path.unlink()
    where = ["--kitti", tiny_kitti, "--sequence", "0"]
    assert run("masks", *where, "--labels", tmp_path / "labels", "--dilation", 9, "--output", tmp_path / "masks") == 0
    for options in (["--masks", tmp_path / "masks", "--plot", tmp_path / "path.png"], ["--speed", 7]):
        capsys.readouterr()
        assert run("odometry", *where, *options, "--json") == 0
        summary = printed(capsys)
        assert summary["rmse_m"] is None and summary["mae_m"] is None
    assert cv2.imread(str(tmp_path / "path.png")) is not None


def test_frames_without_any_keypoint_end_well(tiny_kitti, capsys):
    for path in (tiny_kitti / "sequences/00/image_0").iterdir():
        cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
    assert run("odometry", "--kitti", tiny_kitti, "--sequence", "00", "--json") == 0
    assert printed(capsys)["mean_keypoints"] == 0
