"""Shi-Tomasi keypoints with OpenCV's bits, which share the corner strength of a frame.

The strength does not depend on the mask, the distance or the number of keypoints.
"""

from typing import NamedTuple

import cv2
import numpy as np

from opencv_exact.compiling import compiled
from thesis_repro.odometry.settings import THESIS, OdometrySettings


class Corners(NamedTuple):
    """Corners of a frame (height, width)."""

    strength: np.ndarray  # of every pixel, (height, width)
    # local maxima of the strength, as indices into the flattened image, strongest first
    ranked: np.ndarray


_latest: tuple[np.ndarray | None, dict[int, Corners]] = None, {}  # frame, corners by block size


def detect(
    frame: np.ndarray, settings: OdometrySettings = THESIS, mask: np.ndarray | None = None
) -> np.ndarray:
    """Like `loop.detect`. The corners of the latest frame that nobody can change are kept."""
    global _latest
    latest = _latest  # another thread may change it
    if latest[0] is not frame:
        is_fixed = frame.flags.owndata and not frame.flags.writeable
        latest = _latest = frame if is_fixed else None, {}
    corners, size = latest[1], settings.block_size
    if size not in corners:
        corners[size] = find_corners(frame, size)
    return strongest(corners[size], settings, mask)


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


def strongest(
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
