"""Odd input: what can be read, but is probably not what the user intended. It causes a warning, not
an error. Each function returns warnings, one line each.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import masks
from thesis_repro.data import cityscapes, kitti
from thesis_repro.running import files, results

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


def of_sequence(sequence: kitti.Sequence) -> list[str]:
    """Warnings, one line each, if a sequence's times, poses, camera matrix or frames are
    implausible.
    """
    prefix = f"sequence {sequence.name}: "
    truth = sequence.poses if sequence.has_truth else None
    lines = of_truth(sequence.name, truth, sequence.times)
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
    copies = candidates[pd.Series(results.digests(candidates), dtype=object).duplicated()]
    if len(copies):
        lines.append(
            f"{prefix}{len(copies)} frames are copies of other frames, first {copies[0].name}; remove them"
        )
    return lines


def of_truth(name: str, poses: np.ndarray | None, times: np.ndarray) -> list[str]:
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


def _steps(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Motion from each pose (n, 4, 4) to the next one, (n - 1, 4, 4), and its length, (n - 1,)."""
    motion = np.linalg.inv(poses[:-1]) @ poses[1:]
    return motion, np.linalg.norm(motion[:, :3, 3], axis=1)


def of_steps(name: str, failed: int, steps: int) -> list[str]:
    """Warnings, one line each, if most of a run's steps are flagged."""
    if failed <= steps / 2:
        return []
    return [
        f"sequence {name}: {failed} of {steps} frames have a flag; do frames, calib.txt and poses fit "
        "together?"
    ]


def of_path(
    name: str, estimated: np.ndarray, true: np.ndarray, in_metres: bool = True
) -> list[str]:
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


def of_masks(source: Any, sequence: kitti.Sequence) -> tuple[str, list[str]]:
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
    digests = [
        results.digest_of_files(paths) for paths in (sequence.frame_paths, frames, frames[:present])
    ]
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


def _label_faults(
    label_maps: list[np.ndarray],
    ids: np.ndarray,
    sequence: kitti.Sequence,
    settings: masks.MaskSettings,
) -> list[str]:
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


def _foreign_ids(label_maps: list[np.ndarray]) -> list[str]:
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


def _misplacement(
    source: masks.LabelMasks,
    sequence: kitti.Sequence,
    indices: np.ndarray,
    label_maps: list[np.ndarray],
) -> list[str]:
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
    best = max(fits, key=lambda place: fits[place])
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


def _gradient(frame: np.ndarray) -> np.ndarray:
    """Square root of the gradient at PLACE_SIZE, (height, width), with mean 1; without the root,
    few strong edges would decide.
    """
    small = cv2.resize(frame, PLACE_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    across, down = cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1)
    gradient = np.sqrt(np.hypot(across, down))
    return gradient / max(gradient.mean(), 1e-9)


def _outline(label_map: np.ndarray) -> np.ndarray:
    """Boundaries of a label map at PLACE_SIZE: 1, and 0 elsewhere."""
    return masks.edges(label_map, PLACE_SIZE[::-1], masks.MaskSettings("exact")) / np.float32(255)


def _agreement(gradient: np.ndarray, outline: np.ndarray) -> float:
    """Mean gradient along an outline, 0 without one."""
    return (gradient * outline).sum() / max(outline.sum(), 1)


def _zoomed(outline: np.ndarray, factor: float) -> np.ndarray:
    width, height = PLACE_SIZE
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 0, factor)
    return cv2.warpAffine(outline, matrix, PLACE_SIZE, flags=cv2.INTER_NEAREST)


PLACES: dict[str, Callable] = {
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


def _contrast(frame: np.ndarray, mask: np.ndarray) -> float:
    gradient = np.abs(np.diff(frame.astype(np.int16), axis=1))
    kept = mask[:, 1:] > 0
    return gradient[kept].sum() * (~kept).sum() / max(gradient[~kept].sum() * kept.sum(), 1e-9)


def _leaves_strips(mask: np.ndarray) -> bool:
    """Whether a mask leaves out strips, as inverted boundaries do, not areas, such as cars."""
    left_out = (mask == 0).astype(np.uint8)
    areas = cv2.morphologyEx(left_out, cv2.MORPH_OPEN, np.ones((STRIP, STRIP), np.uint8))
    return areas.sum() < MAX_AREAS * left_out.sum()
