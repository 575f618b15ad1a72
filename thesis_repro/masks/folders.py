"""Masks of a sequence in files: made from label maps on access, or read from images."""

import os
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from thesis_repro.data import label_ids
from thesis_repro.data.cameras import Camera
from thesis_repro.data.frames import say_once
from thesis_repro.data.label_ids import LABEL_IDS
from thesis_repro.data.sequence import Sequence, check_size
from thesis_repro.errors import InputError
from thesis_repro.masks import (
    THESIS_MASKS,
    MaskSettings,
    canny_edges,
    check_width,
    edges,
    keypoint_mask,
    near_movable,
)
from thesis_repro.running import provenance
from thesis_repro.running.files import listed, progress, read_unchanged, write_png

# code that makes the masks of files
CODE = ("thesis_repro/masks", "thesis_repro/data", "thesis_repro/running/files.py")
ENDINGS = (".png", ".jpg", ".jpeg")  # of masks, in small or capital letters
AREA = np.ones((5, 5), np.uint8)  # gray edges are narrower than one of a single gray value
MAX_GRAY = 0.2  # share of a mask's pixels; label maps have more, edges of JPEG files less


class LabelMasks:
    """Masks of a sequence, made from label maps on access: masks[i] for frame i.

    folder: holds one label map a frame, of any size, as a PNG with the frame's name, or a folder of
    them for each sequence. dilation_width, settings: as in `keypoint_mask`. ids: what the files
    hold: Cityscapes' ids ("labels"), its "train" ids or its "colors", or else what the table of
    this name or file names, see `label_ids.read`.
    Raises InputError if the folder or a frame's label map is missing.
    """

    def __init__(
        self,
        folder: str | Path,
        sequence: Sequence,
        dilation_width: int | None,
        settings: MaskSettings = THESIS_MASKS,
        ids: str | Path = LABEL_IDS,
    ) -> None:
        self.paths = _label_map_paths(folder, sequence)
        self.frame_paths = sequence.frame_paths
        self.size = sequence.size
        self.dilation_width = dilation_width
        self.settings, self.ids = settings, str(ids)
        if settings.has_width:
            check_width(dilation_width, self.size)

    def __len__(self) -> int:
        return len(self.paths)

    def __repr__(self) -> str:
        height, width = self.size
        return (
            f"LabelMasks: {len(self)} masks of {width}x{height} pixels, dilation width "
            f"{self.dilation_width}, {self.paths[0].parent}"
        )

    def label_map(self, index: int) -> np.ndarray:
        """Label map of frame `index`, in label ids."""
        path = self.paths[index]
        status = os.stat(path)
        return _read_once(path, self.ids, status.st_mtime_ns, status.st_size)

    def __getitem__(self, index: int) -> np.ndarray:
        label_map = self.label_map(index)
        return keypoint_mask(label_map, self.size, self.dilation_width, self.settings)

    def record(self) -> list[Any]:
        """Return what the masks depend on beside files."""
        table = label_ids.record(self.ids)
        return ["label maps", self.dilation_width, str(self.settings), table]


@lru_cache(maxsize=2)  # masks of several settings, and controls, share label maps
def _read_once(path: Path, ids: str, changed: int, size: int) -> np.ndarray:
    """Read a label map. changed, size: of its file, which may be written anew."""
    return label_ids.read(path, ids)


def forget_edges() -> None:
    """Clear what LabelMasks keeps, so that the time to make a mask can be measured."""
    for function in (canny_edges, edges, near_movable):
        function.forget()
    _read_once.cache_clear()


def write_masks(masks: LabelMasks, folder: str | Path) -> None:
    """Write the mask of every frame as a PNG with the frame's name (A.8). `MaskFolder` reads them.

    The folder is a stage (see provenance): a stopped run resumes, and masks made from other label
    maps or settings are moved aside.
    """
    with provenance.claimed(folder):
        folder = provenance.stage(
            folder,
            labels=provenance.digest_of_files(masks.paths),
            size=masks.size,
            **asdict(masks.settings),
            ids=masks.ids,
            **label_ids.record(masks.ids),
            dilation_width=masks.dilation_width,
            frames=provenance.digest_of_files(masks.frame_paths),
            **provenance.first_frame(masks.frame_paths),
            code=provenance.digest_of_code(*CODE),
            **provenance.versions("opencv"),
        )
        for index, path in enumerate(progress(masks.paths, f"masks, width {masks.dilation_width}")):
            if not (folder / path.name).is_file():
                write_png(folder / path.name, masks[index])


class MaskFolder:
    """Masks of a sequence read from images with the frames' names: masks[i] for frame i.

    One image is used for all frames if `folder` is a file, or holds a single file without the name
    of a frame.
    invert: as in `read_mask`. Raises InputError if the folder or a frame's
    mask is missing, and as `read_mask` does.
    """

    def __init__(self, folder: str | Path, sequence: Sequence, invert: bool = False) -> None:
        self.paths = _mask_paths(folder, sequence)
        self.size = sequence.size
        self.invert = invert

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> np.ndarray:
        return read_mask(self.paths[index], self.size, self.invert)

    def record(self) -> list[Any]:
        """Return what the masks depend on beside files."""
        return ["masks", self.invert]


def read_mask(
    path: str | Path, size: tuple[int, int] | None = None, invert: bool = False
) -> np.ndarray:
    """Read a mask, (height, width) uint8: 0 where keypoints are forbidden, 255 elsewhere.

    Masks of other tools are read, too: any other value in place of 255; of gray edges, the nearer
    of 0 and 255. size: (height, width) of its frame.
    invert: 0 allows keypoints, and any other value forbids them, such as the id or colour of an
    object; of a JPEG file, whose values are not exact, those nearer to 255.
    Raises InputError for another size, for an alpha channel, and if it is not plain which values
    are meant: areas of gray, as of a label map or of several objects.
    """
    mask = read_unchanged(path)
    if mask.ndim == 3:
        if (mask[..., 3:] < np.iinfo(mask.dtype).max).any():
            raise InputError(f"{path}: has an alpha channel; save the mask in gray")
        mask = mask[..., :3].max(axis=2)
    if size is not None:
        check_size(Path(path), mask.shape, size, "its frame")
    if invert and Path(path).suffix.lower() == ".png":
        return np.where(mask > 0, np.uint8(0), np.uint8(255))
    largest = max(mask.max(), 1)
    if np.count_nonzero(np.bincount(mask.ravel())) > 2:
        largest = np.iinfo(mask.dtype).max  # one limit for all frames
    kept = mask > 0.5 * largest
    is_gray = (mask > 0.1 * largest) & (mask < 0.9 * largest)
    is_flat = cv2.erode(mask, AREA) == cv2.dilate(mask, AREA)
    if is_gray.mean() > MAX_GRAY or (is_gray & is_flat).any() or mask.any() and not kept.any():
        raise InputError(
            f"{path}: holds more than two values; a mask has 0 and 255 (label maps go with --labels, "
            "and ids of objects to ignore with --invert, as PNG)"
        )
    return np.where(kept != invert, np.uint8(255), np.uint8(0))


def folder_of_sequence(folder: str | Path, sequence: str) -> Path:
    """Folder with the label maps or masks of a sequence.

    That is the folder of its name in `folder`, or `folder` itself if that holds files, as
    `thesis-repro predict` and `masks` write them.
    """
    folder = Path(folder)
    subfolder = folder / sequence
    if not subfolder.is_dir() and _images_by_name(folder):
        return folder
    return subfolder


def _label_map_paths(folder: str | Path, sequence: Sequence) -> list[Path]:
    """One path a frame to its label map. Raises InputError if one is missing."""
    place = _existing_folder(folder, sequence, "label map")
    return _by_frame(place, {path.name: path for path in listed(place)}, sequence, "label map")


def _mask_paths(folder: str | Path, sequence: Sequence) -> list[Path]:
    """One path a frame to its mask. Raises InputError if one is missing."""
    if Path(folder).is_file():
        _check_lens(Path(folder), sequence, "mask")
        return [Path(folder)] * len(sequence)
    place = _existing_folder(folder, sequence, "mask")
    present = _images_by_name(place)
    if len(present) == 1:
        single = next(iter(present.values()))
        # a single mask with the name of a frame, also outside of a subset, is that frame's
        frames = listed(sequence.frame_paths[0].parent, "*")
        if single.stem not in [path.stem for path in frames]:
            return [single] * len(sequence)
    return _by_frame(place, present, sequence, "mask")


def _existing_folder(folder: str | Path, sequence: Sequence, kind: str) -> Path:
    """Folder of a sequence's files of a kind. Raises InputError if there is none that fits."""
    if not hasattr(sequence, "frame_paths"):
        raise InputError(
            f"{folder}: the frames are not in files, so no {kind} belongs to them; give masks as a "
            "list, one a frame"
        )
    place = folder_of_sequence(folder, sequence.name)
    if not place.is_dir():
        raise InputError(
            f"{place}: no such folder; it must hold one {kind}, an image, for each frame of sequence "
            f"{sequence.name}"
        )
    _check_lens(place, sequence, kind)
    return place


def _check_lens(place: Path, sequence: Sequence, kind: str) -> None:
    """Say of which frames masks must be, and raise InputError if a command made them of others.

    They live in frames without distortion, as the odometry sees them.
    """
    lens = getattr(sequence, "lens", Camera(np.eye(3), np.empty(0)))
    made = provenance.record(place) or {}
    how = "make them again of this sequence's folder, with the same --camera and --calibration"
    if "first_frame" in made:
        name, digest = made["first_frame"]
        frame = sequence.frame_paths[0].with_name(name)
        if frame.is_file() and provenance.digest_of_file(frame) != digest:
            raise InputError(f"{place}: {kind}s of another camera or sequence than {frame}; {how}")
    if "model" in made and made.get("camera", []) != lens.record():
        raise InputError(
            f"{place}: made of frames with other distortion than the odometry sees; {how}"
        )
    if lens.record():
        say_once(
            f"{place}: {kind}s must be of frames without distortion, as predict and tr.Sequence make them"
        )


def _by_frame(folder: Path, present: dict[str, Path], sequence: Sequence, kind: str) -> list[Path]:
    """One path a frame, of those that are present, by name. Raises InputError if one is missing."""
    missing = [name for name in sequence.label_names if name not in present]
    if missing:
        raise InputError(
            f"{folder / missing[0]}: no such {kind} ({len(missing)} of {len(sequence)} frames of sequence "
            f"{sequence.name} have none); each frame needs one"
        )
    return [present[name] for name in sequence.label_names]


def _images_by_name(folder: Path) -> dict[str, Path]:
    """Return the masks of a folder by their names with the ending .png."""
    paths = [path for path in listed(folder, "*") if path.suffix.lower() in ENDINGS]
    return {f"{path.stem}.png": path for path in paths}
