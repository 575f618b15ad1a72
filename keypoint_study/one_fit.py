"""The precision of one motion, from one fit: a second measure of what keypoints are worth.

The halves of `worth` need two fits a split. This needs one for all keypoints: its cluster-robust
covariance H^-1 (sum of g g^T over the fields) H^-1, the sandwich of Huber and of Liang and Zeger.
H is the Gauss-Newton matrix of the fit, and g the sum of the gradients of a field's points. What
the points of a field share is then not counted as if each knew it for itself, as it would be by
H^-1 alone.
"""

import numpy as np

from thesis_repro.odometry import Matches, Motion
from thesis_repro.odometry.refined.fit import SUPPORT_THRESHOLDS, columns, near
from thesis_repro.odometry.refined.normal_equations import gradients_of_groups, normal_equations

MIN_FIELDS = 6  # that determine the five parameters of a motion


def variances(motion: Motion, matches: Matches, fields: np.ndarray) -> tuple[float, float]:
    """Return the variances (degrees^2) of a fitted motion's rotation and direction.

    matches: N of the fit. fields: (N,), the number of the field of each. They are sums over the
    axes. Infinite if fewer than MIN_FIELDS fields hold points near the motion.
    """
    scale = matches.threshold / 2  # of the fit's weights
    limit = SUPPORT_THRESHOLDS * matches.threshold
    supporting = near(motion.rotation, motion.translation, matches, limit)
    points, fields = columns(matches)[:, supporting], fields[supporting]
    order = np.argsort(fields, kind="stable")
    starts = np.flatnonzero(np.diff(fields[order], prepend=-1))
    if len(starts) < MIN_FIELDS:
        return np.inf, np.inf
    of_motion = motion.rotation, motion.translation
    gradients = gradients_of_groups(
        *of_motion, np.ascontiguousarray(points[:, order]), starts, scale
    )
    _, hessian, _ = normal_equations(*of_motion, np.ascontiguousarray(points), scale, True)
    moved = np.degrees(np.linalg.solve(hessian, gradients.T))  # (5, fields)
    squares = (moved**2).sum(axis=1)
    return float(squares[:3].sum()), float(squares[3:].sum())
