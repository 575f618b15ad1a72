"""The estimators: how the motion follows from the essential matrix, which allows four motions."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from thesis_repro.odometry import pose
from thesis_repro.odometry.pose import Motion
from thesis_repro.odometry.refined.fit import fit, smaller_rotation


@dataclass(frozen=True, eq=False)
class Essential:
    """An essential matrix and the normalised correspondences (N, 2) from which it was estimated."""

    current: np.ndarray
    previous: np.ndarray
    order: np.ndarray | slice  # indices of the step's points in the order given to RANSAC
    matrix: Any  # 3x3, or None if there is none; no estimator is asked then
    inliers: np.ndarray  # (N,) booleans, in the order given to RANSAC
    problem: str
    seconds: float

    def inliers_of_step(self) -> np.ndarray:
        """Inliers in the order of the step's points."""
        inliers = np.empty_like(self.inliers)
        inliers[self.order] = self.inliers
        return inliers


def _vote_of_all(essential: Essential, threshold: float) -> Motion:
    """The motion that most points vote for, outliers included."""
    votes, rotation, translation = pose.recover_pose(
        essential.matrix, essential.current, essential.previous
    )
    return Motion(rotation, translation, essential.inliers_of_step(), votes)


def _vote_of_inliers(essential: Essential, threshold: float) -> Motion:
    """The motion that most inliers vote for."""
    current, previous = essential.current, essential.previous
    inliers = essential.inliers
    votes, rotation, translation = pose.recover_pose(
        essential.matrix, current[inliers], previous[inliers]
    )
    return Motion(rotation, translation, essential.inliers_of_step(), votes)


def _refined(essential: Essential, threshold: float) -> Motion:
    """The motion with the smaller rotation, fitted to all points near it."""
    rotation, translation = smaller_rotation(essential.matrix)
    motion = fit(
        rotation,
        translation,
        essential.current,
        essential.previous,
        essential.inliers,
        threshold,
    )
    return replace(motion, inliers=essential.inliers_of_step())


class Estimator(NamedTuple):
    """An estimator of the motion."""

    title: str  # in tables and figures
    # from an essential matrix and the threshold of its inliers
    motion: Callable[[Essential, float], Motion]
    is_compared: bool = True  # in studies; otherwise only the ablations run it


# A new estimator is an entry here. OdometrySettings describes them.
ESTIMATORS = {
    "thesis": Estimator("thesis's estimator", _vote_of_all),
    "inliers": Estimator("vote of the inliers", _vote_of_inliers, is_compared=False),
    "refined": Estimator("refined estimator", _refined),
}
