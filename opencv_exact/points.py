"""Points and frames as callers give them: what OpenCV refuses is refused."""

from typing import Any

import cv2
import numpy as np


def as_points(name: str, points: Any, kind: type = np.float64) -> np.ndarray:
    """Points (N, 2), (N, 1, 2) or (1, N, 2) as an array (N, 2) of a kind of numbers.

    Raises ValueError for other shapes, which could only be read as other points.
    """
    refuse_umat(name, points)
    array: np.ndarray = np.asarray(points, kind)
    is_list = array.ndim == 2 or (array.ndim == 3 and 1 in array.shape[:2])
    if not is_list or array.shape[-1] != 2:
        raise ValueError(f"{name}: of shape {array.shape}; must be (N, 2) or (N, 1, 2)")
    return array.reshape(-1, 2)


def as_pairs(points1: Any, points2: Any) -> tuple[np.ndarray, np.ndarray]:
    """Correspondences as two arrays (N, 2) float64. Raises ValueError for unequal numbers, too."""
    first, second = as_points("points1", points1), as_points("points2", points2)
    if len(first) != len(second):
        raise ValueError(f"points1, points2: {len(first)} and {len(second)} points; must be pairs")
    return first, second


def refuse_umat(name: str, array: Any) -> None:
    """Raise ValueError for OpenCV's array on a graphics card."""
    if isinstance(array, cv2.UMat):
        raise ValueError(f"{name}: a cv2.UMat is not served; {name}.get() is an array")
