"""The keypoint mask filter (Section 3.6, A.8): from a label map to edges to a dilated mask.

A mask is a uint8 image of the frame's size. Keypoints are allowed where it is 255 and forbidden
where it is 0.
"""

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from numbers import Integral, Real
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.data.cityscapes import ID, N_CLASSES, read_label_map
from thesis_repro.data.kitti import Sequence, check_size
from thesis_repro.errors import InputError, need
from thesis_repro.running import results
from thesis_repro.running.files import listed, numbers_of, progress, read_gray, write_png

BOUNDARIES, IDS = ("canny", "exact"), ("labels", "train")
CLASS_EDGE_WINDOW = 5  # side in pixels: a Canny edge belongs to a boundary up to two pixels away
MOVABLE = tuple(range(ID["person"], ID["license plate"] + 1))  # people and vehicles, parked or not
# Where keypoints are allowed: on boundaries, as in the thesis, or as in published SLAM systems with
# segmentation.
KEEP = ("boundaries", "static", "inverse", "static-boundaries")
CHOICES = {"boundaries": BOUNDARIES, "keep": KEEP, "ids": IDS, "symmetric": (False, True)}
# pixels around movable objects that DynaSLAM excludes as well (in its Frame.cc)
DYNASLAM_MARGIN = 15


@dataclass(frozen=True)
class MaskSettings:
    """Settings of the mask filter. The defaults are the thesis's.

    keep: where keypoints are allowed. "boundaries": on dilated boundaries. "inverse": everywhere
    else. "static": everywhere except on movable objects and DYNASLAM_MARGIN around them.
    "static-boundaries": on boundaries between two classes that cannot move.
    boundaries: "canny" finds edges in label ids, "exact" marks every change of class (see `edges`).
    canny: both thresholds (Section 3.6), with OpenCV's default 3x3 Sobel operator.
    symmetric: no shift by half a pixel, so that a mirrored label map gives the mirrored mask (see
    `edges`, `dilate`).
    classes: names of labels. Only boundaries of these classes are used, with any neighbour. Empty:
    all boundaries.
    movable: no keypoints on people and vehicles, or within this many pixels of them. None:
    keypoints are allowed there, except with "static".
    margin: no keypoints within this many pixels of the frame's border. Points there are lost in the
    next frame, and networks that pad with zeros predict false boundaries there.
    ids: ids in the files, Cityscapes' "labels" or its "train" ids (`cityscapes.TRAINED`).
    Raises InputError for an unknown name, a bad number, or no tuple where one belongs.
    """

    boundaries: str = "canny"
    symmetric: bool = False
    classes: tuple[str, ...] = ()
    movable: int | None = None
    margin: int = 0
    keep: str = "boundaries"
    ids: str = "labels"
    canny: tuple[float, float] = (5, 15)

    def __post_init__(self) -> None:
        for name, example in (("classes", '("sky",)'), ("canny", "(5, 15)")):
            values = getattr(self, name)
            if not isinstance(values, (tuple, list)):  # a list, if read from JSON
                raise InputError(f"{name}={values!r}: must be a tuple, such as {example}")
            object.__setattr__(self, name, tuple(values))
        thresholds = [value for value in self.canny if isinstance(value, Real) and value >= 0]
        if len(self.canny) != 2 or len(thresholds) != 2:
            raise InputError(f"canny={self.canny}: must be two numbers from 0 on, such as (5, 15)")
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


def edges(
    label_map: np.ndarray, size: tuple[int, int], settings: MaskSettings = MaskSettings()
) -> np.ndarray:
    """Edges between classes at the frame's size, (height, width) uint8, 255 on edges.

    label_map: (h, w) uint8 class ids. size: (height, width) of the frame.

    boundaries="canny" is the thesis's way. It enlarges the label map bilinearly, which creates
    wrong ids along every boundary. Then it runs Canny on the ids, which finds a boundary only if
    the two ids differ enough. boundaries="exact" is the correction. It enlarges with nearest
    neighbour and marks every pixel whose right or lower neighbour has another class.
    symmetric: enlarge by the nearest pixel centres and mark both sides of an exact boundary.
    OpenCV's plain nearest neighbour shifts the boundary by half a pixel, and so does a mark on one
    side only. With `classes` or keep="static-boundaries", only some boundaries are used. Canny does
    not know classes, so its edges are kept within two pixels of these boundaries.
    """
    if settings.boundaries == "canny":
        canny = cv2.Canny(cv2.resize(label_map, size[::-1]), *settings.canny)
        if not settings.classes and settings.keep != "static-boundaries":
            return canny
        class_edges = edges(label_map, size, replace(settings, boundaries="exact", symmetric=True))
        return canny & dilate(class_edges, CLASS_EDGE_WINDOW)
    enlarged = _enlarge(label_map, size, settings.symmetric)
    selected = np.ones(size, bool)  # one side of a boundary must be
    if settings.classes:
        selected = np.isin(enlarged, [ID[name] for name in settings.classes])
    allowed = np.ones(size, bool)  # both sides of a boundary must be
    if settings.keep == "static-boundaries":
        allowed = ~np.isin(enlarged, MOVABLE)
    different = np.zeros(size, bool)
    for pixel, neighbour in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        change = (enlarged[pixel] != enlarged[neighbour]) & (selected[pixel] | selected[neighbour])
        change &= allowed[pixel] & allowed[neighbour]
        different[pixel] |= change
        if settings.symmetric:
            different[neighbour] |= change
    return different.astype(np.uint8) * 255


def _enlarge(label_map: np.ndarray, size: tuple[int, int], symmetric: bool) -> np.ndarray:
    """Enlarge a label map to the frame's size by nearest neighbour, so that no new ids appear."""
    nearest = cv2.INTER_NEAREST_EXACT if symmetric else cv2.INTER_NEAREST
    return cv2.resize(label_map, size[::-1], interpolation=nearest)


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
    is_whole_number = isinstance(dilation_width, Integral) and not isinstance(dilation_width, bool)
    if not is_whole_number or not 1 <= dilation_width <= limit:
        raise InputError(
            f"dilation width {dilation_width!r}: must be a whole number from 1 to {limit} pixels for "
            f"frames of {size[1]}x{size[0]}"
        )


def forbidden(label_map: np.ndarray, size: tuple[int, int], settings: MaskSettings) -> np.ndarray:
    """Pixels where keypoints are forbidden, (height, width) booleans.

    They are movable objects and the border's margin.
    """
    height, width = size
    margin = settings.margin
    is_forbidden = np.ones(size, bool)
    is_forbidden[margin : height - margin, margin : width - margin] = False
    if settings.movable is not None:
        moving = _enlarge(np.isin(label_map, MOVABLE).astype(np.uint8), size, True)
        is_forbidden |= dilate(moving, 2 * settings.movable + 1) > 0
    return is_forbidden


def keypoint_mask(
    label_map: np.ndarray,
    size: tuple[int, int],
    dilation_width: int,
    settings: MaskSettings = MaskSettings(),
) -> np.ndarray:
    """Keypoint mask of one frame from its label map.

    It is `dilate(edges(...))` without the `forbidden` pixels.

    Raises InputError unless the label map is (h, w) uint8 label ids, and for another kind of size
    or settings.
    """
    need("settings", settings, MaskSettings)
    if np.shape(size) != (2,) or not all(isinstance(side, Integral) and side > 0 for side in size):
        raise InputError(f"size: must be (height, width) of the frame in pixels, not {size}")
    label_map = np.asarray(label_map)
    if label_map.ndim != 2 or label_map.dtype != np.uint8 or not label_map.size:
        raise InputError(
            f"label map: {label_map.dtype} of shape {label_map.shape}; must be uint8 ids, (height, width)"
        )
    if label_map.max() >= N_CLASSES:
        raise InputError(
            f"label map: holds {label_map.max()}; must hold Cityscapes label ids, 0 to {N_CLASSES - 1}"
        )
    return _finish_mask(_parts(label_map, size, settings), dilation_width, settings)


class _Parts(NamedTuple):
    """The parts of a mask that do not depend on the dilation width."""

    edges: np.ndarray  # (height, width) uint8
    forbidden: np.ndarray | None  # (height, width) booleans; None if no pixel is


def _parts(label_map: np.ndarray, size: tuple[int, int], settings: MaskSettings) -> _Parts:
    if settings.keep == "static":
        if settings.movable is None:
            settings = replace(settings, movable=DYNASLAM_MARGIN)
        everywhere = np.full(size, 255, np.uint8)
        return _Parts(everywhere, forbidden(label_map, size, settings))
    edge_image = edges(label_map, size, settings)
    if settings.movable is None and not settings.margin:
        return _Parts(edge_image, None)
    return _Parts(edge_image, forbidden(label_map, size, settings))


def _finish_mask(parts: _Parts, dilation_width: int, settings: MaskSettings) -> np.ndarray:
    mask = dilate(parts.edges, dilation_width, settings.symmetric)
    if settings.keep == "inverse":
        mask = cv2.bitwise_not(mask)
    if parts.forbidden is not None:
        mask[parts.forbidden] = 0
    return mask


def boundaries_found(mask: np.ndarray, true_labels: np.ndarray) -> float:
    """Share of the true boundary pixels that a mask keeps, 0 to 1. NaN if there are none.

    true_labels: (h, w) label ids. True boundaries are marked on both sides (`edges`, exact and
    symmetric).
    """
    true = edges(true_labels, mask.shape, MaskSettings("exact", symmetric=True)) > 0
    if not true.any():
        return np.nan
    return float((mask[true] > 0).mean())


def coverage(mask: np.ndarray) -> float:
    """Share of the frame that the mask keeps, 0 to 1."""
    return float(np.count_nonzero(mask)) / mask.size


class LabelMasks:
    """Masks of a sequence, made from label maps on access: masks[i] for frame i.

    folder: holds one label map a frame, of any size, as a PNG with the frame's name, or a folder of
    them for each sequence. settings: as in `keypoint_mask`.
    Raises InputError if the folder or a frame's label map is missing.
    """

    def __init__(
        self,
        folder: str | Path,
        sequence: Sequence,
        dilation_width: int,
        settings: MaskSettings = MaskSettings(),
    ) -> None:
        need("settings", settings, MaskSettings)
        self.paths = _paths_by_frame(folder, sequence, "label map")
        self.frame_paths = sequence.frame_paths
        self.size = sequence.size
        self.dilation_width = dilation_width
        self.settings = settings
        check_width(dilation_width, self.size)
        for name, pixels, limit in (
            ("margin", settings.margin, (min(self.size) - 1) // 2),
            ("movable", settings.movable or 0, max(self.size) - 1),
        ):
            if pixels > limit:
                raise InputError(
                    f"{name}={pixels}: leaves nothing of frames of {self.size[1]}x{self.size[0]}; give at "
                    f"most {limit} pixels"
                )

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        need("index", index, int | np.integer)
        path = self.paths[index]
        parts = _parts_of_file(path, _content(path), self.size, self.settings)
        return _finish_mask(parts, self.dilation_width, self.settings)


def label_map_of(masks: LabelMasks, index: int) -> np.ndarray:
    """Label map of frame `index`, in label ids."""
    return read_label_map(masks.paths[index], masks.settings.ids == "train")


def _content(path: Path) -> bytes:
    """Bytes of a file; none if it cannot be read, for which `read_label_map` has the reason.

    What is remembered of a label map goes by them, because the file may be written again.
    """
    with suppress(OSError):
        if path.is_file():
            return path.read_bytes()
    return b""


@lru_cache(maxsize=8)  # masks of several dilation widths share edges
def _parts_of_file(
    path: Path, content: bytes, size: tuple[int, int], settings: MaskSettings
) -> _Parts:
    label_map = _read_once(path, content, settings.ids == "train")
    return _parts(label_map, size, settings)


# Masks of several settings share the label map of a frame, and one control takes that of another
# frame: two are kept.
@lru_cache(maxsize=2)
def _read_once(path: Path, content: bytes, train_ids: bool) -> np.ndarray:
    return read_label_map(path, train_ids)


def forget_edges() -> None:
    """Clear the caches of LabelMasks, so that the time to make a mask can be measured."""
    _parts_of_file.cache_clear()
    _read_once.cache_clear()


def write_masks(masks: LabelMasks, folder: str | Path) -> None:
    """Write the mask of every frame as a PNG with the frame's name (A.8). `MaskFolder` reads them.

    The folder is a stage (see results): a stopped run resumes, and masks made from other label maps
    or settings are moved aside.
    """
    with results.claimed(folder):
        folder = results.stage(
            folder,
            labels=results.digest_of_files(masks.paths),
            size=masks.size,
            **asdict(masks.settings),
            dilation_width=masks.dilation_width,
            frames=results.digest_of_files(masks.frame_paths),
            code=results.digest_of_code("thesis_repro.masks", "thesis_repro.data.cityscapes"),
            **results.made_with("opencv"),
        )
        for index, path in enumerate(progress(masks.paths, f"masks, width {masks.dilation_width}")):
            if not (folder / path.name).is_file():
                write_png(folder / path.name, masks[index])


class MaskFolder:
    """Masks of a sequence read from images with the frames' names: masks[i] for frame i.

    One image is used for all frames if `folder` is a file, or holds a single file without the name
    of a frame.
    invert: keypoints are allowed where the image is 0. Raises InputError if the folder or a frame's
    mask is missing, and as `read_mask` does.
    """

    def __init__(self, folder: str | Path, sequence: Sequence, invert: bool = False) -> None:
        self.paths = _paths_by_frame(folder, sequence, "mask")
        self.size = sequence.size
        self.invert = invert

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        need("index", index, int | np.integer)
        mask = read_mask(self.paths[index], self.size)
        if self.invert:
            return cv2.bitwise_not(mask)
        return mask


def read_mask(path: str | Path, size: tuple[int, int]) -> np.ndarray:
    """Read a mask for frames of (height, width).

    It is uint8, 0 where keypoints are forbidden and 255 elsewhere; a file may have another value in
    place of 255, such as 1. Raises InputError if the size differs or there are more than two
    values, as in a label map.
    """
    mask = read_gray(path)
    check_size(Path(path), mask.shape, size, "its frame")
    if ((mask != 0) & (mask != mask.max())).any():
        raise InputError(
            f"{path}: holds {len(np.unique(mask))} different values; a mask has 0 and 255 (label maps go "
            "with --labels)"
        )
    return np.where(mask, np.uint8(255), np.uint8(0))


def folder_of_sequence(folder: str | Path, sequence: str) -> Path:
    """Folder with the label maps or masks of a sequence.

    That is the folder of its name in `folder`, or `folder` itself if that holds files, as
    `thesis-repro predict` and `masks` write them.
    """
    folder = Path(folder)
    subfolder = folder / sequence
    if not subfolder.is_dir() and any(folder.glob("[!.]*.png")):
        return folder
    return subfolder


def _paths_by_frame(folder: str | Path, sequence: Sequence, kind: str) -> list[Path]:
    """One path a frame to its mask or label map. Raises InputError if one is missing."""
    need("sequence", sequence, Sequence)
    if kind == "mask" and Path(folder).is_file():
        return [Path(folder)] * len(sequence)
    folder = folder_of_sequence(folder, sequence.name)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: no such folder; it must hold one {kind} for each frame of sequence "
            f"{sequence.name}"
        )
    present = {path.name: path for path in listed(folder)}
    if kind == "mask" and len(present) == 1:
        single = next(iter(present.values()))
        # a single mask named as frames are is the mask of one frame only
        if not _is_named_as_a_frame(single, sequence):
            return [single] * len(sequence)
    paths: list[Path] = []
    missing: list[str] = []
    for name, frame in zip(sequence.label_names, sequence.frame_paths, strict=True):
        # some tools append .png to the whole name
        path = present.get(name) or present.get(f"{frame.name}.png")
        if path is None:
            missing.append(name)
        else:
            paths.append(path)
    if missing:
        raise InputError(
            f"{folder / missing[0]}: no such {kind} ({len(missing)} of {len(sequence)} frames of sequence "
            f"{sequence.name} have none); each frame needs one"
        )
    return paths


def _is_named_as_a_frame(mask: Path, sequence: Sequence) -> bool:
    """Whether a mask is that of one frame, by its name, with or without an appended .png."""
    for frame in listed(sequence.frame_paths[0].parent, "*"):  # those outside of a subset, too
        if mask.name in (f"{frame.stem}.png", f"{frame.name}.png"):
            return True
    stem = mask.name.removesuffix(".png").removesuffix(".png")
    return numbers_of([*sequence.frame_paths, Path(stem)]) is not None
