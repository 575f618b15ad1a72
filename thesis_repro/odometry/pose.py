"""Relative motion of a calibrated camera from point correspondences (Section 2.2).

The essential matrix comes first, then the motion.

As in PySLAM, points of the current frame come first. So the rotation and the unit translation take
coordinates of the current camera to coordinates of the previous camera. A camera-to-world pose is
moved by them without an inverse.
"""

import numpy as np

from opencv_exact import find_essential_matrix, recover_pose  # noqa: F401
from thesis_repro.odometry.types import Motion  # noqa: F401

PROBABILITY = 0.999  # of RANSAC
MIN_CORRESPONDENCES = 5


def normalise(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Normalised image coordinates (N, 2), in double precision, of pixels (N, 2).

    u * (1 / fx) + (-cx / fx) equals the product of the inverse camera matrix and (u, v, 1) to the
    last bit. The formula (u - cx) / fx does not. RANSAC amplifies a difference in the last bit, so
    the trajectory would be another one.
    """
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    return points * (1 / focal) + (-intrinsics[:2, 2] / focal)


def essential_matrix(
    current: np.ndarray, previous: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray, str]:
    """Essential matrix of normalised correspondences (N, 2). Returns (matrix, inliers, problem).

    If there is no matrix or more than one, `matrix` is None and `problem` says why. (From exactly
    five correspondences, OpenCV returns all solutions in one array.)
    """
    no_inliers = np.zeros(len(current), bool)
    if len(current) < MIN_CORRESPONDENCES:
        return None, no_inliers, "fewer than five correspondences"
    matrix, inliers = find_essential_matrix(current, previous, threshold, PROBABILITY)
    if matrix is None or inliers is None or not np.isfinite(matrix).all():
        return None, no_inliers, "no essential matrix"
    if matrix.shape != (3, 3):
        return None, no_inliers, "several essential matrices"
    return matrix, inliers.ravel() > 0, ""
