"""Check the user's KITTI and Cityscapes folders.

The report names missing, wrong and odd files, and the commands that can be run.
"""

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import joblib
import numpy as np

from thesis_repro.checks import oddities
from thesis_repro.data import cityscapes, kitti
from thesis_repro.errors import InputError, one_line
from thesis_repro.running import files, messages, results
from thesis_repro.running.settings import Settings, read_settings


class _Problems(list):
    """A list of problems, one line each."""

    def call(self, function: Callable, *arguments: Any) -> Any:
        """Return the result of a function, or None if it raises InputError.

        The message of the error becomes a problem of the list.
        """
        try:
            return function(*arguments)
        except InputError as error:
            self.append(str(error))
            return None

    def call_for_each(self, function: Callable, items: list, description: str) -> None:
        """Call a function for every item in threads; reading and decoding release Python's lock."""
        calls = (joblib.delayed(self.call)(function, item) for item in items)
        done = joblib.Parallel(n_jobs=-1, prefer="threads", return_as="generator")(calls)
        for _ in files.progress(done, description, total=len(items), unit="file"):
            pass


def check_kitti(root: Path, deep: bool = False) -> tuple[list[str], list[str]]:
    """Check all sequences below an odometry root.

    Returns (lines that describe the sequences, problems). Checks file names and numbers,
    calibration, times and poses, and the start and end of every frame's file. Decodes the first and
    the last frame. deep: decodes all frames, on all cores.
    """
    facts, problems = [], _Problems()
    with_truth = problems.call(kitti.sequences, root) or []
    usable, evaluable = [], []
    for name in kitti.with_frames(root):
        has_truth = name in with_truth
        fact, sequence_problems = _check_sequence(root, name, has_truth, deep)
        facts.append(fact)
        problems += sequence_problems
        if not sequence_problems:
            usable.append(name)
            if has_truth:
                evaluable.append(name)
    facts.append(_runnable("odometry, predict and masks", usable))
    facts.append(_runnable("evaluate and study", evaluable))
    return facts, sorted(problems)


def _runnable(commands: str, names: list[str]) -> str:
    """Return a line that says with which sequences commands can be run."""
    if not names:
        return f"cannot be run: {commands}"
    return f"can be run: {commands} with {', '.join(names)}"


def _check_sequence(root: Path, name: str, needs_truth: bool, deep: bool) -> tuple[str, list[str]]:
    """Check one sequence. Returns (one line that describes it, problems).

    Unlike kitti.Sequence, this lists all problems, not only the first.
    """
    _, folder, poses = kitti.locate(root, name)
    problems = _Problems()
    frame_folder = problems.call(kitti.images_of, folder)
    paths = None
    if frame_folder is not None:
        paths = problems.call(files.images, frame_folder)
    if not paths:
        no_frames = [f"{frame_folder}: holds no PNG or JPEG frames"]
        return f"sequence {name}: no frames", problems or no_frames
    calibration, times = kitti.texts_of(folder, frame_folder)
    camera = kitti.camera_of(frame_folder)
    matrix = problems.call(kitti.read_intrinsics, calibration, camera)
    rows: dict[Path, Any] = {}  # one a frame
    if needs_truth:
        rows[poses] = problems.call(kitti.truth_of, poses)
    has_times = os.path.lexists(times)
    if has_times:
        rows[times] = problems.call(kitti.times_of, times)
    counts = {path: len(values) for path, values in rows.items() if values is not None}
    missing = _missing_frames(paths, counts, problems)
    size = problems.call(files.glance, paths[0])
    if size and matrix is not None:
        problems.call(kitti.check_camera, calibration, matrix, paths[0], size)
    _check_frames(name, paths, size, deep, problems)
    notes = [_frame_count(len(paths), len(missing), size)]
    if camera != kitti.IMAGE_FOLDERS[0]:
        notes.append(f"in {camera}")
    complete = kitti.FRAME_COUNTS.get(name, len(paths))
    if complete != len(paths):
        notes.append(f"an excerpt of {complete}")
    if not needs_truth:
        notes.append("no ground truth, so step lengths follow from --speed, or are 1 m")
    if not has_times:
        notes.append(f"no {times.name}, so {1 / kitti.FRAME_TIME:g} frames a second")
    return f"sequence {name}: {'; '.join(notes)}", problems


def _frame_count(present: int, missing: int, size: tuple[int, int] | None) -> str:
    if missing:
        return f"{present} of {present + missing} frames"
    if size is None:
        return f"{present} frames"
    return f"{present} frames of {size[1]}x{size[0]}"


def _missing_frames(paths: list[Path], counts: dict[Path, int], problems: _Problems) -> list[Path]:
    """Return the frames that are missing in a sequence, and check its numbers.

    counts: lines of the files that have one line a frame.
    """
    higher_counts = [count for count in counts.values() if count > len(paths)]
    missing = kitti.missing_frames(paths, max(higher_counts, default=None))
    if missing:
        problems += [f"{path}: is missing" for path in missing]
        return missing
    problems.call(kitti.check_numbering, paths)
    for path, count in counts.items():
        problems.call(kitti.check_count, path, count, paths)
    return []


def _check_frames(
    name: str, paths: list[Path], size: tuple[int, int] | None, deep: bool, problems: _Problems
) -> None:
    """Check the file of each frame.

    size: (height, width) of the first one, or None if it cannot be read.
    """
    ends = paths[0], paths[-1]

    def check_frame(path: Path) -> None:
        decode = deep or path in ends
        frame_size = files.read_gray(path).shape if decode else files.glance(path)
        if size is not None:
            kitti.check_size(path, frame_size, size)

    if size is None:
        paths = paths[1:]  # its problem is known
    problems.call_for_each(check_frame, paths, f"sequence {name}")


def check_cityscapes(
    root: Path, deep: bool = False, splits: tuple[str, ...] = ("train", "val")
) -> tuple[list[str], list[str]]:
    """Check the training and validation split.

    Returns (lines that describe the splits, problems). Checks file names, and the start and end of
    every file. Decodes the first and the last pair. deep: decodes all.
    """
    facts, problems = [], _Problems()
    decoded = "labels in the first and last"
    if deep:
        decoded = "labels"
    for split in splits:
        pairs = problems.call(cityscapes.listing, root, split)
        if pairs is None:
            continue
        ids: set[int] = set()
        ends = pairs[0], pairs[-1]

        def check_pair(pair: cityscapes.Pair, ids: set = ids, ends: tuple = ends) -> None:
            cityscapes.check_complete(pair)
            if deep or pair in ends:
                size = files.read_gray(pair.image).shape
                label_map = cityscapes.read_label_map(pair.label)
                label_size = label_map.shape
                ids.update(np.unique(label_map).tolist())
            else:
                size = files.glance(pair.image)
                label_size = files.glance(pair.label)
            kitti.check_size(pair.label, label_size, size, "its image")

        problems.call_for_each(check_pair, pairs, f"split {split}")
        names = ", ".join(
            f"{label.name} {label.id}" for label in cityscapes.LABELS if label.id in ids
        )
        complete = sum(None not in pair for pair in pairs)
        facts.append(f"split {split}: {complete} images with label maps; {decoded}: {names}")
    return facts, sorted(problems)


def report(
    kitti_root: Path | None = None,
    cityscapes_root: Path | None = None,
    kitti_semantic: Path | None = None,
    deep: bool = False,
) -> bool:
    """Print the content of the folders, problems and warnings.

    Returns True if there are no problems.
    """
    has_problems = False
    # KITTI's street scenes have one split
    check_semantic = partial(check_cityscapes, splits=("train",))
    for option, root, check in (
        ("KITTI", kitti_root, check_kitti),
        ("CITYSCAPES", cityscapes_root, check_cityscapes),
        ("KITTI_SEMANTIC", kitti_semantic, check_semantic),
    ):
        if not root:
            continue
        facts, problems = check(root, deep)
        can = "cannot" if problems else "can"
        facts.append(f"{can} be run: make figures {option}={root}")
        print("\n  ".join(map(one_line, [root, *facts])))
        for problem in problems:
            print(f"wrong: {one_line(problem)}", file=sys.stderr)
        has_problems = has_problems or bool(problems)
    if has_problems:
        return False
    for name in kitti.with_frames(kitti_root) if kitti_root else ():
        for warning in oddities.of_sequence(kitti.Sequence(kitti_root, name)):
            print(f"warning: {one_line(warning)}", file=sys.stderr)
    return True


def main(path: Path) -> int:
    """Check the data that the environment's settings name, unless it was checked before.

    path: file with the digest of the files that were checked; it is written after a check without
    problems. Returns the exit code.
    """
    settings = read_settings()
    kitti_root = None if settings.kitti_is_embedded else settings.kitti
    cityscapes_root = None if settings.cityscapes_is_embedded else settings.cityscapes
    digest = ""
    with suppress(InputError):  # `report` below names all problems
        digest = results.digest_of_files(_used_files(kitti_root, cityscapes_root, settings))
    if digest and path.is_file() and path.read_text(encoding="utf-8") == digest:
        return 0
    if not report(kitti_root, cityscapes_root, settings.kitti_semantic):
        return 1
    files.write_text(path, digest)
    return 0


def _used_files(
    kitti_root: Path | None, cityscapes_root: Path | None, settings: Settings
) -> list[Path]:
    """Return the user's files that a run reads. Raises InputError for the first problem."""
    used_files: list[Path] = []
    if kitti_root:
        for name in kitti.sequences(kitti_root):
            used_files += kitti.Sequence(kitti_root, name).subset(settings.sizes.frames).files
    for root, split in (
        (cityscapes_root, "train"),
        (cityscapes_root, "val"),
        (settings.kitti_semantic, "train"),
    ):
        if root:
            for pair in cityscapes.pairs(root, split):
                used_files += pair[1:]
    return used_files


if __name__ == "__main__":
    messages.run_main(lambda: sys.exit(main(Path(sys.argv[1]))))
