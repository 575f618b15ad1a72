"""Keypoints: Shi-Tomasi detection and Lucas-Kanade tracking (Sections 3.7.1, 3.7.2), for one run or shared by many."""

from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np

from thesis_repro.compiled import fast
from thesis_repro.odometry.settings import OdometrySettings

QUALITY = 0.01  # of the strongest corner (inside the mask)
BLOCK_SIZE = 5
TRACKER = {"winSize": (21, 21), "maxLevel": 3,
           "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)}

NO_POINTS = np.empty((0, 2), np.float32)

Start = tuple[np.ndarray | None, np.ndarray]  # what a run tracks from: the previous frame, and its points there (N, 2)


def detect(frame: np.ndarray, settings: OdometrySettings, mask: np.ndarray | None = None) -> np.ndarray:
    """Keypoints of a frame (height, width), strongest first: (N, 2) float32, N = 0 where there are none.

    `mask` (height, width) allows keypoints where it is not 0. With settings.mask_mode "detect" the detector looks
    inside the mask only and finds up to max_keypoints there; with "filter" it looks everywhere and what lies
    outside is dropped.
    """
    inside = mask if settings.mask_mode == "detect" else None
    if settings.detector == "orb":
        points = cv2.KeyPoint_convert(_orb(settings.max_keypoints).detect(frame, inside))
    else:
        points = cv2.goodFeaturesToTrack(frame, settings.max_keypoints, QUALITY, settings.min_distance, mask=inside,
                                         blockSize=BLOCK_SIZE)
    return _inside(NO_POINTS if points is None else np.reshape(points, (-1, 2)).astype(np.float32, copy=False),
                   settings, mask)


def _inside(points, settings, mask):
    if mask is None or settings.mask_mode == "detect" or not len(points):
        return points
    columns, rows = np.rint(points).astype(int).T
    return points[mask[rows, columns] > 0]


@lru_cache
def _orb(max_keypoints):
    return cv2.ORB_create(max_keypoints)


def track(previous: np.ndarray, current: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 2) of the previous frame are in the current one: (N, 2) float32, and N booleans: success."""
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(previous, current, points, None, **TRACKER)
    return tracked, status.ravel() == 1


class SharedKeypoints:
    """`detect` and `track` with the same results for many runs over one frame, at little more than the cost of one.

    The corner strength does not depend on the mask (only its maximum and the choice do), and Lucas-Kanade tracks
    every point on its own, so the first is computed once a frame and the second once for all points of all runs.
    """

    def __init__(self) -> None:
        self._tracks: tuple[np.ndarray, ...] = ()  # both frames, the sorted keys of all points, what `track` returns
        self._corners: tuple | None = None  # the frame, its corner strength, and its _ranked_maxima

    def expect(self, frame: np.ndarray, starts: Iterable[Start]) -> None:
        """Track to `frame` the points of all runs that come from the same previous frame (nearly always all)."""
        with_points = [(previous, points) for previous, points in starts if previous is not None and len(points)]
        if with_points:
            first, _ = with_points[0]
            keys = np.unique(np.concatenate([_key(points) for previous, points in with_points if previous is first]))
            self._tracks = first, frame, keys, *track(first, frame, keys.view(np.float32).reshape(-1, 2))

    def track(self, previous: np.ndarray, current: np.ndarray,
              points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not self._tracks or previous is not self._tracks[0] or current is not self._tracks[1]:  # resumed, say
            return track(previous, current, points)
        _, _, keys, tracked, success = self._tracks
        where = np.searchsorted(keys, _key(points))
        return tracked[where], success[where]

    def detect(self, frame: np.ndarray, settings: OdometrySettings, mask: np.ndarray | None = None) -> np.ndarray:
        if settings.detector != "shi-tomasi" or settings.min_distance < 1:
            return detect(frame, settings, mask)
        if self._corners is None or frame is not self._corners[0]:
            strength = cv2.cornerMinEigenVal(frame, BLOCK_SIZE)
            self._corners = frame, strength, _ranked_maxima(strength, cv2.dilate(strength, None))
        _, strength, ranked = self._corners
        inside = mask if settings.mask_mode == "detect" else None
        # As OpenCV compares: the limit in double precision, rounded to single.
        limit = np.float32(cv2.minMaxLoc(strength, inside)[1] * QUALITY)
        chosen = _spread(*ranked, limit, np.empty((0, 0), np.uint8) if inside is None else inside,
                         settings.max_keypoints, settings.min_distance, *frame.shape)
        return _inside(chosen, settings, mask)


def _key(points):
    return np.ascontiguousarray(points).view(np.int64).ravel()


def _ranked_maxima(strength, largest_near):
    """Rows, columns and strength of the local maxima inside the border, strongest first, of equals the last first."""
    inner = np.flatnonzero((strength[1:-1, 1:-1] == largest_near[1:-1, 1:-1]) & (strength[1:-1, 1:-1] > 0))
    rows, columns = np.divmod(inner, strength.shape[1] - 2)
    values = strength[rows + 1, columns + 1]
    order = np.argsort(values, kind="stable")[::-1]
    return rows[order] + 1, columns[order] + 1, values[order]


@fast
def _spread(rows, columns, values, limit, mask, max_keypoints, min_distance, height, width):
    """The strongest corners above `limit` inside the mask (if any) that keep `min_distance` from stronger ones.

    Distances are looked at within the neighbouring cells of a grid of about min_distance, as in OpenCV; for a
    fractional min_distance that is not quite the same as looking at all of them.
    """
    cell = int(np.rint(min_distance))
    grid_rows, grid_columns = height // cell + 1, width // cell + 1
    head = np.empty((grid_rows, grid_columns), np.int32)  # last corner taken in a cell
    head[:] = -1
    below = np.empty(len(rows), np.int32)  # the one taken before it in the same cell
    taken = np.empty((len(rows) if max_keypoints <= 0 else min(len(rows), max_keypoints), 2), np.float32)
    count = 0
    for index in range(len(rows)):
        if values[index] <= limit or count == len(taken):
            break
        y, x = rows[index], columns[index]
        if mask.size and mask[y, x] == 0:
            continue
        cell_y, cell_x = y // cell, x // cell
        free = True
        for near_y in range(max(cell_y - 1, 0), min(cell_y + 2, grid_rows)):
            for near_x in range(max(cell_x - 1, 0), min(cell_x + 2, grid_columns)):
                other = head[near_y, near_x]
                while other >= 0:
                    dx, dy = x - taken[other, 0], y - taken[other, 1]
                    if dx * dx + dy * dy < min_distance * min_distance:
                        free = False
                        break
                    other = below[other]
        if free:
            taken[count, 0], taken[count, 1] = x, y
            below[count] = head[cell_y, cell_x]
            head[cell_y, cell_x] = count
            count += 1
    return taken[:count].copy()
