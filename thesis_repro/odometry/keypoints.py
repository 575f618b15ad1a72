"""Keypoints: Shi-Tomasi detection and Lucas-Kanade tracking (Sections 3.7.1, 3.7.2).

`detect` and `track` serve one run. `SharedKeypoints` does the same for many runs at once.
"""

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

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

Start = tuple[np.ndarray | None, np.ndarray]  # a frame to track from and its points (N, 2)


class Corners(NamedTuple):
    """Corners of a frame (height, width)."""

    strength: np.ndarray  # of every pixel, (height, width)
    # local maxima of the strength, as indices into the flattened image, strongest first
    ranked: np.ndarray


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
        keypoints = _orb(settings.max_keypoints).detect(frame, inside)
        points = cv2.KeyPoint_convert(keypoints)
        points = np.reshape(points, (-1, 2)).astype(np.float32, copy=False)
    else:
        corners = corners or find_corners(frame, settings.block_size)
        points = _strongest(corners, settings, inside)
    if mask is None or settings.mask_mode == "detect":
        return points
    columns, rows = np.rint(points).astype(int).T
    return points[mask[rows, columns] > 0]


@lru_cache
def _orb(max_keypoints: int) -> cv2.ORB:
    return cv2.ORB_create(max_keypoints)


def _strongest(
    corners: Corners, settings: OdometrySettings, inside: np.ndarray | None
) -> np.ndarray:
    """Shi-Tomasi keypoints (N, 2) of a frame's corners, inside a mask if there is one."""
    _, strongest, _, _ = cv2.minMaxLoc(corners.strength, inside)
    # OpenCV computes the limit in double precision and rounds it to single.
    limit = np.float32(strongest * settings.quality)
    if inside is None:
        inside = np.empty((0, 0), np.uint8)  # compiled functions take arrays of one type
    return _spread(
        corners.strength,
        corners.ranked,
        limit,
        inside,
        settings.max_keypoints,
        float(settings.min_distance),
    )


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
    tracker = TRACKER | {"winSize": (window, window), "maxLevel": levels}
    tracked_in_order, status, _ = cv2.calcOpticalFlowPyrLK(
        previous, current, points[order], None, flags=cv2.OPTFLOW_LK_GET_MIN_EIGENVALS, **tracker
    )
    tracked = np.empty_like(points)
    tracked[order] = tracked_in_order
    was_found = np.empty(len(points), bool)
    was_found[order] = status.ravel() == 1
    window_corner = tracked - (window - 1) / 2  # upper left
    touches_frame = (window_corner >= -window) & (window_corner < current.shape[::-1])
    return tracked, was_found & touches_frame.all(axis=1)


class _Tracks(NamedTuple):
    """Points of many runs, tracked together from one frame into the next."""

    previous: np.ndarray
    current: np.ndarray
    keys: np.ndarray  # sorted, see `_key`
    tracked: np.ndarray  # (N, 2), in the order of the keys
    success: np.ndarray  # (N,) booleans


class _FrameCorners(NamedTuple):
    """The corners of a frame for one block size."""

    frame: np.ndarray
    block_size: int
    corners: Corners


class SharedKeypoints:
    """`detect` and `track` for many runs over one frame, with the same results as separate calls.

    The corner strength does not depend on the mask, so it is computed once a frame. Lucas-Kanade
    tracks each point independently, so all points of all runs are tracked in one call.
    """

    def __init__(self) -> None:
        self._tracks: _Tracks | None = None
        self._corners: _FrameCorners | None = None

    def expect(self, frame: np.ndarray, starts: Iterable[Start]) -> None:
        """Track the points of all runs that have the same previous frame into `frame`.

        starts: of the runs. Few runs have another previous frame than the first one.
        """
        starts_with_points = [
            (previous, points)
            for previous, points in starts
            if previous is not None and len(points)
        ]
        if not starts_with_points:
            return
        first, _ = starts_with_points[0]
        all_keys = [_key(points) for previous, points in starts_with_points if previous is first]
        keys = np.unique(np.concatenate(all_keys))
        points = keys.view(np.float32).reshape(-1, 2)
        self._tracks = _Tracks(first, frame, keys, *track(first, frame, points))

    def track(
        self,
        previous: np.ndarray,
        current: np.ndarray,
        points: np.ndarray,
        window: int = WINDOW,
        levels: int = LEVELS,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Like `keypoints.track`. Points that `expect` has tracked are looked up."""
        tracks = self._tracks
        is_shared = (
            tracks is not None
            and previous is tracks.previous
            and current is tracks.current
            and (window, levels) == (WINDOW, LEVELS)
        )
        if tracks is None or not is_shared:
            return track(previous, current, points, window, levels)
        indices = np.searchsorted(tracks.keys, _key(points))
        return tracks.tracked.take(indices, axis=0), tracks.success[indices]

    def detect(
        self, frame: np.ndarray, settings: OdometrySettings, mask: np.ndarray | None = None
    ) -> np.ndarray:
        """Like `keypoints.detect`. The corners of the last frame are kept."""
        size = settings.block_size
        last = self._corners
        if last is None or frame is not last.frame or size != last.block_size:
            last = _FrameCorners(frame, size, find_corners(frame, size))
            self._corners = last
        return detect(frame, settings, mask, last.corners)


def _key(points: np.ndarray) -> np.ndarray:
    """The bits of each of N points (N, 2) float32 as one integer, (N,)."""
    return np.ascontiguousarray(points).view(np.int64).ravel()


def find_corners(frame: np.ndarray, block_size: int) -> Corners:
    """Corner strength of each pixel and its ranked local maxima.

    Of equal maxima, the last pixel comes first. Pixels on the border are left out.
    """
    strength = cv2.cornerMinEigenVal(frame, block_size)
    is_peak = (strength == cv2.dilate(strength, None)) & (strength > 0)
    is_peak[[0, -1]] = False
    is_peak[:, [0, -1]] = False
    peaks = np.flatnonzero(is_peak)
    # a stable sort leaves equal maxima in the order of their pixels
    weakest_first = np.argsort(strength.ravel()[peaks], kind="stable")
    return Corners(strength, peaks[weakest_first[::-1]])


@fast
def _spread(strength, ranked, limit, mask, max_keypoints, min_distance):
    """Strongest corners above `limit` that are at least `min_distance` apart.

    They lie inside the mask (height, width), unless it is empty, (0, 0). max_keypoints: 0 for no
    limit. As in OpenCV, neighbours are searched in adjacent grid cells only, so a fractional
    distance is not kept exactly.
    """
    height, width = strength.shape
    cell = max(int(np.rint(min_distance)), 1)
    grid_rows = height // cell + 1
    grid_columns = width // cell + 1
    head = np.empty((grid_rows, grid_columns), np.int32)  # last corner taken in a cell
    head[:] = -1
    below = np.empty(len(ranked), np.int32)  # the corner taken before it in the same cell
    most = len(ranked)
    if max_keypoints > 0:
        most = min(most, max_keypoints)
    taken = np.empty((most, 2), np.float32)
    count = 0
    for index in ranked:
        y = index // width
        x = index % width
        if strength[y, x] <= limit or count == most:
            break
        if mask.size and mask[y, x] == 0:
            continue
        cell_y = y // cell
        cell_x = x // cell
        free = True
        for near_y in range(max(cell_y - 1, 0), min(cell_y + 2, grid_rows)):
            for near_x in range(max(cell_x - 1, 0), min(cell_x + 2, grid_columns)):
                other = head[near_y, near_x]
                while free and other >= 0:
                    dx = x - taken[other, 0]
                    dy = y - taken[other, 1]
                    free = dx * dx + dy * dy >= min_distance * min_distance
                    other = below[other]
        if free:
            taken[count, 0] = x
            taken[count, 1] = y
            below[count] = head[cell_y, cell_x]
            head[cell_y, cell_x] = count
            count += 1
    return taken[:count].copy()
