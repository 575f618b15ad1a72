"""Whether a step's motion can be believed, given the steps before: what makes the refined pose reliable.

A camera on a car keeps its way from frame to frame. Of KITTI's 22,437 true pairs of steps of more than 0.25 m, 7 have
rotations that differ by more than TURN (after the first is stretched to the second's length) and 4 have directions of
motion that differ by more than SWING. A motion estimated from few points, from points far away or from points along
one line can differ by far more: a turn looks like a shift to the side, and both explain the correspondences.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from thesis_repro.odometry import guided
from thesis_repro.odometry.pose import Motion
from thesis_repro.odometry.refine import fit, near

TURN, SWING = 1.5, 20.0  # degrees
SUPPORT = 0.8  # of the correspondences near the estimated motion: enough for the one that goes on to be believed
UNSURE_TURN, UNSURE_SWING = 0.5, 5.0  # degrees: standard deviations from which on a motion is not determined

AMBIGUOUS, NOT_DETERMINED = "ambiguous motion", "motion not determined"


@dataclass(frozen=True)
class Course:
    """How the camera went last: `rotation` (3x3) and unit `translation` of its last believed step of `scale` metres.

    `missed`: steps since then whose motion is not known. Before the first step a camera is expected to look where it
    goes, and `scale` is 0.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 0.0
    missed: int = 2

    def after(self, scale: float) -> np.ndarray:
        """The rotation to expect of a step of `scale` metres, 3x3: the same curve."""
        if not self.scale:
            return self.rotation
        return cv2.Rodrigues(cv2.Rodrigues(self.rotation)[0] * (scale / self.scale))[0]

    def numbers(self) -> dict:
        """The course as JSON values; `Course.of` makes it again, to the last bit."""
        return {"rotation": self.rotation.tolist(), "translation": self.translation.tolist(), "scale": self.scale,
                "missed": self.missed}

    @staticmethod
    def of(numbers: dict) -> "Course":
        """What `numbers` returned, as a course again."""
        return Course(np.array(numbers["rotation"]), np.array(numbers["translation"]), numbers["scale"],
                      numbers["missed"])

    def lost(self) -> "Course":
        """The course after one more step whose motion is not known."""
        return replace(self, missed=self.missed + 1)


START = Course(np.eye(3), np.array([0.0, 0.0, 1.0]))


def believe(motion: Motion, current: np.ndarray, previous: np.ndarray, scale: float, threshold: float,
            course: Course) -> tuple[Motion, Course, str]:
    """The motion to go on with, the course after it, and a flag, "" where the refined `motion` is simply believed.

    current, previous: the step's normalised correspondences (N, 2) in the order of motion.inliers. scale: metres.

    A motion that is determined and goes on from the course is believed. Otherwise the best one is looked for among
    those that do go on: it is taken if it is determined and at least SUPPORT times as many correspondences lie near it,
    and the step is flagged AMBIGUOUS. Failing that the step is NOT_DETERMINED and the course is kept; at the start,
    where there is none, the motion is. To go on is to differ by no more than TURN and SWING, and by half as much more
    for every step that is not known; a motion of which only that can be said is AMBIGUOUS too.
    """
    rotation, translation = course.after(scale), course.translation
    patience = 1 + course.missed / 2

    def off(one):
        """By how many times TURN or SWING a motion differs from the expected one."""
        return max(_angle((np.trace(rotation.T @ one.rotation) - 1) / 2) / TURN,
                   _angle(translation @ one.translation) / SWING)

    if _determined(motion) and off(motion) <= patience:
        return motion, _course(motion, scale), "" if off(motion) <= 1 or not course.scale else AMBIGUOUS
    found = guided.find(current, previous, threshold, rotation, translation, patience * TURN, patience * SWING)
    if found is not None:
        other = fit(*found, current, previous, near(*found, current, previous, threshold), threshold)
        if other.support >= SUPPORT * motion.support and _determined(other) and off(other) <= patience:
            return other, _course(other, scale), AMBIGUOUS
    if not course.scale and _determined(motion):
        return motion, _course(motion, scale), AMBIGUOUS
    return replace(motion, rotation=rotation, translation=translation), course.lost(), NOT_DETERMINED


def _course(motion, scale):
    return Course(motion.rotation, motion.translation, scale, 0)


def _determined(motion):
    return motion.turn_sd < UNSURE_TURN and motion.swing_sd < UNSURE_SWING


def _angle(cosine):
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))
