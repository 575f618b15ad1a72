"""The boresight is estimated from finished runs and removed from them."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesis_repro import InputError
from thesis_repro.cli import main
from thesis_repro.odometry.refined import boresight
from thesis_repro.odometry.refined.boresight import corrected, rotation
from thesis_repro.trajectories import read_poses

KNOWN = np.array([0.4, -0.6, 0.3])  # pitch, yaw, roll in degrees


def drive(steps=200, turning=0.02, start=None, seed=3):
    """Paths (estimated, ground truth) of a car that turns to both sides; the estimate is noisy."""
    random = np.random.default_rng(seed)
    paths = [[np.eye(4) if start is None else start] for _ in range(2)]
    for index in range(steps):
        turn = turning * np.sin(index / 15)
        for noise, path in zip((1, 0), paths, strict=True):
            motion = np.eye(4)
            motion[:3, :3] = Rotation.from_rotvec(
                [0, turn, 0] + noise * random.normal(0, 3e-4, 3)
            ).as_matrix()
            motion[:3, 3] = np.array([1.1 * turn, -0.02, 1]) + noise * random.normal(0, 5e-3, 3)
            path.append(path[-1] @ motion)
    return tuple(np.array(path) for path in paths)


def test_a_corrected_path_has_each_of_its_motions_turned():
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = rotation((10, 20, 30)), (1, 2, 3)
    poses, _ = drive(20, start=start)
    b = rotation(KNOWN)
    ahead, right = b @ [0, 0, 1], rotation((0, 0, 1.0)) @ [1, 0, 0]
    assert ahead[0] < 0 and ahead[1] < 0 < right[1]  # forward turns left and up, right turns down
    after = corrected(poses, KNOWN)
    assert after[0] == pytest.approx(start)
    before, motion = (np.linalg.inv(path[:-1]) @ path[1:] for path in (poses, after))
    assert motion[:, :3, :3] == pytest.approx(b @ before[:, :3, :3] @ b.T)
    assert motion[:, :3, 3] == pytest.approx(before[:, :3, 3] @ b.T)
    with pytest.raises(InputError):
        corrected(poses, (0, float("nan"), 0))


@pytest.mark.parametrize("seed", (1, 2, 3))
def test_a_known_rotation_is_recovered_within_its_intervals(seed):
    estimated, true = drive(seed=seed)
    result = boresight.estimate([(estimated, corrected(true, KNOWN))])
    assert (result.low < KNOWN).all() and (KNOWN < result.high).all() and result.steps == 200
    assert (result.high - result.low < 0.5).all() and result.angles == pytest.approx(
        KNOWN, abs=0.12
    )


def test_failed_steps_do_not_count_much():
    estimated, true = drive()
    broken = estimated.copy()
    for index in (30, 90, 91, 150):  # a motion to the side with a wrong turn
        wrong = np.eye(4)
        wrong[:3, :3], wrong[:3, 3] = rotation((0, 5.0, 0)), (0.3, 0, 0)
        broken[index:] = (
            broken[index - 1] @ wrong @ np.linalg.inv(estimated[index - 1]) @ estimated[index:]
        )
    result = boresight.estimate([(broken, corrected(true, KNOWN))])
    assert result.angles == pytest.approx(KNOWN, abs=0.15)


def test_too_little_motion_leaves_angles_undetermined():
    straight = boresight.estimate([drive(turning=0)])
    assert (
        np.isnan(straight.angles[2])
        and np.isnan(straight.low[2])
        and np.isfinite(straight.angles[:2]).all()
    )
    assert straight.usable[2] == 0
    assert np.isnan(boresight.estimate([drive(5)]).angles).all()


def test_the_table_compares_errors_with_and_without_the_boresight():
    paths = {}
    for seed, name in enumerate(("04", "05", "00")):
        estimated, true = drive(seed=seed)
        paths[name] = estimated, corrected(true, KNOWN)
    table = boresight.explained(paths).set_index("sequence")
    assert table["others"].to_dict() == {"04": "05", "05": "04", "00": ""}
    assert (table["rmse_own"] < table["rmse"] / 2).all()
    assert (table["rmse_others"].dropna() < table["rmse"].dropna()[:2] / 2).all() and np.isnan(
        table.loc["00", "rmse_others"]
    )
    assert (table[["camera_sway", "truth_sway"]] > 0).any().all()


def test_the_commands_estimate_and_apply(small_world, tmp_path, capsys):
    kitti = ["--kitti", str(small_world / "kitti")]
    assert main(["boresight", *kitti, "--sequences", "00", "01", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert set(record["sequences"]) == {"00", "01"}
    assert set(record["angles"]) == set(boresight.ANGLES) and record["steps"] > 0
    assert all(
        (angle["degrees"] is None) == (angle["low"] is None) for angle in record["angles"].values()
    )
    assert main(["boresight", *kitti, "--sequences", "00", "01"]) == 0
    assert {"pitch", "yaw", "roll", "rmse_own", "truth_sway"} <= set(
        capsys.readouterr().out.split()
    )
    raw, turned = tmp_path / "raw.txt", tmp_path / "turned.txt"
    summaries = []
    for options in (
        ["--output", str(raw)],
        ["--output", str(turned), "--boresight", *map(str, KNOWN)],
    ):
        assert main(["odometry", *kitti, "--sequence", "00", "--json", *options]) == 0
        summaries.append(json.loads(capsys.readouterr().out))
    assert read_poses(turned) == pytest.approx(corrected(read_poses(raw), KNOWN), abs=1e-12)
    assert summaries[0]["rmse_m"] != summaries[1]["rmse_m"]
    assert summaries[0]["ate_se3_m"] == pytest.approx(summaries[1]["ate_se3_m"], abs=1e-6)
