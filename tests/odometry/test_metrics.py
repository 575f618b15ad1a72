"""Trajectory errors against cases worked by hand."""

import cv2
import numpy as np
import pytest
from evo.core import geometry
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from evo.tools import file_interface

from thesis_repro import InputError
from thesis_repro.kitti import write_kitti_poses, write_tum
from thesis_repro.odometry import metrics
from thesis_repro.odometry.refined.boresight import turned


def path(positions):
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, 3] = positions
    return poses


def test_rmse_and_mae_by_hand():
    true = path([[0, 0, 0], [0, 0, 1], [0, 0, 2], [0, 0, 3]])
    estimated = path([[9, 9, 9], [5, 5, 6], [5, 5, 10], [5, 2, 8]])  # off by (5, 5, 5) at frame 1, which does not count
    # Differences from frame 1 on: (0, 0, 0), (0, 0, 3), (0, -3, 0)
    assert metrics.rmse(estimated, true) == pytest.approx(np.sqrt((0 + 9 + 9) / 3))
    assert metrics.mae(estimated, true) == pytest.approx((0 + 3 + 3) / 9)


def test_pose_alignment_takes_a_turned_start_out():
    true = path([[0, 0, 0], [0, 0, 1], [0, 0, 2]])
    turn = np.array([[0, 0, 1.0, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    estimated = turn @ true
    assert metrics.rmse(estimated, true, "position") == pytest.approx(1.0)  # (1, 0, 0) for (0, 0, 1) on one of two
    assert metrics.rmse(estimated, true, "pose") == pytest.approx(0.0, abs=1e-12)


def test_percent_change_is_negative_where_smaller():
    assert metrics.percent_change(3.0, 4.0) == pytest.approx(-25.0)
    assert metrics.percent_change(5.0, 4.0) == pytest.approx(25.0)


def test_paths_that_cannot_be_compared():
    with pytest.raises(InputError, match="3 poses and the true one 2"):
        metrics.rmse(path(np.zeros((3, 3))), path(np.zeros((2, 3))))
    with pytest.raises(InputError, match="at least 2 frames"):
        metrics.mae(path([[0, 0, 0]]), path([[0, 0, 0]]))


def winding(count=60, step=1.0):
    """A path with turns about all axes."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        turn = cv2.Rodrigues(np.array([0.01 * np.sin(index), 0.06, 0.02 * np.cos(index)]))[0]
        poses[index] = poses[index - 1]
        poses[index, :3, :3] = poses[index - 1, :3, :3] @ turn
        poses[index, :3, 3] += step * poses[index, :3, 2]
    return poses


def drifted(poses, seed=0):
    """The same path with noise in every step."""
    random = np.random.RandomState(seed)
    result = poses.copy()
    for index in range(1, len(poses)):
        step = np.linalg.inv(poses[index - 1]) @ poses[index]
        step[:3, :3] = step[:3, :3] @ cv2.Rodrigues(random.normal(0, 0.01, 3))[0]
        step[:3, 3] += random.normal(0, 0.05, 3)
        result[index] = result[index - 1] @ step
    return result


def test_ate_leaves_what_the_alignment_allows():
    true = winding()
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.5, -0.2]))[0]
    turn[:3, 3] = 3, 0, 4
    moved = np.linalg.inv(turn) @ true
    larger = moved.copy()
    larger[:, :3, 3] /= 1.25
    assert metrics.ate(true + [[0, 0, 0, 3.0], [0, 0, 0, 0], [0, 0, 0, 4.0], [0, 0, 0, 0]], true)["rmse"] == (
        pytest.approx(5.0))
    assert metrics.ate(moved, true)["rmse"] > 1
    assert metrics.ate(moved, true, "se3")["rmse"] == pytest.approx(0, abs=1e-9)
    assert metrics.ate(larger, true, "se3")["rmse"] > 1
    similar = metrics.ate(larger, true, "sim3")
    assert similar["rmse"] == pytest.approx(0, abs=1e-9) and similar["scale"] == pytest.approx(1.25)


@pytest.mark.parametrize("alignment, scale", [("se3", False), ("sim3", True)])
def test_aligned_ate_is_the_least_squares_of_umeyama(alignment, scale):
    true = winding()
    estimated = drifted(true)
    rotation, shift, factor = geometry.umeyama_alignment(estimated[:, :3, 3].T, true[:, :3, 3].T, with_scale=scale)
    aligned = factor * estimated[:, :3, 3] @ rotation.T + shift
    expected = np.sqrt(((aligned - true[:, :3, 3]) ** 2).sum(axis=1).mean())
    assert expected > 0.1
    assert metrics.ate(estimated, true, alignment)["rmse"] == pytest.approx(expected)


def test_a_path_that_fixes_no_alignment_says_so():
    straight = path([[0, 0, z] for z in range(5)])
    result = metrics.ate(straight, straight, "se3")
    assert np.isnan(result["rmse"]) and "straight" in result["note"]
    assert metrics.ate(straight, straight)["rmse"] == 0


def test_rpe_by_hand():
    true = path([[0, 0, z] for z in range(5)])
    estimated = path([[0, 0, 1.5 * z] for z in range(5)])
    result = metrics.rpe(estimated, true)
    assert result["translation_rmse"] == pytest.approx(0.5) and result["rotation_max"] == pytest.approx(0)
    for index in range(5):
        estimated[index, :3, :3] = cv2.Rodrigues(np.array([0, np.radians(2.0) * index, 0]))[0]
    assert metrics.rpe(estimated, true)["rotation_median"] == pytest.approx(2.0)


def test_rpe_and_raw_ate_are_evos():
    true = winding()
    estimated = drifted(true)
    paths = [PosePath3D(poses_se3=list(some)) for some in (true, estimated)]
    error = evo_metrics.RPE(evo_metrics.PoseRelation.translation_part, 1, Unit.frames, all_pairs=True)
    error.process_data(tuple(paths))
    assert metrics.rpe(estimated, true)["translation_rmse"] == pytest.approx(error.get_all_statistics()["rmse"])
    raw = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    raw.process_data(tuple(paths))
    assert metrics.ate(estimated, true)["max"] == pytest.approx(raw.get_all_statistics()["max"])


def test_kitti_errors_by_hand():
    # 2 % too long on a straight line: 2 % translation error in every segment, no rotation error
    true = path([[0, 0, z] for z in range(301)])
    estimated = path([[0, 0, 1.02 * z] for z in range(301)])
    errors = metrics.kitti_errors(estimated, true)
    segments = metrics.kitti_segments(estimated, true)
    # a segment ends at the first frame beyond its length: 101, 201 and 301 m (one too far for the last)
    assert segments.groupby("length").size().to_dict() == {100: 20, 200: 10}
    assert errors["segments"] == 30 and errors["note"] == ""
    assert errors["translation_percent"] == pytest.approx(
        100 * (20 * 0.02 * 101 / 100 + 10 * 0.02 * 201 / 200) / 30)
    assert errors["rotation_deg_per_m"] == pytest.approx(0, abs=1e-9)


def test_kitti_rotation_error_by_hand():
    # turned by 0.01 degrees more every metre, where the truth does not turn
    true = path([[0, 0, z] for z in range(150)])
    estimated = true.copy()
    for index in range(150):
        estimated[index, :3, :3] = cv2.Rodrigues(np.array([0, np.radians(0.01) * index, 0]))[0]
    assert metrics.kitti_errors(estimated, true)["rotation_deg_per_m"] == pytest.approx(0.01 * 101 / 100)


def test_a_path_too_short_for_kittis_segments_says_so():
    short = path([[0, 0, z] for z in range(100)])
    errors = metrics.kitti_errors(short, short)
    assert np.isnan(errors["translation_percent"]) and np.isnan(errors["rotation_deg_per_m"])
    assert errors["note"] == "too short: 99.0 m, the shortest segment is 100 m" and errors["segments"] == 0


def test_relative_errors_do_not_know_a_constant_rotation_between_the_frames():
    true = winding()
    estimated = drifted(true)
    angles = (2.0, -3.0, 1.0)
    plain, moved = (metrics.relative_errors(some, true, 10) for some in (estimated, turned(estimated, angles)))
    for key in ("translation_percent", "rotation_deg_per_m"):
        assert plain[key] > 0 and moved[key] == pytest.approx(plain[key], rel=1e-3)
    assert metrics.relative_errors(turned(true, angles), true, 10)["translation_percent"] < 0.01
    assert metrics.rmse(turned(true, angles), true) > 0.1


def test_relative_errors_by_hand():
    true = path([[0, 0, z] for z in range(31)])
    longer = path([[0, 0, 1.02 * z] for z in range(31)])
    errors = metrics.relative_errors(longer, true)
    assert errors["segments"] == 11 and errors["note"] == ""
    assert errors["translation_percent"] == pytest.approx(2, rel=1e-3)
    assert errors["rotation_deg_per_m"] == pytest.approx(0, abs=1e-9)
    short = metrics.relative_errors(true[:15], true[:15])
    assert np.isnan(short["translation_percent"]) and short["note"] == (
        "too short: 14.0 m, stretches of 20 m are compared")


def test_errors_side_by_side_are_each_one_of_its_own():
    true = winding()
    found = metrics.errors(drifted(true), true)
    assert list(found) == ["rmse", "mae", "se3", "translation_percent", "rotation_deg_per_m"]
    assert found["se3"] == metrics.ate(drifted(true), true, "se3")["rmse"] < found["rmse"] == metrics.rmse(
        drifted(true), true)
    angle = metrics.errors(turned(true, np.array([0.5, 1.0, 0.2])), true)
    assert angle["rmse"] > 0.1 and angle["se3"] < 0.1 * angle["rmse"]
    assert angle["translation_percent"] == pytest.approx(0, abs=1e-4)
    short = metrics.errors(true[:5], true[:5])
    assert short["rmse"] == 0 and np.isnan(short["translation_percent"])


def test_evo_opens_the_trajectories(tmp_path):
    poses = drifted(winding())
    write_kitti_poses(tmp_path / "path.txt", poses)
    write_tum(tmp_path / "path.tum", poses, 0.1 * np.arange(60))
    kitti = file_interface.read_kitti_poses_file(tmp_path / "path.txt")
    tum = file_interface.read_tum_trajectory_file(tmp_path / "path.tum")
    np.testing.assert_array_equal(np.array(kitti.poses_se3), poses)
    np.testing.assert_allclose(np.array(tum.poses_se3), poses, atol=1e-9)
    np.testing.assert_array_equal(tum.timestamps, 0.1 * np.arange(60))
