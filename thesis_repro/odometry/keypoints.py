"""Choices of keypoints beside the thesis's: spread ones, filled masks, ORB's, filtered ones."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from thesis_repro.odometry import odometry
from thesis_repro.odometry.settings import THESIS, OdometrySettings

FIELDS = (5, 16)  # rows and columns into which a frame is divided to fill a mask


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
    if settings.detector == "orb":
        points = _detect_orb(frame, settings, inside)
    elif settings.choice == "spread":
        points = spread(frame, settings, inside, shi_tomasi)
    else:
        points = shi_tomasi(frame, settings, inside)
    if mask is None:
        return points
    if settings.mask_mode == "filter":
        columns, rows = np.rint(points).astype(int).T
        points = points[mask[rows, columns] > 0]
    if settings.fill:
        all_strongest = replace(settings, choice="strongest", max_keypoints=0)
        everywhere = shi_tomasi(frame, all_strongest, None)
        points = filled(points, everywhere, frame.shape, settings)
    return points


def spread(
    frame: np.ndarray,
    settings: OdometrySettings,
    inside: np.ndarray | None,
    shi_tomasi: Callable,
) -> np.ndarray:
    """The strongest keypoints that are as far apart as their number allows.

    The field calls it adaptive non-maximal suppression. The distance, whole pixels, is found by
    bisection in each frame: the largest one that leaves max_keypoints.
    """
    chosen = shi_tomasi(frame, settings, inside)
    near, far = settings.min_distance, max(frame.shape)
    while len(chosen) == settings.max_keypoints and far - near > 1:
        middle = int((near + far) / 2)
        points = shi_tomasi(frame, replace(settings, min_distance=middle), inside)
        if len(points) == settings.max_keypoints:
            near, chosen = middle, points
        else:
            far = middle
    return chosen


def filled(
    points: np.ndarray,
    everywhere: np.ndarray,
    size: tuple[int, ...],
    settings: OdometrySettings,
) -> np.ndarray:
    """Points of a mask (N, 2), and more in the fields of the frame where the mask leaves few.

    A field with fewer than settings.fill points gets its strongest keypoints of `everywhere` (M, 2)
    that are min_distance away from its points. The field calls such a division bucketing.
    """
    chosen = list(points)
    fields_of_points = _fields(points, size)
    fields_of_others = _fields(everywhere, size)
    for field in range(FIELDS[0] * FIELDS[1]):
        taken = list(points[fields_of_points == field])
        for candidate in everywhere[fields_of_others == field]:
            if len(taken) >= settings.fill:
                break
            distances = np.linalg.norm(np.reshape(taken, (-1, 2)) - candidate, axis=1)
            if (distances >= settings.min_distance).all():
                taken.append(candidate)
                chosen.append(candidate)
    return np.reshape(chosen, (-1, 2)).astype(np.float32)


def _fields(points: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Number of the field in which each of N points (N, 2) lies, (N,)."""
    columns, rows = (points // (size[1] / FIELDS[1], size[0] / FIELDS[0])).astype(int).T
    return rows * FIELDS[1] + columns


def _detect_orb(
    frame: np.ndarray, settings: OdometrySettings, inside: np.ndarray | None
) -> np.ndarray:
    found = cv2.ORB_create(settings.max_keypoints).detect(frame, inside)
    points = cv2.KeyPoint_convert(found)
    return np.reshape(points, (-1, 2)).astype(np.float32, copy=False)
