"""Keypoints: Shi-Tomasi detection and Lucas-Kanade tracking (Sections 3.7.1, 3.7.2), for one
run or for many runs.
"""

from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np

from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.running.compiled import fast

WINDOW, LEVELS = THESIS.window, THESIS.levels
TRACKER = {
    "winSize": (WINDOW, WINDOW),
    "maxLevel": LEVELS,
    "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
}

NO_POINTS = np.empty((0, 2), np.float32)

Corners = tuple[np.ndarray, np.ndarray]  # see find_corners
Start = tuple[np.ndarray | None, np.ndarray]  # a frame to track from and its points (N, 2)


def detect(
    frame: np.ndarray,
    settings: OdometrySettings,
    mask: np.ndarray | None = None,
    corners: Corners | None = None,
) -> np.ndarray:
    """Keypoints of a frame (height, width): (N, 2) float32 pixels, strongest first. N may be 0.

    `mask` (height, width) allows keypoints where it is not 0. With settings.mask_mode "detect" the
    detector searches inside the mask only and returns up to max_keypoints. With "filter" it
    searches the whole frame, and keypoints outside the mask are dropped. corners: result of
    `find_corners` for this frame, if known.

    Shi-Tomasi keypoints equal those of cv2.goodFeaturesToTrack to the bit.
    """
    inside = mask if settings.mask_mode == "detect" else None
    if settings.detector == "orb":
        points = cv2.KeyPoint_convert(_orb(settings.max_keypoints).detect(frame, inside))
        points = np.reshape(points, (-1, 2)).astype(np.float32, copy=False)
    else:
        strength, ranked = corners or find_corners(frame, settings.block_size)
        # OpenCV computes the limit in double precision and rounds it to single.
        limit = np.float32(cv2.minMaxLoc(strength, inside)[1] * settings.quality)
        points = _spread(
            strength,
            ranked,
            limit,
            np.empty((0, 0), np.uint8) if inside is None else inside,
            settings.max_keypoints,
            float(settings.min_distance),
        )
    if mask is None or settings.mask_mode == "detect":
        return points
    columns, rows = np.rint(points).astype(int).T
    return points[mask[rows, columns] > 0]


@lru_cache
def _orb(max_keypoints: int) -> cv2.ORB:
    return cv2.ORB_create(max_keypoints)


def track(
    previous: np.ndarray,
    current: np.ndarray,
    points: np.ndarray,
    window: int = WINDOW,
    levels: int = LEVELS,
) -> tuple[np.ndarray, np.ndarray]:
    """Track points (N, 2) from the previous frame into the current one.

    Returns the tracked points, (N, 2) float32, and whether tracking succeeded, (N,) booleans.
    window, levels: as in OdometrySettings.

    The result equals that of OpenCV's plain call to the bit, in less time. Points are sorted by
    row, so that the pixels of neighbouring points are still in the processor's cache. The matching
    error is not computed, because nothing uses it. Computing it, OpenCV also rejects points whose
    window leaves the frame; this function does that itself.
    """
    order = np.argsort(points[:, 1])
    tracked, success = np.empty_like(points), np.empty(len(points), bool)
    tracker = TRACKER | {"winSize": (window, window), "maxLevel": levels}
    tracked[order], status, _ = cv2.calcOpticalFlowPyrLK(
        previous, current, points[order], None, flags=cv2.OPTFLOW_LK_GET_MIN_EIGENVALS, **tracker
    )
    corner = tracked - (window - 1) / 2
    success[order] = status.ravel() == 1
    return tracked, success & ((corner >= -window) & (corner < current.shape[::-1])).all(axis=1)


class SharedKeypoints:
    """`detect` and `track` for many runs over one frame, with the same results as separate calls.

    The corner strength does not depend on the mask, so it is computed once a frame. Lucas-Kanade
    tracks each point independently, so all points of all runs are tracked in one call.
    """

    def __init__(self) -> None:
        # both frames, sorted keys of all points, result of `track`
        self._tracks: tuple[np.ndarray, ...] = ()
        # frame, block size, result of `find_corners`
        self._corners: tuple[np.ndarray, int, Corners] | None = None

    def expect(self, frame: np.ndarray, starts: Iterable[Start]) -> None:
        """Track the points of all runs that have the same previous frame into `frame`. Few runs
        have another one.
        """
        with_points = [
            (previous, points)
            for previous, points in starts
            if previous is not None and len(points)
        ]
        if with_points:
            first, _ = with_points[0]
            keys = np.unique(
                np.concatenate(
                    [_key(points) for previous, points in with_points if previous is first]
                )
            )
            self._tracks = (
                first,
                frame,
                keys,
                *track(first, frame, keys.view(np.float32).reshape(-1, 2)),
            )

    def track(
        self,
        previous: np.ndarray,
        current: np.ndarray,
        points: np.ndarray,
        window: int = WINDOW,
        levels: int = LEVELS,
    ) -> tuple[np.ndarray, np.ndarray]:
        is_shared = self._tracks and previous is self._tracks[0] and current is self._tracks[1]
        if not is_shared or (window, levels) != (WINDOW, LEVELS):
            return track(previous, current, points, window, levels)
        _, _, keys, tracked, success = self._tracks
        indices = np.searchsorted(keys, _key(points))
        return tracked.take(indices, axis=0), success[indices]

    def detect(
        self, frame: np.ndarray, settings: OdometrySettings, mask: np.ndarray | None = None
    ) -> np.ndarray:
        size = settings.block_size
        if self._corners is None or frame is not self._corners[0] or size != self._corners[1]:
            self._corners = frame, size, find_corners(frame, size)
        return detect(frame, settings, mask, self._corners[2])


def _key(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points).view(np.int64).ravel()


def find_corners(frame: np.ndarray, block_size: int) -> Corners:
    """Corner strength of each pixel and its ranked local maxima.

    The maxima are indices into the flattened image, strongest first. Of equal maxima, the last
    pixel comes first. Pixels on the border are left out.
    """
    strength = cv2.cornerMinEigenVal(frame, block_size)
    is_peak = (strength == cv2.dilate(strength, None)) & (strength > 0)
    is_peak[[0, -1]] = is_peak[:, [0, -1]] = False
    peaks = np.flatnonzero(is_peak)
    # Positive floats sort like their bit patterns, so one sort of integers ranks by strength and
    # then by index.
    return strength, np.sort(strength.ravel()[peaks].view(np.int32).astype(np.int64) << 32 | peaks)[
        ::-1
    ] & 0xFFFFFFFF


@fast
def _spread(strength, ranked, limit, mask, max_keypoints, min_distance):
    """Strongest corners above `limit`, inside the mask if it is not empty, at least `min_distance`
    apart.

    As in OpenCV, neighbours are searched in adjacent grid cells only, so a fractional distance is
    not kept exactly.
    """
    height, width = strength.shape
    cell = max(int(np.rint(min_distance)), 1)
    grid_rows, grid_columns = height // cell + 1, width // cell + 1
    head = np.empty((grid_rows, grid_columns), np.int32)  # last corner taken in a cell
    head[:] = -1
    below = np.empty(len(ranked), np.int32)  # the corner taken before it in the same cell
    taken = np.empty(
        (len(ranked) if max_keypoints <= 0 else min(len(ranked), max_keypoints), 2), np.float32
    )
    count = 0
    for index in ranked:
        y, x = index // width, index % width
        if strength[y, x] <= limit or count == len(taken):
            break
        if mask.size and mask[y, x] == 0:
            continue
        cell_y, cell_x = y // cell, x // cell
        free = True
        for near_y in range(max(cell_y - 1, 0), min(cell_y + 2, grid_rows)):
            for near_x in range(max(cell_x - 1, 0), min(cell_x + 2, grid_columns)):
                other = head[near_y, near_x]
                while free and other >= 0:
                    dx, dy = x - taken[other, 0], y - taken[other, 1]
                    free = dx * dx + dy * dy >= min_distance * min_distance
                    other = below[other]
        if free:
            taken[count, 0], taken[count, 1] = x, y
            below[count] = head[cell_y, cell_x]
            head[cell_y, cell_x] = count
            count += 1
    return taken[:count].copy()
