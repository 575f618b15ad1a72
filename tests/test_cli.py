import json
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from thesis_repro.cli import build_parser, main
from thesis_repro.trajectories import read_poses


def run(command, *options):
    return main([command, *map(str, options)])


def printed(capsys):
    return json.loads(capsys.readouterr().out)


COMMANDS = next(action for action in build_parser()._actions if action.dest == "command").choices


def test_the_console_script_prints_the_version():
    script = Path(sys.executable).with_name("thesis-repro")
    assert script.is_file(), "install the package: make setup"
    outputs = [
        subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
        for command in ([script], [sys.executable, "-m", "thesis_repro"])
    ]
    assert outputs[0] == outputs[1] == f"thesis-repro {metadata.version('thesis-repro')}\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_two_valid_examples_and_takes_no_abbreviations(name):
    examples = [shlex.split(line) for line in COMMANDS[name].epilog.splitlines()[1:]]
    assert (
        len(examples) == 2 and not COMMANDS[name].allow_abbrev and not build_parser().allow_abbrev
    )
    assert [build_parser().parse_args(words).command for _, *words in examples] == [name, name]


def test_forms_of_widths_and_frames():
    for words, widths in (
        (["1-3,10"], {1, 2, 3, 10}),
        (["5", "10"], {5, 10}),
        (["1-2", "4"], {1, 2, 4}),
    ):
        options = build_parser().parse_args(
            ["study", "--kitti", "a", "--output", "b", "--widths", *words]
        )
        assert set().union(*options.widths) == widths
    for text, frames in (("all", None), ("40", 40)):
        assert build_parser().parse_args(["evaluate", "a.txt", "--frames", text]).frames == frames
    for wrong in (
        ["evaluate", "a.txt", "--frames", "some"],
        ["study", "--kitti", "a", "--widths", "5-1"],
    ):
        with pytest.raises(SystemExit):
            main(wrong)


def test_written_masks_give_the_same_path_as_label_maps(small_world, small_labels, tmp_path):
    where = ["--kitti", small_world / "kitti", "--sequence", "00"]
    labels = ["--labels", small_labels / "00"]
    corrected = [
        "--boundaries",
        "exact",
        "--symmetric",
        "--without-movable",
        "--classes",
        "road",
        "--margin",
        4,
    ]
    paths = []
    for name, options in (
        ("thesis", []),
        ("corrected", corrected),
        ("inverse", ["--keep", "inverse"]),
    ):
        files = [tmp_path / f"{name}-{source}.txt" for source in ("masks", "labels")]
        assert (
            run("masks", *where, *labels, "--dilation", 5, *options, "--output", tmp_path / name)
            == 0
        )
        assert run("odometry", *where, "--masks", tmp_path / name, "--output", files[0]) == 0
        assert (
            run("odometry", *where, *labels, "--dilation", 5, *options, "--output", files[1]) == 0
        )
        assert files[0].read_bytes() == files[1].read_bytes()
        paths.append(files[0].read_bytes())
    assert len(set(paths)) == len(paths)
    assert sorted(path.name for path in (tmp_path / "thesis").glob("*.png")) == [
        f"{n:06d}.png" for n in range(12)
    ]
    assert (
        run(
            "masks",
            *where,
            *labels,
            "--dilation",
            "1-2",
            "--frames",
            5,
            "--output",
            tmp_path / "both",
        )
        == 0
    )
    assert [len(list((tmp_path / "both" / name).glob("*.png"))) for name in ("mask1", "mask2")] == [
        5,
        5,
    ]


def test_the_odometry_writes_poses_and_prints_a_summary(small_world, tmp_path, capsys):
    poses, tum, kitti = tmp_path / "poses.txt", tmp_path / "path.tum", small_world / "kitti"
    keypoints = []
    for options in (
        (),
        ("--labels", kitti / "sequences/00/labels_0", "--dilation", 3),
        ("--max-keypoints", 50),
    ):
        assert (
            run(
                "odometry",
                "--kitti",
                kitti,
                "--sequence",
                "00",
                "--json",
                "--frames",
                8,
                "--output",
                poses,
                "--tum",
                tum,
                *options,
            )
            == 0
        )
        out, err = capsys.readouterr()
        summary = json.loads(out)
        assert summary["frames"] == len(read_poses(poses)) == 8 and summary["rmse_m"] > 0
        assert str(poses) in err and str(tum) in err
        keypoints.append(summary["mean_keypoints"])
    assert keypoints[0] > keypoints[1] and keypoints[2] == 50
    positions = pd.read_csv(tum, sep=" ", header=None).to_numpy()[:, 1:4]
    assert np.array_equal(read_poses(poses)[:, :3, 3], positions)


def test_jpeg_frames_without_ground_truth_and_png_masks(tiny_kitti, tmp_path, capsys):
    (tiny_kitti / "poses/00.txt").unlink()
    (tmp_path / "labels").mkdir()
    for path in sorted((tiny_kitti / "sequences/00/image_0").glob("*.png")):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)))
        label_map = np.repeat([[7], [23]], 24, axis=0).repeat(64, axis=1).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "labels" / path.name), label_map)
        path.unlink()
    where = ["--kitti", tiny_kitti, "--sequence", "0"]
    assert (
        run(
            "masks",
            *where,
            "--labels",
            tmp_path / "labels",
            "--dilation",
            9,
            "--output",
            tmp_path / "masks",
        )
        == 0
    )
    for options in (
        ["--masks", tmp_path / "masks", "--plot", tmp_path / "path.png"],
        ["--speed", 7],
    ):
        capsys.readouterr()
        assert run("odometry", *where, *options, "--json") == 0
        summary = printed(capsys)
        assert summary["rmse_m"] is None and summary["mae_m"] is None
    assert cv2.imread(str(tmp_path / "path.png")) is not None


def test_frames_without_keypoints(tiny_kitti, capsys):
    for path in (tiny_kitti / "sequences/00/image_0").iterdir():
        cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
    assert run("odometry", "--kitti", tiny_kitti, "--sequence", "00", "--json") == 0
    assert printed(capsys)["mean_keypoints"] == 0
