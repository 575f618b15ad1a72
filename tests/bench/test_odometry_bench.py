"""The bench: what it measures is there and is a ratio of what it says."""

import json

import cv2
import numpy as np
import pytest
from street import Street

from thesis_repro import odometry
from thesis_repro.bench import odometry as bench_odometry

pytestmark = pytest.mark.slow


@pytest.fixture
def kitti(tmp_path):
    """The street of noise in KITTI's layout, four frames."""
    drive, root = Street(4), tmp_path / "kitti"
    images = root / "sequences" / "00" / "image_0"
    images.mkdir(parents=True)
    for index in range(4):
        cv2.imwrite(str(images / f"{index:06d}.png"), drive.frame(index))
    projection = np.hstack([drive.intrinsics, np.zeros((3, 1))])
    (root / "sequences" / "00" / "calib.txt").write_text("P0: " + " ".join(map(str, projection.ravel())) + "\n")
    (root / "sequences" / "00" / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    (root / "poses").mkdir()
    np.savetxt(root / "poses" / "00.txt", drive.poses[:, :3].reshape(4, 12))
    return root


def test_the_bench_measures_what_it_says(kitti, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bench_odometry, "WIDTHS", (5, 15))
    assert bench_odometry.main(["--kitti", str(kitti), "--output", str(tmp_path / "bench.json")]) == 0
    result = json.loads((tmp_path / "bench.json").read_text())
    assert result["machine"]["opencv"] == cv2.__version__
    step = result["step, one thread"]
    assert step["frames"] == 3
    assert step["ratio"] == pytest.approx(step["step_ms"] / step["bare_ms"], rel=0.5)
    assert set(step["bare_by_call_ms"]) == {"track", "essential", "pose", "detect"}
    shared = result["shared pass, one core"]
    assert shared["runs"] == 4 and shared["same_bits"]
    assert shared["cpu_ratio"] == pytest.approx(shared["shared_ms"]["cpu"] / shared["separate_ms"]["cpu"])
    assert result["keypoints"]["500"]["tracked"] < result["keypoints"]["1000"]["tracked"]
    assert result["runs in one pass"]["1"]["ratio_to_one"] == 1
    assert f"ratio {step['ratio']:.3f}" in capsys.readouterr().out


def test_the_bare_calls_are_what_a_step_does(kitti):
    drive = Street(4)
    follower = odometry.Odometry(drive.intrinsics)
    follower.step(drive.frame(0))
    calls = bench_odometry.bare_calls(follower.previous, drive.frame(1), follower.points, drive.intrinsics)
    step = follower.step(drive.frame(1), 0.4)
    assert calls["track"]()[1].sum() == len(step.current)
    assert calls["essential"]()[1].sum() == step.inliers.sum()
    assert calls["pose"]()[0] == step.motion.pose_inliers
    assert len(calls["detect"]()) == step.detected


def test_a_bad_folder_is_one_clear_line(tmp_path, capsys):
    assert bench_odometry.main(["--kitti", str(tmp_path), "--output", str(tmp_path / "bench.json")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and not (tmp_path / "bench.json").exists()
