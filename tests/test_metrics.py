"""Trajectory errors against cases worked by hand."""

import numpy as np
import pytest

from thesis_repro import InputError, metrics


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
