"""Whether ready-made masks are inverted, which only their shape can tell.

255 keeps keypoints by convention, but many tools write masks of what has to be left out. Coverage,
values and contrast tell nothing: a mask without vehicles may cover little or much, and a mask of
the road is as sound as one without it. Nor do steps that fail: of 180 steps on real streets, 8 had
a flag with masks that keep only vehicles, 2 with right boundaries, none with inverted ones.

Two kinds of shape are known:

- boundaries are strips that run through most of the frame, with areas between them;
- things, such as vehicles, are areas that fill little of the frame, and neither reach its upper
  edge nor lie on the road ahead.

Boundaries are kept, and things are left out. Of other masks nothing can be said.

The numbers below were chosen on masks of 19 kinds, from label maps of 33 groups of six frames each
(KITTI's sequences, raw drives and street scenes, CamVid).
"""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np

RIGHT, UNKNOWN = "right", "unknown"
# how masks can be inverted, and the fault to report
INVERTED = {
    "boundaries left out": "keep areas and leave out the strips between them, as if inverted",
    "things kept": "keep only single things, nothing at the upper edge or on the road, as if inverted",
}
STRIP = 31  # pixels; a square of this side fits into an area, not into a strip
MAX_STRIP_AREAS = 0.5  # of strips, the share that such squares fill; boundaries up to width 15
GRID = 8, 4  # cells across and down the frame
MIN_REACHED = 0.02  # of a cell
MIN_STRIP_CELLS = 0.5  # share of the cells that boundaries reach
MIN_THING_AREAS = 0.2  # small cars are hardly larger than the square; poles and signs have 0.05
MAX_THING_CELLS = (
    0.65  # vehicles reach 0.2 to 0.5 of the cells; with a margin of 15 pixels, 0.4 to 0.7
)
MAX_THING_TOP = 0.02  # share of the upper edge
MAX_THING_ROAD = 0.35  # share of the road ahead
TOP = 0.04  # the upper edge, share of the height
ROAD_ROWS, ROAD_COLUMNS = (0.75, 0.95), (0.35, 0.65)  # the road ahead, shares of the frame's sides


class _Shape(NamedTuple):
    """The shape of one side of masks, what they keep or what they leave out.

    Shares, means over the masks. areas: of the side, filled by squares of STRIP pixels. cells: of
    GRID, reached by it. top, road: of the upper edge and of the road ahead, covered by it.
    """

    areas: float
    cells: float
    top: float
    road: float


def polarity(masks: Iterable[np.ndarray]) -> str:
    """Return RIGHT, UNKNOWN, or the name in INVERTED of how masks are inverted.

    masks: (height, width), of some frames of a sequence; keypoints are kept where they are not 0.
    """
    kept, left_out = [], []
    for mask in masks:
        is_kept = mask > 0
        if is_kept.any() and not is_kept.all():  # a frame may be without things
            kept.append(_shape_of(is_kept))
            left_out.append(_shape_of(~is_kept))
    if not kept:
        return UNKNOWN
    kept_shape = _Shape(*np.mean(kept, axis=0))
    left_out_shape = _Shape(*np.mean(left_out, axis=0))
    if _are_boundaries(kept_shape, left_out_shape):
        return RIGHT
    if _are_boundaries(left_out_shape, kept_shape):
        return "boundaries left out"
    if _are_things(kept_shape):
        return "things kept"
    if _are_things(left_out_shape):
        return RIGHT
    return UNKNOWN


def _shape_of(side: np.ndarray) -> _Shape:
    """Return the shape of one side of a mask, (height, width) booleans."""
    height, width = side.shape
    pixels = side.astype(np.uint8)
    areas = cv2.morphologyEx(pixels, cv2.MORPH_OPEN, np.ones((STRIP, STRIP), np.uint8))
    cells = cv2.resize(pixels.astype(np.float32), GRID, interpolation=cv2.INTER_AREA)
    upper_edge = side[: max(1, int(TOP * height))]
    rows, columns = (
        slice(int(first * length), int(last * length))
        for (first, last), length in ((ROAD_ROWS, height), (ROAD_COLUMNS, width))
    )
    return _Shape(
        areas=areas.sum() / pixels.sum(),
        cells=(cells >= MIN_REACHED).mean(),
        top=upper_edge.mean(),
        road=side[rows, columns].mean(),
    )


def _are_boundaries(side: _Shape, other: _Shape) -> bool:
    is_strips = side.areas < MAX_STRIP_AREAS <= other.areas
    return is_strips and side.cells >= MIN_STRIP_CELLS


def _are_things(side: _Shape) -> bool:
    is_small = side.areas >= MIN_THING_AREAS and side.cells <= MAX_THING_CELLS
    return is_small and side.top <= MAX_THING_TOP and side.road <= MAX_THING_ROAD
