"""The refined estimator: the fit, the sign of slow steps, consistency with the motion prior."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from street import Street

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import THESIS, Odometry, Step, keypoints, metrics, pose
from thesis_repro.odometry.odometry import ALL_KEYPOINTS
from thesis_repro.odometry.refined import fit as refine
from thesis_repro.odometry.refined import motion_prior, normal_equations
from thesis_repro.odometry.refined.motion_prior import AMBIGUOUS, NOT_DETERMINED, MotionPrior

AHEAD = np.array([0.0, 0.0, 1.0])
SIDEWAYS = np.array([1.0, 0.0, 0.0])
REFINED = replace(THESIS, estimator="refined")


def turn(degrees):
    """Rotation about the vertical axis."""
    return Rotation.from_euler("Y", degrees, degrees=True).as_matrix()


def seen(world, rotation, translation, noise=0.0, seed=0):
    """Correspondences (current, previous) of points (N, 3) in the current camera.

    rotation, translation: its motion to the previous camera.
    """
    moved = world @ rotation.T + translation
    current, previous = (points[:, :2] / points[:, 2:] for points in (world, moved))
    return current, previous + np.random.default_rng(seed).normal(0, noise, previous.shape)


def street(count=300, seed=0):
    """Points of a street (N, 3), metres."""
    return np.random.default_rng(seed).uniform([-8, -2, 5], [8, 1.6, 60], (count, 3))


def fitted(rotation, translation, current, previous):
    return refine.fit(
        rotation, translation, current, previous, np.ones(len(current), bool), THESIS.threshold
    )


def checked(motion, current, previous, scale, prior):
    return motion_prior.check_consistency(motion, current, previous, scale, THESIS.threshold, prior)


def degrees_apart(rotation, other):
    return np.degrees(Rotation.from_matrix(rotation.T @ other).magnitude())


# One step


def test_the_sign_survives_a_slow_step():
    # All points lie beyond 50 translations, so OpenCV's recoverPose lets none of them vote.
    current, previous = seen(street() + [0, 0, 20], turn(0.2), 0.3 * AHEAD, noise=5e-5)
    essential = np.cross(np.eye(3), AHEAD).T @ turn(0.2)
    votes, _, _ = pose.recover_pose(essential, current, previous)
    assert votes < 20
    for start in (AHEAD, -AHEAD):
        motion = fitted(turn(0.2), start, current, previous)
        assert motion.translation @ AHEAD > 0.999
        assert motion.pose_inliers > 150
    # no two rays meet at so large an angle
    points = refine.columns(current, previous)
    assert refine.cheirality_votes(turn(0.2), AHEAD, points, 1.0) == (0, 0)


def test_normal_equations_are_sums_over_single_points():
    points = np.random.default_rng(0).uniform(
        -0.6, 0.6, (4, 2 * normal_equations.POINTS_PER_BLOCK + 7)
    )
    motion = Rotation.from_rotvec([0.01, 0.02, -0.01]).as_matrix(), np.array([0.0, 0.6, 0.8])
    totals = normal_equations.normal_equations(*motion, points, 0.1, True)
    parts = [
        normal_equations.normal_equations(*motion, np.ascontiguousarray(point), 0.1, True)
        for point in np.split(points, points.shape[1], axis=1)
    ]
    for total, terms in zip(totals, zip(*parts, strict=True), strict=True):
        np.testing.assert_allclose(total, sum(terms), rtol=1e-12, atol=1e-12)


def test_the_fit_meets_exact_points_and_keeps_the_sign_of_the_translation():
    current, previous = seen(street(200), turn(1), AHEAD)
    for sign in (1, -1):
        direction = sign * np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])
        rotation, translation = refine.refine(
            turn(1.2), direction, current, previous, np.arange(200) < 150, THESIS.threshold
        )
        np.testing.assert_allclose(rotation, turn(1), atol=1e-8)
        np.testing.assert_allclose(translation, sign * AHEAD, atol=1e-7)


# A step and its prior


def test_a_consistent_motion_is_used_as_it_is():
    points = seen(street(), turn(1), AHEAD)
    motion = fitted(turn(1), AHEAD, *points)
    used, prior, flag = checked(motion, *points, 0.5, MotionPrior(turn(2), AHEAD, 1.0))
    assert flag == "" and prior.scale == 0.5 and used.inliers is motion.inliers
    assert (
        degrees_apart(motion.rotation, used.rotation) < 1e-3 and used.translation @ AHEAD > 0.9999
    )
    np.testing.assert_array_equal(prior.rotation, used.rotation)


def test_different_minima_end_in_the_same_motion():
    points = seen(street(60), turn(1), 0.15 * AHEAD, noise=1e-4)
    start = fitted(turn(1), AHEAD, *points)
    for off in (0.1, -0.1):  # as if RANSAC had led to another minimum
        motion = replace(start, rotation=turn(off) @ start.rotation, support=start.support - 2)
        used, _, flag = checked(motion, *points, 0.15, MotionPrior(turn(1), AHEAD, 0.15))
        assert flag == "" and degrees_apart(start.rotation, used.rotation) < 0.01


def test_of_two_motions_the_consistent_one_is_used_and_flagged():
    true, other = (turn(2), AHEAD), (turn(-1), np.array([0.0, 0.8, 0.6]))
    parts = [
        seen(street(150, seed), *motion, noise=5e-5, seed=seed)
        for seed, motion in enumerate((true, other))
    ]
    points = [np.concatenate(side) for side in zip(*parts, strict=True)]
    wrong = fitted(*other, *points)
    assert degrees_apart(turn(-1), wrong.rotation) < 0.1
    used, prior, flag = checked(wrong, *points, 1.0, MotionPrior(turn(2.4), AHEAD, 1.0))
    assert (
        flag == AMBIGUOUS
        and degrees_apart(turn(2), used.rotation) < 0.1
        and used.translation[2] > 0.99
    )
    assert used.inliers[:150].mean() > 0.9 and used.inliers[150:].mean() < 0.3
    np.testing.assert_array_equal(prior.rotation, used.rotation)


@pytest.mark.parametrize(
    "rotation, translation, prior",
    [
        (turn(8), AHEAD, MotionPrior(turn(1), AHEAD, 0.5)),
        (turn(0.5), -AHEAD, MotionPrior(turn(1), AHEAD, 0.5)),
        (turn(-4), np.array([0.8, 0, 0.6]), MotionPrior(turn(1), AHEAD, 0.5)),
        (turn(0.5), SIDEWAYS, MotionPrior.straight_ahead()),
    ],
    ids=["a sharp turn", "reversing", "both", "a first step sideways"],
)
def test_an_inconsistent_motion_that_nothing_else_explains_is_used_and_flagged_once(
    rotation, translation, prior
):
    points = seen(street() + [0, 0, 5], rotation, translation, noise=5e-5)
    estimated, flags = fitted(rotation, translation, *points), []
    for _ in range(3):
        used, prior, flag = checked(estimated, *points, 0.5, prior)
        assert degrees_apart(estimated.rotation, used.rotation) < 0.05
        assert used.translation @ estimated.translation > 0.999
        flags.append(flag)
    assert flags == [AMBIGUOUS, "", ""]


def test_a_motion_that_no_point_determines_repeats_the_prior():
    line = np.array([-3.0, 0.5, 5.0]) + np.linspace(0, 1, 200)[:, None] * [0.5, -0.2, 25.0]
    points = seen(line, turn(1), AHEAD, noise=1e-4)
    prior = MotionPrior(turn(1), AHEAD, 1.0)
    used, after, flag = checked(fitted(turn(7), SIDEWAYS, *points), *points, 0.5, prior)
    assert flag == NOT_DETERMINED and after is prior
    # the same curve over half the distance
    np.testing.assert_allclose(used.rotation, turn(0.5), atol=1e-12)
    np.testing.assert_array_equal(used.translation, AHEAD)


# Whole runs


@pytest.mark.parametrize("seed", [None, 1])
def test_a_line_beside_the_road_costs_one_flagged_step(seed):
    drive = Street(8)
    masks = np.full((8, *drive.frame(0).shape), 255, np.uint8)
    masks[4, :, :100] = masks[4, :, 102:] = 0
    result = odometry.run(drive, replace(REFINED, shuffle_seed=seed), masks)
    assert result.frames["flag"].tolist() == ["", "", "", "", "", NOT_DETERMINED, "", ""]
    assert result.frames["updated"][1:].all()
    assert metrics.rmse(result.poses, drive.poses) < 0.05


def test_on_a_plain_drive_the_fit_has_no_flags_and_its_errors_are_smaller_and_vary_less():
    drive, errors = Street(5), {}
    for estimator in ("thesis", "inliers", "refined"):
        results = [
            odometry.run(drive, replace(THESIS, estimator=estimator, shuffle_seed=seed))
            for seed in range(3)
        ]
        assert all(result.flagged.empty for result in results)
        errors[estimator] = [metrics.rmse(result.poses, drive.poses) for result in results]
    assert np.mean(errors["refined"]) < np.mean(errors["inliers"])
    assert np.std(errors["refined"]) < 0.5 * np.std(errors["inliers"])


@pytest.mark.parametrize("estimator", ["thesis", "refined"])
@pytest.mark.parametrize(
    "axis, degrees, zoom, flag",
    [
        ("X", 0.3, 1.0, "no parallax"),
        ("Y", 0.2, 1.0, "no parallax"),
        ("Y", -1.5, 1.0, "no parallax"),
        ("Z", 2.0, 1.0, "no parallax"),
        ("Z", 0.0, 1.005, "zoom"),
        ("Z", 0.0, 0.97, "zoom"),
        ("Y", 0.5, 1.01, "zoom"),
    ],
)
def test_a_camera_that_only_turns_or_zooms_is_flagged(estimator, axis, degrees, zoom, flag):
    drive = Street(1)
    rotation = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    camera = drive.intrinsics @ np.diag([zoom, zoom, 1])
    warp = camera @ rotation @ np.linalg.inv(drive.intrinsics)
    moved = cv2.warpPerspective(drive.frame(0), warp, (480, 160), borderMode=cv2.BORDER_REFLECT)
    follower = Odometry(drive.intrinsics, replace(THESIS, estimator=estimator))
    follower.step(drive.frame(0))
    step = follower.step(moved, 0.5)
    assert step.updated and {"no parallax", "zoom"} & set(step.flags) == {flag}


@pytest.mark.parametrize("estimator", ["thesis", "refined"])
def test_a_turn_that_no_car_can_make_is_flagged_again_and_again(estimator):
    """The second such step is consistent with the first one."""
    camera = Street(1).intrinsics
    follower = Odometry(camera, replace(THESIS, estimator=estimator))
    current, previous = (
        points * np.diag(camera)[:2] + camera[:2, 2] for points in seen(street(), turn(24), AHEAD)
    )
    for frame in (1, 2):
        step = Step(frame, scale=1.0, points=len(current), previous=previous, current=current)
        follower.estimate(step)
        follower.compose(step)
        assert "too large a turn" in step.flags
        assert degrees_apart(turn(24 * frame), follower.pose[:3, :3]) < 0.1


@pytest.mark.real
@pytest.mark.parametrize("seed", [None, 2, 4])
def test_a_turn_is_estimated_from_few_keypoints(kitti_real, seed):
    """05, frames 128 to 149.

    The points are far away, so a shift to the side explains them as well as the turn.
    """
    sequence = Sequence(kitti_real, "05")
    settings = replace(REFINED, max_keypoints=500, shuffle_seed=seed)
    follower = Odometry(sequence.intrinsics, settings, sequence.poses[128])
    follower.count = 128  # the shuffle's seed includes the frame number
    metres = odometry.scales(sequence)
    flags = set()
    for index in range(128, 150):
        step = follower.step(sequence.frame(index), metres[index] if index > 128 else 0.0)
        if index > 128:
            flags |= set(step.flags)
            true = np.linalg.inv(sequence.poses[index - 1]) @ sequence.poses[index]
            assert degrees_apart(true[:3, :3], step.motion.rotation) < 0.5, index
    assert flags <= {AMBIGUOUS}


@pytest.mark.real
def test_a_second_start_leaves_a_poor_minimum(kitti_real):
    """05, frames 0 and 1.

    Without a second start, six shuffles of 300 points give headings up to 11 degrees apart.
    """
    sequence = Sequence(kitti_real, "05")
    directions = []
    for seed in range(6):
        follower = Odometry(
            sequence.intrinsics, replace(REFINED, max_keypoints=300, shuffle_seed=seed or None)
        )
        follower.step(sequence.frame(0))
        directions.append(follower.step(sequence.frame(1), 1.0).motion.translation)
    assert np.degrees(np.arccos(np.min(np.array(directions) @ np.transpose(directions)))) < 4


# Fallback on all keypoints


@pytest.mark.parametrize("estimator", ["thesis", "refined"])
def test_the_fallback_uses_all_keypoints_if_masks_leave_too_few(small_world, estimator):
    drive = Sequence(small_world / "kitti", "00")
    plain = replace(THESIS, estimator=estimator)
    settings = replace(plain, fallback=True)
    few = np.zeros((len(drive), *drive.size), np.uint8)
    few[:, :, :4] = 255  # too few keypoints for any motion
    last = few.copy()
    last[:-2] = 255  # only the last step starts from a frame with few keypoints
    runs = {
        "few": (settings, few),
        "last": (settings, last),
        "without": (plain, last),
        "no mask": (settings, None),
    }
    results = odometry.run_many(drive, runs)
    every = odometry.run(drive, plain).poses
    replaced = {name: result.flagged.get(ALL_KEYPOINTS, 0) for name, result in results.items()}
    assert replaced == {"few": len(drive) - 1, "last": 1, "without": 0, "no mask": 0}
    equal = {name: np.array_equal(result.poses, every) for name, result in results.items()}
    assert equal == {"few": True, "last": True, "without": False, "no mask": True}


def test_fallbacks_of_one_step_track_all_keypoints_once(monkeypatch):
    drive = Street(2)
    few = np.zeros((2, *drive.size), np.uint8)
    few[:, :, :4] = 255  # too few keypoints for any motion
    settings = replace(THESIS, fallback=True)
    runs = {f"{seed}": (replace(settings, shuffle_seed=seed), few) for seed in (1, 2, 3)}
    tracked, track = [], keypoints.track
    monkeypatch.setattr(keypoints, "track", lambda *given: tracked.append(1) or track(*given))
    results = odometry.run_many(drive, runs)
    assert all(result.flagged[ALL_KEYPOINTS] == 1 for result in results.values())
    assert len(tracked) == 2  # with the mask, and without it
