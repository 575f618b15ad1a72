"""The keypoint mask filter (Section 3.6, A.8): label map to edges to dilated mask.

A mask is uint8 of the frame's size: keypoints may lie where it is 255 and not where it is 0.
"""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from thesis_repro import InputError, stages
from thesis_repro.cityscapes import read_label_map
from thesis_repro.files import listed, progress, read_gray, write_png
from thesis_repro.kitti import Sequence

CANNY_LOW, CANNY_HIGH = 5, 15  # Section 3.6; a 3x3 Sobel operator is OpenCV's default
BOUNDARIES = ("canny", "exact")


def edges(label_map: np.ndarray, size: tuple[int, int], boundaries: str = "canny") -> np.ndarray:
    """Boundaries between classes at the frame's size.

    label_map: (h, w) uint8 class ids. size: (height, width) of the frame. Returns (height, width) uint8, 255 on edges.

    boundaries "canny" is the thesis: enlarge bilinearly (which invents ids along every boundary), then Canny (5, 15)
    on the ids themselves, so that a boundary shows only where two ids are far enough apart. "exact" is the correction:
    enlarge with nearest neighbour and mark every pixel whose right or lower neighbour has another class.
    """
    height, width = size
    if boundaries == "canny":
        enlarged = cv2.resize(label_map, (width, height))
        return cv2.Canny(enlarged, CANNY_LOW, CANNY_HIGH)
    if boundaries != "exact":
        raise InputError(f"boundaries={boundaries!r}: unknown; choose one of {', '.join(BOUNDARIES)}")
    enlarged = cv2.resize(label_map, (width, height), interpolation=cv2.INTER_NEAREST)
    different = np.zeros((height, width), bool)
    different[:, :-1] |= enlarged[:, :-1] != enlarged[:, 1:]
    different[:-1] |= enlarged[:-1] != enlarged[1:]
    return different.astype(np.uint8) * 255


def dilate(edge_image: np.ndarray, dilation_width: int) -> np.ndarray:
    """Widen edges with a square of ones, `dilation_width` pixels a side.

    An even width has no centre pixel: OpenCV's anchor then shifts the mask half a pixel, and the thesis keeps that.
    """
    if dilation_width < 1:
        raise InputError(f"dilation width {dilation_width}: must be 1 or more pixels")
    return cv2.dilate(edge_image, np.ones((dilation_width, dilation_width), np.uint8))


def keypoint_mask(label_map: np.ndarray, size: tuple[int, int], dilation_width: int,
                  boundaries: str = "canny") -> np.ndarray:
    """The mask of one frame from its label map: `dilate(edges(...))`."""
    return dilate(edges(label_map, size, boundaries), dilation_width)


def coverage(mask: np.ndarray) -> float:
    """Share of the frame that the mask keeps, 0 to 1."""
    return float(np.count_nonzero(mask)) / mask.size


class LabelMasks:
    """Masks of a sequence made from its label maps when they are asked for: masks[i] for frame i.

    folder holds one label map a frame, of any size, named like the frame.
    Raises InputError when the folder or a frame's label map is missing.
    """

    def __init__(self, folder: str | Path, sequence: Sequence, dilation_width: int, boundaries: str = "canny") -> None:
        self.paths = _files_of_frames(folder, sequence, "label map")
        self.size = sequence.size
        self.dilation_width = dilation_width
        self.boundaries = boundaries
        if dilation_width < 1:
            raise InputError(f"dilation width {dilation_width}: must be 1 or more pixels")

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        return dilate(_edges_of_file(self.paths[index], self.size, self.boundaries), self.dilation_width)


@lru_cache(maxsize=8)  # the variants of one frame differ in their dilation alone
def _edges_of_file(path, size, boundaries):
    return edges(read_label_map(path), size, boundaries)


def forget_edges() -> None:
    """Drop the edges that LabelMasks keeps for its next width, so that the making of a mask can be timed."""
    _edges_of_file.cache_clear()


def write_masks(masks: LabelMasks, folder: str | Path) -> None:
    """Write the mask of every frame as a PNG named like the frame (A.8), for `MaskFolder` to read.

    The folder is a stage (see stages): a stopped run goes on, masks of other label maps or widths in it are deleted.
    """
    folder = stages.stage(folder, labels=stages.listing(masks.paths), size=masks.size, boundaries=masks.boundaries,
                          dilation_width=masks.dilation_width, code=stages.code("masks"))
    for index, path in enumerate(progress(masks.paths, f"masks, width {masks.dilation_width}")):
        if not (folder / path.name).is_file():
            write_png(folder / path.name, masks[index])


class MaskFolder:
    """Masks of a sequence read from a folder of images named like the frames: masks[i] for frame i.

    Raises InputError when the folder or a frame's mask is missing, or a mask has another size than the frame.
    """

    def __init__(self, folder: str | Path, sequence: Sequence) -> None:
        self.paths = _files_of_frames(folder, sequence, "mask")
        self.size = sequence.size

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        mask = read_gray(self.paths[index])
        if mask.shape != self.size:
            raise InputError(f"{self.paths[index]}: {mask.shape[1]}x{mask.shape[0]} pixels, but the frames have "
                             f"{self.size[1]}x{self.size[0]}; masks must have the size of the frames")
        return mask


def _files_of_frames(folder, sequence, what):
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it must hold one {what} for each frame of sequence "
                         f"{sequence.name}")
    present = {path.name for path in listed(folder)}
    missing = [path.name for path in sequence.frame_paths if path.name not in present]
    if missing:
        raise InputError(f"{folder / missing[0]}: no such {what} ({len(missing)} of {len(sequence)} frames of sequence "
                         f"{sequence.name} have none); every frame needs one")
    return [folder / path.name for path in sequence.frame_paths]
