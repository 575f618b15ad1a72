"""Consistency of a step's motion with the step before, which makes the refined estimator reliable.

A camera on a car moves nearly the same way from frame to frame. KITTI's ground truth has 22,437
pairs of steps longer than 0.25 m. In 7 pairs the rotations differ by more than MAX_ROTATION_CHANGE
(with the first rotation scaled to the second step's length). In 4 pairs the directions of motion
differ by more than MAX_HEADING_CHANGE. A motion estimated from few points, far points or points
along one line can differ by far more: a turn looks like a shift to the side, and both explain the
correspondences.
"""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.odometry.refined.fit import RefinedMotion, fit, near
from thesis_repro.odometry.refined.guided import ransac_with_prior
from thesis_repro.odometry.step import Matches

MAX_ROTATION_CHANGE, MAX_HEADING_CHANGE = 1.5, 20.0  # degrees
MAX_FIRST_ROTATION = 5.0  # degrees: KITTI's cars turn by up to 4.8 a frame
# points within so many thresholds of the expected motion start the second fit
PRIOR_FIT_THRESHOLDS = 4
SAME_SUPPORT = 0.97  # a second fit with this share of the estimated motion's support is as good
# an alternative with less than this share of the estimated motion's support is wrong
MIN_SUPPORT = 0.6
# degrees; with more, the points do not determine the motion
MAX_ROTATION_STD, MAX_HEADING_STD = 0.5, 5.0

AMBIGUOUS, NOT_DETERMINED = "ambiguous motion", "motion not determined"  # flags


class MotionPrior(NamedTuple):
    """Last consistent step. The next step should be similar."""

    rotation: np.ndarray  # 3x3
    translation: np.ndarray  # 3, unit length
    scale: float  # metres; 0 before the first step

    @classmethod
    def straight_ahead(cls) -> "MotionPrior":
        """Expected motion before the first step."""
        return cls(np.eye(3), np.array([0.0, 0.0, 1.0]), 0.0)

    def expected_rotation(self, scale: float) -> np.ndarray:
        """Expected rotation (3x3) of a step of `scale` metres on the same curve."""
        if not self.scale:
            return self.rotation
        vector, _ = cv2.Rodrigues(self.rotation)
        rotation, _ = cv2.Rodrigues(vector * (scale / self.scale))
        return rotation


def check_consistency(
    motion: RefinedMotion, matches: Matches, scale: float, prior: MotionPrior
) -> tuple[RefinedMotion, MotionPrior, str]:
    """Return the motion to use, the prior of the next step, and a flag.

    The flag is "" if the refined `motion` is consistent.

    scale: metres.

    A consistent motion (`is_consistent`) is fitted once more, starting from the expected motion.
    This start does not depend on RANSAC's random samples, so shuffled correspondences give nearly
    the same motion.

    If the motion is not consistent, the best consistent motion is searched for. In a static scene,
    the true motion has nearly as much support as any other. So the consistent motion is used if its
    support is at least MIN_SUPPORT times that of the estimated motion. If not, the camera really
    moved differently, and the estimated motion is used. The flag is AMBIGUOUS in both cases. If the
    points determine no motion, the step repeats the expected motion, and the flag is
    NOT_DETERMINED.
    """
    rotation, translation = prior.expected_rotation(scale), prior.translation
    flag = ""
    if is_consistent(motion, scale, prior):
        limit = PRIOR_FIT_THRESHOLDS * matches.threshold
        near_prior = near(rotation, translation, matches, limit)
        again = fit(rotation, translation, replace(matches, inliers=near_prior))
        if is_consistent(again, scale, prior) and again.support >= SAME_SUPPORT * motion.support:
            motion = again
    else:
        flag = AMBIGUOUS
        other = _consistent_motion(matches, scale, prior)
        if other is not None:
            has_support = other.support >= MIN_SUPPORT * motion.support
            if has_support or not _is_determined(motion):
                motion = other
    if not _is_determined(motion):
        expected = replace(motion, rotation=rotation, translation=translation)
        return expected, prior, NOT_DETERMINED
    # copies, because the caller may change what a step returns
    return motion, MotionPrior(motion.rotation.copy(), motion.translation.copy(), scale), flag


def _consistent_motion(matches: Matches, scale: float, prior: MotionPrior) -> RefinedMotion | None:
    """The motion with most inliers that is consistent with the prior, or None if there is none."""
    start = ransac_with_prior(
        matches,
        prior.expected_rotation(scale),
        prior.translation,
        _max_rotation(prior),
        MAX_HEADING_CHANGE,
    )
    if start is None:
        return None
    inliers = near(*start, matches, matches.threshold)
    motion = fit(*start, replace(matches, inliers=inliers))
    return motion if is_consistent(motion, scale, prior) else None


def is_consistent(motion: RefinedMotion, scale: float, prior: MotionPrior) -> bool:
    """Whether a motion is determined by its points and near the expected motion.

    scale: length of the step, metres.
    """
    if not _is_determined(motion):
        return False
    difference = prior.expected_rotation(scale).T @ motion.rotation
    turned = _degrees((np.trace(difference) - 1) / 2)
    heading_change = _degrees(prior.translation @ motion.translation)
    return bool(turned <= _max_rotation(prior) and heading_change <= MAX_HEADING_CHANGE)


def _max_rotation(prior: MotionPrior) -> float:
    return MAX_ROTATION_CHANGE if prior.scale else MAX_FIRST_ROTATION


def _is_determined(motion: RefinedMotion) -> bool:
    return motion.rotation_std_deg < MAX_ROTATION_STD and motion.heading_std_deg < MAX_HEADING_STD


def _degrees(cosine: float) -> float:
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
