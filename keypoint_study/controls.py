"""Controls: masks that know nothing of the frame's classes, and how far spread keypoints are."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from keypoint_study.sources import FileMasks
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import dilate
from thesis_repro.odometry import THESIS

LARGEST_GRADIENT = 8 * 255  # |dx| + |dy| of 3x3 Sobel operators
COVERAGE_TOLERANCE = 0.002  # of the frame
SAMPLE = 12  # frames on which the distance between keypoints is chosen
STEP = 0.1  # pixels between the distances that are tried


@dataclass(frozen=True, eq=False)
class MadeMasks:
    """Masks that a function makes: that of frame i is ``make(given, *values, i)``.

    given: other masks, or a sequence. values: what else the function takes.
    """

    make: Callable
    given: Any
    values: tuple = ()

    def __len__(self) -> int:
        return len(self.given)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.make(self.given, *self.values, index)

    @property
    def paths(self) -> list[Path]:
        """The files that the masks are made from, beside the frames."""
        return getattr(self.given, "paths", [])

    def record(self) -> list[Any]:
        """Return what the masks depend on beside files."""
        parts = [part for part in (self.given, *self.values) if not hasattr(part, "frame")]
        return [self.make.__name__, *(recorded(part) for part in parts)]


def recorded(part: Any) -> Any:
    """Return what a record of results says of masks, or of a value that they are made from.

    An object without `record()` is described in Python's words: what those leave out, such as its
    address, is never the same again, so its runs are made again.
    """
    return part.record() if hasattr(part, "record") else repr(part)


# Functions of masks, of more values and of the number of a frame


def other_frame(masks: FileMasks, index: int) -> np.ndarray:
    """The mask of the frame half a sequence away: similar boundaries in the wrong place."""
    return masks[(index + len(masks) // 2) % len(masks)]


def mirrored(masks: FileMasks, index: int) -> np.ndarray:
    """The mask of the frame, flipped left to right.

    It looks like a street, but not like the street in the frame.
    """
    return cv2.flip(masks[index], 1)


def random_lines(masks: FileMasks, line_width: int, index: int) -> np.ndarray:
    """Random line segments that cover as many pixels as the mask of the frame.

    They are dilated like the boundaries.
    """
    mask = masks[index]
    target = np.count_nonzero(mask)
    for number in (2**8, 2**11, 2**14):
        first = _first_segments(index, number, mask.shape, line_width)
        pixels = cv2.calcHist([first], [0], None, [number], [0, number])
        covered = np.cumsum(pixels, dtype=int)  # by the first 1, 2, ... segments
        if covered[-1] >= target:
            break
    count = np.abs(np.concatenate([[0], covered]) - target).argmin()
    return cv2.compare(first, int(count), cv2.CMP_LT)


def _first_segments(index: int, number: int, shape: tuple[int, ...], line_width: int) -> np.ndarray:
    """Return, for each pixel, the index of the first dilated segment that covers it.

    The index is `number` if none does.
    """
    random = np.random.default_rng((0, index))
    height, width = shape
    start_x, start_y, angle, length = random.uniform(size=(number, 4)).T
    length = length * height / 2
    start = np.column_stack([start_x * width, start_y * height])
    direction = np.column_stack([np.cos(2 * np.pi * angle), np.sin(2 * np.pi * angle)])
    end = start + direction * length[:, None]
    image = np.full(shape, number, np.uint16)
    starts, ends = start.astype(int).tolist(), end.astype(int).tolist()
    for segment in reversed(range(number)):  # so that the first one is on top
        cv2.line(image, starts[segment], ends[segment], segment)
    # the lowest index near a pixel
    square = np.ones((line_width, line_width), np.uint8)
    return cv2.erode(image, square)


def image_edges(masks: FileMasks, sequence: Sequence, line_width: int, index: int) -> np.ndarray:
    """The strongest Canny edges of the frame, dilated, that cover as many pixels as its mask.

    They need no network.
    """
    frame = sequence.frame(index)
    target = np.count_nonzero(masks[index])
    across, down = cv2.spatialGradient(frame)
    low, high = 1, LARGEST_GRADIENT  # thresholds that cover too many and too few pixels
    covered_low, covered_high = frame.size, 0
    best, miss = np.zeros_like(frame), target
    while high - low > 1 and miss > COVERAGE_TOLERANCE * frame.size:
        # interpolation, kept away from both ends so that the interval always shrinks
        share = np.clip((covered_low - target) / (covered_low - covered_high), 0.1, 0.9)
        between = low * (high / low) ** share
        threshold = int(np.clip(between, low + 1, high - 1))
        mask = dilate(cv2.Canny(across, down, threshold / 2, threshold), line_width)
        covered = cv2.countNonZero(mask)
        if abs(covered - target) < miss:
            best, miss = mask, abs(covered - target)
        if covered > target:
            low, covered_low = threshold, covered
        else:
            high, covered_high = threshold, covered
    return best


# How far keypoints are apart


def min_distance(sequence: Sequence, number: float) -> float:
    """Return the distance between keypoints that leaves `number` of them on average.

    The distance (pixels) is the setting of the detector. It is found by bisection on SAMPLE frames
    of the sequence, and is never below the distance of the thesis.
    """
    from thesis_repro.odometry import corners  # loads the compiler

    sample = np.unique(np.linspace(0, len(sequence) - 1, SAMPLE).round().astype(int))
    # the corners of a frame are ranked once for all distances, with OpenCV's bits
    ranked = [corners.find_corners(sequence.frame(index), THESIS.block_size) for index in sample]
    visible = [sequence.visible(index) for index in sample]

    def mean_number(distance: float) -> float:
        settings = replace(THESIS, min_distance=distance)
        found = map(corners.strongest, ranked, repeat(settings), visible)
        return float(np.mean([len(points) for points in found]))

    low, high = 0, round(min(sequence.size) / STEP)
    distances = [round(THESIS.min_distance + step * STEP, 6) for step in range(high)]
    numbers = {distances[0]: mean_number(distances[0])}
    while high - low > 1:
        middle = (low + high) // 2
        distance = distances[middle]
        numbers[distance] = mean_number(distance)
        if numbers[distance] > number:
            low = middle
        else:
            high = middle
    return min(numbers, key=lambda distance: abs(numbers[distance] - number))
