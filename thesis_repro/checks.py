"""Checks of data and results: what is missing, damaged or certainly wrong.

Damage is a problem, which ends a command. What can be read, but cannot be right, is a warning. What
can only be guessed is not checked: the figures of a study show frames, masks and keypoints.
"""

import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from thesis_repro.data import cityscapes, kitti
from thesis_repro.errors import InputError, one_line
from thesis_repro.mask_files import LabelMasks, MaskFolder, label_map_of
from thesis_repro.masks import coverage
from thesis_repro.running import files, messages, results
from thesis_repro.running.settings import read_settings

# Of the principal point from the middle, in frame widths and heights. KITTI has at most 0.04.
# Frames are cropped at their upper or lower edge more often than at their sides.
MAX_CENTRE_OFFSET = 0.075, 0.15
MASK_SAMPLES = 6  # frames whose masks are looked at
MIN_SHARE = 0.005  # of the frames: that masks keep, and of a class that is named
MAX_DROPPED = 0.1  # share of a run's steps

# Problems of folders


def _attempt(problems: list[str], function: Callable, *arguments: Any) -> Any:
    """Return the result of a function; an InputError becomes one of the problems instead."""
    try:
        return function(*arguments)
    except InputError as error:
        problems.append(str(error))


def _attempt_each(
    problems: list[str], function: Callable, items: Collection, description: str
) -> None:
    """Call a function for every item in threads; reading and decoding release Python's lock."""
    with ThreadPoolExecutor() as threads:
        done = threads.map(partial(_attempt, problems, function), items)
        list(files.progress(done, description, total=len(items), unit="file"))


def check_kitti(root: Path) -> tuple[list[str], list[str]]:
    """Check all sequences below an odometry root, and decode every frame.

    Returns (lines that describe the sequences, problems). Of each sequence, this names the first
    problem with its names, calibration, times and poses, or else all frames that are damaged.
    """
    facts: list[str] = []
    problems: list[str] = []
    with_truth = _attempt(problems, kitti.sequences, root) or []
    for name in kitti.with_frames(root):
        sequence = _attempt(problems, kitti.Sequence, root, name)
        if _attempt(problems, getattr, sequence, "size", None):
            height, width = sequence.size
            facts.append(
                f"sequence {name}: {len(sequence)} frames of {width}x{height}; with ground truth: "
                f"{sequence.has_truth}; with times: {sequence.has_times}"
            )
            facts += of_sequence(sequence)
            if name in with_truth:
                _attempt(problems, getattr, sequence, "poses")
            _attempt_each(problems, sequence.frame, range(len(sequence)), f"sequence {name}")
    return facts, sorted(problems)


def check_cityscapes(
    root: Path, splits: Iterable[str] = ("train", "val")
) -> tuple[list[str], list[str]]:
    """Check the training and validation split, and decode every image and label map.

    Returns (lines that describe the splits, problems).
    """
    facts: list[str] = []
    problems: list[str] = []

    def check_pair(pair: cityscapes.Pair) -> None:
        size = files.read_gray(pair.image).shape
        kitti.check_size(pair.label, cityscapes.read_label_map(pair.label).shape, size, "its image")

    for split in splits:
        pairs = _attempt(problems, cityscapes.pairs, root, split) or []
        facts.append(f"split {split}: {len(pairs)} images with label maps")
        _attempt_each(problems, check_pair, pairs, f"split {split}")
    return facts, sorted(problems)


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
            facts, problems_of_root = check(root)
            print("\n  ".join(map(one_line, [root, *facts])))
            problems += problems_of_root
    for problem in problems:
        print(f"wrong: {one_line(problem)}", file=sys.stderr)
    return not problems


def main(path: Path) -> int:
    """Check the data that the environment's settings name, unless it was checked before.

    path: file with the digest of the files that were checked; it is written after a check without
    problems. Returns the exit code. Raises InputError if a file is missing.
    """
    settings = read_settings()
    roots = [settings.kitti, settings.cityscapes, settings.kitti_semantic]
    if settings.kitti_is_embedded:
        roots[0] = None
    if settings.cityscapes_is_embedded:
        roots[1] = None
    digest = results.digest_of_files(_used_files(roots, settings.sizes.frames))
    if path.is_file() and path.read_text(encoding="utf-8") == digest:
        return 0
    if not report(*roots):
        return 1
    files.write_text(path, digest)
    return 0


def _used_files(roots: list[Path | None], frames: int | None) -> Iterator[Path]:
    """Yield the user's files that a run reads. Raises InputError for the first problem.

    roots: folders of KITTI, Cityscapes and KITTI's street scenes; None for no such folder.
    """
    if roots[0]:
        for name in kitti.sequences(roots[0]):
            yield from kitti.Sequence(roots[0], name).subset(frames).files
    for root, split in ((roots[1], "train"), (roots[1], "val"), (roots[2], "train")):
        if root:
            for pair in cityscapes.pairs(root, split):
                yield from pair[1:]


# Warnings, one line each: "place: what is wrong"


def of_sequence(sequence: kitti.Sequence) -> list[str]:
    """Warn of a camera whose principal point is far from the middle of the frames."""
    height, width = sequence.size
    u, v = sequence.intrinsics[:2, 2]
    across, down = MAX_CENTRE_OFFSET
    if abs(u / width - 0.5) <= across and abs(v / height - 0.5) <= down:
        return []
    return [
        f"sequence {sequence.name}: {sequence.calibration_path.name} has the centre {u:g}, {v:g}, far "
        f"from the middle of frames of {width}x{height} pixels; it must belong to frames of this size"
    ]


def of_run(
    name: str, frames: int, failed: int, dropped: int = 0, scale_gate: float = 0.1
) -> list[str]:
    """Warn if many steps of a run failed or were dropped.

    name: of the sequence. frames, failed, dropped: numbers of frames, of steps with a flag, and of
    steps that were no longer than the scale gate (metres), so that their motion was left out.
    """
    warnings = []
    if failed > frames / 2:
        warnings.append(
            f"sequence {name}: {failed} of {frames} frames have a flag; do frames, calibration and "
            "poses fit together?"
        )
    if dropped >= MAX_DROPPED * frames:
        warnings.append(
            f"sequence {name}: {dropped} of {frames} steps are no longer than the scale gate of "
            f"{scale_gate:g} m, so their motion and rotation were left out; --scale-gate 0 takes all"
        )
    return warnings


def of_masks(source: LabelMasks | MaskFolder, sequence: kitti.Sequence) -> list[str]:
    """Warn of what is certainly wrong with the masks of a sequence, seen on MASK_SAMPLES of them.

    Raises InputError if one of them cannot be read.
    """
    folder, shares = source.paths[0].parent, _shares_kept(source)
    if isinstance(source, LabelMasks) and source.settings.ids == "labels":
        ids = np.flatnonzero(_class_shares(source))
        if ids.max() < len(cityscapes.TRAINED):
            return [
                f"{folder}: label maps hold no id above {ids.max()}, so no sky, vegetation or cars; "
                "--ids train reads train ids"
            ]
        if ids.max() == cityscapes.ID["license plate"]:
            return [
                f"{folder}: label maps hold id {ids.max()}, a license plate, but a garage in KITTI-360; "
                "--ids FILE gives ids the names that are meant"
            ]
    if min(shares) < MIN_SHARE or min(shares) == 1:
        return [
            f"{folder}: masks keep {min(shares):.1%} to {max(shares):.1%} of the frames; --invert "
            "inverts ready-made masks"
        ]
    made_from = (results.record(folder) or {}).get("frames")
    frames = kitti.frames_in(sequence.frame_paths[0].parent)
    # a study may use only the first frames
    used = sequence.frame_paths, frames, frames[: len(files.listed(folder))]
    if made_from and made_from not in map(results.digest_of_files, used):
        return [f"{folder}: was made from other frames"]
    return []


def describe_masks(source: LabelMasks | MaskFolder, sequence: kitti.Sequence) -> str:
    """Return one line that says what masks of a sequence keep, and what label maps hold."""
    share = np.mean(_shares_kept(source))
    line = f"{source.paths[0].parent}: masks keep {share:.1%} of {sequence.name}"
    if isinstance(source, LabelMasks):
        shares = zip(cityscapes.LABELS, _class_shares(source), strict=False)
        held = [f"{label.name} {share:.0%}" for label, share in shares if share >= MIN_SHARE]
        line += f" (width {source.dilation_width}); label maps hold {', '.join(held)}"
    return line


def _shares_kept(source: LabelMasks | MaskFolder) -> list[float]:
    """Return the share of the frame that each sampled mask keeps."""
    return [coverage(source[index]) for index in _sampled(source)]


def _sampled(source: LabelMasks | MaskFolder) -> list[int]:
    """Return the numbers of about MASK_SAMPLES frames, spread evenly over a sequence."""
    return np.unique(np.linspace(0, len(source) - 1, MASK_SAMPLES).astype(int)).tolist()


def _class_shares(source: LabelMasks) -> np.ndarray:
    """Return the share of each label id, (N_CLASSES,), in the sampled label maps."""
    label_maps = [label_map_of(source, index).ravel() for index in _sampled(source)]
    counts = np.bincount(np.concatenate(label_maps), minlength=cityscapes.N_CLASSES)
    return counts / counts.sum()


if __name__ == "__main__":
    messages.run_main(lambda: main(Path(sys.argv[1])))
