"""The refined estimator: the fit, the sign of slow steps, consistency with the motion prior."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from street import Street

from thesis_repro import odometry
from thesis_repro.odometry import THESIS, Matches, metrics
from thesis_repro.odometry.estimators import ESTIMATORS, refined
from thesis_repro.odometry.refined import RefinedEstimator
from thesis_repro.odometry.refined import fit as refine
from thesis_repro.odometry.refined.motion_prior import (
    AMBIGUOUS,
    NOT_DETERMINED,
    MotionPrior,
    check_consistency,
)

AHEAD = np.array([0.0, 0.0, 1.0])
SIDEWAYS = np.array([1.0, 0.0, 0.0])
REFINED = replace(THESIS, estimator=refined)


def turn(degrees):
    """Rotation about the vertical axis."""
    return Rotation.from_euler("Y", degrees, degrees=True).as_matrix()


def seen(world, rotation, translation, noise=0.0, seed=0):
    """Matches of points (N, 3) in the current camera, all of them inliers.

    rotation, translation: its motion to the previous camera.
    """
    moved = world @ rotation.T + translation
    current, previous = (points[:, :2] / points[:, 2:] for points in (world, moved))
    previous = previous + np.random.default_rng(seed).normal(0, noise, previous.shape)
    return Matches(current, previous, THESIS.threshold, np.ones(len(world), bool))


def street(count=300, seed=0):
    """Points of a street (N, 3), metres."""
    return np.random.default_rng(seed).uniform([-8, -2, 5], [8, 1.6, 60], (count, 3))


def essential(rotation, translation):
    return np.cross(np.eye(3), translation).T @ rotation


def degrees_apart(rotation, other):
    return np.degrees(Rotation.from_matrix(rotation.T @ other).magnitude())


# One step


def test_the_sign_survives_a_slow_step():
    # All points lie beyond 50 translations, so OpenCV's recoverPose lets none of them vote.
    matches = seen(street() + [0, 0, 20], turn(0.2), 0.3 * AHEAD, noise=5e-5)
    matrix = essential(turn(0.2), AHEAD)
    assert cv2.recoverPose(matrix, matches.current, matches.previous)[0] < 20
    for start in (AHEAD, -AHEAD):
        motion = refine.fit(turn(0.2), start, matches)
        assert motion.translation @ AHEAD > 0.999
        assert motion.pose_inliers > 150
    # no two rays meet at so large an angle
    assert refine.cheirality_votes(turn(0.2), AHEAD, refine.columns(matches), 1.0) == (0, 0)


def test_the_fit_meets_exact_points_and_keeps_the_sign_of_the_translation():
    matches = replace(seen(street(200), turn(1), AHEAD), inliers=np.arange(200) < 150)
    for sign in (1, -1):
        direction = sign * np.array([0.05, -0.03, 1.0]) / np.linalg.norm([0.05, -0.03, 1.0])
        rotation, translation, _ = refine.refine(turn(1.2), direction, matches)
        np.testing.assert_allclose(rotation, turn(1), atol=1e-8)
        np.testing.assert_allclose(translation, sign * AHEAD, atol=1e-7)


def test_points_vote_that_lie_in_front_of_both_cameras_or_behind_both():
    random = np.random.default_rng(0)
    matches = Matches(*random.normal(0, 1, (2, 300, 2)), THESIS.threshold)
    previous, current = (np.c_[side, np.ones(300)] for side in (matches.previous, matches.current))
    depths = [  # along both rays, to where they are nearest to each other
        np.linalg.lstsq(np.transpose([turn(1) @ ray, -other]), -AHEAD)[0]
        for ray, other in zip(current, previous)
    ]
    both = [(np.sign(depths) == sign).all(axis=1).sum() for sign in (1, -1)]
    assert refine.cheirality_votes(turn(1), AHEAD, refine.columns(matches), 0.0) == tuple(both)
    assert min(both) > 20 and sum(both) < 280


def test_deviations_are_those_of_fits_to_noise():
    fits = []
    for seed in range(100):
        noisy = seen(street(), turn(1), AHEAD, noise=THESIS.threshold / np.sqrt(2), seed=seed)
        fits.append(refine.fit(turn(1), AHEAD, noisy))
    turns = [Rotation.from_matrix(turn(1).T @ each.rotation).as_rotvec() for each in fits]
    for name, errors in (
        ("rotation_std_deg", turns),
        ("heading_std_deg", [each.translation for each in fits]),
    ):
        largest = np.degrees(np.sqrt(np.linalg.eigvalsh(np.cov(np.transpose(errors)))[-1]))
        assert np.mean([getattr(each, name) for each in fits]) == pytest.approx(largest, rel=0.3)


# A step and its prior


def test_a_consistent_motion_is_used_as_it_is():
    matches = seen(street(), turn(1), AHEAD)
    motion = refine.fit(turn(1), AHEAD, matches)
    used, prior, flag = check_consistency(motion, matches, 0.5, MotionPrior(turn(2), AHEAD, 1.0))
    assert flag == "" and prior.scale == 0.5
    assert (
        degrees_apart(motion.rotation, used.rotation) < 1e-3 and used.translation @ AHEAD > 0.9999
    )
    np.testing.assert_array_equal(prior.rotation, used.rotation)


def test_of_two_motions_the_consistent_one_is_used_and_flagged():
    true, other = (turn(2), AHEAD), (turn(-1), np.array([0.0, 0.8, 0.6]))
    parts = [
        seen(street(150, seed), *motion, noise=5e-5, seed=seed)
        for seed, motion in enumerate((true, other))
    ]
    current = np.concatenate([part.current for part in parts])
    previous = np.concatenate([part.previous for part in parts])
    matches = replace(parts[0], current=current, previous=previous, inliers=np.ones(300, bool))
    wrong = refine.fit(*other, matches)
    assert degrees_apart(turn(-1), wrong.rotation) < 0.1
    used, prior, flag = check_consistency(wrong, matches, 1.0, MotionPrior(turn(2.4), AHEAD, 1.0))
    assert flag == AMBIGUOUS
    assert degrees_apart(turn(2), used.rotation) < 0.1 and used.translation[2] > 0.99
    near = refine.near(used.rotation, used.translation, matches, THESIS.threshold)
    assert near[:150].mean() > 0.9 and near[150:].mean() < 0.3


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
    matches = seen(street() + [0, 0, 5], rotation, translation, noise=5e-5)
    estimated = refine.fit(rotation, translation, matches)
    estimator, flags = RefinedEstimator(), []
    estimator.prior = prior
    for _ in range(3):
        used = estimator.motion(essential(rotation, translation), matches, 0.5, moves=True)
        assert degrees_apart(estimated.rotation, used.rotation) < 0.05
        assert used.translation @ estimated.translation > 0.999
        flags.append(used.flag)
    assert flags == [AMBIGUOUS, "", ""]


def test_a_step_that_does_not_move_the_pose_is_not_compared_and_leaves_the_prior():
    matches = seen(street() + [0, 0, 5], turn(8), AHEAD)
    estimator = RefinedEstimator()
    before = estimator.prior
    motion = estimator.motion(essential(turn(8), AHEAD), matches, 0.05, moves=False)
    assert motion.flag == "" and estimator.prior is before
    assert degrees_apart(turn(8), motion.rotation) < 0.05


def test_the_fit_takes_shuffled_matches_in_the_order_of_ransac():
    matches = seen(street(), turn(1), AHEAD, noise=1e-4)
    order = np.random.default_rng(0).permutation(len(matches.current))
    shuffled = replace(matches, current=matches.current[order], previous=matches.previous[order])
    results = [
        RefinedEstimator().motion(essential(turn(1), AHEAD), given, 1.0, moves=False)
        for given in (replace(matches, order=order), shuffled)
    ]
    np.testing.assert_array_equal(results[0].rotation, results[1].rotation)
    np.testing.assert_array_equal(results[0].translation, results[1].translation)


def test_a_motion_that_no_point_determines_repeats_the_prior():
    line = np.array([-3.0, 0.5, 5.0]) + np.linspace(0, 1, 200)[:, None] * [0.5, -0.2, 25.0]
    matches = seen(line, turn(1), AHEAD, noise=1e-4)
    prior = MotionPrior(turn(1), AHEAD, 1.0)
    motion = refine.fit(turn(7), SIDEWAYS, matches)
    used, after, flag = check_consistency(motion, matches, 0.5, prior)
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
    for name, entry in ESTIMATORS.items():
        results = [
            odometry.run(drive, replace(THESIS, estimator=entry.make, shuffle_seed=seed))
            for seed in range(3)
        ]
        assert all(result.flagged.empty for result in results)
        errors[name] = [metrics.rmse(result.poses, drive.poses) for result in results]
    assert np.mean(errors["refined"]) < np.mean(errors["inliers"])
    assert np.std(errors["refined"]) < 0.5 * np.std(errors["inliers"])
