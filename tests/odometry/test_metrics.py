"""Trajectory errors, compared with values worked out by hand and by evo."""

import re

import numpy as np
import pytest
from evo.core import lie_algebra as lie
from evo.core import metrics as evo
from evo.core.trajectory import PosePath3D
from made_up import winding
from scipy.spatial.transform import Rotation

from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics


def rotation(*degrees):
    return Rotation.from_rotvec(degrees, degrees=True)


def ahead(count, factor=1.0, turn=0.0):
    """A straight path of `factor` metres and `turn` degrees a step."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = factor * np.arange(count)
    poses[:, :3, :3] = [rotation(0, turn * index, 0).as_matrix() for index in range(count)]
    return poses


def drive(seed=None):
    """A kilometre of curves and straights at 0.1 to 1.8 metres a frame.

    With a seed: 2 % too long, with noise, and with turns of 1 to 4 degrees in a twentieth of steps.
    """
    random, poses = np.random.RandomState(seed), [np.eye(4)]
    for index in range(1100):
        turn = [0.1 * np.cos(index), 1.8 * np.sin(index / 60) ** 3, 0.1 * np.sin(index)]
        step = np.array([0, 0.02 * np.sin(index), 0.95 - 0.85 * np.cos(index / 25)])
        if seed is not None:
            turn += random.normal(0, 0.1, 3)
            turn[1] += random.uniform(1, 4) * random.choice([-1, 0, 1], p=[0.025, 0.95, 0.025])
            step = 1.02 * step + random.normal(0, 0.03, 3)
        poses.append(poses[-1] @ lie.se3(rotation(*turn).as_matrix(), step))
    return np.array(poses)


def angle(matrix):
    return abs(lie.so3_log_angle(matrix[:3, :3], degrees=True))


def aligned(estimated, true, with_scale):
    """RMSE after the best rotation and shift, and the best scale."""
    ours, theirs = (path[:, :3, 3] - path[:, :3, 3].mean(axis=0) for path in (estimated, true))
    ours = Rotation.align_vectors(theirs, ours)[0].apply(ours)
    scale = (ours * theirs).sum() / (ours**2).sum() if with_scale else 1
    return np.sqrt(((scale * ours - theirs) ** 2).sum(axis=1).mean())


def segments(estimated, true, length, every, reached):
    """(estimated, true) motions to the first frame that is so many metres ahead."""
    along = [
        0,
        *np.cumsum([np.linalg.norm(b - a) for a, b in zip(true[:, :3, 3], true[1:, :3, 3])]),
    ]
    for first in range(0, len(true), every):
        ends = [k for k, at in enumerate(along) if k > first and reached(at, along[first] + length)]
        if ends:
            yield [lie.relative_se3(path[first], path[ends[0]]) for path in (estimated, true)]


def of_steps(estimated, true):
    """Errors of single steps, one after the other."""
    turned, moved = [], []
    for ours, theirs in segments(estimated, true, 0, 1, lambda at, end: True):
        turned.append((angle(theirs), angle(lie.relative_se3(ours, theirs))))
        if np.linalg.norm(theirs[:3, 3]) >= 0.25:
            headings = [step[:3, 3] / np.linalg.norm(step[:3, 3]) for step in (ours, theirs)]
            between = np.degrees(np.arctan2(np.linalg.norm(np.cross(*headings)), np.dot(*headings)))
            failed = turned[-1][1] > 2 or between > 90
            moved.append((between, *np.degrees(headings[0] - headings[1]), failed))
    turns, errors = np.transpose(turned)
    direction, across, down, _ = np.median(np.array(moved)[:, :4], axis=0)
    return {
        "rotation": errors.mean(),
        "in_turns": errors[turns > 1].mean(),
        "on_straights": errors[turns < 0.3].mean(),
        "direction": direction,
        "across": across,
        "down": down,
        "failed": 100 * np.mean([step[-1] for step in moved]),
        "steps": len(moved),
    }


def over_twenty_metres(estimated, true):
    """Errors of segments after the rotation that fits all of them best."""
    pairs = [*segments(estimated, true, 20, 1, lambda at, end: at >= end)]
    vectors = [
        [motion[:3, 3] for motion in side] + [20 * lie.so3_log(motion[:3, :3]) for motion in side]
        for side in zip(*pairs)
    ]
    turn = np.eye(4)
    turn[:3, :3] = Rotation.align_vectors(vectors[1], vectors[0])[0].as_matrix()
    turned = [(turn @ ours @ turn.T, theirs) for ours, theirs in pairs]
    return {
        "translation_percent": np.mean(
            [np.linalg.norm(ours[:3, 3] - theirs[:3, 3]) / 20 * 100 for ours, theirs in turned]
        ),
        "rotation_deg_per_100m": np.mean(
            [angle(lie.relative_se3(*pair)) / 20 * 100 for pair in turned]
        ),
    }


def of_kitti(estimated, true):
    """Errors of segments of 100 to 800 metres."""
    errors = [
        (np.linalg.norm(error[:3, 3]) / length * 100, angle(error) / length * 100)
        for length in range(100, 900, 100)
        for pair in segments(estimated, true, length, 10, lambda at, end: at > end)
        for error in [lie.relative_se3(*pair)]
    ]
    return dict(zip(("t_rel", "r_rel"), np.mean(errors, axis=0)))


def test_every_error_of_a_kilometre_is_that_worked_out_by_hand():
    """From their definitions, one pose after the other."""
    mounting = lie.se3(rotation(2, -3, 1).as_matrix(), np.zeros(3))
    true, estimated = drive(), mounting @ drive(seed=0) @ mounting.T
    errors = {
        **{alignment: metrics.ate(estimated, true, alignment) for alignment in ("none", "sim3")},
        **metrics.errors(estimated, true),
        **metrics.step_errors(estimated, true),
        **metrics.kitti_errors(estimated, true),
    }
    off = np.array(
        [(b - estimated[1] - a + true[1])[:3, 3] for a, b in zip(true[1:], estimated[1:])]
    )
    ape = evo.APE(evo.PoseRelation.translation_part)
    ape.process_data([PosePath3D(poses_se3=[*poses]) for poses in (true, estimated)])
    by_hand = {
        "none": ape.get_statistic(evo.StatisticsType.rmse),
        "sim3": aligned(estimated, true, True),
        "rmse": np.mean(np.linalg.norm(off, axis=1) ** 2) ** 0.5,
        "mae": np.mean(abs(off)),
        "se3": aligned(estimated, true, False),
        **over_twenty_metres(estimated, true),
        **of_steps(estimated, true),
        "lost": 0,
        **of_kitti(estimated, true),
    }
    assert errors == pytest.approx(by_hand, rel=1e-5)
    assert np.linalg.norm(metrics.shifted(estimated, true)[1] - true[1], axis=0)[3] < 1e-12


def test_a_rotation_between_two_cameras_is_no_reflection():
    """Of these unrelated motions, the best orthogonal matrix is one."""
    random = np.random.RandomState(0)
    turns, shifts = random.uniform(-180, 180, (40, 3)), random.normal(0, 9, (40, 3))
    poses = [lie.se3(rotation(*turn).as_matrix(), shift) for turn, shift in zip(turns, shifts)]
    given = np.array(poses), winding(40)
    assert metrics.relative_errors(*given) == pytest.approx(over_twenty_metres(*given), rel=1e-3)


def test_a_path_that_is_too_short_or_straight_has_no_such_error():
    assert np.isnan(metrics.ate(ahead(5), ahead(5), "se3"))
    assert metrics.ate(ahead(5), ahead(5)) == 0
    for errors in (metrics.relative_errors, metrics.kitti_errors):
        assert np.isnan([*errors(ahead(15), ahead(15)).values()]).all()
    turning = metrics.kitti_errors(ahead(150, turn=0.01), ahead(150))
    assert turning["r_rel"] == pytest.approx(0.01 * 101)  # the first frame beyond 100 m


FLIPPED = ahead(9, 0.1)
FLIPPED[4:, :3, :3] = np.diag([-1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    "estimated, true, expected",
    [
        (winding(), winding(), {"failed": 0, "direction": 0, "rotation": 0, "lost": 0}),
        (ahead(9, turn=0.5), ahead(9), {"failed": 0, "rotation": 0.5, "lost": 0}),
        (ahead(9, turn=2.1), ahead(9), {"failed": 100}),
        (ahead(9, turn=1.9), ahead(9), {"failed": 0}),
        (ahead(9, factor=-1.0), ahead(9), {"failed": 100}),
        # at walking pace no step is long enough to fail
        (FLIPPED, ahead(9, 0.1), {"failed": np.nan, "lost": 1}),
        # a camera in the hand turns more than a car, and the estimate follows it
        (ahead(9, turn=8.0), ahead(9, turn=6.1), {"lost": 0}),
        (ahead(9, turn=8.0), ahead(9, turn=5.9), {"lost": 1}),
        (ahead(9, turn=5.9), ahead(9), {"lost": 0}),
        (ahead(9, turn=6.1), ahead(9), {"lost": 1}),
        (ahead(9, 0.25), ahead(9, 0.25), {"steps": 8}),
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


@pytest.mark.parametrize(
    "shape, count, named",
    [((5, 3), 5, "(5, 3)"), ((5, 3, 4), 5, "(5, 3, 4)"), ((5, 16), 5, "(5, 16)")]
    + [((4, 4, 4), 5, "one pose a frame"), ((1, 4, 4), 1, "at least 2 frames")],
)
def test_paths_of_other_shapes_and_lengths_are_named(shape, count, named):
    for pair in ((np.zeros(shape), ahead(count)), (ahead(count), np.zeros(shape))):
        for error in (metrics.ate, metrics.rmse, metrics.errors):
            with pytest.raises(InputError, match=re.escape(named)):
                error(*pair)
