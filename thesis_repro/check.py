"""What is there, missing or wrong in the user's KITTI and Cityscapes folders."""

import joblib
import numpy as np

from thesis_repro import InputError, cityscapes, kitti
from thesis_repro.files import progress, read_gray


def check_kitti(root):
    """Check every sequence below an odometry root; returns (lines that describe, problems)."""
    facts, problems = [], []
    names = without_truth = kitti.without_truth(root)
    try:
        names = sorted(kitti.sequences(root) + without_truth)
    except InputError as error:  # there is nothing to compare with, but what there is can be looked at
        problems.append(str(error))
    for name in names:
        try:
            sequence = kitti.Sequence(root, name)
            wrong = _wrong_times(sequence) + ([] if name in without_truth else _wrong_poses(sequence))
            height, width = sequence.size
        except InputError as error:
            problems.append(str(error))
            continue
        problems += _failures(sequence.frame, range(len(sequence)), f"sequence {name}") + wrong
        notes = []
        if name in without_truth:
            notes.append("no true poses, so the study passes it over and the odometry takes steps of --speed or 1 m")
        if sequence.frame_paths[0].parent.name in kitti.IMAGE_FOLDERS[1:]:
            notes.append(f"the frames of {sequence.frame_paths[0].parent.name}, read as gray")
        if not sequence.has_times:
            notes.append(f"no times.txt, so {1 / kitti.FRAME_TIME:g} frames a second")
        expected = kitti.FRAME_COUNTS.get(name)
        if expected and len(sequence) != expected:
            notes.append(f"an excerpt: the complete sequence has {expected}")
        camera = kitti.CAMERAS.get(name)
        if camera and (width, height) == (camera.width, camera.height):
            matrix = sequence.intrinsics
            difference = np.abs(np.array([matrix[0, 0] - camera.fx, matrix[1, 1] - camera.fy,
                                          matrix[0, 2] - camera.cx, matrix[1, 2] - camera.cy])).max()
            if difference > 1e-3:
                problems.append(f"{sequence.folder / 'calib.txt'}: the camera differs from the thesis's by "
                                f"{difference:.4g} pixels; it must be the file of sequence {name}")
            else:
                notes.append("the thesis's camera")
        elif camera:
            notes.append(f"not the thesis's size of {camera.width}x{camera.height}")
        facts.append(f"sequence {name}: {len(sequence)} frames of {width}x{height}"
                     + "".join(f"; {note}" for note in notes))
    return facts, problems


def _wrong_poses(sequence):
    rotations = sequence.poses[:, :3, :3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    return [f"{sequence.poses_path}, line {index + 1}: is no rotation (off by {error[index]:.2g}); the file is damaged"
            for index in np.flatnonzero(error > 1e-3)[:1]]


def _wrong_times(sequence):
    return [f"{sequence.folder / 'times.txt'}, line {index + 2}: time does not increase; the file is damaged"
            for index in np.flatnonzero(np.diff(sequence.times) <= 0)[:1]]


def check_cityscapes(root, splits=("train", "val")):
    """Check the training and validation split; returns (lines that describe, problems)."""
    facts, problems = [], []
    for split in splits:
        try:
            found = cityscapes.pairs(root, split)
        except InputError as error:
            problems.append(str(error))
            continue
        ids: set[int] = set()
        problems += _failures(lambda pair, ids=ids: ids.update(_check_pair(pair)), found, f"split {split}")
        names = ", ".join(f"{label.name} {label.id}" for label in cityscapes.LABELS if label.id in ids)
        facts.append(f"split {split}: {len(found)} images with label maps; labels: {names}")
    return facts, problems


def _check_pair(pair):
    image, label_map = read_gray(pair.image), cityscapes.read_label_map(pair.label)
    if image.shape != label_map.shape:
        raise InputError(f"{pair.label}: {label_map.shape[1]}x{label_map.shape[0]} pixels, but {pair.image.name} has "
                         f"{image.shape[1]}x{image.shape[0]}; a label map must have the size of its image")
    return np.unique(label_map)


def check_kitti_semantic(root):
    """Check KITTI's street scenes with label maps, which have a training split alone."""
    return check_cityscapes(root, ("train",))


def _failures(check, items, description):
    def problem(item):
        try:
            check(item)
        except InputError as error:
            return str(error)
        return None

    # decoding releases the interpreter, so threads are enough
    results = joblib.Parallel(n_jobs=-1, prefer="threads", return_as="generator")(
        joblib.delayed(problem)(item) for item in items)
    return [result for result in progress(results, description, total=len(items), unit="file") if result]
