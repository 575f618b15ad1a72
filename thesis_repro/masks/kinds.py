"""Other kinds of masks than the thesis's: one table, KINDS, and the functions in it.

MaskSettings chooses among them; its defaults are the thesis's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.data.cityscapes import ID, N_CLASSES
from thesis_repro.errors import InputError
from thesis_repro.masks.filter import CANNY, canny_edges, check_width, dilate, thesis_mask
from thesis_repro.masks.memory import remembered

BOUNDARIES = ("canny", "exact")
CLASS_EDGE_WINDOW = 5  # side in pixels: a Canny edge belongs to a boundary up to two pixels away
MOVABLE = tuple(range(ID["person"], ID["license plate"] + 1))  # people and vehicles, parked or not
# pixels around movable objects that DynaSLAM excludes as well (in its Frame.cc)
DYNASLAM_MARGIN = 15


@dataclass(frozen=True)
class MaskSettings:
    """Settings of the mask filter. The defaults are the thesis's.

    keep: where keypoints are allowed, one of KINDS.
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
    Raises InputError for an unknown name or a bad number of pixels.
    """

    boundaries: str = "canny"
    symmetric: bool = False
    classes: tuple[str, ...] = ()
    movable: int | None = None
    margin: int = 0
    keep: str = "boundaries"
    canny: tuple[float, float] = CANNY

    @property
    def has_width(self) -> bool:
        """Whether masks of this kind are dilated."""
        return KINDS[self.keep].has_width

    def __post_init__(self) -> None:
        for name in ("classes", "canny"):  # they are lists, if read from JSON
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name, choices in {"boundaries": BOUNDARIES, "keep": KINDS}.items():
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


# Kinds of masks: functions of a label map (h, w), the frame's size, a width and settings


def boundaries(
    label_map: np.ndarray, size: tuple[int, int], dilation_width: int, settings: MaskSettings
) -> np.ndarray:
    """On dilated boundaries."""
    return dilate(edges(label_map, size, settings), dilation_width, settings.symmetric)


def inverse(
    label_map: np.ndarray, size: tuple[int, int], dilation_width: int, settings: MaskSettings
) -> np.ndarray:
    """Everywhere but on dilated boundaries."""
    return cv2.bitwise_not(boundaries(label_map, size, dilation_width, settings))


def static(
    label_map: np.ndarray, size: tuple[int, int], dilation_width: None, settings: MaskSettings
) -> np.ndarray:
    """Everywhere but on movable objects and, unless settings say otherwise, DYNASLAM_MARGIN."""
    around = DYNASLAM_MARGIN if settings.movable is None else settings.movable
    return np.where(near_movable(label_map, size, around), np.uint8(0), np.uint8(255))


def static_boundaries(
    label_map: np.ndarray, size: tuple[int, int], dilation_width: int, settings: MaskSettings
) -> np.ndarray:
    """On dilated boundaries between two classes that cannot move."""
    return dilate(edges(label_map, size, settings, MOVABLE), dilation_width, settings.symmetric)


class Kind(NamedTuple):
    """A kind of mask: its function, and where it allows keypoints, for --help."""

    make: Callable
    help: str
    has_width: bool = True  # whether masks are dilated


# Where keypoints are allowed: on boundaries, as in the thesis, or as in published SLAM systems with
# segmentation.
KINDS = {
    "boundaries": Kind(boundaries, "on boundaries"),
    "static": Kind(static, "on all but movable things", has_width=False),
    "inverse": Kind(inverse, "on all but boundaries"),
    "static-boundaries": Kind(static_boundaries, "on boundaries between static classes"),
}


THESIS_MASKS = MaskSettings()


def keypoint_mask(
    label_map: np.ndarray,
    size: tuple[int, int],
    dilation_width: int | None = None,
    settings: MaskSettings = THESIS_MASKS,
) -> np.ndarray:
    """Keypoint mask of one frame from its label map, (height, width) uint8.

    dilation_width: pixels, for kinds of masks that have a width.
    Raises InputError unless the label map is (h, w) label ids.
    """
    label_map = _checked(label_map)
    if settings.has_width:
        check_width(dilation_width, size)
    if settings == THESIS_MASKS:
        assert dilation_width is not None  # checked above
        return thesis_mask(label_map, size, dilation_width)
    mask = KINDS[settings.keep].make(label_map, size, dilation_width, settings)
    if settings.movable is not None:
        mask[near_movable(label_map, size, settings.movable)] = 0
    if settings.margin:
        first, last = slice(settings.margin), slice(-settings.margin, None)
        mask[first] = mask[last] = 0
        mask[:, first] = mask[:, last] = 0
    return mask


@remembered
def edges(
    label_map: np.ndarray,
    size: tuple[int, int],
    settings: MaskSettings = THESIS_MASKS,
    without: tuple[int, ...] = (),
) -> np.ndarray:
    """Edges that a mask widens, (height, width) uint8, 255 on edges.

    label_map: (h, w) uint8 ids. size: (height, width) of the frame. without: ids whose boundaries
    are left out.
    """
    if settings.boundaries == "exact":
        return exact_edges(label_map, size, settings, settings.symmetric, without)
    canny = canny_edges(label_map, size, settings.canny)
    if settings.classes or without:
        # Canny does not know classes: keep its edges within two pixels of the chosen boundaries
        chosen = exact_edges(label_map, size, settings, True, without)
        canny = canny & dilate(chosen, CLASS_EDGE_WINDOW)
    return canny


def exact_edges(
    label_map: np.ndarray,
    size: tuple[int, int],
    settings: MaskSettings,
    symmetric: bool,
    without: tuple[int, ...] = (),
) -> np.ndarray:
    """Every pixel whose right or lower neighbour has another class, (height, width) uint8.

    symmetric: enlarge by the nearest pixel centres and mark both sides of a boundary. OpenCV's
    plain nearest neighbour shifts the boundary by half a pixel, and so does a mark on one side.
    Only boundaries of the settings' classes are marked, and none of the ids `without`.
    """
    enlarged = _enlarge(label_map, size, symmetric)
    selected = np.ones(size, bool)  # one side of a boundary must be
    if settings.classes:
        selected = np.isin(enlarged, [ID[name] for name in settings.classes])
    allowed = np.ones(size, bool)  # both sides of a boundary must be
    if without:
        allowed = ~np.isin(enlarged, without)
    different = np.zeros(size, bool)
    for pixel, neighbour in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        change = enlarged[pixel] != enlarged[neighbour]
        change &= selected[pixel] | selected[neighbour]
        change &= allowed[pixel] & allowed[neighbour]
        different[pixel] |= change
        if symmetric:
            different[neighbour] |= change
    return different.astype(np.uint8) * 255


@remembered
def near_movable(label_map: np.ndarray, size: tuple[int, int], pixels: int) -> np.ndarray:
    """Whether each pixel is on people or vehicles or so near them, (height, width) booleans."""
    moving = _enlarge(np.isin(label_map, MOVABLE).astype(np.uint8), size, True)
    return dilate(moving, 2 * pixels + 1) > 0


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
