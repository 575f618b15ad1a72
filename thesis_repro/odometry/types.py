"""What the odometry hands from call to call: matched points, and the motion found from them."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Matches:
    """Points matched between two frames, in normalised image coordinates.

    current, previous: (N, 2). inliers: (N,) booleans, those that agree with the essential matrix;
    None before it is known. threshold: largest distance of an inlier.
    """

    current: np.ndarray
    previous: np.ndarray
    threshold: float
    inliers: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the camera between two frames.

    As in PySLAM, it takes coordinates of the current camera to coordinates of the previous camera,
    so it moves a camera-to-world pose without an inverse. rotation is None if it is not known, and
    `flag` says why.
    """

    rotation: np.ndarray | None = None  # 3x3
    translation: np.ndarray | None = None  # 3, unit length
    pose_inliers: int = 0  # matches in front of both cameras and not too far away
    flag: str = ""
