"""Errors of an estimated path: the thesis's RMSE and MAE (Section 3.4), and other common
measures.
"""

from typing import Any

import evo
import numpy as np
from evo.core.metrics import PoseRelation
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from evo.main_ape import ape
from evo.main_rpe import rpe as evo_rpe
from scipy.spatial.transform import Rotation

from thesis_repro.errors import InputError


def rmse(estimated: np.ndarray, true: np.ndarray) -> float:
    """Root mean square error (Equation 3.5), metres, over frames 1 to n-1 of two paths, (n, 4, 4)
    each.

    The estimate is shifted so that the positions of frame 1 agree, as in PySLAM of 2021.
    """
    return float(np.sqrt((_differences(estimated, true) ** 2).sum(axis=1).mean()))


def mae(estimated: np.ndarray, true: np.ndarray) -> float:
    """Mean absolute error (Equation 3.6), metres, over x, y, z and frames. Aligned as in `rmse`."""
    return float(np.abs(_differences(estimated, true)).mean())


def percent_change(value: Any, benchmark: Any) -> Any:
    """Change of a value from a benchmark in percent (Equations 4.1 and 4.2). Negative if the
    value is smaller.
    """
    return (value - benchmark) / benchmark * 100


def shifted(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Estimated path (n, 4, 4), shifted as in `rmse`."""
    estimated, true = checked(estimated, true)
    motion = np.eye(4)
    motion[:3, 3] = true[1, :3, 3] - estimated[1, :3, 3]
    return motion @ estimated


def _differences(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Position differences of the aligned paths (see `rmse`) from frame 1 on, (n - 1, 3)."""
    estimated, true = checked(estimated, true)
    positions = estimated[1:, :3, 3] - estimated[1, :3, 3]
    return positions - (true[1:, :3, 3] - true[1, :3, 3])


def checked(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both paths as arrays. Raises InputError if their lengths differ or are below two."""
    estimated, true = np.asarray(estimated), np.asarray(true)
    if estimated.shape != true.shape:
        raise InputError(
            f"the estimated path has {len(estimated)} poses and the true path {len(true)}; "
            "both need one pose a frame"
        )
    if len(true) < 2:
        raise InputError("a path needs at least 2 frames to have an error")
    return estimated, true


# Other common measures

ALIGNMENTS = ("none", "se3", "sim3", "scale")
STATISTICS = ("rmse", "mean", "median", "max")


def ate(estimated: np.ndarray, true: np.ndarray, alignment: str = "none") -> dict[str, Any]:
    """Absolute trajectory error, metres, over all frames: {rmse, mean, median, max, scale, note}.

    estimated, true: (n, 4, 4) poses. alignment: see `align`, which also determines the scale. A
    straight or motionless path does not determine the alignment. Then the numbers are NaN and
    `note` says so.
    """
    try:
        estimated, scale = align(estimated, true, alignment)
    except evo.EvoException:
        return {
            **dict.fromkeys((*STATISTICS, "scale"), np.nan),
            "note": f"no {alignment} alignment: the path is straight or does not move",
        }
    result = ape(*_evo_paths(estimated, true), PoseRelation.translation_part)
    return {
        **{name: float(result.stats[name]) for name in STATISTICS},
        "scale": float(scale),
        "note": "",
    }


def align(estimated: np.ndarray, true: np.ndarray, alignment: str) -> tuple[np.ndarray, float]:
    """Align the estimated path (n, 4, 4) with the true path. Returns the aligned path and the
    scale.

    alignment: "none", "se3" (the best rotation and shift, by Umeyama's method), "sim3" (also the
    best scale) or "scale" (only the scale of "sim3"). Raises InputError for another alignment, and
    evo.EvoException if a straight or motionless path does not determine the alignment.
    """
    if alignment not in ALIGNMENTS:
        raise InputError(f"alignment={alignment!r}: unknown; choose one of {', '.join(ALIGNMENTS)}")
    if alignment == "none":
        return np.asarray(estimated), 1.0
    reference, estimate = _evo_paths(estimated, true)
    _, _, scale = estimate.align(
        reference, correct_scale=alignment == "sim3", correct_only_scale=alignment == "scale"
    )
    return np.array(estimate.poses_se3), float(scale)


def rpe(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Relative pose error from frame to frame: translation_rmse, _mean, _median, _max in metres,
    and the same of rotation in degrees."""
    relations = {
        "translation": PoseRelation.translation_part,
        "rotation": PoseRelation.rotation_angle_deg,
    }
    results = {
        name: evo_rpe(
            *_evo_paths(estimated, true), relation, delta=1, delta_unit=Unit.frames, all_pairs=True
        )
        for name, relation in relations.items()
    }
    return {
        f"{name}_{key}": float(results[name].stats[key]) for name in relations for key in STATISTICS
    }


def _evo_paths(estimated: np.ndarray, true: np.ndarray) -> tuple[PosePath3D, ...]:
    checked(estimated, true)
    return tuple(
        PosePath3D(poses_se3=list(np.array(poses, np.float64))) for poses in (true, estimated)
    )


RELATIVE_LENGTH = 20.0  # metres; even the short excerpts have several segments of this length


def relative_errors(
    estimated: np.ndarray, true: np.ndarray, length: float = RELATIVE_LENGTH
) -> dict[str, Any]:
    """Mean errors over segments of one length: {translation_percent, rotation_deg_per_100m,
    segments, note}.

    A segment goes from each frame to the first frame that is `length` metres of true path away.
    Each estimated motion M is rotated to B M B^T and compared with the true motion. The rotation B
    is common to all segments and fits best: Kabsch's solution for the translations and rotation
    vectors. So neither a constant rotation between camera and ground truth nor the start of the
    path changes the errors. (The KITTI benchmark's errors contain that rotation.) The errors are
    NaN, with a note, if the path is shorter than `length`.
    """
    estimated, true = checked(estimated, true)
    along = travelled(true)
    last = np.searchsorted(along, along + length)
    first = np.flatnonzero(last < len(true))
    if not len(first):
        return {
            "translation_percent": np.nan,
            "rotation_deg_per_100m": np.nan,
            "segments": 0,
            "note": f"too short: {along[-1]:.1f} m, segments of {length:g} m are compared",
        }
    motion, true_motion = (
        np.linalg.inv(poses[first]) @ poses[last[first]] for poses in (estimated, true)
    )
    vectors, true_vectors = (
        np.concatenate(
            [steps[:, :3, 3], length * Rotation.from_matrix(steps[:, :3, :3]).as_rotvec()]
        )
        for steps in (motion, true_motion)
    )
    moments = true_vectors.T @ vectors
    # The small multiple of the identity keeps a rotation zero that a straight path does not
    # determine.
    left, _, right = np.linalg.svd(
        moments + 1e-6 * np.trace(true_vectors.T @ true_vectors) * np.eye(3)
    )
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    offsets = np.linalg.norm(true_motion[:, :3, 3] - motion[:, :3, 3] @ turn.T, axis=1)
    differences = true_motion[:, :3, :3].swapaxes(1, 2) @ turn @ motion[:, :3, :3] @ turn.T
    angle = np.linalg.norm(Rotation.from_matrix(differences).as_rotvec(), axis=1)
    return {
        "translation_percent": float(offsets.mean() / length * 100),
        "rotation_deg_per_100m": float(np.degrees(angle.mean()) / length * 100),
        "segments": len(first),
        "note": "",
    }


def errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Errors of one run: rmse and mae (metres), se3 (RMSE in metres after
    the best rotation and shift), and the two errors of `relative_errors`. NaN if the path is too
    short or too straight.
    """
    relative = relative_errors(estimated, true)
    return {
        "rmse": rmse(estimated, true),
        "mae": mae(estimated, true),
        "se3": ate(estimated, true, "se3")["rmse"],
        **{name: relative[name] for name in ("translation_percent", "rotation_deg_per_100m")},
    }


MIN_DIRECTED_STEP = 0.25  # metres; the direction of a shorter step is mostly noise
FAILED_ROTATION = 2.0  # degrees; a step with a larger rotation error has failed
TURN_RATE, STRAIGHT_RATE = 1.0, 0.3  # degrees a frame: more is a turn, less is a straight


def step_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Errors of single steps of two camera-to-world paths, (n, 4, 4) each. Earlier errors do not
    add up.

    rotation: mean angle between estimated and true rotation, degrees a frame. in_turns,
    on_straights: the same for steps that turn by more than TURN_RATE, and by less than
    STRAIGHT_RATE. The other errors are computed from steps of MIN_DIRECTED_STEP or more. direction:
    median angle between estimated and true direction of motion, degrees. across, down: median
    difference to the right and downwards, degrees (audit row 30). failed: percent of steps with a
    rotation error above FAILED_ROTATION or a backward motion. steps: their number.
    """
    steps, true_steps = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (estimated, true))
    rotation_error, turn = angles(np.linalg.inv(true_steps) @ steps), angles(true_steps)
    directed = np.linalg.norm(true_steps[:, :3, 3], axis=1) >= MIN_DIRECTED_STEP
    shifts = steps[directed, :3, 3], true_steps[directed, :3, 3]
    heading, true_heading = (
        shift / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-12) for shift in shifts
    )
    cosine = np.clip((heading * true_heading).sum(axis=1), -1, 1)
    offset = (
        np.degrees(np.median(heading - true_heading, axis=0))
        if directed.any()
        else np.full(3, np.nan)
    )
    return {
        "rotation": rotation_error.mean(),
        "in_turns": _mean(rotation_error[turn > TURN_RATE]),
        "on_straights": _mean(rotation_error[turn < STRAIGHT_RATE]),
        "direction": np.degrees(np.median(np.arccos(cosine))) if directed.any() else np.nan,
        "across": offset[0],
        "down": offset[1],
        "failed": 100 * _mean((rotation_error[directed] > FAILED_ROTATION) | (cosine < 0)),
        "steps": int(directed.sum()),
    }


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else np.nan


def travelled(poses: np.ndarray) -> np.ndarray:
    """Length of a path (n, 4, 4) up to each pose, (n,), metres."""
    return np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))]
    )


def angles(rotations: np.ndarray) -> np.ndarray:
    """Rotation angles in degrees of rotations (..., 3, 3) or of the rotations in poses (..., 4,
    4).
    """
    trace = np.trace(rotations[..., :3, :3], axis1=-2, axis2=-1)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


KITTI_LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)  # metres
KITTI_EVERY = 10  # frames between the starts of segments


def kitti_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    """Errors of the KITTI odometry benchmark: {translation_percent, rotation_deg_per_100m,
    segments, note}.

    The errors are means over segments. At every tenth frame, one segment for each of KITTI_LENGTHS
    starts. It ends at the first frame that is more than this length of true path away. NaN, with a
    note, if the path is too short.
    """
    estimated, true = checked(estimated, true)
    along = travelled(true)
    first, length = (
        grid.ravel()
        for grid in np.meshgrid(np.arange(0, len(true), KITTI_EVERY), KITTI_LENGTHS, indexing="ij")
    )
    last = np.searchsorted(along, along[first] + length, side="right")
    first, last, length = (values[last < len(true)] for values in (first, last, length))
    if not len(first):
        return {
            "translation_percent": np.nan,
            "rotation_deg_per_100m": np.nan,
            "segments": 0,
            "note": f"too short: {along[-1]:.1f} m, the shortest segment is {min(KITTI_LENGTHS)} m",
        }
    motion, true_motion = (np.linalg.inv(poses[first]) @ poses[last] for poses in (estimated, true))
    error = np.linalg.inv(motion) @ true_motion
    return {
        "translation_percent": float(
            100 * (np.linalg.norm(error[:, :3, 3], axis=1) / length).mean()
        ),
        "rotation_deg_per_100m": float(100 * (angles(error) / length).mean()),
        "segments": len(first),
        "note": "",
    }
