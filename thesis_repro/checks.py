"""Checks of data and results: what is missing, damaged or certainly wrong.

Damage is a problem, which ends a command. What can be read, but cannot be right, is a warning. What
can only be guessed is not checked: the figures of a study show frames, masks and keypoints.
"""

import sys
import zlib
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.geometry import centre_doubt
from thesis_repro.data.label_ids import LABEL_IDS
from thesis_repro.data.memory import are_impossible
from thesis_repro.data.sequence import Sequence, check_size
from thesis_repro.errors import InputError, one_line
from thesis_repro.masks import coverage
from thesis_repro.masks.folders import LabelMasks, MaskFolder
from thesis_repro.running import files, program

MAX_GAP = 10  # intervals between frames
STANDING = 0.01  # metres; no direction can be told of a shorter step
MASK_SAMPLES = 6  # frames whose masks are looked at
MIN_SHARE = 0.005  # of the frames: that masks keep, and of a class that is named
# Classes that fill less than MAX_SELDOM of a street's frames: all but these
USUAL = (
    *("unlabeled", "road", "sidewalk", "building", "wall", "fence", "vegetation", "terrain", "sky"),
    *("person", "car", "truck", "bus"),
)
SELDOM = [label for label in cityscapes.LABELS[: cityscapes.N_CLASSES] if label.name not in USUAL]
MAX_SELDOM = 0.2
MAX_DROPPED = 0.1  # share of a run's steps

# Problems of folders


def _damaged(read: Callable, items: Collection, description: str) -> list[str]:
    """Read every item in threads, because decoding releases Python's lock; return the problems."""

    def problem(item: Any) -> list[str]:
        try:
            read(item)
        except InputError as error:
            return [str(error)]
        return []

    with ThreadPoolExecutor() as threads:
        done = threads.map(problem, items)
        return list(chain(*files.progress(done, description, total=len(items), unit="file")))


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
        checksums: dict[int, int] = {}

        def read(index: int, sequence: Any = sequence, checksums: Any = checksums) -> None:
            checksums[index] = zlib.crc32(sequence.frame(index).data)

        problems += _damaged(read, range(len(sequence)), f"sequence {name}")
        equal = sum(checksums[index] == checksums.get(index - 1) for index in checksums)
        if equal:
            print(f"  sequence {name}: {equal} frames equal the frame before, and are no steps")
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
            told = _label_map_doubts(list(map(cityscapes.read_label_map, sampled)))
            print("".join(f"  split {split}: {text}\n" for text in told[:1]), end="")
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
    """Warn of a principal point far from the middle of the frames, and of impossible steps."""
    doubt = centre_doubt(sequence.intrinsics, sequence.size)
    place = f"sequence {sequence.name}: {sequence.calibration_path.name}: "
    return [place + doubt] * bool(doubt) + sequence.doubts() + _step_warnings(sequence)


def standing(sequence: Sequence) -> int:
    """Return the number of true steps in which the camera hardly moves, so that flags are right."""
    return int((sequence.scales[1:] < STANDING).sum()) if sequence.has_truth else 0


def _step_warnings(sequence: Sequence) -> list[str]:
    """Warn of steps longer or faster than what drives, and of gaps in the times."""
    intervals = np.diff(sequence.times)
    lengths, unit = sequence.scales[1:], "times in seconds, and the speed in metres a second"
    if sequence.has_truth:
        unit = "true positions in metres, and times in seconds"
    impossible = are_impossible(lengths, intervals if sequence.has_times else None)
    gaps = intervals > MAX_GAP * sequence.usual_interval
    warnings = []
    if 2 * standing(sequence) > len(lengths):
        warnings.append(
            f"sequence {sequence.name}: the camera stands in {standing(sequence)} of {len(lengths)} steps, "
            f"which are shorter than {STANDING:g} m (median {np.median(lengths):.2g} m), so flags and "
            "wrong directions are no wonder"
        )
    if impossible.any():
        first = impossible.argmax()
        warnings.append(
            f"sequence {sequence.name}: {impossible.sum()} of {len(lengths)} steps are impossible; the "
            f"first is {lengths[first]:.3g} m in {intervals[first]:.3g} s, to "
            f"{sequence.frame_paths[first + 1].name}; are {unit}?"
        )
    if gaps.any():
        first = gaps.argmax()
        warnings.append(
            f"sequence {sequence.name}: gaps in the times: {gaps.sum()}; the first is "
            f"{intervals[first]:.3g} s, before {sequence.frame_paths[first + 1].name}; the odometry cannot "
            f"bridge them, so run the parts on their own (--frames {first + 1} takes the first one)"
        )
    return warnings


def run_warnings(
    name: str,
    frames: int,
    failed: int,
    dropped: int = 0,
    scale_gate: float = 0.1,
    standing: int = 0,
) -> list[str]:
    """Warn if many steps of a run failed or were dropped.

    name: of the sequence. frames, failed, dropped: numbers of frames, of steps with a flag, and of
    steps that were no longer than the scale gate (metres), so that their motion was left out.
    standing: steps in which the camera stands, which may have a flag.
    """
    told = [
        (
            failed - standing > (frames - standing) / 2,
            f"{failed} of {frames} frames have a flag; do frames, calibration and poses fit together?",
        ),
        (
            dropped >= MAX_DROPPED * frames,
            f"{dropped} of {frames} steps are no longer than the scale gate of {scale_gate:g} m, so their "
            "motion and rotation were left out; --scale-gate 0 takes all",
        ),
    ]
    return [f"sequence {name}: {text}" for applies, text in told if applies]


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
        label_maps = [source.label_map(index) for index in sampled]
        of_classes = _class_shares(label_maps)
        told = _label_map_doubts(label_maps, source.ids)
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


def _label_map_doubts(label_maps: list[np.ndarray], ids_option: str | None = None) -> list[str]:
    """Return what is certainly wrong with label maps of a street, the worst first.

    ids_option: what they were read with; None for those of a training, which has no such option.
    """
    has_label_ids = ids_option in (None, LABEL_IDS)
    of_classes = _class_shares(label_maps)
    ids = np.flatnonzero(of_classes)
    seldom = max(SELDOM, key=lambda label: of_classes[label.id])
    advice = "--ids FILE gives ids the names that are meant"
    if ids_option is None:
        advice = "a training needs Cityscapes' label ids"
    elif ids.max() < len(cityscapes.TRAINED) and _is_street_of_train_ids(label_maps):
        advice = "--ids train reads train ids"
    told = [
        (
            len(ids) == 1,
            f"label maps hold nothing but {cityscapes.LABELS[ids[0]].name}; the network that made them "
            "does not work, or has other ids",
        ),
        (
            has_label_ids and ids.max() < len(cityscapes.TRAINED),
            f"label maps hold no id above {ids.max()}, so no sky, vegetation or cars; {advice}",
        ),
        (
            has_label_ids and ids.max() == cityscapes.ID["license plate"],
            f"label maps hold id {ids.max()}, a license plate, but a garage in KITTI-360; {advice}",
        ),
        (
            MAX_SELDOM < of_classes[seldom.id] < 1,
            f"label maps hold {of_classes[seldom.id]:.0%} {seldom.name}, which streets seldom have; do they "
            "have other ids?",
        ),
    ]
    return [text for applies, text in told if applies]


def _is_street_of_train_ids(label_maps: list[np.ndarray]) -> bool:
    """Return whether ids read as train ids show a road below, and something else above it."""
    upper, lower = (
        np.bincount(np.concatenate([half.ravel() for half in halves])).argmax()
        for halves in zip(*(np.array_split(label_map, 2) for label_map in label_maps))
    )
    return cityscapes.TRAINED[lower] == "road" != cityscapes.TRAINED[upper]


def _class_shares(label_maps: list[np.ndarray]) -> np.ndarray:
    """Return the share of each label id, (N_CLASSES,), in label maps."""
    pixels = np.concatenate([label_map.ravel() for label_map in label_maps])
    return np.bincount(pixels, minlength=cityscapes.N_CLASSES) / pixels.size
