"""Keypoints: Shi-Tomasi detection and Lucas-Kanade tracking (Sections 3.7.1, 3.7.2), for one run or shared by many."""

from collections.abc import Iterable
from functools import lru_cache

import cv2
import numpy as np

from thesis_repro.compiled import fast
from thesis_repro.odometry.settings import THESIS, OdometrySettings

QUALITY = THESIS.quality  # of the strongest corner (inside the mask)
BLOCK_SIZE = THESIS.block_size
WINDOW, LEVELS = THESIS.window, THESIS.levels
TRACKER = {"winSize": (WINDOW, WINDOW), "maxLevel": LEVELS,
           "criteria": (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)}

NO_POINTS = np.empty((0, 2), np.float32)

Corners = tuple[np.ndarray, np.ndarray]  # see find_corners
Start = tuple[np.ndarray | None, np.ndarray]  # what a run tracks from: the previous frame, and its points there (N, 2)


def detect(frame: np.ndarray, settings: OdometrySettings, mask: np.ndarray | None = None,
           corners: Corners | None = None) -> np.ndarray:
    """Keypoints of a frame (height, width), strongest first: (N, 2) float32, N = 0 where there are none.

    `mask` (height, width) allows keypoints where it is not 0. With settings.mask_mode "detect" the detector looks
    inside the mask only and finds up to max_keypoints there; with "filter" it looks everywhere and what lies
    outside is dropped. corners: what `find_corners` gives for the frame, where it was asked before.

    Shi-Tomasi has the bits of cv2.goodFeaturesToTrack.
    """
    inside = mask if settings.mask_mode == "detect" else None
    if settings.detector == "orb":
        points = cv2.KeyPoint_convert(_orb(settings.max_keypoints).detect(frame, inside))
        points = np.reshape(points, (-1, 2)).astype(np.float32, copy=False)
    else:
        strength, ranked = corners or find_corners(frame, settings.block_size)
        # As OpenCV compares: the limit in double precision, rounded to single.
        limit = np.float32(cv2.minMaxLoc(strength, inside)[1] * settings.quality)
        points = _spread(strength, ranked, limit, np.empty((0, 0), np.uint8) if inside is None else inside,
                         settings.max_keypoints, float(settings.min_distance))
    if mask is None or settings.mask_mode == "detect":
        return points
    columns, rows = np.rint(points).astype(int).T
    return points[mask[rows, columns] > 0]


@lru_cache
def _orb(max_keypoints):
    return cv2.ORB_create(max_keypoints)


def track(previous: np.ndarray, current: np.ndarray, points: np.ndarray, window: int = WINDOW,
          levels: int = LEVELS) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 2) of the previous frame are in the current one: (N, 2) float32, and N booleans: success.

    window, levels: as in OdometrySettings.

    The bits of a plain call of OpenCV, for less: points close to each other follow one another, so that their pixels
    are still in the processor's cache, and the matching error that nobody reads is not computed. Computing it, OpenCV
    also gives up points whose window has left the frame, which therefore is done here.
    """
    order = np.argsort(points[:, 1])
    tracked, success = np.empty_like(points), np.empty(len(points), bool)
    tracker = TRACKER | {"winSize": (window, window), "maxLevel": levels}
    tracked[order], status, _ = cv2.calcOpticalFlowPyrLK(previous, current, points[order], None,
                                                         flags=cv2.OPTFLOW_LK_GET_MIN_EIGENVALS, **tracker)
    corner = tracked - (window - 1) / 2
    success[order] = status.ravel() == 1
    return tracked, success & ((corner >= -window) & (corner < current.shape[::-1])).all(axis=1)


class SharedKeypoints:
    """`detect` and `track` with the same results for many runs over one frame, at little more than the cost of one.

    The corner strength does not depend on the mask (only its maximum and the choice do), and Lucas-Kanade tracks
    every point on its own, so the first is computed once a frame and the second once for all points of all runs.
    """

    def __init__(self) -> None:
        self._tracks: tuple[np.ndarray, ...] = ()  # both frames, the sorted keys of all points, what `track` returns
        self._corners: tuple[np.ndarray, int, Corners] | None = None  # what `find_corners` was given and gave

    def expect(self, frame: np.ndarray, starts: Iterable[Start]) -> None:
        """Track to `frame` the points of all runs that come from the same previous frame (nearly always all)."""
        with_points = [(previous, points) for previous, points in starts if previous is not None and len(points)]
        if with_points:
            first, _ = with_points[0]
            keys = np.unique(np.concatenate([_key(points) for previous, points in with_points if previous is first]))
            self._tracks = first, frame, keys, *track(first, frame, keys.view(np.float32).reshape(-1, 2))

    def track(self, previous: np.ndarray, current: np.ndarray, points: np.ndarray, window: int = WINDOW,
              levels: int = LEVELS) -> tuple[np.ndarray, np.ndarray]:
        is_shared = self._tracks and previous is self._tracks[0] and current is self._tracks[1]  # else resumed, say
        if not is_shared or (window, levels) != (WINDOW, LEVELS):
            return track(previous, current, points, window, levels)
        _, _, keys, tracked, success = self._tracks
        where = np.searchsorted(keys, _key(points))
        return tracked.take(where, axis=0), success[where]

    def detect(self, frame: np.ndarray, settings: OdometrySettings, mask: np.ndarray | None = None) -> np.ndarray:
        size = settings.block_size
        if self._corners is None or frame is not self._corners[0] or size != self._corners[1]:
            self._corners = frame, size, find_corners(frame, size)
        return detect(frame, settings, mask, self._corners[2])


def _key(points):
    return np.ascontiguousarray(points).view(np.int64).ravel()


def find_corners(frame: np.ndarray, block_size: int = BLOCK_SIZE) -> Corners:
    """The strength of each pixel of a frame, cv2.cornerMinEigenVal to the bit, and where its local maxima are.

    These are indices of the flattened image, strongest first, of equals the last first; none lies on the border.
    """
    scale = 1 / (4 * BLOCK_SIZE * 255)  # 4: the sum of a smoothing of (1, 2, 1)
    dx, dy = (cv2.copyMakeBorder(cv2.Sobel(frame, cv2.CV_32F, *order, scale=scale), *[BLOCK_SIZE // 2] * 4,
                                 cv2.BORDER_REFLECT_101) for order in ((1, 0), (0, 1)))
    strength = _min_eigenvalues(dx, dy) if block_size == BLOCK_SIZE else cv2.cornerMinEigenVal(frame, block_size)
    is_peak = (strength == cv2.dilate(strength, None)) & (strength > 0)
    is_peak[[0, -1]] = is_peak[:, [0, -1]] = False
    peaks = np.flatnonzero(is_peak)
    # The bits of positive numbers are ordered as the numbers are, so one sort of integers ranks by both.
    return strength, np.sort(strength.ravel()[peaks].view(np.int32).astype(np.int64) << 32 | peaks)[::-1] & 0xFFFFFFFF


@fast
def _min_eigenvalues(dx, dy):
    """The smaller eigenvalue of the sums of dx dx, dx dy, dy dy over a square of BLOCK_SIZE; the border is cut off."""
    height, width = dx.shape[0] - BLOCK_SIZE + 1, dx.shape[1] - BLOCK_SIZE + 1
    smaller = np.empty((height, width), np.float32)
    products, half = np.empty((3, dx.shape[1]), np.float32), np.float32(0.5)
    rows, sums = np.zeros((BLOCK_SIZE, 3, width)), np.zeros((3, width))  # in OpenCV's order and double precision
    for y in range(dx.shape[0]):
        for x in range(dx.shape[1]):
            products[0, x] = dx[y, x] * dx[y, x]
            products[1, x] = dx[y, x] * dy[y, x]
            products[2, x] = dy[y, x] * dy[y, x]
        for k in range(3):
            product, row, total = products[k], rows[y % BLOCK_SIZE, k], sums[k]
            for x in range(width):
                along = np.float64(product[x]) + product[x + 1] + product[x + 2] + product[x + 3] + product[x + 4]
                total[x] = total[x] - row[x] + along
                row[x] = along
        if y >= BLOCK_SIZE - 1:
            for x in range(width):
                xx, xy, yy = np.float32(sums[0, x]) * half, np.float32(sums[1, x]), np.float32(sums[2, x]) * half
                smaller[y - BLOCK_SIZE + 1, x] = xx + yy - np.sqrt((xx - yy) * (xx - yy) + xy * xy)
    return smaller


@fast
def _spread(strength, ranked, limit, mask, max_keypoints, min_distance):
    """The strongest corners above `limit` inside the mask (if any) that keep `min_distance` from stronger ones, which
    are looked for in the neighbouring cells of a grid, as in OpenCV (so a fractional distance is not kept quite)."""
    height, width = strength.shape
    cell = max(int(np.rint(min_distance)), 1)
    grid_rows, grid_columns = height // cell + 1, width // cell + 1
    head = np.empty((grid_rows, grid_columns), np.int32)  # last corner taken in a cell
    head[:] = -1
    below = np.empty(len(ranked), np.int32)  # the one taken before it in the same cell
    taken = np.empty((len(ranked) if max_keypoints <= 0 else min(len(ranked), max_keypoints), 2), np.float32)
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
