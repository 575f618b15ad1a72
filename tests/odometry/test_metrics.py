"""Trajectory errors, compared with values worked out by hand."""

import re

import numpy as np
import pytest
from made_up import winding
from scipy.spatial.transform import Rotation

from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics


def path(positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return poses


def ahead(count, factor=1.0, turn=0.0):
    """A straight path of `factor` metres and `turn` degrees a step."""
    poses = path([[0, 0, factor * z] for z in range(count)])
    poses[:, :3, :3] = Rotation.from_rotvec(
        [[0, turn * index, 0] for index in range(count)], degrees=True
    ).as_matrix()
    return poses


def test_rmse_and_mae_by_hand():
    true = path([[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 0, 3]])
    # off by (5, 5, 5) at frame 1, which does not count
    estimated = path([[9, 9, 9], [5, 5, 6], [5, 5, 10], [5, 2, 8]])
    # Differences from frame 1 on: (0, 0, 0), (0, 0, 3), (0, -3, 0)
    assert metrics.rmse(estimated, true) == pytest.approx(np.sqrt((0 + 9 + 9) / 3))
    assert metrics.mae(estimated, true) == pytest.approx((0 + 3 + 3) / 9)


def test_paths_of_different_or_no_length_are_refused():
    for estimated, true in ((ahead(3), ahead(2)), (ahead(1), ahead(1))):
        with pytest.raises(InputError):
            metrics.rmse(estimated, true)


def test_a_straight_path_cannot_be_aligned():
    assert np.isnan(metrics.ate(ahead(5), ahead(5), "se3"))
    assert metrics.ate(ahead(5), ahead(5)) == 0


def test_kitti_errors_by_hand():
    # 2 % too long on a straight line: 2 % translation error in every segment, no rotation error
    errors = metrics.kitti_errors(ahead(301, 1.02), ahead(301))
    # A segment ends at the first frame beyond its length: 101 m from 20 starts and 201 m from 10;
    # 301 m is too far.
    assert errors["t_rel"] == pytest.approx(
        100 * (20 * 0.02 * 101 / 100 + 10 * 0.02 * 201 / 200) / 30
    )
    assert errors["r_rel"] == pytest.approx(0, abs=1e-9)
    turning = metrics.kitti_errors(ahead(150, turn=0.01), ahead(150))
    assert turning["r_rel"] == pytest.approx(0.01 * 101)
    short = metrics.kitti_errors(ahead(100), ahead(100))
    assert np.isnan(short["t_rel"]) and np.isnan(short["r_rel"])


def test_errors_that_a_constant_rotation_of_the_camera_does_not_change():
    true, estimated, mounting = winding(), winding(seed=0), np.eye(4)
    mounting[:3, :3] = Rotation.from_euler("xyz", (2, -3, 1), degrees=True).as_matrix()
    turned = mounting @ estimated @ mounting.T
    assert abs(metrics.rmse(turned, true) - metrics.rmse(estimated, true)) > 0.1
    for alignment in ("se3", "sim3"):
        plain, after = (metrics.ate(poses, true, alignment) for poses in (estimated, turned))
        assert after == pytest.approx(plain)
    plain, after = (metrics.relative_errors(poses, true) for poses in (estimated, turned))
    for key in ("translation_percent", "rotation_deg_per_100m"):
        assert plain[key] > 0 and after[key] == pytest.approx(plain[key], rel=1e-3)


def test_relative_errors_by_hand():
    errors = metrics.relative_errors(ahead(31, 1.02), ahead(31))
    assert errors["translation_percent"] == pytest.approx(2, rel=1e-3)
    assert errors["rotation_deg_per_100m"] == pytest.approx(0, abs=1e-9)
    short = metrics.relative_errors(ahead(15), ahead(15))
    assert np.isnan(short["translation_percent"])


FLIPPED = ahead(9, 0.1)
FLIPPED[4:, :3, :3] = np.diag([-1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    "estimated, true, expected",
    [
        (winding(), winding(), {"failed": 0, "direction": 0, "rotation": 0, "lost": 0}),
        (ahead(9, turn=0.5), ahead(9), {"failed": 0, "rotation": 0.5, "lost": 0}),
        (ahead(9, turn=3.0), ahead(9), {"failed": 100}),
        (ahead(9, factor=-1.0), ahead(9), {"failed": 100}),
        # at walking pace no step is long enough to fail
        (FLIPPED, ahead(9, 0.1), {"failed": np.nan, "lost": 1}),
        # a camera in the hand turns more than a car, and the estimate follows it
        (ahead(9, turn=8.0), ahead(9, turn=8.0), {"lost": 0}),
        (ahead(9, turn=5.0), ahead(9), {"lost": 0}),
    ],
)
def test_errors_of_single_steps(estimated, true, expected):
    errors = metrics.step_errors(estimated, true)
    for name, value in expected.items():
        assert errors[name] == pytest.approx(value, abs=0.01, nan_ok=True), name


def test_a_small_angle_is_exact():
    small = 1e-4 * np.arange(1, 50)
    rotations = Rotation.from_rotvec(np.outer(small, [0, 1, 0]), degrees=True).as_matrix()
    assert metrics.angles(rotations) == pytest.approx(small, rel=1e-6)


def test_errors_of_a_run():
    true, estimated = winding(), winding(seed=0)
    errors = metrics.errors(estimated, true)
    assert list(errors) == ["rmse", "mae", "se3", "translation_percent", "rotation_deg_per_100m"]
    assert errors["se3"] == metrics.ate(estimated, true, "se3") < errors["rmse"]
    assert errors["rmse"] == metrics.rmse(estimated, true)
    assert metrics.errors(true[:5], true[:5])["rmse"] == 0


OPENGL = np.diag([1.0, -1, -1, 1])  # axes of a camera
AXES = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # x forward, z up


def quaternions(poses, order, sign=1):
    """Poses whose quaternions x, y, z, w are read in another order, or as their inverse."""
    read = np.array(poses)
    numbers = Rotation.from_matrix(poses[:, :3, :3]).as_quat() * [sign, sign, sign, 1]
    read[:, :3, :3] = Rotation.from_quat(numbers[:, order]).as_matrix()
    return read


@pytest.mark.parametrize(
    "change, kind",
    [
        (lambda poses: poses, None),
        (np.linalg.inv, "are world-to-camera poses; invert"),
        (lambda poses: poses[::-1], "in reverse order"),
        (lambda poses: OPENGL @ poses @ OPENGL, "diag(1, -1, -1, 1)"),
        (lambda poses: poses @ OPENGL, "diag(1, -1, -1, 1)"),
        (lambda poses: OPENGL @ np.linalg.inv(poses) @ OPENGL, "inv(poses) @ diag(1, -1, -1, 1)"),
        (lambda poses: quaternions(poses, [3, 0, 1, 2]), "w first"),
        (lambda poses: quaternions(poses, [1, 2, 3, 0]), "w last"),
        (lambda poses: quaternions(poses, [0, 1, 2, 3], -1), "invert the rotations"),
        (lambda poses: AXES @ poses @ AXES.T, "a body with other axes"),
        (lambda poses: poses[np.random.default_rng(0).permutation(len(poses))], "do not fit"),
    ],
)
def test_true_poses_that_are_not_the_cameras_are_told(change, kind):
    true = winding(60)
    estimated = true.copy()
    estimated[:, :3, 3] += np.random.default_rng(1).normal(0, 0.05, (60, 3))
    reason = metrics.foreign_poses(change(true), estimated)
    assert reason == "" if kind is None else kind in reason
    # a path of one camera without its scale
    path = np.array(change(true))
    path[:, :3, 3] *= 0.05
    told = metrics.foreign_poses(path, estimated)
    assert told == "" if kind is None else kind in told
    # what did not move, and too few steps, say nothing
    assert metrics.foreign_poses(change(true), np.tile(np.eye(4), (60, 1, 1))) == ""
    assert metrics.foreign_poses(change(true)[:9], estimated[:9]) == ""
    # steps that are too short alone count over a distance
    slow, slowly = winding(120), winding(120)
    slow[:, :3, 3] *= 0.1
    slowly[:, :3, 3] = 0.1 * slowly[:, :3, 3] + np.random.default_rng(1).normal(0, 0.002, (120, 3))
    assert metrics.travelled(slow)[-1] / 120 < 0.15
    told = metrics.foreign_poses(change(slow), slowly)
    assert told == "" if kind is None else kind in told


def test_poses_without_rotations_are_told():
    true = winding(60)
    positions = np.tile(np.eye(4), (60, 1, 1))
    positions[:, :3, 3] = true[:, :3, 3]
    turned = AXES @ positions @ AXES.T  # as of a satellite: east, north, up
    for poses in (positions, turned, turned @ AXES):
        assert "no rotations" in metrics.foreign_poses(poses, true)
    straight = np.tile(np.eye(4), (60, 1, 1))
    straight[:, 2, 3] = np.arange(60)
    assert metrics.foreign_poses(straight, straight) == ""  # a camera that does not turn


@pytest.mark.parametrize("shape", [(5, 3), (5, 3, 4), (5, 16)])
def test_paths_of_other_shapes_are_named(shape):
    for pair in ((np.zeros(shape), ahead(5)), (ahead(5), np.zeros(shape))):
        for error in (metrics.ate, metrics.rmse, metrics.errors):
            with pytest.raises(InputError, match=re.escape(f"{shape}")):
                error(*pair)
