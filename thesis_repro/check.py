"""What is there, missing or wrong in the user's KITTI and Cityscapes folders, and what can be run with it."""

from itertools import pairwise
from pathlib import Path

import joblib
import numpy as np

from thesis_repro import InputError, cityscapes, files, kitti

NAMED = 10  # files with the same fault that a quick look names; a deep one names all


def check_kitti(root, deep=False):
    """Check every sequence below an odometry root; returns (lines that describe, problems).

    Names, numbers, both ends of every file, calibration, times and poses are looked at, and the first and last frame
    decoded; deep: all frames are, on all cores.
    """
    facts, problems, sound = [], [], []
    names = without_truth = kitti.without_truth(root)
    try:
        with_truth = kitti.sequences(root)
        names = sorted(with_truth + without_truth)
    except InputError as error:  # there is nothing to compare with, but what there is can be looked at
        with_truth = []
        problems.append(str(error))
    for name in names:
        fact, wrong = _check_sequence(root, name, name not in without_truth, deep)
        facts.append(fact)
        problems += wrong
        if not wrong:
            sound.append(name)
    compared = [name for name in sound if name in with_truth]
    facts.append(_can("odometry, predict and masks", sound))
    facts.append(_can("evaluate, boresight, study and plan", compared)
                 + (f"; make figures KITTI={root}" if with_truth and compared == with_truth else
                    "; make figures needs all sequences without fault, so mend or move away the others"))
    return facts, problems


def _can(commands, names):
    return f"can be run: {commands} with {', '.join(names)}" if names else f"cannot be run: {commands}"


def _check_sequence(root, name, needs_truth, deep):
    """(what a sequence holds in one line, its problems)"""
    folder, problems, notes = Path(root) / "sequences" / name, [], []
    try:
        where = kitti.images_of(folder)
        paths = files.images(where)
    except InputError as error:
        return f"sequence {name}: cannot be read", [str(error)]
    if not paths:
        return f"sequence {name}: no frames", [f"{where}: holds no PNG or JPEG frames; copy them there"]

    def tried(function, *arguments):
        try:
            return function(*arguments)
        except InputError as error:
            problems.append(str(error))
            return None

    matrix = tried(kitti.read_intrinsics, folder / "calib.txt", where.name)
    counts = {}
    poses, times = Path(root) / "poses" / f"{name}.txt", folder / "times.txt"
    if needs_truth:
        counts[poses] = _length(tried(kitti.read_poses, poses))
    else:
        notes.append("no true poses, so the study passes it over and the odometry takes steps of --speed or 1 m")
    if times.is_file():
        counts[times] = _length(tried(kitti.read_times, times))
    else:
        notes.append(f"no times.txt, so {1 / kitti.FRAME_TIME:g} frames a second")
    lines = max((count for count in counts.values() if count), default=0)
    missing = kitti.missing_frames(paths, lines if lines > len(paths) else None)
    if missing:
        problems.append(f"{where}: {_ranges(missing)} missing ({len(missing)} in all), copy them again")
    else:
        for path in counts:
            if counts[path]:
                tried(kitti.check_count, path, counts[path], paths)
        tried(kitti.check_numbering, paths)
    looked, size = _look(paths, deep, f"sequence {name}", None if matrix is None else
                         lambda size: kitti.check_camera(folder / "calib.txt", matrix, paths[0], size))
    problems += looked
    if where.name in kitti.IMAGE_FOLDERS[1:]:
        notes.append(f"the frames of {where.name}, read as gray")
    elif any(files.glance(path)[1] for path in {paths[0], paths[-1]} if size):
        notes.append("frames in colour, read as gray")
    expected = kitti.FRAME_COUNTS.get(name)
    if expected and len(paths) != expected:
        notes.append(f"an excerpt: the complete sequence has {expected}")
    camera = kitti.CAMERAS.get(name)
    if camera and size == (camera.height, camera.width) and matrix is not None:
        difference = np.abs(np.array([matrix[0, 0] - camera.fx, matrix[1, 1] - camera.fy,
                                      matrix[0, 2] - camera.cx, matrix[1, 2] - camera.cy])).max()
        if difference > 1e-3:
            problems.append(f"{folder / 'calib.txt'}: the camera differs from the thesis's by {difference:.4g} pixels; "
                            f"it must be the file of sequence {name}")
        else:
            notes.append("the thesis's camera")
    elif camera and size:
        notes.append(f"not the thesis's size of {camera.width}x{camera.height}")
    of = f" of {len(paths) + len(missing)}" if missing else ""
    pixels = f" of {size[1]}x{size[0]}" if size else ""
    return (f"sequence {name}: {len(paths)}{of} frames{pixels}{', all decoded' * deep}"
            + "".join(f"; {note}" for note in notes), problems)


def _length(rows):
    return None if rows is None else len(rows)


def _ranges(missing):
    """The names of missing frames, neighbours as a range."""
    numbers = files.numbers_of(missing)
    breaks = [index for index, (before, after) in enumerate(pairwise(numbers), 1) if after != before + 1]
    runs = [missing[start:end] for start, end in zip([0, *breaks], [*breaks, len(missing)])]
    named = [run[0].name if len(run) == 1 else f"{run[0].name} to {run[-1].name}" for run in runs]
    return f"{', '.join(named)} {'is' if len(missing) == 1 else 'are'}"


def _look(paths, deep, description, check_size):
    """(problems, (height, width)) of frames, which must all have the size of the first; None where that is unreadable.

    check_size: what may raise an InputError about the size, or None.
    """
    try:
        size = files.glance(paths[0])[0]
        if check_size:
            check_size(size)
        problems = []
    except InputError as error:
        size, problems = None, [str(error)]

    def check(path):
        found = files.read_gray(path).shape if deep or path in ends else files.glance(path)[0]
        if size and found != size:
            raise InputError(f"{path}: {found[1]}x{found[0]} pixels, but the first frame of the sequence has "
                             f"{size[1]}x{size[0]}; all frames must have one size")

    ends = {paths[0], paths[-1]}
    found = _failures(check, paths, description, deep)
    return [*problems, *(problem for problem in found if problem not in problems)], size


def check_cityscapes(root, deep=False, splits=("train", "val"), used="make figures CITYSCAPES"):
    """Check the training and validation split; returns (lines that describe, problems).

    Names and both ends of every file are looked at, and the first and last pair decoded; deep: all pairs are.
    """
    facts, problems = [], []
    for split in splits:
        try:
            images, labels, where = cityscapes.listing(root, split)
        except InputError as error:
            problems.append(str(error))
            if not any((Path(root) / name).is_dir() for name in ("leftImg8bit", *splits)):
                break  # the others would be missing for the same reason
            continue
        alone = sorted(images.keys() ^ labels.keys())
        lonely = [f"{images[name]}: has no label map" if name in images else f"{labels[name]}: has no image"
                  for name in alone]
        problems += _few([f"{text}; add it or remove the file" for text in lonely], deep)
        found = [cityscapes.Pair(name, images[name], labels[name]) for name in sorted(images.keys() & labels.keys())]
        if not found:
            problems.append(f"{where}: no PNG images with label maps; the {split} split must hold at least one")
            continue
        ids, ends = set(), (found[0], found[-1])

        def check(pair, ids=ids, ends=ends):
            ids.update(_check_pair(pair, deep or pair in ends))

        problems += _failures(check, found, f"split {split}", deep)
        names = ", ".join(f"{label.name} {label.id}" for label in cityscapes.LABELS if label.id in ids)
        expected = cityscapes.OFFICIAL.get(split) if (Path(root) / "leftImg8bit").is_dir() else None
        facts.append(f"split {split}: {len(found)} images with label maps"
                     + (f"; an excerpt: the complete split has {expected}" if len(found) < (expected or 0) else "")
                     + f"; {'labels' if deep else 'labels in the first and last'}: {names}")
    facts.append(f"{'cannot' if problems else 'can'} be run: {used}={root}")
    return facts, problems


def _check_pair(pair, decode):
    """The ids of a pair's label map, none where it is not decoded. Raises InputError for what is wrong."""
    if decode:
        size, label_map = files.read_gray(pair.image).shape, cityscapes.read_label_map(pair.label)
        found = label_map.shape
    else:
        size, found, label_map = files.glance(pair.image)[0], files.glance(pair.label)[0], ()
    if size != found:
        raise InputError(f"{pair.label}: {found[1]}x{found[0]} pixels, but {pair.image.name} has {size[1]}x{size[0]}; "
                         "a label map must have the size of its image")
    return np.unique(label_map).tolist()


def check_kitti_semantic(root, deep=False):
    """Check KITTI's street scenes with label maps, which have a training split alone."""
    return check_cityscapes(root, deep, ("train",), "make figures KITTI_SEMANTIC")


def _failures(check, items, description, deep):
    def problem(item):
        try:
            check(item)
        except InputError as error:
            return str(error)
        return None

    # decoding and reading release the interpreter, so threads are enough
    results = joblib.Parallel(n_jobs=-1, prefer="threads", return_as="generator")(
        joblib.delayed(problem)(item) for item in items)
    bar = files.progress(results, description, total=len(items), unit="file")
    return _few([result for result in bar if result], deep)


def _few(problems, deep):
    if deep or len(problems) <= NAMED:
        return problems
    return [*problems[:NAMED], f"and {len(problems) - NAMED} more like these; check-data --deep names all"]
