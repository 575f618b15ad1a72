"""Choices of keypoints beside the thesis's: ORB's, and dropping those outside a mask."""

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from thesis_repro.odometry import odometry
from thesis_repro.odometry.settings import THESIS, OdometrySettings


def detect(
    frame: np.ndarray,
    settings: OdometrySettings = THESIS,
    mask: np.ndarray | None = None,
    shi_tomasi: Callable = odometry.detect,
) -> np.ndarray:
    """Find keypoints of a frame (height, width): (N, 2) float32 pixels, strongest first.

    mask: (height, width), allows keypoints where it is not 0. With settings.mask_mode "detect" the
    detector searches inside the mask only and returns up to max_keypoints. With "filter" it
    searches the whole frame, and keypoints outside the mask are dropped.
    shi_tomasi: what finds Shi-Tomasi keypoints, with the arguments of `odometry.detect`.
    """
    inside = mask if settings.mask_mode == "detect" else None
    find = _detect_orb if settings.detector == "orb" else shi_tomasi
    points = find(frame, settings, inside)
    if mask is None or settings.mask_mode == "detect":
        return points
    columns, rows = np.rint(points).astype(int).T
    return points[mask[rows, columns] > 0]


def _detect_orb(
    frame: np.ndarray, settings: OdometrySettings, inside: np.ndarray | None
) -> np.ndarray:
    found = _orb(settings.max_keypoints).detect(frame, inside)
    points = cv2.KeyPoint_convert(found)
    return np.reshape(points, (-1, 2)).astype(np.float32, copy=False)


@lru_cache
def _orb(max_keypoints: int) -> cv2.ORB:
    return cv2.ORB_create(max_keypoints)
