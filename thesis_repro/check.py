"""What is there, missing or wrong in the user's KITTI and Cityscapes folders, and what can be run with it.

The readers say what is wrong with a file; here all that they say about a folder is collected.
"""

from pathlib import Path

import joblib
import numpy as np

from thesis_repro import InputError, cityscapes, files, kitti

MAX_NAMED = 10  # problems of one kind that a quick look names; a deep one names all


class _Problems(list):
    """Lines that say what is wrong."""

    def of(self, function, *arguments):
        """What a function returns; None where it raises InputError, which is entered."""
        try:
            return function(*arguments)
        except InputError as error:
            self.append(str(error))
            return None

    def of_each(self, function, items, description, deep):
        """The same for every item, in threads, for reading and decoding release the interpreter."""
        def problems_of(item):
            problems = _Problems()
            problems.of(function, item)
            return problems

        results = joblib.Parallel(n_jobs=-1, prefer="threads", return_as="generator")(
            joblib.delayed(problems_of)(item) for item in items)
        self.add(sum(files.progress(results, description, total=len(items), unit="file"), []), deep)

    def add(self, problems, deep):
        self += problems if deep else problems[:MAX_NAMED]
        if not deep and len(problems) > MAX_NAMED:
            self.append(f"and {len(problems) - MAX_NAMED} more like these; check-data --deep names all")


def check_kitti(root, deep=False):
    """Check every sequence below an odometry root; returns (lines that describe, problems).

    Names, numbers, both ends of every file, calibration, times and poses are looked at, and the first and last frame
    decoded; deep: all frames are, on all cores.
    """
    facts, problems, sound = [], _Problems(), []
    without_truth = kitti.without_truth(root)
    with_truth = problems.of(kitti.sequences, root) or []
    for name in sorted(with_truth + without_truth):
        fact, its_problems = _check_sequence(root, name, name in with_truth, deep)
        facts.append(fact)
        problems += its_problems
        sound += [] if its_problems else [name]
    for commands, names in (("odometry, predict and masks", sound),
                            ("evaluate, boresight, study and plan", [name for name in sound if name in with_truth])):
        facts.append(f"can be run: {commands} with {', '.join(names)}" if names else f"cannot be run: {commands}")
    facts.append(f"{'cannot' if problems else 'can'} be run: make figures KITTI={root}")
    return facts, problems


def _check_sequence(root, name, needs_truth, deep):
    """(what a sequence holds in one line, its problems)"""
    folder, problems = Path(root) / "sequences" / name, _Problems()
    where = kitti.images_of(folder)
    paths = problems.of(files.images, where)
    if not paths:
        return f"sequence {name}: no frames", problems or [f"{where}: holds no PNG or JPEG frames"]
    matrix = problems.of(kitti.read_intrinsics, folder / "calib.txt", where.name)
    poses, times, rows = Path(root) / "poses" / f"{name}.txt", folder / "times.txt", {}
    if needs_truth:
        rows[poses] = problems.of(kitti.read_poses, poses)
    if times.is_file():
        rows[times] = problems.of(kitti.read_times, times)
    counts = {path: len(values) for path, values in rows.items() if values is not None}
    missing = kitti.missing_frames(paths, max([count for count in counts.values() if count > len(paths)], default=None))
    problems.add([f"{path}: is missing" for path in missing], deep)
    if not missing:
        problems.of(kitti.check_numbering, paths)
        for path, count in counts.items():
            problems.of(kitti.check_count, path, count, paths)
    size, _ = problems.of(files.glance, paths[0]) or (None, None)
    if size and matrix is not None:
        problems.of(kitti.check_camera, folder / "calib.txt", matrix, paths[0], size)
        camera = kitti.CAMERAS.get(name)
        if camera and size == (camera.height, camera.width) and not np.allclose(
                matrix[[0, 1, 0, 1], [0, 1, 2, 2]], [camera.fx, camera.fy, camera.cx, camera.cy], rtol=0, atol=1e-3):
            problems.append(f"{folder / 'calib.txt'}: is not the camera of sequence {name}")

    def check_frame(path):
        its_size = files.read_gray(path).shape if deep or path in (paths[0], paths[-1]) else files.glance(path)[0]
        kitti.check_size(path, its_size, size)

    problems.of_each(check_frame, paths if size else paths[1:], f"sequence {name}", deep)
    complete = kitti.FRAME_COUNTS.get(name, len(paths))
    notes = {f"{len(paths)} of {len(paths) + len(missing)} frames": bool(missing),
             f"{len(paths)} frames{f' of {size[1]}x{size[0]}' if size else ''}": not missing,
             f"in {where.name}": where.name != kitti.IMAGE_FOLDERS[0],
             f"an excerpt of {complete}": complete != len(paths),
             "no true poses, so steps are those of --speed or 1 m": not needs_truth,
             f"no times.txt, so {1 / kitti.FRAME_TIME:g} frames a second": not times.is_file()}
    return f"sequence {name}: {'; '.join(note for note, holds in notes.items() if holds)}", problems


def check_cityscapes(root, deep=False, splits=("train", "val"), used="make figures CITYSCAPES"):
    """Check the training and validation split; returns (lines that describe, problems).

    Names and both ends of every file are looked at, and the first and last pair decoded; deep: all pairs are.
    """
    facts, problems = [], _Problems()
    for split in splits:
        listing = problems.of(cityscapes.listing, root, split)
        if listing is None:
            continue
        images, labels, where = listing
        problems.add([f"{(images | labels)[name]}: has no {'label map' if name in images else 'image'}"
                      for name in sorted(images.keys() ^ labels.keys())], deep)
        pairs = [cityscapes.Pair(name, images[name], labels[name]) for name in sorted(images.keys() & labels.keys())]
        if not pairs:
            problems.append(f"{where}: no PNG images with label maps")
            continue
        ids, ends = set(), (pairs[0], pairs[-1])

        def check_pair(pair, ids=ids, ends=ends):
            if deep or pair in ends:
                size, label_map = files.read_gray(pair.image).shape, cityscapes.read_label_map(pair.label)
                label_size = label_map.shape
                ids.update(np.unique(label_map).tolist())
            else:
                size, label_size = files.glance(pair.image)[0], files.glance(pair.label)[0]
            if size != label_size:
                raise InputError(f"{pair.label}: {label_size[1]}x{label_size[0]} pixels; its image has "
                                 f"{size[1]}x{size[0]}")

        problems.of_each(check_pair, pairs, f"split {split}", deep)
        names = ", ".join(f"{label.name} {label.id}" for label in cityscapes.LABELS if label.id in ids)
        facts.append(f"split {split}: {len(pairs)} images with label maps; "
                     f"{'labels' if deep else 'labels in the first and last'}: {names}")
    facts.append(f"{'cannot' if problems else 'can'} be run: {used}={root}")
    return facts, list(dict.fromkeys(problems))


def check_kitti_semantic(root, deep=False):
    """Check KITTI's street scenes with label maps, which have a training split alone."""
    return check_cityscapes(root, deep, ("train",), "make figures KITTI_SEMANTIC")
