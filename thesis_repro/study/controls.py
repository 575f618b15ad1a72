"""The controls: masks and settings that leave as many keypoints as the segmentation, but for another reason.

If the odometry gains as much from them, it is not the segmentation that helps. Masks are indexed by frame number, like
those of `masks`.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from thesis_repro.kitti import Sequence
from thesis_repro.masks import MaskSettings, dilate
from thesis_repro.odometry import THESIS
from thesis_repro.odometry.keypoints import SharedKeypoints
from thesis_repro.study.sources import FileMasks, Source

LARGEST_GRADIENT = 8 * 255  # |dx| + |dy| of 3x3 Sobel operators
CLOSE = 0.002  # of the frame: a difference of coverage that is none
SAMPLE = 12  # frames on which a distance between keypoints is chosen
STEP = 0.1  # pixels between the distances that are tried
SEED = 0  # of the random lines
# All corrections together, chosen by no error: a label map of 320 columns places a boundary no better than within 2
# pixels of the frame, and within 10 of its rim the window of 21 in which Lucas and Kanade track is cut off.
CORRECTED = MaskSettings("exact", symmetric=True, movable=2, margin=10)
LINE_WIDTH = 10  # pixels, of lines and edges beside masks that come ready made and have no width


def true_labels(kitti: Path, name: str) -> Path:
    """Where a sequence's true label maps are, if it has any (the embedded world's have)."""
    return Path(kitti) / "sequences" / name / "labels_0"


class OtherFrame:
    """The mask of the frame half a sequence away: as many boundaries, of the same kind, in the wrong place."""

    def __init__(self, source: Source, sequence: Sequence, dilation_width: int | None) -> None:
        self.masks = source.masks(sequence, dilation_width)
        self.paths = self.masks.paths
        self.line_width = dilation_width or LINE_WIDTH

    def __len__(self) -> int:
        return len(self.masks)

    def __getitem__(self, index: int) -> np.ndarray:
        count = len(self)
        return self.masks[(index + count // 2) % count]


class Mirrored(OtherFrame):
    """The frame's own mask, left and right exchanged: the layout of a street, but not of this one."""

    def __getitem__(self, index: int) -> np.ndarray:
        return cv2.flip(self.masks[index], 1)


class RandomLines(OtherFrame):
    """Random segments, dilated as the boundaries are, as many as cover what the frame's mask covers."""

    def __getitem__(self, index: int) -> np.ndarray:
        mask = self.masks[index]
        wanted = np.count_nonzero(mask)
        for number in (2**8, 2**11, 2**14):
            first = self._first_segments(index, number, mask.shape)
            covered = np.cumsum(cv2.calcHist([first], [0], None, [number], [0, number]), dtype=int)
            if covered[-1] >= wanted:
                break
        count = np.abs(np.concatenate([[0], covered]) - wanted).argmin()
        return cv2.compare(first, int(count), cv2.CMP_LT)

    def _first_segments(self, index: int, number: int, shape: tuple[int, ...]) -> np.ndarray:
        """The number of the first of the dilated segments that covers a pixel, `number` where none does."""
        random = np.random.default_rng((SEED, index))
        height, width = shape
        start_x, start_y, angle, length = random.uniform(size=(number, 4)).T
        length = length * height / 2
        start = np.column_stack([start_x * width, start_y * height])
        end = start + np.column_stack([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)]) * length[:, None]
        image = np.full(shape, number, np.uint16)
        for segment in range(number - 1, -1, -1):
            cv2.line(image, start[segment].astype(int).tolist(), end[segment].astype(int).tolist(), segment)
        return cv2.erode(image, np.ones((self.line_width,) * 2, np.uint8))  # the least number near a pixel


class ImageEdges(OtherFrame):
    """The strongest Canny edges of the frame itself, dilated, that cover what its mask covers: no network at all."""

    def __init__(self, source: Source, sequence: Sequence, dilation_width: int | None) -> None:
        super().__init__(source, sequence, dilation_width)
        self.sequence = sequence

    def __getitem__(self, index: int) -> np.ndarray:
        frame, wanted = self.sequence.frame(index), np.count_nonzero(self.masks[index])
        across, down = cv2.spatialGradient(frame)
        low, high = 1, LARGEST_GRADIENT  # thresholds that cover too much, and not enough
        covered_low, covered_high = frame.size, 0
        best, miss = np.zeros_like(frame), wanted
        while high - low > 1 and miss > CLOSE * frame.size:
            # interpolated, but never so near one end that the other end could stay for ever
            share = np.clip((covered_low - wanted) / (covered_low - covered_high), 0.1, 0.9)
            threshold = int(np.clip(low * (high / low) ** share, low + 1, high - 1))
            mask = dilate(cv2.Canny(across, down, threshold / 2, threshold), self.line_width)
            covered = cv2.countNonZero(mask)
            if abs(covered - wanted) < miss:
                best, miss = mask, abs(covered - wanted)
            if covered > wanted:
                low, covered_low = threshold, covered
            else:
                high, covered_high = threshold, covered
        return best


ControlMasks: TypeAlias = FileMasks | OtherFrame
OF_MASKS: dict[str, Callable[[Source, Sequence, int | None], ControlMasks]] = {
    "fallback": Source.masks,  # the masks themselves: it is the odometry that does without them (OdometrySettings)
    "other-frame": OtherFrame, "mirrored": Mirrored, "random-lines": RandomLines, "image-edges": ImageEdges}
LITERATURE = ("static", "inverse", "static-boundaries")  # other places to keep keypoints in, of masks.KEEP
# These ask what label maps are good for.
OF_LABEL_MAPS = ("exact-boundaries", "corrected", *LITERATURE, "true-labels")
MASKS = (*OF_MASKS, *OF_LABEL_MAPS)


def masks(method: str, source: Source, sequence: Sequence, dilation_width: int | None) -> ControlMasks:
    """The masks of one of MASKS for a sequence, as control of the source's own.

    dilation_width: pixels, of masks from label maps.
    """
    if method in OF_MASKS:
        return OF_MASKS[method](source, sequence, dilation_width)
    if method == "true-labels":
        source = replace(source, folder=true_labels(sequence.root, sequence.name),
                         settings=replace(source.settings, ids="labels"))
    elif method == "corrected":
        source = replace(source, settings=replace(CORRECTED, ids=source.settings.ids))
    elif method in LITERATURE:
        source = replace(source, settings=replace(source.settings, keep=method))
    else:
        source = replace(source, settings=replace(source.settings, boundaries="exact"))
    return source.masks(sequence, dilation_width)


def min_distance(sequence: Sequence, number: float) -> float:
    """The distance between keypoints, pixels, at which the detector finds `number` of them on average.

    Looked for on SAMPLE frames of the sequence, never below the distance of the thesis.
    """
    chosen = np.unique(np.linspace(0, len(sequence) - 1, SAMPLE).round().astype(int))
    frames = [(sequence.frame(index), SharedKeypoints()) for index in chosen]

    def distance(steps: int) -> float:
        return round(THESIS.min_distance + steps * STEP, 6)

    def mean_number(steps: int) -> float:
        settings = replace(THESIS, min_distance=distance(steps))
        return float(np.mean([len(keypoints.detect(frame, settings)) for frame, keypoints in frames]))

    low, high = 0, round(min(sequence.size) / STEP)
    counts = {low: mean_number(low)}
    while high - low > 1:
        middle = (low + high) // 2
        counts[middle] = mean_number(middle)
        low, high = (middle, high) if counts[middle] > number else (low, middle)
    best = min(counts, key=lambda steps: abs(counts[steps] - number))
    return distance(best)
