"""The errors of a path: one table, and their numbers.

Errors are computed from the poses of finished runs, so a new one repeats no run. It is an entry in
ERRORS and a number in `path_errors`.
"""

from typing import NamedTuple

import numpy as np

from thesis_repro.odometry import metrics
from thesis_repro.odometry.metrics import RELATIVE_LENGTH


class Error(NamedTuple):
    """An error of a path. title, unit: in tables and figures.

    decides: whether masks help. Of an error that does, margin: the factor by which it may be larger
    with few keypoints; plainly: what it is, for readers who know no titles.
    """

    title: str
    unit: str
    decides: bool = False
    margin: float = np.nan
    plainly: str = ""


# A constant angle between camera and ground truth leaves the aligned ATE alone. It changes the
# rotational RPE by thousandths of a degree.
ERRORS = {
    "se3": Error("aligned ATE", "m", True, 1.25, "error of the path"),
    "rotation": Error("rotational RPE, 1 frame", "deg", True, 1.1, "error of the rotations"),
    "rmse": Error("RMSE", "m"),
    "mae": Error("MAE", "m"),
    "translation_percent": Error(f"translation error over {RELATIVE_LENGTH:g} m", "%"),
    "rotation_deg_per_100m": Error(f"rotation error over {RELATIVE_LENGTH:g} m", "deg/100 m"),
    "t_rel": Error("KITTI's t_rel", "%"),
    "r_rel": Error("KITTI's r_rel", "deg/100 m"),
}


def path_errors(poses: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Return the errors of a path; poses, true: (n, 4, 4).

    They are those of `metrics.errors` and `metrics.step_errors`; t_rel (percent) and r_rel (degrees
    per 100 m) are those of `metrics.kitti_errors`.
    """
    return {
        **metrics.errors(poses, true),
        **metrics.step_errors(poses, true),
        **metrics.kitti_errors(poses, true),
    }
