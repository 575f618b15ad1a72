"""Check the user's KITTI and Cityscapes folders: report missing, wrong and odd files, and which
commands can be run.
"""

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
from thesis_repro.running import console, files, results
from thesis_repro.running.settings import read_settings


class _Problems(list):
    """A list of problems, one line each."""

    def call(self, function: Callable, *arguments: Any) -> Any:
        """Return the result of a function. If it raises InputError, add the message to the list
        and return None.
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
    """Check all sequences below an odometry root. Returns (lines that describe the sequences,
    problems).

    Checks file names and numbers, calibration, times and poses, and the start and end of every
    frame's file. Decodes the first and the last frame. deep: decodes all frames, on all cores.
    """
    facts, problems, usable = [], _Problems(), []
    with_truth = problems.call(kitti.sequences, root) or []
    for name in kitti.with_frames(root):
        fact, sequence_problems = _check_sequence(root, name, name in with_truth, deep)
        facts.append(fact)
        problems += sequence_problems
        usable += [] if sequence_problems else [name]
    for commands, names in (
        ("odometry, predict and masks", usable),
        ("evaluate and study", [name for name in usable if name in with_truth]),
    ):
        facts.append(
            f"can be run: {commands} with {', '.join(names)}"
            if names
            else f"cannot be run: {commands}"
        )
    return facts, sorted(problems)


def _check_sequence(root: Path, name: str, needs_truth: bool, deep: bool) -> tuple[str, list[str]]:
    """Check one sequence. Returns (one line that describes it, problems).

    Unlike kitti.Sequence, this lists all problems, not only the first.
    """
    folder, poses, problems = *kitti.locate(root, name)[1:], _Problems()
    frame_folder = kitti.images_of(folder)
    paths = problems.call(files.images, frame_folder)
    if not paths:
        return f"sequence {name}: no frames", problems or [
            f"{frame_folder}: holds no PNG or JPEG frames"
        ]
    (calibration, times), rows = kitti.texts_of(folder, frame_folder), {}
    camera = kitti.camera_of(frame_folder)
    matrix = problems.call(kitti.read_intrinsics, calibration, camera)
    if needs_truth:
        rows[poses] = problems.call(kitti.truth_of, poses)
    if times.is_file():
        rows[times] = problems.call(kitti.times_of, times)
    counts = {path: len(values) for path, values in rows.items() if values is not None}
    missing = kitti.missing_frames(
        paths, max([count for count in counts.values() if count > len(paths)], default=None)
    )
    problems += [f"{path}: is missing" for path in missing]
    if not missing:
        problems.call(kitti.check_numbering, paths)
        for path, count in counts.items():
            problems.call(kitti.check_count, path, count, paths)
    size = problems.call(files.glance, paths[0])
    if size and matrix is not None:
        problems.call(kitti.check_camera, calibration, matrix, paths[0], size)

    def check_frame(path: Path) -> None:
        decode = deep or path in (paths[0], paths[-1])
        kitti.check_size(path, files.read_gray(path).shape if decode else files.glance(path), size)

    problems.call_for_each(check_frame, paths if size else paths[1:], f"sequence {name}")
    complete = kitti.FRAME_COUNTS.get(name, len(paths))
    notes = {
        f"{len(paths)} of {len(paths) + len(missing)} frames": bool(missing),
        f"{len(paths)} frames{f' of {size[1]}x{size[0]}' if size else ''}": not missing,
        f"in {camera}": camera != kitti.IMAGE_FOLDERS[0],
        f"an excerpt of {complete}": complete != len(paths),
        "no ground truth, so step lengths follow from --speed, or are 1 m": not needs_truth,
        f"no {times.name}, so {1 / kitti.FRAME_TIME:g} frames a second": not times.is_file(),
    }
    return f"sequence {name}: {'; '.join(note for note, holds in notes.items() if holds)}", problems


def check_cityscapes(
    root: Path, deep: bool = False, splits: tuple[str, ...] = ("train", "val")
) -> tuple[list[str], list[str]]:
    """Check the training and validation split. Returns (lines that describe the splits, problems).

    Checks file names, and the start and end of every file. Decodes the first and the last pair.
    deep: decodes all.
    """
    facts, problems = [], _Problems()
    for split in splits:
        pairs = problems.call(cityscapes.listing, root, split)
        if pairs is None:
            continue
        ids: set[int] = set()
        ends = pairs[0], pairs[-1]

        def check_pair(pair: cityscapes.Pair, ids: set = ids, ends: tuple = ends) -> None:
            cityscapes.check_complete(pair)
            if deep or pair in ends:
                size, label_map = (
                    files.read_gray(pair.image).shape,
                    cityscapes.read_label_map(pair.label),
                )
                label_size = label_map.shape
                ids.update(np.unique(label_map).tolist())
            else:
                size, label_size = files.glance(pair.image), files.glance(pair.label)
            kitti.check_size(pair.label, label_size, size, "its image")

        problems.call_for_each(check_pair, pairs, f"split {split}")
        names = ", ".join(
            f"{label.name} {label.id}" for label in cityscapes.LABELS if label.id in ids
        )
        facts.append(
            f"split {split}: {sum(None not in pair for pair in pairs)} images with label maps; "
            f"{'labels' if deep else 'labels in the first and last'}: {names}"
        )
    return facts, sorted(problems)


def report(
    kitti_root: Path | None = None,
    cityscapes_root: Path | None = None,
    kitti_semantic: Path | None = None,
    deep: bool = False,
) -> bool:
    """Print the content of the folders, problems and warnings. Returns True if there are no
    problems.
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
        facts.append(f"{'cannot' if problems else 'can'} be run: make figures {option}={root}")
        print("\n  ".join([str(root), *facts]))
        for problem in problems:
            print(f"wrong: {one_line(problem)}", file=sys.stderr)
        has_problems = has_problems or bool(problems)
    for name in kitti.with_frames(kitti_root) if kitti_root and not has_problems else ():
        for line in oddities.of_sequence(kitti.Sequence(kitti_root, name)):
            print(f"warning: {one_line(line)}", file=sys.stderr)
    return not has_problems


def main(path: Path) -> int:
    """Check the data that the environment's settings name, unless `path` holds the digest of the
    same files.

    Returns the exit code. After a check without problems, the digest is written to `path`.
    """
    settings, used_files, digest = read_settings(), [], None
    kitti_root = None if settings.kitti_is_embedded else settings.kitti
    cityscapes_root = None if settings.cityscapes_is_embedded else settings.cityscapes
    with suppress(InputError):  # `report` below names all problems
        for name in kitti.sequences(kitti_root) if kitti_root else ():
            used_files += kitti.Sequence(kitti_root, name).subset(settings.sizes.frames).files
        for root, split in (
            (cityscapes_root, "train"),
            (cityscapes_root, "val"),
            (settings.kitti_semantic, "train"),
        ):
            used_files += (
                [file for pair in cityscapes.pairs(root, split) for file in pair[1:]]
                if root
                else []
            )
        digest = results.digest_of_files(used_files)
    if digest and path.is_file() and path.read_text(encoding="utf-8") == digest:
        return 0
    if not report(kitti_root, cityscapes_root, settings.kitti_semantic):
        return 1
    files.write_text(path, digest or "")
    return 0


if __name__ == "__main__":
    console.run_main(lambda: sys.exit(main(Path(sys.argv[1]))))
