"""The refined estimator (not in the thesis): one object that remembers the step before.

The motion is fitted to all points near it and compared with the motion of the step before.
"""

from dataclasses import replace

import numpy as np

from thesis_repro.odometry.refined import fit
from thesis_repro.odometry.refined.motion_prior import MotionPrior, check_consistency
from thesis_repro.odometry.step import Matches, Motion


class RefinedEstimator:
    """The motion with the smaller rotation, fitted to all points near it and then checked."""

    def __init__(self) -> None:
        """Start before the first step."""
        self.prior = MotionPrior.straight_ahead()

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step (see step.Estimator), flagged if it is not consistent.

        A step that does not move the pose is not compared with the step before, and the next one is
        not compared with it.
        """
        # RANSAC's order: sums in another order have other last digits
        motion = fit.fit(*fit.smaller_rotation(essential), _in_order_of_ransac(matches))
        if not moves:
            return motion
        motion, self.prior, flag = check_consistency(motion, matches, scale, self.prior)
        return replace(motion, flag=flag)


def _in_order_of_ransac(matches: Matches) -> Matches:
    return replace(
        matches,
        current=matches.current[matches.order],
        previous=matches.previous[matches.order],
        inliers=matches.inliers[matches.order],
        order=slice(None),
    )
