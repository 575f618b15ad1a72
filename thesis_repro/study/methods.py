"""What a study compares: one table of methods.

A method chooses the keypoints of a run. Beside all keypoints and masks, there are *controls*: masks
and settings that leave as many keypoints as the masks of the segmentation, chosen differently. If
the odometry gains as much from a control, the segmentation is not what helps. A new method is an
entry in METHODS, a new error of a path one in study/errors.py.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np

from thesis_repro.data.kitti import TRUE_LABELS, Sequence
from thesis_repro.masks import MaskSettings, dilate
from thesis_repro.odometry import THESIS, OdometrySettings
from thesis_repro.odometry.odometry import detect
from thesis_repro.study.sources import Source

# Masks that are controls. They are indexed by frame number, as in `masks`.

LARGEST_GRADIENT = 8 * 255  # |dx| + |dy| of 3x3 Sobel operators
COVERAGE_TOLERANCE = 0.002  # of the frame
SAMPLE = 12  # frames on which the distance between keypoints is chosen
STEP = 0.1  # pixels between the distances that are tried
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

    def check_files(self, known: set[Any]) -> None:
        """Raise InputError if a file of the source is damaged, see `LabelMasks.check_files`."""
        self.masks.check_files(known)

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


# The methods: functions of a sequence, a source and a width of its masks in pixels

Choice: TypeAlias = tuple[OdometrySettings, Any]  # settings and masks of a run, or None


def all_keypoints(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run as the thesis does, without masks."""
    return THESIS, None


def masked(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run with the masks of the source."""
    return THESIS, source.masks(sequence, width)


def brought(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run with what the source brings in place of the odometry or parts of it."""
    return THESIS, source


def altered(masks: type[OtherFrame]) -> Callable[..., Choice]:
    """Return a method with masks that are made from those of the source."""
    return lambda sequence, source, width: (THESIS, masks(source, sequence, width))


def made_with(settings: MaskSettings | None = None, **changes: Any) -> Callable[..., Choice]:
    """Return a method with other masks from the same label maps.

    settings: of the masks; None: those of the source, with changes.
    """

    def choose(sequence: Sequence, source: Source, width: int | None) -> Choice:
        ids = source.settings.ids
        chosen = replace(settings or source.settings, **{"ids": ids, **changes})
        return masked(sequence, replace(source, settings=chosen), width)

    return choose


def from_true_labels(sequence: Sequence, source: Source, width: int | None) -> Choice:
    """Run with masks from the true label maps."""
    folder = true_labels(sequence.root, sequence.name)
    settings = replace(source.settings, ids="labels")
    return masked(sequence, replace(source, folder=folder, settings=settings), width)


class Method(NamedTuple):
    """A way to choose the keypoints of a run.

    title: in tables and figures. group: REFERENCE, BROUGHT by the user, from LABEL_MAPS of the
    user, a CONTROL without segmentation, which keeps as many keypoints as the masks do but knows
    nothing of the classes, or THESIS_ONLY, for a figure of the thesis. choose: from a sequence, a
    source and a width to the settings and masks of a run.
    """

    title: str
    group: str
    choose: Callable[[Sequence, Source, int | None], Choice]


REFERENCE, BROUGHT, LABEL_MAPS, CONTROL, THESIS_ONLY = (
    "reference",
    "brought",
    "label maps",
    "control",
    "thesis",
)
METHODS = {  # in the order in which they are shown
    "baseline": Method("all keypoints", REFERENCE, all_keypoints),
    "masked": Method("masks", BROUGHT, masked),
    "keypoints": Method("own keypoints", BROUGHT, brought),  # these two as sources.KINDS has them
    "paths": Method("path of another system", BROUGHT, brought),
    "exact-boundaries": Method(
        "exact class boundaries", LABEL_MAPS, made_with(boundaries="exact", keep="boundaries")
    ),
    "corrected": Method("corrected mask", LABEL_MAPS, made_with(CORRECTED)),
    "static-boundaries": Method(
        "boundaries of static things", LABEL_MAPS, made_with(keep="static-boundaries")
    ),
    "static": Method("all but movable things", LABEL_MAPS, made_with(keep="static")),
    "inverse": Method("all but the boundaries", LABEL_MAPS, made_with(keep="inverse")),
    "true-labels": Method("true label maps", LABEL_MAPS, from_true_labels),
    "other-frame": Method("mask of another frame", CONTROL, altered(OtherFrame)),
    "mirrored": Method("mirrored mask", CONTROL, altered(Mirrored)),
    "random-lines": Method("random lines", CONTROL, altered(RandomLines)),
    "image-edges": Method("edges of the image", CONTROL, altered(ImageEdges)),
    # these two as many keypoints as masks leave, which the job says
    "fewer": Method("fewer keypoints", CONTROL, all_keypoints),
    "spread": Method("keypoints spread out", CONTROL, all_keypoints),
    "reduced": Method("reduced keypoints", THESIS_ONLY, all_keypoints),  # Figure 4.12
}
AS_SLAM_SYSTEMS = ("static", "inverse", "static-boundaries")
OF_LABEL_MAPS = ("exact-boundaries", "corrected", *AS_SLAM_SYSTEMS, "true-labels")
# the methods with masks beside "masked", in the order of their runs
MASK_CONTROLS = ("other-frame", "mirrored", "random-lines", "image-edges", *OF_LABEL_MAPS)


def min_distance(sequence: Sequence, number: float) -> float:
    """Return the distance between keypoints that leaves `number` of them on average.

    The distance (pixels) is the setting of the detector. It is found by bisection on SAMPLE frames
    of the sequence, and is never below the distance of the thesis.
    """
    sample = np.unique(np.linspace(0, len(sequence) - 1, SAMPLE).round().astype(int))
    frames = [(sequence.frame(index), sequence.visible(index)) for index in sample]

    def mean_number(distance: float) -> float:
        settings = replace(THESIS, min_distance=distance)
        return float(np.mean([len(detect(frame, settings, visible)) for frame, visible in frames]))

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
