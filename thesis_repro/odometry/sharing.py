"""The four calls of the odometry for many runs over the same frames: what several ask for, once.

The results equal those of separate runs with OpenCV's calls, to the bit.
"""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

import opencv_exact
from opencv_exact.compiling import compiled
from thesis_repro.odometry import keypoints
from thesis_repro.odometry.odometry import PROBABILITY, TERMINATION, Calls, Odometry
from thesis_repro.odometry.settings import THESIS, OdometrySettings


class Corners(NamedTuple):
    """Corners of a frame (height, width)."""

    strength: np.ndarray  # of every pixel, (height, width)
    # local maxima of the strength, as indices into the flattened image, strongest first
    ranked: np.ndarray


class _Tracks(NamedTuple):
    """Points of many runs, tracked together from one frame into the next."""

    previous: np.ndarray
    keys: np.ndarray  # sorted, see `_keys`
    tracked: np.ndarray  # (N, 2), in the order of the keys
    success: np.ndarray  # (N,) booleans


class SharedCalls:
    """The four calls, which remember what one run has asked for until the next frame.

    The corner strength does not depend on the mask, so it is computed once a frame. Lucas-Kanade
    tracks each point independently, so all points of all runs are tracked in one call. The search
    for the essential matrix and the vote are those of opencv_exact.
    """

    def __init__(self) -> None:
        self.calls = Calls(
            self.detect, self.track, self.find_essential_matrix, opencv_exact.recover_pose
        )
        self._frame: np.ndarray | None = None
        self._forget()

    def _forget(self) -> None:
        self._tracks: _Tracks | None = None
        self._corners: dict[int, Corners] = {}
        self._detected: dict[tuple, tuple] = {}
        self._tracked: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        self._matrices: dict[tuple, tuple] = {}

    def expect(self, frame: np.ndarray, runs: Iterable[Odometry]) -> None:
        """Forget the frame before, and track the points of all runs into this one."""
        self._turn_to(frame)
        previous = None
        points_of_runs = {}
        for run in runs:
            if len(run.points):
                previous = run.previous  # the same for all runs
                points_of_runs[run.points.tobytes()] = run.points
        if previous is None:
            return
        keys = np.unique(np.concatenate([_keys(points) for points in points_of_runs.values()]))
        points = keys.view(np.float32).reshape(-1, 2)
        self._tracks = _Tracks(previous, keys, *track(previous, frame, points))

    def track(
        self,
        previous: np.ndarray,
        current: np.ndarray,
        points: np.ndarray,
        settings: OdometrySettings = THESIS,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Like `odometry.track`. Points that `expect` has tracked are looked up."""
        tracks = self._tracks
        is_usual = (settings.window, settings.levels) == (THESIS.window, THESIS.levels)
        if tracks is None or tracks.previous is not previous or not is_usual:
            return track(previous, current, points, settings)
        key = points.tobytes()
        if key not in self._tracked:
            indices = np.searchsorted(tracks.keys, _keys(points))
            self._tracked[key] = tracks.tracked[indices], tracks.success[indices]
        return self._tracked[key]

    def detect(
        self,
        frame: np.ndarray,
        settings: OdometrySettings = THESIS,
        mask: np.ndarray | None = None,
    ) -> np.ndarray:
        """Like `keypoints.detect`."""
        self._turn_to(frame)
        # the mask is remembered, too, so that no other array gets its identity
        key = (id(mask), *settings.of_detection())
        if key not in self._detected:
            points = keypoints.detect(frame, settings, mask, self._shi_tomasi)
            self._detected[key] = mask, points
        return self._detected[key][1]

    def _shi_tomasi(
        self, frame: np.ndarray, settings: OdometrySettings, inside: np.ndarray | None
    ) -> np.ndarray:
        size = settings.block_size
        if size not in self._corners:
            self._corners[size] = find_corners(frame, size)
        return _strongest(self._corners[size], settings, inside)

    def find_essential_matrix(
        self, current: np.ndarray, previous: np.ndarray, threshold: float
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Like `odometry.find_essential_matrix`."""
        key = (current.tobytes(), previous.tobytes(), threshold)
        if key not in self._matrices:
            self._matrices[key] = opencv_exact.find_essential_matrix(
                current, previous, threshold, PROBABILITY
            )
        return self._matrices[key]

    def _turn_to(self, frame: np.ndarray) -> None:
        if frame is not self._frame:
            self._frame = frame
            self._forget()


def _keys(points: np.ndarray) -> np.ndarray:
    """The bits of each of N points (N, 2) float32 as one integer, (N,)."""
    return np.ascontiguousarray(points).view(np.int64).ravel()


def track(
    previous: np.ndarray,
    current: np.ndarray,
    points: np.ndarray,
    settings: OdometrySettings = THESIS,
) -> tuple[np.ndarray, np.ndarray]:
    """Track points (N, 2) as `odometry.track` does, in less time.

    Points are sorted by row, so that the pixels of neighbouring points are still in the processor's
    cache. The matching error is not computed, because nothing uses it. Computing it, OpenCV also
    rejects points whose window leaves the frame; this function does that itself.
    """
    window = settings.window
    order = np.argsort(points[:, 1])
    tracked_in_order, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        points[order],
        None,
        winSize=(window, window),
        maxLevel=settings.levels,
        criteria=TERMINATION,
        flags=cv2.OPTFLOW_LK_GET_MIN_EIGENVALS,
    )
    tracked = np.empty_like(points)
    tracked[order] = tracked_in_order
    was_found = np.empty(len(points), bool)
    was_found[order] = status.ravel() == 1
    window_corner = tracked - (window - 1) / 2  # upper left
    touches_frame = (window_corner >= -window) & (window_corner < current.shape[::-1])
    return tracked, was_found & touches_frame.all(axis=1)


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


def _strongest(
    corners: Corners, settings: OdometrySettings, inside: np.ndarray | None
) -> np.ndarray:
    """Shi-Tomasi keypoints (N, 2) of a frame's corners, inside a mask if there is one."""
    _, strongest, _, _ = cv2.minMaxLoc(corners.strength, inside)
    # OpenCV computes the limit in double precision and rounds it to single.
    limit = np.float32(strongest * settings.quality)
    if inside is None:
        inside = np.empty((0, 0), np.uint8)  # compiled functions take arrays of one type
    return _apart(
        corners.strength,
        corners.ranked,
        limit,
        inside,
        settings.max_keypoints,
        float(settings.min_distance),
    )


@compiled
def _apart(
    strength: np.ndarray,
    ranked: np.ndarray,
    limit: np.float32,
    mask: np.ndarray,
    max_keypoints: int,
    min_distance: float,
) -> np.ndarray:
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
