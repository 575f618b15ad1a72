"""The controls: masks and settings that leave as many keypoints, chosen differently.

They leave as many as the masks of the segmentation. If the odometry gains as much from a control,
the segmentation is not what helps. Masks are indexed by frame number, as in `masks`.
"""

from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from thesis_repro.data.kitti import TRUE_LABELS, Sequence
from thesis_repro.masks import MaskSettings, dilate
from thesis_repro.odometry import THESIS
from thesis_repro.odometry.odometry import detect
from thesis_repro.study.sources import FileMasks, Source

LARGEST_GRADIENT = 8 * 255  # |dx| + |dy| of 3x3 Sobel operators
COVERAGE_TOLERANCE = 0.002  # of the frame
SAMPLE = 12  # frames on which the distance between keypoints is chosen
STEP = 0.1  # pixels between the distances that are tried
SEED = 0  # of the random lines
# All corrections together. No error was used to choose them: a label map of 320 columns places a
# boundary within about 2 pixels of the frame, and within 10 pixels of its border the Lucas-Kanade
# window of 21 pixels is cut off.
CORRECTED = MaskSettings("exact", symmetric=True, movable=2, margin=10)
LINE_WIDTH = 10  # pixels, of lines and edges as controls of ready-made masks, which have no width


def true_labels(kitti: Path, name: str) -> Path:
    """Return the folder of a sequence's true label maps.

    Only sequences of the embedded world have one. kitti: the root of the sequences.
    """
    return Path(kitti) / "sequences" / name / TRUE_LABELS


class OtherFrame:
    """The mask of the frame half a sequence away: similar boundaries in the wrong place."""

    def __init__(self, source: Source, sequence: Sequence, dilation_width: int | None) -> None:
        self.sequence = sequence
        self.masks = source.masks(sequence, dilation_width)
        self.paths = self.masks.paths
        self.line_width = dilation_width or LINE_WIDTH

    def __len__(self) -> int:
        return len(self.masks)

    def __getitem__(self, index: int) -> np.ndarray:
        count = len(self)
        return self.masks[(index + count // 2) % count]


class Mirrored(OtherFrame):
    """The mask of the frame, flipped left to right.

    It looks like a street, but not like the street in the frame.
    """

    def __getitem__(self, index: int) -> np.ndarray:
        return cv2.flip(self.masks[index], 1)


class RandomLines(OtherFrame):
    """Random line segments that cover as many pixels as the mask of the frame.

    They are dilated like the boundaries.
    """

    def __getitem__(self, index: int) -> np.ndarray:
        mask = self.masks[index]
        target = np.count_nonzero(mask)
        for number in (2**8, 2**11, 2**14):
            first = self._first_segments(index, number, mask.shape)
            pixels = cv2.calcHist([first], [0], None, [number], [0, number])
            covered = np.cumsum(pixels, dtype=int)  # by the first 1, 2, ... segments
            if covered[-1] >= target:
                break
        count = np.abs(np.concatenate([[0], covered]) - target).argmin()
        return cv2.compare(first, int(count), cv2.CMP_LT)

    def _first_segments(self, index: int, number: int, shape: tuple[int, ...]) -> np.ndarray:
        """Return, for each pixel, the index of the first dilated segment that covers it.

        The index is `number` if none does.
        """
        random = np.random.default_rng((SEED, index))
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
        square = np.ones((self.line_width, self.line_width), np.uint8)
        return cv2.erode(image, square)


class ImageEdges(OtherFrame):
    """The strongest Canny edges of the frame, dilated, that cover as many pixels as its mask.

    They need no network.
    """

    def __getitem__(self, index: int) -> np.ndarray:
        frame = self.sequence.frame(index)
        target = np.count_nonzero(self.masks[index])
        across, down = cv2.spatialGradient(frame)
        low, high = 1, LARGEST_GRADIENT  # thresholds that cover too many and too few pixels
        covered_low, covered_high = frame.size, 0
        best, miss = np.zeros_like(frame), target
        while high - low > 1 and miss > COVERAGE_TOLERANCE * frame.size:
            # interpolation, kept away from both ends so that the interval always shrinks
            share = np.clip((covered_low - target) / (covered_low - covered_high), 0.1, 0.9)
            between = low * (high / low) ** share
            threshold = int(np.clip(between, low + 1, high - 1))
            mask = dilate(cv2.Canny(across, down, threshold / 2, threshold), self.line_width)
            covered = cv2.countNonZero(mask)
            if abs(covered - target) < miss:
                best, miss = mask, abs(covered - target)
            if covered > target:
                low, covered_low = threshold, covered
            else:
                high, covered_high = threshold, covered
        return best


ControlMasks: TypeAlias = FileMasks | OtherFrame


def min_distance(sequence: Sequence, number: float) -> float:
    """Return the distance between keypoints that leaves `number` of them on average.

    The distance (pixels) is the setting of the detector. It is found by bisection on SAMPLE frames
    of the sequence, and is never below the distance of the thesis.
    """
    sample = np.unique(np.linspace(0, len(sequence) - 1, SAMPLE).round().astype(int))
    frames = [sequence.frame(index) for index in sample]

    def distance(steps: int) -> float:
        return round(THESIS.min_distance + steps * STEP, 6)

    def mean_number(steps: int) -> float:
        settings = replace(THESIS, min_distance=distance(steps))
        numbers = [len(detect(frame, settings)) for frame in frames]
        return float(np.mean(numbers))

    low, high = 0, round(min(sequence.size) / STEP)
    counts = {low: mean_number(low)}
    while high - low > 1:
        middle = (low + high) // 2
        counts[middle] = mean_number(middle)
        if counts[middle] > number:
            low = middle
        else:
            high = middle
    nearest = min(counts, key=lambda steps: abs(counts[steps] - number))
    return distance(nearest)
