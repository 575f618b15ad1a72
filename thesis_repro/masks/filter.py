"""The keypoint mask filter (Section 3.6, A.8): from a label map to edges to a dilated mask.

A mask is a uint8 image of the frame's size. Keypoints are allowed where it is 255 and forbidden
where it is 0. Other kinds of masks are in kinds.py.
"""

from numbers import Integral

import cv2
import numpy as np

from thesis_repro.data.cityscapes import resize_bilinear
from thesis_repro.errors import InputError
from thesis_repro.masks.memory import remembered

CANNY = (5, 15)  # both thresholds (Section 3.6)
WIDTHS = tuple(range(1, 16))  # dilation widths of the thesis, pixels (Section 3.6)


def thesis_mask(label_map: np.ndarray, size: tuple[int, int], dilation_width: int) -> np.ndarray:
    """The thesis's mask of a frame of (height, width), from a label map (h, w) of uint8 ids."""
    edge_image = canny_edges(label_map, size)
    return dilate(edge_image, dilation_width)


@remembered  # masks of several widths share edges
def canny_edges(
    label_map: np.ndarray, size: tuple[int, int], thresholds: tuple[float, float] = CANNY
) -> np.ndarray:
    """Edges that Canny finds in a label map, (height, width) uint8, 255 on edges.

    Resizing is bilinear, which creates wrong ids along every boundary. Canny's gradients are those
    of ids, so it finds a boundary only if the two ids differ enough. Both are the thesis's way.
    """
    enlarged = resize_bilinear(label_map, size)
    return cv2.Canny(enlarged, *thresholds)


def dilate(edge_image: np.ndarray, dilation_width: int, symmetric: bool = False) -> np.ndarray:
    """Widen edges with a square of ones, `dilation_width` pixels a side.

    A square of even width has no centre pixel, so OpenCV shifts the mask by half a pixel, as in the
    thesis.
    symmetric: a square of even width is made one pixel smaller. The mask is as wide as before,
    because symmetric exact edges are two pixels wide.
    """
    check_width(dilation_width, edge_image.shape)
    side = dilation_width
    if symmetric and side % 2 == 0:
        side -= 1
    return cv2.dilate(edge_image, np.ones((side, side), np.uint8))


def check_width(dilation_width: int | None, size: tuple[int, int]) -> None:
    """Raise InputError if a dilation width is not possible for frames of (height, width)."""
    limit = 2 * max(size)  # a wider square always covers the whole frame
    if not isinstance(dilation_width, Integral) or not 1 <= dilation_width <= limit:
        raise InputError(
            f"dilation width {dilation_width!r}: must be a whole number from 1 to {limit} pixels for "
            f"frames of {size[1]}x{size[0]}"
        )


def coverage(mask: np.ndarray) -> float:
    """Share of the frame that the mask keeps, 0 to 1."""
    return float(np.count_nonzero(mask)) / mask.size
