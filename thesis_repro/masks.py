"""The keypoint mask filter (Section 3.6, A.8): from a label map to edges to a dilated mask.

A mask is a uint8 image of the frame's size. Keypoints are allowed where it is 255 and forbidden
where it is 0.
"""

from dataclasses import dataclass
from numbers import Integral

import cv2
import numpy as np

from thesis_repro.data.cityscapes import ID, N_CLASSES, resize_bilinear
from thesis_repro.errors import InputError

CANNY = (5, 15)  # both thresholds (Section 3.6)


def thesis_mask(label_map: np.ndarray, size: tuple[int, int], dilation_width: int) -> np.ndarray:
    """The thesis's mask of a frame of (height, width), from a label map (h, w) of uint8 ids."""
    edge_image = canny_edges(label_map, size)
    return dilate(edge_image, dilation_width)


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


def check_width(dilation_width: int, size: tuple[int, int]) -> None:
    """Raise InputError if a dilation width is not possible for frames of (height, width)."""
    limit = 2 * max(size)  # a wider square always covers the whole frame
    if not isinstance(dilation_width, Integral) or not 1 <= dilation_width <= limit:
        raise InputError(
            f"dilation width {dilation_width!r}: must be a whole number from 1 to {limit} pixels for "
            f"frames of {size[1]}x{size[0]}"
        )


# Other kinds of masks. MaskSettings chooses among them; its defaults are the thesis's.

BOUNDARIES = ("canny", "exact")
CLASS_EDGE_WINDOW = 5  # side in pixels: a Canny edge belongs to a boundary up to two pixels away
MOVABLE = tuple(range(ID["person"], ID["license plate"] + 1))  # people and vehicles, parked or not
# Where keypoints are allowed: on boundaries, as in the thesis, or as in published SLAM systems with
# segmentation.
KEEP = ("boundaries", "static", "inverse", "static-boundaries")
CHOICES = {"boundaries": BOUNDARIES, "keep": KEEP}
# pixels around movable objects that DynaSLAM excludes as well (in its Frame.cc)
DYNASLAM_MARGIN = 15


@dataclass(frozen=True)
class MaskSettings:
    """Settings of the mask filter. The defaults are the thesis's.

    keep: where keypoints are allowed. "boundaries": on dilated boundaries. "inverse": everywhere
    else. "static": everywhere except on movable objects and DYNASLAM_MARGIN around them.
    "static-boundaries": on boundaries between two classes that cannot move.
    boundaries: "canny" finds edges in label ids, as in the thesis; "exact", the correction, marks
    every change of class (see `exact_edges`).
    canny: both thresholds (Section 3.6), with OpenCV's default 3x3 Sobel operator.
    symmetric: no shift by half a pixel, so that a mirrored label map gives the mirrored mask (see
    `edges`, `dilate`).
    classes: names of labels. Only boundaries of these classes are used, with any neighbour. Empty:
    all boundaries.
    movable: no keypoints on people and vehicles, or within this many pixels of them. None:
    keypoints are allowed there, except with "static".
    margin: no keypoints within this many pixels of the frame's border. Points there are lost in the
    next frame, and networks that pad with zeros predict false boundaries there.
    ids: what the files hold: Cityscapes' ids ("labels"), its "train" ids or its "colors", or else
    what the table of this file names, see data/label_ids.
    Raises InputError for an unknown name or a bad number of pixels.
    """

    boundaries: str = "canny"
    symmetric: bool = False
    classes: tuple[str, ...] = ()
    movable: int | None = None
    margin: int = 0
    keep: str = "boundaries"
    ids: str = "labels"
    canny: tuple[float, float] = CANNY

    def __post_init__(self) -> None:
        for name in ("classes", "canny"):  # they are lists, if read from JSON
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise InputError(
                    f"{name}={value!r}: unknown; choose one of {', '.join(map(str, choices))}"
                )
        for name in self.classes:
            if name not in ID:
                raise InputError(f"classes: {name!r} is no label; choose from {', '.join(ID)}")
        for name, pixels in (("movable", self.movable or 0), ("margin", self.margin)):
            if not isinstance(pixels, Integral) or pixels < 0:
                raise InputError(f"{name}={pixels}: must be a whole number of pixels, 0 or more")


THESIS_MASKS = MaskSettings()


def keypoint_mask(
    label_map: np.ndarray,
    size: tuple[int, int],
    dilation_width: int,
    settings: MaskSettings = THESIS_MASKS,
) -> np.ndarray:
    """Keypoint mask of one frame from its label map, (height, width) uint8.

    Edges are dilated, inverted if `keep` says so, and the forbidden pixels are taken out.
    Raises InputError unless the label map is (h, w) label ids.
    """
    label_map = _checked(label_map)
    if settings == THESIS_MASKS:
        return thesis_mask(label_map, size, dilation_width)
    edge_image = edges(label_map, size, settings)
    return finished(edge_image, forbidden(label_map, size, settings), dilation_width, settings)


def finished(
    edge_image: np.ndarray,
    forbidden_pixels: np.ndarray | None,
    dilation_width: int,
    settings: MaskSettings,
) -> np.ndarray:
    """Mask of a frame from its edges and forbidden pixels, see `edges` and `forbidden`."""
    mask = dilate(edge_image, dilation_width, settings.symmetric)
    if settings.keep == "inverse":
        mask = cv2.bitwise_not(mask)
    if forbidden_pixels is not None:
        mask[forbidden_pixels] = 0
    return mask


def edges(
    label_map: np.ndarray, size: tuple[int, int], settings: MaskSettings = THESIS_MASKS
) -> np.ndarray:
    """Edges that a mask widens, (height, width) uint8, 255 on edges; with "static", all pixels.

    label_map: (h, w) uint8 ids. size: (height, width) of the frame.
    """
    if settings.keep == "static":
        return np.full(size, 255, np.uint8)
    if settings.boundaries == "exact":
        return exact_edges(label_map, size, settings, settings.symmetric)
    canny = canny_edges(label_map, size, settings.canny)
    if settings.classes or settings.keep == "static-boundaries":
        # Canny does not know classes: keep its edges within two pixels of the chosen boundaries
        chosen = exact_edges(label_map, size, settings, symmetric=True)
        canny &= dilate(chosen, CLASS_EDGE_WINDOW)
    return canny


def exact_edges(
    label_map: np.ndarray, size: tuple[int, int], settings: MaskSettings, symmetric: bool
) -> np.ndarray:
    """Every pixel whose right or lower neighbour has another class, (height, width) uint8.

    symmetric: enlarge by the nearest pixel centres and mark both sides of a boundary. OpenCV's
    plain nearest neighbour shifts the boundary by half a pixel, and so does a mark on one side.
    With `classes` or keep="static-boundaries", only some boundaries are marked.
    """
    enlarged = _enlarge(label_map, size, symmetric)
    selected = np.ones(size, bool)  # one side of a boundary must be
    if settings.classes:
        selected = np.isin(enlarged, [ID[name] for name in settings.classes])
    allowed = np.ones(size, bool)  # both sides of a boundary must be
    if settings.keep == "static-boundaries":
        allowed = ~np.isin(enlarged, MOVABLE)
    different = np.zeros(size, bool)
    for pixel, neighbour in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        change = enlarged[pixel] != enlarged[neighbour]
        change &= selected[pixel] | selected[neighbour]
        change &= allowed[pixel] & allowed[neighbour]
        different[pixel] |= change
        if symmetric:
            different[neighbour] |= change
    return different.astype(np.uint8) * 255


def forbidden(
    label_map: np.ndarray, size: tuple[int, int], settings: MaskSettings
) -> np.ndarray | None:
    """Pixels where keypoints are forbidden, (height, width) booleans; None if there are none.

    They are movable objects and the border's margin.
    """
    movable, margin = settings.movable, settings.margin
    if settings.keep == "static" and movable is None:
        movable = DYNASLAM_MARGIN
    if movable is None and not margin:
        return None
    height, width = size
    is_forbidden = np.ones(size, bool)
    is_forbidden[margin : height - margin, margin : width - margin] = False
    if movable is not None:
        moving = _enlarge(np.isin(label_map, MOVABLE).astype(np.uint8), size, True)
        is_forbidden |= dilate(moving, 2 * movable + 1) > 0
    return is_forbidden


def _checked(label_map: np.ndarray) -> np.ndarray:
    """Return a label map as an array, or raise InputError for another kind of map."""
    label_map = np.asarray(label_map)
    if label_map.ndim != 2 or not label_map.size or label_map.dtype.kind not in "ui":
        raise InputError(
            f"label map: {label_map.dtype} of shape {label_map.shape}; must be whole ids, "
            "(height, width)"
        )
    if label_map.min() < 0 or label_map.max() >= N_CLASSES:
        raise InputError(
            f"label map: holds {label_map.min()} to {label_map.max()}; must hold Cityscapes label "
            f"ids, 0 to {N_CLASSES - 1}"
        )
    return label_map.astype(np.uint8, copy=False)  # argmax gives int64


def _enlarge(label_map: np.ndarray, size: tuple[int, int], symmetric: bool) -> np.ndarray:
    """Enlarge a label map to the frame's size by nearest neighbour, so that no new ids appear."""
    nearest = cv2.INTER_NEAREST_EXACT if symmetric else cv2.INTER_NEAREST
    return cv2.resize(label_map, size[::-1], interpolation=nearest)


def boundaries_found(mask: np.ndarray, true_labels: np.ndarray) -> float:
    """Share of the true boundary pixels that a mask keeps, 0 to 1. NaN if there are none.

    true_labels: (h, w) label ids. True boundaries are marked on both sides (`edges`, exact and
    symmetric).
    """
    true = exact_edges(true_labels, mask.shape, THESIS_MASKS, symmetric=True) > 0
    if not true.any():
        return np.nan
    return float((mask[true] > 0).mean())


def coverage(mask: np.ndarray) -> float:
    """Share of the frame that the mask keeps, 0 to 1."""
    return float(np.count_nonzero(mask)) / mask.size
