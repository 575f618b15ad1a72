"""Whether a step's motion can be believed, given the step before: what makes the refined pose reliable.

A camera on a car keeps its way from frame to frame. Of KITTI's 22,437 true pairs of steps of more than 0.25 m, 7 have
rotations that differ by more than TURN (after the first is stretched to the second's length) and 4 have directions of
motion that differ by more than SWING. A motion estimated from few points, from points far away or from points along
one line can differ by far more: a turn looks like a shift to the side, and both explain the correspondences.
"""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.odometry.pose import Motion
from thesis_repro.odometry.refined import guided
from thesis_repro.odometry.refined.fit import fit, near

TURN, SWING = 1.5, 20.0  # degrees
FIRST_TURN = 5.0  # degrees: KITTI's cars turn by up to 4.8 a frame
WITHIN = 4  # thresholds: where the fit from the expected motion looks first
ALIKE = 0.97  # of the correspondences near the estimated motion: as good as that one
SUPPORT = 0.6  # of the correspondences near the estimated motion: what explains fewer than that is refuted by them
UNSURE_TURN, UNSURE_SWING = 0.5, 5.0  # degrees: standard deviations from which on a motion is not determined

AMBIGUOUS, NOT_DETERMINED = "ambiguous motion", "motion not determined"


class Course(NamedTuple):
    """How the camera went last: `rotation` (3x3) and unit `translation` of its last believed step of `scale` metres.

    Before the first step, `scale` is 0 and a camera is expected to look where it goes.
    """

    rotation: np.ndarray = np.eye(3)
    translation: np.ndarray = np.array([0.0, 0.0, 1.0])
    scale: float = 0.0

    def after(self, scale: float) -> np.ndarray:
        """The rotation to expect of a step of `scale` metres, 3x3: the same curve."""
        if not self.scale:
            return self.rotation
        return cv2.Rodrigues(cv2.Rodrigues(self.rotation)[0] * (scale / self.scale))[0]


def believe(motion: Motion, current: np.ndarray, previous: np.ndarray, scale: float, threshold: float,
            course: Course) -> tuple[Motion, Course, str]:
    """The motion to go on with, the course after it, and a flag, "" where the refined `motion` is simply believed.

    current, previous: the step's normalised correspondences (N, 2) in the order of motion.inliers. scale: metres.

    A motion that its points determine and that goes on from the course, by no more than TURN and SWING, is believed; so
    that little of RANSAC's chance is left in it, it is fitted once more from the expected motion, where all orders of
    the correspondences start alike. Otherwise the best motion is looked for among those that do go on. In a scene that
    stands still the true motion has nearly as many correspondences near it as any other, so that one is taken if it has
    at least SUPPORT times as many; if not, the camera has left its course, and the estimated motion is taken. Either
    way the step is AMBIGUOUS. Where neither is determined the step is NOT_DETERMINED: the camera goes on along its
    course.
    """
    rotation, translation = course.after(scale), course.translation
    turn = TURN if course.scale else FIRST_TURN

    def goes_on(one):
        return (_determined(one) and _degrees((np.trace(rotation.T @ one.rotation) - 1) / 2) <= turn
                and _degrees(translation @ one.translation) <= SWING)

    flag = ""
    if goes_on(motion):
        first = near(rotation, translation, current, previous, WITHIN * threshold)
        again = fit(rotation, translation, current, previous, first, threshold)
        if goes_on(again) and again.support >= ALIKE * motion.support:
            motion = replace(again, inliers=motion.inliers)
    else:
        flag = AMBIGUOUS
        found = guided.find(current, previous, threshold, rotation, translation, turn, SWING)
        other = found and fit(*found, current, previous, near(*found, current, previous, threshold), threshold)
        if other and goes_on(other) and (other.support >= SUPPORT * motion.support or not _determined(motion)):
            motion = other
    if _determined(motion):
        assert motion.rotation is not None and motion.translation is not None  # a fitted motion has both
        return motion, Course(motion.rotation, motion.translation, scale), flag
    return replace(motion, rotation=rotation, translation=translation), course, NOT_DETERMINED


def _determined(motion):
    return motion.turn_sd < UNSURE_TURN and motion.swing_sd < UNSURE_SWING


def _degrees(cosine):
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
