"""Odd input: what can be read, but is probably not what the user intended.

It causes a warning, not an error. Each function returns warnings, one line each.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import masks
from thesis_repro.checks import polarity
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
MIN_COVERAGE = 0.005
MIN_TURN_SPREAD = 0.3  # degrees a frame; smaller turns cannot be compared
MIN_CORRELATION, MAX_TURN_DIFFERENCE = 0.4, 0.5  # degrees; correct paths have >= 0.79 and <= 0.04


def of_sequence(sequence: kitti.Sequence) -> list[str]:
    """Return warnings if a sequence's times, poses, camera matrix or frames are implausible."""
    truth = sequence.poses if sequence.has_truth else None
    warnings = of_truth(sequence.name, truth, sequence.times)
    warnings += _of_camera(sequence)
    warnings += _of_copies(sequence)
    return warnings


def _of_camera(sequence: kitti.Sequence) -> list[str]:
    """Return a warning if the camera matrix does not fit KITTI's camera or the frames' size."""
    height, width = sequence.size
    (fx, _, u), (_, fy, v), _ = sequence.intrinsics
    camera = kitti.CAMERAS.get(sequence.name)
    if camera and (height, width) == (camera.height, camera.width):
        expected = (camera.fx, camera.fy, camera.cx, camera.cy)
        if np.allclose((fx, fy, u, v), expected, rtol=0, atol=1e-3):
            return []
        return [
            f"sequence {sequence.name}: calib.txt has the focal lengths {fx:.8g}, {fy:.8g} and centre "
            f"{u:.8g}, {v:.8g}; KITTI's camera has {camera.fx:.8g}, {camera.fy:.8g} and "
            f"{camera.cx:.8g}, {camera.cy:.8g}"
        ]
    offset = abs(u / width - 0.5), abs(v / height - 0.5)
    if offset[0] > MAX_CENTRE_OFFSET[0] or offset[1] > MAX_CENTRE_OFFSET[1]:
        return [
            f"sequence {sequence.name}: calib.txt has the centre {u:g}, {v:g}, but frames have "
            f"{width}x{height} pixels; it must belong to frames of this size"
        ]
    return []


def _of_copies(sequence: kitti.Sequence) -> list[str]:
    """Return a warning if some frames are copies of other frames."""
    sizes = pd.Series({path: path.stat().st_size for path in sequence.frame_paths})
    # compressed frames seldom have equal sizes, so few files are read
    candidates = sizes.index[sizes.duplicated(keep=False)]
    digests = pd.Series(results.digests(candidates), dtype=object)
    copies = candidates[digests.duplicated()]
    if not len(copies):
        return []
    return [
        f"sequence {sequence.name}: {len(copies)} frames are copies of other frames, first "
        f"{copies[0].name}; remove them"
    ]


def of_truth(name: str, poses: np.ndarray | None, times: np.ndarray) -> list[str]:
    """Return warnings if the times or the true poses of a sequence are implausible.

    poses: (n, 4, 4), or None. times: (n,), seconds.
    """
    seconds = np.diff(times)
    if not len(seconds):
        return []
    interval = np.median(seconds)
    if not FRAME_SECONDS[0] <= interval <= FRAME_SECONDS[1]:
        return [f"sequence {name}: frames are {interval:g} s apart; times.txt must be in seconds"]
    if poses is None:
        return []
    warnings = []
    motion, metres = _steps(poses)
    speed = metres / seconds
    if speed.max() > MAX_CAR_SPEED:
        warnings.append(
            f"sequence {name}: at frame {speed.argmax() + 1} the car drives {speed.max():.0f} m/s "
            f"(median: {np.median(speed):.3g}); positions must be in metres, one line a frame"
        )
    moved = metres > MIN_STEP
    if moved.any():
        forward = motion[moved, 2, 3] / metres[moved]
        lowest_fifth, half = np.quantile(forward, (0.2, 0.5))
        if lowest_fifth < MIN_FORWARD_SHARES[0] or half < MIN_FORWARD_SHARES[1]:
            warnings.append(
                f"sequence {name}: {half:.2f} of a step lies along the camera's axis (median; "
                f"{lowest_fifth:.2f} or less in a fifth of them); poses must be camera to world "
                "(inverted?), x right, y down, z ahead"
            )
    turns = np.linalg.norm(motion[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2)  # radians
    most_turn = MAX_TURN_OF_A_METRE * max(1, metres.sum())
    if len(metres) >= MIN_STEPS and turns.sum() > most_turn:
        warnings.append(
            f"sequence {name}: the car turns by {np.degrees(turns.sum()):.0f} degrees within "
            f"{metres.sum():.3g} m; positions must be in metres, and poses those of each frame, not steps"
        )
    return warnings


def _steps(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion from each pose (n, 4, 4) to the next one, (n - 1, 4, 4), and its length."""
    motion = np.linalg.inv(poses[:-1]) @ poses[1:]
    return motion, np.linalg.norm(motion[:, :3, 3], axis=1)


def of_steps(name: str, failed: int, steps: int) -> list[str]:
    """Return a warning if most of a run's steps are flagged."""
    if failed <= steps / 2:
        return []
    return [
        f"sequence {name}: {failed} of {steps} frames have a flag; do frames, calib.txt and poses fit "
        "together?"
    ]


def of_path(
    name: str, estimated: np.ndarray, true: np.ndarray, in_metres: bool = True
) -> list[str]:
    """Return warnings if estimated and true poses, (n, 4, 4), probably belong to different drives.

    in_metres: the estimate's scale is meant to be the true one.
    """
    steps, metres = _steps(estimated)
    true_steps, true_metres = _steps(true)
    warnings = []
    if estimated[0, :3, 1] @ true[0, :3, 1] < 0:
        warnings.append(
            f"sequence {name}: the first camera is upside down; poses are x right, y down, z ahead, and "
            "TUM's quaternions end with w"
        )
    moved = (metres > 0) & (true_metres > MIN_STEP)
    if moved.sum() >= MIN_STEPS:
        cosines = (steps[moved, :3, 3] * true_steps[moved, :3, 3]).sum(axis=1)
        cosines /= metres[moved] * true_metres[moved]
        angle = np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))
        if angle > MAX_DIRECTION_DIFFERENCE:
            warnings.append(
                f"sequence {name}: steps differ from the ground truth's by {angle:.0f} degrees in "
                "direction (median); are frames in the order of the poses, with the same axes?"
            )
    both = (metres > 0) & (true_metres > 0)
    if in_metres and both.sum() >= MIN_STEPS:
        ratio = np.median(metres[both]) / np.median(true_metres[both])
        if not 1 / MAX_LENGTH_RATIO < ratio < MAX_LENGTH_RATIO:
            warnings.append(
                f"sequence {name}: steps are {ratio:.3g} times as long as the ground truth's (median); "
                "both must be in metres (--align sim3 compares paths without a scale)"
            )
    return warnings + _of_turns(name, steps, true_steps)


def _of_turns(name: str, steps: np.ndarray, true_steps: np.ndarray) -> list[str]:
    """Return a warning if the turns of estimated and true steps, (n, 4, 4), differ."""
    turns = pd.DataFrame({"estimated": _headings(steps), "true": _headings(true_steps)})
    spread = (turns.quantile(0.95) - turns.quantile(0.05)) / 2
    if len(turns) < MIN_STEPS or not spread["estimated"]:
        return []
    correlation = 1.0
    if spread.max() > MIN_TURN_SPREAD and spread["true"]:
        correlation = turns.corr("spearman").iloc[0, 1]
    difference = (turns["estimated"] - turns["true"]).abs().median()
    if correlation >= MIN_CORRELATION and difference <= MAX_TURN_DIFFERENCE:
        return []
    return [
        f"sequence {name}: turns from frame to frame differ from the ground truth by {difference:.2g} degrees "
        f"(median), correlation {correlation:.2f}; do frames and poses belong to one drive, in the same order?"
    ]


def _headings(steps: np.ndarray) -> np.ndarray:
    """Return the change of heading (n,), degrees, of each step (n, 4, 4)."""
    return np.degrees(np.arctan2(steps[:, 0, 2], steps[:, 2, 2]))


def of_masks(source: Any, sequence: kitti.Sequence) -> tuple[str, list[str]]:
    """Check MASK_SAMPLES masks of a sequence. Returns (description, [warning] or []).

    source: LabelMasks or MaskFolder.
    """
    indices = _sampled(len(source))
    sampled_masks = [source[index] for index in indices]
    coverage = np.array([masks.coverage(mask) for mask in sampled_masks])
    folder = source.paths[0].parent
    description = f"{folder}: masks keep {coverage.mean():.1%} of {sequence.name}"
    kind, option, shape = "masks", "; --invert inverts masks", polarity.RIGHT
    faults = []
    if isinstance(source, masks.LabelMasks):
        kind, option = "label maps", ""
        label_maps = [masks.label_map_of(source, index) for index in indices]
        shares = _class_shares(label_maps)
        description += f" (width {source.dilation_width}); label maps hold {_class_text(shares)}"
        faults += _label_faults(label_maps, np.flatnonzero(shares), sequence, source.settings)
        faults += _foreign_ids(label_maps) or _misplacement(source, sequence, indices, label_maps)
    else:
        shape = polarity_of(source)
        if shape == polarity.UNKNOWN:
            description += "; their shape does not tell whether they are inverted"
    faults += _file_faults(folder, sequence)
    coverage_text = f"leave {coverage.min():.1%} to {coverage.max():.1%} of the frames"
    if coverage.min() < MIN_COVERAGE:
        faults.append(f"{coverage_text}{option}")
    elif coverage.min() == 1:  # of single frames, masks without vehicles may keep all
        faults.append(coverage_text)
    elif shape in polarity.INVERTED:
        faults.append(f"{polarity.INVERTED[shape]}{option}")
    if not faults:
        return description, []
    return description, [f"{folder}: {kind} {faults[0]}"]


def _sampled(count: int) -> np.ndarray:
    """Return the numbers of about MASK_SAMPLES frames, spread evenly over a sequence.

    They are even and odd in turn, because a tool may treat every second frame in another way.
    """
    spread = np.linspace(0, count - 1, MASK_SAMPLES).astype(int)
    wrong_parity = (spread + np.arange(MASK_SAMPLES)) % 2
    return np.unique(np.minimum(spread + wrong_parity, count - 1))


def _class_shares(label_maps: list[np.ndarray]) -> np.ndarray:
    """Return the share of each label id in label maps of one size, (N_CLASSES,)."""
    shares = [
        np.bincount(label_map.ravel(), minlength=cityscapes.N_CLASSES) / label_map.size
        for label_map in label_maps
    ]
    return np.mean(shares, axis=0)


def _class_text(shares: np.ndarray) -> str:
    """Return the names and shares of the labels that cover 0.5 % or more, the largest first."""
    texts = []
    for index in np.argsort(-shares, kind="stable"):
        if shares[index] >= 0.005:
            name = cityscapes.LABELS[index].name
            texts.append(f"{name} {shares[index]:.0%}")
    return ", ".join(texts)


def _file_faults(folder: Path, sequence: kitti.Sequence) -> list[str]:
    """Return the fault of a folder of masks or label maps that belongs to other frames."""
    record = results.record(folder) or {}
    present = len(files.listed(folder))
    frames = files.images(sequence.frame_paths[0].parent)
    if "frames" in record:
        # A study may use only the first frames.
        used = (sequence.frame_paths, frames, frames[:present])
        if record["frames"] not in [results.digest_of_files(paths) for paths in used]:
            return ["were made from other frames"]
    elif present not in (1, len(sequence), len(frames)):
        return [f"are {present} files for {len(frames)} frames"]
    return []


def polarity_of(source: masks.MaskFolder) -> str:
    """Return the `polarity` of the masks of a sequence.

    Those that this project wrote are what their record says.
    """
    if "keep" in (results.record(source.paths[0].parent) or {}) and not source.invert:
        return polarity.RIGHT
    return polarity.polarity(source[index] for index in _sampled(len(source)))


def _label_faults(
    label_maps: list[np.ndarray],
    ids: np.ndarray,
    sequence: kitti.Sequence,
    settings: masks.MaskSettings,
) -> list[str]:
    """Return the faults of label maps in their ids and their shape.

    ids: those that the label maps hold. settings: say how the ids are read.
    """
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
    """Return the fault of label maps that hold other numbers than label ids.

    It shows in the share of common classes, and in numbers between those of both neighbours, which
    blurring and JPEG make.
    """
    shares, blurred = [], []
    for label_map in label_maps:
        labelled = max(np.count_nonzero(label_map), 1)
        shares.append(np.isin(label_map, COMMON).sum() / labelled)
        left, middle, right = label_map[:, :-2], label_map[:, 1:-1], label_map[:, 2:]
        between = (np.minimum(left, right) < middle) & (middle < np.maximum(left, right))
        boundary = max(np.count_nonzero(left != right), 1)
        blurred.append(between.sum() / boundary)
    # one odd map is no fault, so the second worst one decides; a single map decides alone
    second = min(1, len(label_maps) - 1)
    share = sorted(shares)[second]
    blur = sorted(blurred, reverse=True)[second]
    if share < MIN_COMMON:
        return [f"hold {share:.0%} of the common street classes; are these Cityscapes label ids?"]
    if blur > MAX_BLURRED:
        return [
            f"have other ids along {blur:.0%} of boundaries; were they smoothed, or saved as JPEG?"
        ]
    return []


def _misplacement(
    source: masks.LabelMasks,
    sequence: kitti.Sequence,
    indices: np.ndarray,
    label_maps: list[np.ndarray],
) -> list[str]:
    """Return the fault of label maps whose boundaries do not lie where the frames' gradients are.

    They agree better with the gradients at another place, or with other frames, than with their
    own. Short sequences are not judged. indices: of the frames of the label maps.
    """
    if len(sequence) < MIN_STEPS:
        return []
    gradients = [_gradient(sequence.frame(index)) for index in indices]
    outlines = [_outline(label_map) for label_map in label_maps]
    own = np.array(list(map(_agreement, gradients, outlines)))
    if not own.all():
        return []  # maps of a single class
    fits = _fits_elsewhere(gradients, outlines, own)
    fits |= _fits_of_near_frames(source, indices, gradients, own)
    best = max(fits, key=lambda place: fits[place])
    if fits[best] > MIN_BETTER_FIT:
        return [
            f"fit the frames {fits[best]:.2f} times as well if {best}; do both belong together?"
        ]
    others = _fits_of_unlike_frames(gradients, outlines, own)
    if not others:
        return []
    mean, good_fits = np.mean(others), sum(fit > MAX_OTHER_FIT[1] for fit in others)
    if mean > MAX_OTHER_FIT[0] or good_fits > 1:
        return [
            f"fit other frames {mean:.2f} times as well as their own (at most "
            f"{max(others):.2f}); do both belong together?"
        ]
    return []


def _fits_elsewhere(
    gradients: list[np.ndarray], outlines: list[np.ndarray], own: np.ndarray
) -> dict[str, float]:
    """Return how well outlines fit at each of PLACES, {place: multiple of their own fit}.

    own: agreement (n,) of the outlines with their own frames.
    """
    fits = {}
    for place, move in PLACES.items():
        moved = [move(outline) for outline in outlines]
        fits[place] = np.mean(list(map(_agreement, gradients, moved))) / own.mean()
    return fits


def _fits_of_near_frames(
    source: masks.LabelMasks, indices: np.ndarray, gradients: list[np.ndarray], own: np.ndarray
) -> dict[str, float]:
    """Return how well label maps of near frames fit, {place: multiple of the own maps' fit}."""
    fits = {}
    for step in (-5, -1, 1, 5):
        first = 1 if step > 0 else 0
        near, own_of_near = [], []
        for sample in range(first, len(indices), 2):  # half of the samples, to read fewer files
            index = indices[sample] + step
            if 0 <= index < len(source):
                outline = _outline(masks.label_map_of(source, index))
                near.append(_agreement(gradients[sample], outline))
                own_of_near.append(own[sample])
        if len(near) > 1:
            fits[f"taken from frame {step:+}"] = np.mean(near) / np.mean(own_of_near)
    return fits


def _fits_of_unlike_frames(
    gradients: list[np.ndarray], outlines: list[np.ndarray], own: np.ndarray
) -> list[float]:
    """Return how well outlines of unlike frames fit, as multiples of the own outline's fit.

    There is one number for each frame that is unlike others.
    """
    correlations = np.corrcoef([gradient.ravel() for gradient in gradients])
    fits = []
    for gradient, row, own_fit in zip(gradients, correlations, own, strict=True):
        unlike = np.flatnonzero(row < MAX_FRAME_CORRELATION)
        if len(unlike):
            agreements = [_agreement(gradient, outlines[other]) for other in unlike]
            fits.append(np.mean(agreements) / own_fit)
    return fits


def _gradient(frame: np.ndarray) -> np.ndarray:
    """Return the square root of the gradient at PLACE_SIZE, (height, width), with mean 1.

    Without the root, few strong edges would decide.
    """
    small = cv2.resize(frame, PLACE_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    across = cv2.Sobel(small, cv2.CV_32F, 1, 0)
    down = cv2.Sobel(small, cv2.CV_32F, 0, 1)
    gradient = np.sqrt(np.hypot(across, down))
    return gradient / max(gradient.mean(), 1e-9)


def _outline(label_map: np.ndarray) -> np.ndarray:
    """Return the boundaries of a label map at PLACE_SIZE: 1, and 0 elsewhere."""
    edges = masks.edges(label_map, PLACE_SIZE[::-1], masks.MaskSettings("exact"))
    return edges / np.float32(255)


def _agreement(gradient: np.ndarray, outline: np.ndarray) -> float:
    """Return the mean gradient along an outline, 0 without one."""
    return (gradient * outline).sum() / max(outline.sum(), 1)


def _zoomed(outline: np.ndarray, factor: float) -> np.ndarray:
    width, height = PLACE_SIZE
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), 0, factor)
    return cv2.warpAffine(outline, matrix, PLACE_SIZE, flags=cv2.INTER_NEAREST)


def _places() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Return the names of wrong places, and functions that move an outline there."""
    places: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "mirrored": lambda outline: outline[:, ::-1],
        "turned upside down": lambda outline: outline[::-1],
        "turned by 180 degrees": lambda outline: outline[::-1, ::-1],
        "made smaller": partial(_zoomed, factor=0.8),
        "made larger": partial(_zoomed, factor=1.25),
    }
    width, height = PLACE_SIZE
    for axis, size, direction in ((0, height, "downwards"), (1, width, "to the right")):
        for pixels in (-16, -8, -3, 3, 8, 16):
            name = f"moved by {pixels} of {size} pixels {direction}"
            places[name] = partial(np.roll, shift=pixels, axis=axis)
    return places


PLACES = _places()
