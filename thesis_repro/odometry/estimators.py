"""The names of estimators, in tables and on the command line.

Settings take the objects: OdometrySettings(estimator=refined). A new estimator is a class with a
method `motion` and, if it wants no RANSAC, its own `search` (step.Estimator), and an entry here.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from thesis_repro.odometry.loop import VoteOfAll
from thesis_repro.odometry.step import Estimator, Matches, Motion


class VoteOfInliers(VoteOfAll):
    """The motion that most inliers vote for."""

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step (see step.Estimator)."""
        current, previous = matches.current[matches.inliers], matches.previous[matches.inliers]
        return super().motion(
            essential, Matches(current, previous, matches.threshold), scale, moves
        )


def refined(calls: Any) -> Estimator:
    """Return a new refined estimator (odometry.refined)."""
    from thesis_repro.odometry.refined import RefinedEstimator  # compiles functions

    return RefinedEstimator()


class Entry(NamedTuple):
    """An estimator by name."""

    title: str  # in tables and figures
    make: Callable | None  # as in settings: from the odometry's calls to an estimator


ESTIMATORS = {
    "thesis": Entry("thesis's estimator", None),
    "inliers": Entry("vote of the inliers", VoteOfInliers),
    "refined": Entry("refined estimator", refined),
}
COMPARED = ("thesis", "refined")  # those of every study that names no others
