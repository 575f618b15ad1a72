"""Whether a step's motion is consistent with the step before: what makes the refined estimator reliable.

A camera on a car moves nearly the same way from frame to frame. KITTI has 22,437 true pairs of steps of more than
0.25 m. In 7 of them the rotations differ by more than MAX_ROTATION_CHANGE (after the first is stretched to the second's
length), and in 4 the directions of motion differ by more than MAX_HEADING_CHANGE. A motion estimated from few points,
from points far away or from points along one line can differ by far more: a turn looks like a shift to the side, and
both explain the correspondences.
"""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.odometry.refined.fit import RefinedMotion, fit, near
from thesis_repro.odometry.refined.guided import ransac_with_prior

MAX_ROTATION_CHANGE, MAX_HEADING_CHANGE = 1.5, 20.0  # degrees
MAX_FIRST_ROTATION = 5.0  # degrees: KITTI's cars turn by up to 4.8 a frame
PRIOR_FIT_THRESHOLDS = 4  # how near the expected motion the correspondences of the second fit lie
SAME_SUPPORT = 0.97  # a fit with this share of the estimated motion's support is as good
MIN_SUPPORT = 0.6  # a motion with less than this share of the estimated motion's support is wrong
MAX_ROTATION_STD, MAX_HEADING_STD = 0.5, 5.0  # degrees: with more, a motion is not determined by its points

AMBIGUOUS, NOT_DETERMINED = "ambiguous motion", "motion not determined"  # flags


class MotionPrior(NamedTuple):
    """The last consistent step: `rotation` (3x3), unit `translation` and `scale` (metres). The next one is expected to
    be like it.

    Before the first step, `scale` is 0 and a camera is expected to look where it goes.
    """

    rotation: np.ndarray = np.eye(3)
    translation: np.ndarray = np.array([0.0, 0.0, 1.0])
    scale: float = 0.0

    def expected_rotation(self, scale: float) -> np.ndarray:
        """The rotation to expect of a step of `scale` metres, 3x3: the same curve."""
        if not self.scale:
            return self.rotation
        return cv2.Rodrigues(cv2.Rodrigues(self.rotation)[0] * (scale / self.scale))[0]


def check_consistency(motion: RefinedMotion, current: np.ndarray, previous: np.ndarray, scale: float, threshold: float,
                      prior: MotionPrior) -> tuple[RefinedMotion, MotionPrior, str]:
    """The motion to use, the prior of the next step, and a flag: "" where the refined `motion` is consistent.

    current, previous: the step's normalised correspondences (N, 2) in the order of motion.inliers. scale: metres.

    A consistent motion (`is_consistent`) is fitted once more from the expected motion. All shuffles of the
    correspondences start alike there, so little of RANSAC's chance is left.

    Otherwise the best consistent motion is searched for. In a scene that stands still the true motion has nearly as
    many correspondences near it as any other. So this motion is used if it has at least MIN_SUPPORT times as many; if
    not, the camera did move another way, and the estimated motion is used. Either way the step is AMBIGUOUS. Where
    neither is determined, the step is NOT_DETERMINED and repeats the motion of the prior.
    """
    rotation, translation = prior.expected_rotation(scale), prior.translation
    flag = ""
    if is_consistent(motion, scale, prior):
        near_prior = near(rotation, translation, current, previous, PRIOR_FIT_THRESHOLDS * threshold)
        again = fit(rotation, translation, current, previous, near_prior, threshold)
        if is_consistent(again, scale, prior) and again.support >= SAME_SUPPORT * motion.support:
            motion = replace(again, inliers=motion.inliers)
    else:
        flag = AMBIGUOUS
        start = ransac_with_prior(current, previous, threshold, rotation, translation, _max_rotation(prior),
                                  MAX_HEADING_CHANGE)
        if start:
            other = fit(*start, current, previous, near(*start, current, previous, threshold), threshold)
            if is_consistent(other, scale, prior) and (other.support >= MIN_SUPPORT * motion.support
                                                       or not _determined(motion)):
                motion = other
    if _determined(motion):
        assert motion.rotation is not None and motion.translation is not None  # a fitted motion has both
        return motion, MotionPrior(motion.rotation, motion.translation, scale), flag
    return replace(motion, rotation=rotation, translation=translation), prior, NOT_DETERMINED


def is_consistent(motion: RefinedMotion, scale: float, prior: MotionPrior) -> bool:
    """Whether a step's points determine its motion, and it is within the limits of the prior's; scale: metres."""
    assert motion.rotation is not None and motion.translation is not None
    turned = _degrees((np.trace(prior.expected_rotation(scale).T @ motion.rotation) - 1) / 2)
    return bool(_determined(motion) and turned <= _max_rotation(prior)
                and _degrees(prior.translation @ motion.translation) <= MAX_HEADING_CHANGE)


def _max_rotation(prior):
    return MAX_ROTATION_CHANGE if prior.scale else MAX_FIRST_ROTATION


def _determined(motion):
    return motion.rotation_std_deg < MAX_ROTATION_STD and motion.heading_std_deg < MAX_HEADING_STD


def _degrees(cosine):
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
