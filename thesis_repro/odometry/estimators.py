"""The estimators: how a step's motion follows from its essential matrix, which allows four."""

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from thesis_repro.odometry.types import Matches, Motion, motion_of_vote


class Entry(NamedTuple):
    """An estimator that settings can name."""

    title: str  # in tables and figures
    module: str  # imported when a setting asks for it
    class_name: str  # has `motion`, see odometry.Estimator
    is_compared: bool = True  # in studies; otherwise only the ablations run it


# A new estimator is an entry here. OdometrySettings describes them.
ESTIMATORS = {
    "thesis": Entry("thesis's estimator", "thesis_repro.odometry.odometry", "VoteOfAll"),
    "inliers": Entry(
        "vote of the inliers", "thesis_repro.odometry.estimators", "VoteOfInliers", False
    ),
    "refined": Entry("refined estimator", "thesis_repro.odometry.refined", "RefinedEstimator"),
}


def new_estimator(name: str, calls: Any) -> Any:
    """Return a new object of an estimator. calls: see odometry.Calls."""
    entry = ESTIMATORS[name]
    return getattr(import_module(entry.module), entry.class_name)(calls)


class VoteOfInliers:
    """The motion that most inliers vote for."""

    def __init__(self, calls: Any):
        self.calls = calls

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step (see odometry.Estimator)."""
        inliers = matches.inliers
        voted = self.calls.recover_pose(
            essential, matches.current[inliers], matches.previous[inliers]
        )
        return motion_of_vote(*voted)
