"""Checks of data and results: what is missing, damaged or certainly wrong.

Damage is a problem, which ends a command. What can be read, but cannot be right, is a warning. What
can only be guessed is not checked: the figures of a study show frames, masks and keypoints.
"""

import sys
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.arrays import are_impossible
from thesis_repro.data.label_ids import LABEL_IDS
from thesis_repro.data.sequence import Sequence, check_size
from thesis_repro.errors import InputError, one_line
from thesis_repro.masks import coverage
from thesis_repro.masks.folders import LabelMasks, MaskFolder
from thesis_repro.running import files, program

FITS = 15.0  # degrees; the median direction of the healthy runs recorded is at most 5.9 off
MIN_STEPS = 10  # that say whether a truth fits
MASK_SAMPLES = 6  # frames whose masks are looked at
MIN_SHARE = 0.005  # of the frames: that masks keep, and of a class that is named
MAX_DROPPED = 0.1  # share of a run's steps

# Problems of folders


def _damaged(read: Callable, items: Collection, description: str) -> list[str]:
    """Read every item in threads, because decoding releases Python's lock; return the problems."""

    def problem(item: Any) -> str:
        try:
            read(item)
        except InputError as error:
            return str(error)
        return ""

    with ThreadPoolExecutor() as threads:
        done = threads.map(problem, items)
        told = files.progress(done, description, total=len(items), unit="file")
        return list(filter(None, told))


def check_kitti(root: Path) -> list[str]:
    """Check all sequences below an odometry root, decode every frame, and print what there is.

    Returns problems: of each sequence the first one with its names, calibration, times and poses,
    or else all frames that are damaged.
    Raises InputError for a folder of another layout, and if no sequence has ground truth.
    """
    problems: list[str] = []
    with_truth = kitti.sequences(root)
    for name in kitti.with_frames(root):
        try:
            sequence = Sequence(root, name)
            height, width = sequence.size
            if name in with_truth:
                sequence.poses  # noqa: B018  raises InputError if there are none
        except InputError as error:
            problems.append(str(error))
            continue
        fact = (
            f"sequence {name}: {len(sequence)} frames of {width}x{height}; with ground truth: "
            f"{sequence.has_truth}; with times: {sequence.has_times}"
        )
        print("\n".join(f"  {one_line(line)}" for line in [fact, *sequence_warnings(sequence)]))
        problems += _damaged(sequence.frame, range(len(sequence)), f"sequence {name}")
    return sorted(problems)


def check_cityscapes(root: Path, splits: Iterable[str] = ("train", "val")) -> list[str]:
    """Check the splits, decode every image and label map, and return problems."""
    problems: list[str] = []

    def read_pair(pair: cityscapes.Pair) -> None:
        size = files.read_gray(pair.image).shape
        check_size(pair.label, cityscapes.read_label_map(pair.label).shape, size, "its image")

    for split in splits:
        try:
            pairs = cityscapes.pairs(root, split)
        except InputError as error:
            problems.append(str(error))
            continue
        print(f"  split {split}: {len(pairs)} images with label maps")
        sampled = [pairs[index].label for index in _sample(len(pairs))]
        with suppress(InputError):  # of a damaged one, which is told below
            shares = _class_shares([cityscapes.read_label_map(path) for path in sampled])
            for text in _label_map_doubts(shares, LABEL_IDS):
                print(f"  split {split}: {text}")
        problems += _damaged(read_pair, pairs, f"split {split}")
    return sorted(problems)


def report(
    kitti_root: Path | None = None,
    cityscapes_root: Path | None = None,
    kitti_semantic: Path | None = None,
) -> bool:
    """Print the content of the folders, and problems.

    Returns True if there are no problems.
    """
    problems: list[str] = []
    for root, check in (
        (kitti_root, check_kitti),
        (cityscapes_root, check_cityscapes),
        (kitti_semantic, partial(check_cityscapes, splits=["train"])),
    ):
        if root:
            print(one_line(root))
            problems += check(root)
    for problem in problems:
        print(f"wrong: {one_line(problem)}", file=sys.stderr)
    return not problems


# Warnings, one line each: "place: what is wrong"


def sequence_warnings(sequence: Sequence) -> list[str]:
    """Warn of steps longer or faster than what drives."""
    intervals = np.diff(sequence.times)
    lengths, unit = sequence.scales[1:], "times in seconds, and the speed in metres a second"
    if sequence.has_truth:
        unit = "true positions in metres, and times in seconds"
    impossible = are_impossible(lengths, intervals if sequence.has_times else None)
    if not impossible.any():
        return []
    first = impossible.argmax()
    return [
        f"sequence {sequence.name}: {impossible.sum()} of {len(lengths)} steps are impossible; the "
        f"first is {lengths[first]:.3g} m in {intervals[first]:.3g} s, to "
        f"{sequence.frame_paths[first + 1].name}; are {unit}?"
    ]


def run_warnings(
    name: str, frames: int, failed: int, dropped: int = 0, scale_gate: float = 0.1
) -> list[str]:
    """Warn if many steps of a run failed or were dropped.

    name: of the sequence. frames, failed, dropped: numbers of frames, of steps with a flag, and of
    steps that were no longer than the scale gate (metres), so that their motion was left out.
    """
    warnings = []
    if failed > frames / 2:
        warnings.append(
            f"sequence {name}: {failed} of {frames} frames have a flag; do frames, calibration and poses "
            "fit together?"
        )
    if dropped >= MAX_DROPPED * frames:
        warnings.append(
            f"sequence {name}: {dropped} of {frames} steps are no longer than the scale gate of "
            f"{scale_gate:g} m, so their motion and rotation were left out; --scale-gate 0 takes all"
        )
    return warnings


def inverted_truth(sequence: Sequence, estimated: np.ndarray) -> list[str]:
    """Warn if the true poses fit an estimated path, (n, 4, 4), better when they are inverted.

    Only directions of steps are compared, in the median, of paths that have enough of them. On a
    straight street, poses with OpenGL's axes or in reverse order fit better inverted, too.
    """
    from thesis_repro.odometry.metrics import step_errors  # takes 0.4 s to load

    given = step_errors(estimated, sequence.poses)
    inverted = step_errors(estimated, np.linalg.inv(sequence.poses))
    if inverted["steps"] < MIN_STEPS or not inverted["direction"] < FITS < given["direction"]:
        return []
    return [
        f"{sequence.poses_path}: the truth fits better inverted; true poses must be camera to world, with "
        "the axes x right, y down, z forward"
    ]


def input_warnings(sequence: Sequence, mask_sets: Iterable) -> list[str]:
    """Print what masks of a sequence hold, and return warnings of doubtful input."""
    warnings = sequence_warnings(sequence)
    for masks in mask_sets:
        with suppress(InputError):  # a file that cannot be read is reported when it is used
            line, of_masks = look_at_masks(masks, sequence)
            program.log.info(line)
            warnings += of_masks
    return warnings


def look_at_masks(source: LabelMasks | MaskFolder, sequence: Sequence) -> tuple[str, list[str]]:
    """Look at about MASK_SAMPLES masks of a sequence, spread evenly over it.

    Returns one line that says what they keep, and what label maps hold, and at most one warning of
    what is certainly wrong. Raises InputError if one of them cannot be read.
    """
    folder = source.paths[0].parent
    sampled = _sample(len(source))
    shares = [coverage(source[index]) for index in sampled]
    line = f"{folder}: masks keep {np.mean(shares):.1%} of {sequence.name}"
    told = []
    if isinstance(source, LabelMasks):
        of_classes = _class_shares([source.label_map(index) for index in sampled])
        told = _label_map_doubts(of_classes, source.ids)
        if source.dilation_width is not None:
            line += f" (width {source.dilation_width})"
        classes = zip(cityscapes.LABELS, of_classes, strict=False)
        held = [f"{label.name} {share:.0%}" for label, share in classes if share >= MIN_SHARE]
        line += f"; label maps hold {', '.join(held)}"
    if min(shares) < MIN_SHARE or min(shares) == 1:
        told.append(
            f"masks keep {min(shares):.1%} to {max(shares):.1%} of the frames; --invert inverts ready-made "
            "masks"
        )
    return line, [f"{folder}: {text}" for text in told[:1]]


def _sample(count: int) -> list[int]:
    """Return about MASK_SAMPLES of so many numbers, spread evenly over them."""
    return np.unique(np.linspace(0, count - 1, MASK_SAMPLES).astype(int)).tolist()


def _class_shares(label_maps: list[np.ndarray]) -> np.ndarray:
    """Return the share of each label id, (N_CLASSES,), in label maps."""
    pixels = np.concatenate([label_map.ravel() for label_map in label_maps])
    return np.bincount(pixels, minlength=cityscapes.N_CLASSES) / pixels.size


def _label_map_doubts(shares: np.ndarray, ids_option: str) -> list[str]:
    """Return what is certainly wrong with the label maps of a street.

    shares: of each label id, (N_CLASSES,). ids_option: what the label maps were read with.
    """
    ids = np.flatnonzero(shares)
    if len(ids) == 1:
        return [
            f"label maps hold nothing but {cityscapes.LABELS[ids[0]].name}; the network that made them "
            "does not work, or has other ids"
        ]
    if ids_option == LABEL_IDS and ids.max() < len(cityscapes.TRAINED):
        return [
            f"label maps hold no id above {ids.max()}, so no sky, vegetation or cars; name their ids with "
            "--ids (train ids: --ids train); a training needs label ids"
        ]
    return []
