"""Check the user's KITTI and Cityscapes folders: report missing, wrong and odd files, and which
commands can be run.

Odd input can be read, but is probably not what the user intended. It causes a warning, not an
error.
"""

import sys
from contextlib import suppress
from functools import partial
from pathlib import Path

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import (
    InputError,
    cityscapes,
    files,
    kitti,
    masks,
    one_line,
    results,
)
from thesis_repro.settings import read_settings


class _Problems(list):
    """A list of problems, one line each."""

    def call(self, function, *arguments):
        """Return the result of a function. If it raises InputError, add the message to the list
        and return None.
        """
        try:
            return function(*arguments)
        except InputError as error:
            self.append(str(error))
            return None

    def call_for_each(self, function, items, description):
        """Call a function for every item in threads; reading and decoding release Python's lock."""
        calls = (joblib.delayed(self.call)(function, item) for item in items)
        done = joblib.Parallel(n_jobs=-1, prefer="threads", return_as="generator")(calls)
        for _ in files.progress(done, description, total=len(items), unit="file"):
            pass


def check_kitti(root, deep=False):
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


def _check_sequence(root, name, needs_truth, deep):
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

    def check_frame(path):
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


def check_cityscapes(root, deep=False, splits=("train", "val")):
    """Check the training and validation split. Returns (lines that describe the splits, problems).

    Checks file names, and the start and end of every file. Decodes the first and the last pair.
    deep: decodes all.
    """
    facts, problems = [], _Problems()
    for split in splits:
        pairs = problems.call(cityscapes.listing, root, split)
        if pairs is None:
            continue
        ids, ends = set(), (pairs[0], pairs[-1])

        def check_pair(pair, ids=ids, ends=ends):
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


def report(kitti_root=None, cityscapes_root=None, kitti_semantic=None, deep=False):
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
        for line in oddities(kitti.Sequence(kitti_root, name)):
            print(f"warning: {one_line(line)}", file=sys.stderr)
    return not has_problems


# Odd input

# least and greatest time between frames; times outside are probably not in seconds
FRAME_SECONDS = 0.005, 2
MAX_CAR_SPEED = 60  # metres a second; the cars of KITTI drive at most 27
# Street classes that cover 68 % or more of each label map at hand, without pixels of id 0; half of
# that or less in CamVid's, ADE20K's and shifted train ids
COMMON = [
    cityscapes.ID[name]
    for name in ("road", "sidewalk", "building", "vegetation", "terrain", "sky", "car")
]
MIN_COMMON = 0.5
MAX_BLURRED = 0.1  # of boundary pixels; label maps at hand have 0.03, smoothed ones 0.2 or more
PLACE_SIZE = 320, 160  # width and height at which boundaries and gradients are compared
# On 213 excerpts of 21 sequences, maps fit no other place or near frame more than 0.996 times as
# well as their own, and no frames unlike theirs more than 0.93 times.
MIN_BETTER_FIT, MAX_OTHER_FIT, MAX_FRAME_CORRELATION = 1.03, (0.95, 0.97), 0.5
MIN_STEP = 0.1  # metres; the direction of a shorter step is mostly noise
MIN_STEPS = 20  # paths with fewer steps are not judged
MAX_TURN_OF_A_METRE = (
    0.3  # radians, over a whole drive; a car's circle is 0.2, KITTI has at most 0.05
)
MAX_DIRECTION_DIFFERENCE = 45  # degrees
MAX_LENGTH_RATIO = 1.5  # between the steps of an estimate and of the ground truth
# of a step, along the camera's axis: of the lowest fifth and of half of the steps; KITTI has 0.23
# and 0.97 or more
MIN_FORWARD_SHARES = 0.1, 0.5
# of the principal point, in frame widths and heights; KITTI has at most 0.04
MAX_CENTRE_OFFSET = 0.1, 0.15
MASK_SAMPLES = 6  # number of frames whose masks are checked
MIN_COVERAGE, MAX_COVERAGE = 0.005, 0.99
# Mean gradient inside a mask divided by the mean gradient outside. The thesis's masks cover less
# than half of a frame and have 0.98 to 1.6. Inverted, they cover more than half and have 0.64 to
# 1.02. Masks without cars can have the same contrast, but squares of STRIP pixels fill more than
# MAX_AREAS of what they leave out, unless all cars are small.
MIN_CONTRAST, MIN_CONTRAST_OF_LARGE_MASK = 0.7, 0.9
STRIP, MAX_AREAS = 31, 0.5
MIN_TURN_SPREAD = 0.3  # degrees a frame; smaller turns cannot be compared
MIN_CORRELATION, MAX_TURN_DIFFERENCE = 0.4, 0.5  # degrees; correct paths have >= 0.79 and <= 0.04


def oddities(sequence):
    """Warnings, one line each, if a sequence's times, poses, camera matrix or frames are
    implausible.
    """
    prefix = f"sequence {sequence.name}: "
    truth = sequence.poses if sequence.has_truth else None
    lines = truth_oddities(sequence.name, truth, sequence.times)
    height, width = sequence.size
    (fx, _, u), (_, fy, v), _ = sequence.intrinsics
    camera = kitti.CAMERAS.get(sequence.name)
    if camera and (height, width) == (camera.height, camera.width):
        if not np.allclose(
            (fx, fy, u, v), (camera.fx, camera.fy, camera.cx, camera.cy), rtol=0, atol=1e-3
        ):
            lines.append(
                f"{prefix}calib.txt has the focal lengths {fx:.8g}, {fy:.8g} and centre {u:.8g}, {v:.8g}; "
                f"KITTI's camera has {camera.fx:.8g}, {camera.fy:.8g} and {camera.cx:.8g}, {camera.cy:.8g}"
            )
    elif (
        abs(u / width - 0.5) > MAX_CENTRE_OFFSET[0] or abs(v / height - 0.5) > MAX_CENTRE_OFFSET[1]
    ):
        lines.append(
            f"{prefix}calib.txt has the centre {u:g}, {v:g}, but frames have {width}x{height} pixels; it must "
            "belong to frames of this size"
        )
    sizes = pd.Series({path: path.stat().st_size for path in sequence.frame_paths})
    # compressed frames seldom have equal sizes
    candidates = sizes.index[sizes.duplicated(keep=False)]
    copies = candidates[pd.Series(results.contents(candidates), dtype=object).duplicated()]
    if len(copies):
        lines.append(
            f"{prefix}{len(copies)} frames are copies of other frames, first {copies[0].name}; remove them"
        )
    return lines


def truth_oddities(name, poses, times):
    """Warnings, one line each, if the times (n,), seconds, or true poses (n, 4, 4), or None, of a
    sequence are implausible.
    """
    lines, prefix, seconds = [], f"sequence {name}: ", np.diff(times)
    if not len(seconds):
        return []
    if not FRAME_SECONDS[0] <= np.median(seconds) <= FRAME_SECONDS[1]:
        return [f"{prefix}frames are {np.median(seconds):g} s apart; times.txt must be in seconds"]
    if poses is None:
        return []
    motion, metres = _steps(poses)
    moved = metres > MIN_STEP
    forward, speed = motion[moved, 2, 3] / metres[moved], metres / seconds
    turns = np.linalg.norm(motion[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2)  # radians
    if speed.max() > MAX_CAR_SPEED:
        lines.append(
            f"{prefix}at frame {speed.argmax() + 1} the car drives {speed.max():.0f} m/s "
            f"(median: {np.median(speed):.3g}); positions must be in metres, one line a frame"
        )
    ahead = np.quantile(forward, (0.2, 0.5)) if len(forward) else np.ones(2)
    if (ahead < MIN_FORWARD_SHARES).any():
        lines.append(
            f"{prefix}{ahead[1]:.2f} of a step lies along the camera's axis (median; {ahead[0]:.2f} or "
            "less in a fifth of them); poses must be camera to world (inverted?), x right, y down, z ahead"
        )
    if len(metres) >= MIN_STEPS and turns.sum() > MAX_TURN_OF_A_METRE * max(1, metres.sum()):
        lines.append(
            f"{prefix}the car turns by {np.degrees(turns.sum()):.0f} degrees within {metres.sum():.3g} m; "
            "positions must be in metres, and poses those of each frame, not steps"
        )
    return lines


def _steps(poses):
    """Motion from each pose (n, 4, 4) to the next one, (n - 1, 4, 4), and its length, (n - 1,)."""
    motion = np.linalg.inv(poses[:-1]) @ poses[1:]
    return motion, np.linalg.norm(motion[:, :3, 3], axis=1)


def step_oddities(name, failed, steps):
    """Warnings, one line each, if most of a run's steps are flagged."""
    if failed <= steps / 2:
        return []
    return [
        f"sequence {name}: {failed} of {steps} frames have a flag; do frames, calib.txt and poses fit "
        "together?"
    ]


def path_oddities(name, estimated, true, in_metres=True):
    """Warnings, one line each, if estimated and true poses, (n, 4, 4), probably belong to
    different drives.

    in_metres: the estimate's scale is meant to be the true one.
    """
    (steps, metres), (true_steps, true_metres) = _steps(estimated), _steps(true)
    lines, moved = [], (metres > 0) & (true_metres > MIN_STEP)
    if estimated[0, :3, 1] @ true[0, :3, 1] < 0:
        lines.append(
            f"sequence {name}: the first camera is upside down; poses are x right, y down, z ahead, and "
            "TUM's quaternions end with w"
        )
    if moved.sum() >= MIN_STEPS:
        cosines = (steps[moved, :3, 3] * true_steps[moved, :3, 3]).sum(axis=1)
        cosines /= metres[moved] * true_metres[moved]
        angle = np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))
        if angle > MAX_DIRECTION_DIFFERENCE:
            lines.append(
                f"sequence {name}: steps differ from the ground truth's by {angle:.0f} degrees in "
                "direction (median); are frames in the order of the poses, with the same axes?"
            )
    both = (metres > 0) & (true_metres > 0)
    if in_metres and both.sum() >= MIN_STEPS:
        ratio = np.median(metres[both]) / np.median(true_metres[both])
        if not 1 / MAX_LENGTH_RATIO < ratio < MAX_LENGTH_RATIO:
            lines.append(
                f"sequence {name}: steps are {ratio:.3g} times as long as the ground truth's (median); "
                "both must be in metres (--align sim3 compares paths without a scale)"
            )
    turns = pd.DataFrame(
        {
            key: np.degrees(np.arctan2(motion[:, 0, 2], motion[:, 2, 2]))
            for key, motion in (("estimated", steps), ("true", true_steps))
        }
    )
    spread = (turns.quantile(0.95) - turns.quantile(0.05)) / 2
    if len(turns) < MIN_STEPS or not spread["estimated"]:
        return lines
    correlation = (
        turns.corr("spearman").iloc[0, 1]
        if spread.max() > MIN_TURN_SPREAD and spread["true"]
        else 1
    )
    difference = (turns["estimated"] - turns["true"]).abs().median()
    if correlation >= MIN_CORRELATION and difference <= MAX_TURN_DIFFERENCE:
        return lines
    return lines + [
        f"sequence {name}: turns from frame to frame differ from the ground truth by {difference:.2g} degrees "
        f"(median), correlation {correlation:.2f}; do frames and poses belong to one drive, in the same order?"
    ]


def mask_oddities(source, sequence):
    """Check MASK_SAMPLES masks (LabelMasks or MaskFolder) of a sequence. Returns (description,
    [warning] or []).
    """
    spread = np.linspace(0, len(source) - 1, MASK_SAMPLES).astype(int)
    # of both parities, because a tool may treat every second frame in another way
    indices = np.unique(
        np.minimum(spread + (spread + np.arange(MASK_SAMPLES)) % 2, len(source) - 1)
    )
    sampled_masks = [source[index] for index in indices]
    coverage = np.array([masks.coverage(mask) for mask in sampled_masks])
    folder, has_labels = source.paths[0].parent, isinstance(source, masks.LabelMasks)
    description, faults = f"{folder}: masks keep {coverage.mean():.1%} of {sequence.name}", []
    if has_labels:
        label_maps = [masks.label_map_of(source, index) for index in indices]
        shares = np.mean(
            [
                np.bincount(label_map.ravel(), minlength=cityscapes.N_CLASSES) / label_map.size
                for label_map in label_maps
            ],
            axis=0,
        )
        largest = [index for index in np.argsort(-shares, kind="stable") if shares[index] >= 0.005]
        description += f" (width {source.dilation_width}); label maps hold " + ", ".join(
            f"{cityscapes.LABELS[index].name} {shares[index]:.0%}" for index in largest
        )
        faults = _label_faults(label_maps, np.flatnonzero(shares), sequence, source.settings)
        faults += _foreign_ids(label_maps) or _misplacement(source, sequence, indices, label_maps)
    record = results.record(folder) or {}
    present, frames = len(files.listed(folder)), files.images(sequence.frame_paths[0].parent)
    # A study may use only the first frames.
    digests = [results.listing(paths) for paths in (sequence.frame_paths, frames, frames[:present])]
    if record.get("frames", digests[0]) not in digests:
        faults.append("were made from other frames")
    elif "frames" not in record and present not in (1, len(sequence), len(frames)):
        faults.append(f"are {present} files for {len(frames)} frames")
    option = "" if has_labels else "; --invert inverts masks"
    if coverage.min() < MIN_COVERAGE or coverage.mean() > MAX_COVERAGE:
        faults.append(f"leave {coverage.min():.1%} to {coverage.max():.1%} of the frames{option}")
    # masks that this project wrote are what their record says
    elif not has_labels and ("keep" not in record or source.invert):
        contrasts = [
            _contrast(sequence.frame(index), mask)
            for index, mask in zip(indices, sampled_masks, strict=True)
        ]
        low = [
            contrast
            for contrast, mask, share in zip(contrasts, sampled_masks, coverage, strict=True)
            if contrast < (MIN_CONTRAST_OF_LARGE_MASK if share > 0.5 else MIN_CONTRAST)
            and (share <= 0.5 or _leaves_strips(mask))
        ]
        if len(low) >= min(2, len(indices)):  # one odd mask is no fault
            faults.append(
                f"keep regions with {np.mean(low):.2f} times the contrast of the rest{option}"
            )
    return description, [
        f"{folder}: {'label maps' if has_labels else 'masks'} {faults[0]}"
    ] if faults else []


def _label_faults(label_maps, ids, sequence, settings):
    height, width = label_maps[0].shape
    faults = []
    if len(ids) == 1:
        faults.append(f"hold only {cityscapes.LABELS[ids[0]].name} {ids[0]}")
    elif settings.ids == "labels" and ids.max() < len(cityscapes.TRAINED):
        faults.append(
            f"hold no id above {ids.max()}, so no sky, vegetation or cars; --ids train reads train ids"
        )
    if (height - width) * (sequence.size[0] - sequence.size[1]) < 0:
        faults.append(
            f"have {width}x{height} pixels, the frames {sequence.size[1]}x{sequence.size[0]}; rotated?"
        )
    return faults


def _foreign_ids(label_maps):
    """Faults of label maps that hold other numbers than label ids: by the share of common classes,
    and by numbers between those of both neighbours, which blurring and JPEG make.
    """
    shares, blurred = [], []
    for label_map in label_maps:
        shares.append(np.isin(label_map, COMMON).sum() / max(np.count_nonzero(label_map), 1))
        left, middle, right = label_map[:, :-2], label_map[:, 1:-1], label_map[:, 2:]
        between = (np.minimum(left, right) < middle) & (middle < np.maximum(left, right))
        blurred.append(between.sum() / max(np.count_nonzero(left != right), 1))
    few, many = sorted(shares)[:2][-1], sorted(blurred)[-2:][0]  # one odd map is no fault
    if few < MIN_COMMON:
        return [f"hold {few:.0%} of the common street classes; are these Cityscapes label ids?"]
    if many > MAX_BLURRED:
        return [
            f"have other ids along {many:.0%} of boundaries; were they smoothed, or saved as JPEG?"
        ]
    return []


def _misplacement(source, sequence, indices, label_maps):
    """Faults of label maps whose boundaries agree better with the frames' gradients at another
    place, or with other frames, than with their own; [] for short sequences.
    """
    if len(sequence) < MIN_STEPS:
        return []
    gradients = [_gradient(sequence.frame(index)) for index in indices]
    outlines = [_outline(label_map) for label_map in label_maps]
    own = np.array(list(map(_agreement, gradients, outlines)))
    if not own.all():
        return []  # maps of a single class
    fits = {
        name: np.mean([_agreement(*pair) for pair in zip(gradients, map(move, outlines))])
        / own.mean()
        for name, move in PLACES.items()
    }
    for step in (-5, -1, 1, 5):
        parts = slice(int(step > 0), None, 2)  # half of the samples, to read fewer files
        near = [
            _agreement(gradient, _outline(masks.label_map_of(source, index + step)))
            for gradient, index in zip(gradients[parts], indices[parts])
            if 0 <= index + step < len(sequence)
        ]
        if len(near) > 1:
            of_own = own[parts][-len(near) :] if step < 0 else own[parts][: len(near)]
            fits[f"taken from frame {step:+}"] = np.mean(near) / of_own.mean()
    best = max(fits, key=fits.get)
    if fits[best] > MIN_BETTER_FIT:
        return [
            f"fit the frames {fits[best]:.2f} times as well if {best}; do both belong together?"
        ]
    unlike = np.corrcoef([gradient.ravel() for gradient in gradients]) < MAX_FRAME_CORRELATION
    others = [
        np.mean([_agreement(gradient, outlines[other]) for other in np.flatnonzero(row)]) / fit
        for gradient, row, fit in zip(gradients, unlike, own)
        if row.any()
    ]
    if others and (
        np.mean(others) > MAX_OTHER_FIT[0] or sum(np.array(others) > MAX_OTHER_FIT[1]) > 1
    ):
        return [
            f"fit other frames {np.mean(others):.2f} times as well as their own (at most "
            f"{max(others):.2f}); do both belong together?"
        ]
    return []


def _gradient(frame):
    """Square root of the gradient at PLACE_SIZE, (height, width), with mean 1; without the root,
    few strong edges would decide.
    """
    small = cv2.resize(frame, PLACE_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    across, down = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
    gradient = np.sqrt(np.hypot(across, down))
    return gradient / max(gradient.mean(), 1e-9)


def _outline(label_map):
    """Boundaries of a label map at PLACE_SIZE: 1, and 0 elsewhere."""
    return masks.edges(label_map, PLACE_SIZE[::-1], masks.MaskSettings("exact")) / np.float32(255)


def _agreement(gradient, outline):
    """Mean gradient along an outline, 0 without one."""
    return (gradient * outline).sum() / max(outline.sum(), 1)


def _zoomed(outline, factor):
    width, height = PLACE_SIZE
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 0, factor)
    return cv2.warpAffine(outline, matrix, PLACE_SIZE, flags=cv2.INTER_NEAREST)


PLACES = {
    "mirrored": lambda outline: outline[:, ::-1],
    "turned upside down": lambda outline: outline[::-1],
    "turned by 180 degrees": lambda outline: outline[::-1, ::-1],
    "made smaller": partial(_zoomed, factor=0.8),
    "made larger": partial(_zoomed, factor=1.25),
    **{
        f"moved by {pixels} of {PLACE_SIZE[1 - axis]} pixels {direction}": partial(
            np.roll, shift=pixels, axis=axis
        )
        for axis, direction in enumerate(("downwards", "to the right"))
        for pixels in (-16, -8, -3, 3, 8, 16)
    },
}


def _contrast(frame, mask):
    gradient = np.abs(np.diff(frame.astype(np.int16), axis=1))
    kept = mask[:, 1:] > 0
    return gradient[kept].sum() * (~kept).sum() / max(gradient[~kept].sum() * kept.sum(), 1e-9)


def _leaves_strips(mask):
    """Whether a mask leaves out strips, as inverted boundaries do, not areas, such as cars."""
    left_out = (mask == 0).astype(np.uint8)
    areas = cv2.morphologyEx(left_out, cv2.MORPH_OPEN, np.ones((STRIP, STRIP), np.uint8))
    return areas.sum() < MAX_AREAS * left_out.sum()


def main(path):
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
        digest = results.listing(used_files)
    if digest and path.is_file() and path.read_text(encoding="utf-8") == digest:
        return 0
    if not report(kitti_root, cityscapes_root, settings.kitti_semantic):
        return 1
    files.write_text(path, digest or "")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(Path(sys.argv[1])))
    except InputError as error:
        sys.exit(f"error: {error}")
