"""Several trajectories against the truth, and that evo's own command-line tools find the same errors."""

import json
import logging
import re
import sys

import cv2
import numpy as np
import pytest
from evo.cli import entry_points

from thesis_repro import InputError
from thesis_repro.cli import main
from thesis_repro.kitti import write_kitti_poses, write_tum
from thesis_repro.odometry import metrics
from thesis_repro.report import trajectories

EVO = {"none": [], "se3": ["--align"], "sim3": ["--align", "--correct_scale"], "scale": ["--correct_scale"]}


def winding(count=160, seed=None, stretch=1.0):
    """A path with turns about all axes, and one metre a step; with a seed, noise in every step."""
    random, noise = np.random.RandomState(seed), seed is not None
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        turn = np.array([0.01 * np.sin(index), 0.03, 0.02 * np.cos(index)]) + noise * random.normal(0, 0.01, 3)
        poses[index] = poses[index - 1]
        poses[index, :3, :3] = poses[index - 1, :3, :3] @ cv2.Rodrigues(turn)[0]
        poses[index, :3, 3] += stretch * poses[index, :3, 2] + noise * random.normal(0, 0.05, 3)
    return poses


@pytest.fixture
def files(tmp_path):
    """A KITTI folder with the truth of sequence 07 alone, and two estimates of it."""
    write_kitti_poses(tmp_path / "poses/07.txt", winding())
    for name, seed, stretch in (("good", 1, 1.0), ("long", 2, 1.2)):
        write_kitti_poses(tmp_path / f"{name}.txt", winding(seed=seed, stretch=stretch))
    return tmp_path


def evaluate(files, *options):
    return main(["evaluate", "--kitti", str(files), "--sequence", "7", str(files / "good.txt"), str(files / "long.txt"),
                 *map(str, options)])


def evos(tool, *arguments, monkeypatch, capsys):
    """What evo prints, {"rmse": 0.123456, ...}."""
    logging.getLogger("evo").handlers.clear()  # those of the call before print elsewhere
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", [tool, *map(str, arguments)])
    getattr(entry_points, tool.removeprefix("evo_"))()
    return {name: float(value) for name, value in re.findall(r"(\w+)\t([0-9.e+-]+)", capsys.readouterr().out)}


@pytest.mark.slow
@pytest.mark.parametrize("alignment", EVO)
def test_the_numbers_are_those_of_evos_own_tools(files, alignment, monkeypatch, capsys):
    assert evaluate(files, "--align", alignment, "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["trajectory"] for row in rows] == ["good", "long"]
    for row in rows:
        given = ["kitti", files / "poses/07.txt", files / f"{row['trajectory']}.txt", *EVO[alignment]]
        ape = evos("evo_ape", *given, monkeypatch=monkeypatch, capsys=capsys)
        rpe = evos("evo_rpe", *given, monkeypatch=monkeypatch, capsys=capsys)
        turns = evos("evo_rpe", *given, "-r", "angle_deg", monkeypatch=monkeypatch, capsys=capsys)
        for key in ("rmse", "mean", "median", "max"):
            assert row[f"ate_{key}_m"] == pytest.approx(ape[key], abs=5.1e-7)  # evo prints six digits
            assert row[f"rpe_translation_{key}_m"] == pytest.approx(rpe[key], abs=5.1e-7)
            assert row[f"rpe_rotation_{key}_deg"] == pytest.approx(turns[key], abs=5.1e-7)


@pytest.mark.slow
def test_evo_reads_our_tum_files(files, monkeypatch, capsys):
    for name, poses in (("true", winding()), ("good", winding(seed=1))):
        write_tum(files / f"{name}.tum", poses, 0.1 * np.arange(len(poses)))
    printed = evos("evo_ape", "tum", files / "true.tum", files / "good.tum", monkeypatch=monkeypatch, capsys=capsys)
    assert metrics.ate(winding(seed=1), winding())["rmse"] == pytest.approx(printed["rmse"], abs=5.1e-7)


def test_the_thesiss_rmse_is_what_the_output_says_it_is(files, capsys):
    true, estimated = winding(), winding(seed=1)
    later = metrics.shifted(estimated, true)[1:]
    assert metrics.ate(later, true[1:])["rmse"] == pytest.approx(metrics.rmse(estimated, true))
    assert evaluate(files, "--align", "scale") == 0
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines() if line}
    assert rows["good"][0] == f"{metrics.rmse(estimated, true):.6f}"
    assert float(rows["long"][-1]) == pytest.approx(1 / 1.2, abs=0.02)


def test_a_picture_of_all_of_them(files):
    assert evaluate(files, "--plot", files / "both.svg") == 0
    drawn = (files / "both.svg").read_text()
    assert all(word in drawn for word in ("good", "long", "ground truth", "error along the way"))
    assert evaluate(files, "--plot", files / "both.png") == 0
    assert cv2.imread(str(files / "both.png")).shape[1] > 800


def test_what_cannot_be_compared_is_one_line(files, capsys):
    straight = np.tile(np.eye(4), (160, 1, 1))
    write_kitti_poses(files / "long.txt", straight)
    assert evaluate(files, "--align", "se3") == 0
    assert "long: " in capsys.readouterr().out.splitlines()[-1]  # the path that has no alignment
    write_kitti_poses(files / "long.txt", straight[:9])
    for options, named in (([], "long.txt: 9"), (["--plot", files / "both.doc"], "both.doc")):
        assert evaluate(files, *options) == 1
        assert named in capsys.readouterr().err
    assert main(["evaluate", "--kitti", str(files), "--sequence", "11", str(files / "good.txt")]) == 1
    assert "poses/11.txt" in capsys.readouterr().err
    with pytest.raises(InputError, match="alignment='sim'"):
        trajectories.evaluate({"good": winding()}, winding(), "sim")
