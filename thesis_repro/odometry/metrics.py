"""Errors of an estimated path: the thesis's RMSE and MAE (Section 3.4), and other measures."""

from typing import Any

import evo
import numpy as np
from evo.core.metrics import PoseRelation
from evo.core.trajectory import PosePath3D
from evo.main_ape import ape
from scipy.spatial.transform import Rotation

from thesis_repro.errors import InputError
from thesis_repro.odometry.loop import MAX_TURN


def rmse(estimated: np.ndarray, true: np.ndarray) -> float:
    """Root mean square error (Equation 3.5), metres, over frames 1 to n-1.

    estimated, true: paths, (n, 4, 4) each. The estimate is shifted so that the positions of frame 1
    agree, as in PySLAM of 2021.
    """
    return float(np.sqrt((_differences(estimated, true) ** 2).sum(axis=1).mean()))


def mae(estimated: np.ndarray, true: np.ndarray) -> float:
    """Mean absolute error (Equation 3.6), metres, over x, y, z and frames. Aligned as in `rmse`."""
    return float(np.abs(_differences(estimated, true)).mean())


def shifted(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Estimated path (n, 4, 4), shifted as in `rmse`."""
    estimated, true = _as_paths(estimated, true)
    motion = np.eye(4)
    motion[:3, 3] = true[1, :3, 3] - estimated[1, :3, 3]
    return motion @ estimated


def _differences(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Position differences of the aligned paths (see `rmse`) from frame 1 on, (n - 1, 3)."""
    estimated, true = _as_paths(estimated, true)
    positions = estimated[1:, :3, 3] - estimated[1, :3, 3]
    return positions - (true[1:, :3, 3] - true[1, :3, 3])


def _as_paths(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both paths as arrays. Raises InputError for other shapes, other lengths and below two."""
    estimated, true = np.asarray(estimated), np.asarray(true)
    if not estimated.shape[1:] == true.shape[1:] == (4, 4):
        raise InputError(
            f"the estimated path has the shape {estimated.shape} and the true path {true.shape}; both are "
            "poses, (n, 4, 4)"
        )
    if len(estimated) != len(true):
        raise InputError(
            f"the estimated path has {len(estimated)} poses and the true path {len(true)}; "
            "both need one pose a frame"
        )
    if len(true) < 2:
        raise InputError("a path needs at least 2 frames to have an error")
    return estimated, true


# Other common measures

ALIGNMENTS = ("none", "se3", "sim3")


def ate(estimated: np.ndarray, true: np.ndarray, alignment: str = "none") -> float:
    """Absolute trajectory error: root mean square distance over all frames, metres.

    estimated, true: (n, 4, 4) poses. alignment of the estimate: "none", "se3" (the best rotation
    and shift, by Umeyama's method) or "sim3" (also the best scale). NaN if a straight or motionless
    path does not determine the alignment. Raises InputError for another alignment.
    """
    if alignment not in ALIGNMENTS:
        raise InputError(f"alignment={alignment!r}: unknown; choose one of {', '.join(ALIGNMENTS)}")
    paths = _as_paths(estimated, true)
    estimate, reference = (PosePath3D(poses_se3=list(poses.astype(float))) for poses in paths)
    if alignment != "none":
        try:
            estimate.align(reference, correct_scale=alignment == "sim3")
        except evo.EvoException:
            return np.nan
    return float(ape(reference, estimate, PoseRelation.translation_part).stats["rmse"])


RELATIVE_LENGTH = 20.0  # metres; even the short excerpts have several segments of this length


def relative_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Mean errors over segments of RELATIVE_LENGTH.

    Returns {translation_percent, rotation_deg_per_100m}. These are not the errors of the KITTI
    benchmark (`kitti_errors`). A segment goes from each frame to the first frame that
    is so many metres of true path away. Each estimated motion M is rotated to B M B^T and compared
    with the true motion. The rotation B is common to all segments and fits best: Kabsch's solution
    for the translations and rotation vectors. So neither a constant rotation between camera and
    ground truth nor the start of the path changes the errors. (The KITTI benchmark's errors contain
    that rotation.) The errors are NaN if the path is shorter.
    """
    estimated, true = _as_paths(estimated, true)
    along = travelled(true)
    last = np.searchsorted(along, along + RELATIVE_LENGTH)
    first = np.flatnonzero(last < len(true))
    if not len(first):
        return {"translation_percent": np.nan, "rotation_deg_per_100m": np.nan}
    motion = _motions(estimated, first, last[first])
    true_motion = _motions(true, first, last[first])
    vectors, true_vectors = _motion_vectors(motion), _motion_vectors(true_motion)
    moments = true_vectors.T @ vectors
    # The small multiple of the identity keeps a rotation zero that a straight path does not
    # determine.
    small = 1e-6 * np.trace(true_vectors.T @ true_vectors)
    left, _, right = np.linalg.svd(moments + small * np.eye(3))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    offsets = np.linalg.norm(true_motion[:, :3, 3] - motion[:, :3, 3] @ turn.T, axis=1)
    differences = true_motion[:, :3, :3].swapaxes(1, 2) @ turn @ motion[:, :3, :3] @ turn.T
    angle = np.linalg.norm(Rotation.from_matrix(differences).as_rotvec(), axis=1)
    return {
        "translation_percent": float(offsets.mean() / RELATIVE_LENGTH * 100),
        "rotation_deg_per_100m": float(np.degrees(angle.mean()) / RELATIVE_LENGTH * 100),
    }


def _motion_vectors(motions: np.ndarray) -> np.ndarray:
    """Translations and rotation vectors (2 n, 3) of motions (n, 4, 4).

    The rotation vectors, radians, are multiplied by RELATIVE_LENGTH, so that both weigh alike.
    """
    rotations = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    return np.concatenate([motions[:, :3, 3], RELATIVE_LENGTH * rotations])


def errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Errors of one run: {rmse, mae, se3, translation_percent, rotation_deg_per_100m}.

    rmse, mae: metres. se3: RMSE in metres after the best rotation and shift. The other two are
    those of `relative_errors`. NaN if the path is too short or too straight.
    """
    return {
        "rmse": rmse(estimated, true),
        "mae": mae(estimated, true),
        "se3": ate(estimated, true, "se3"),
        **relative_errors(estimated, true),
    }


MIN_DIRECTED_STEP = 0.25  # metres; the direction of a shorter step is mostly noise
FAILED_ROTATION = 2.0  # degrees; a step with a larger rotation error has failed
TURN_RATE, STRAIGHT_RATE = 1.0, 0.3  # degrees a frame: more is a turn, less is a straight


def step_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Errors of single steps of two camera-to-world paths, (n, 4, 4) each.

    Earlier errors do not add up.

    rotation: mean angle between estimated and true rotation, degrees a frame. in_turns,
    on_straights: the same for steps that turn by more than TURN_RATE, and by less than
    STRAIGHT_RATE. The other errors are computed from steps of MIN_DIRECTED_STEP or more. direction:
    median angle between estimated and true direction of motion, degrees. across, down: median
    difference to the right and downwards, degrees (audit row 30). failed: percent of steps with a
    rotation error above FAILED_ROTATION or a backward motion. steps: their number.

    lost: 1 if a step of any length is estimated to turn by more than MAX_TURN, which a car cannot
    do, and this is wrong by more than FAILED_ROTATION; otherwise 0. Such a turn is often a flip by
    180 degrees at walking pace, which `failed` does not see.
    """
    every = slice(None, -1), slice(1, None)
    steps, true_steps = _motions(estimated, *every), _motions(true, *every)
    rotation_error = angles(np.linalg.inv(true_steps) @ steps)
    turn = angles(true_steps)
    impossible = (angles(steps) > MAX_TURN) & (rotation_error > FAILED_ROTATION)
    directed = _length(true_steps) >= MIN_DIRECTED_STEP
    heading = _directions(steps[directed, :3, 3])
    true_heading = _directions(true_steps[directed, :3, 3])
    cosine = np.clip((heading * true_heading).sum(axis=1), -1, 1)
    direction, offset = np.nan, np.full(3, np.nan)
    if directed.any():
        direction = np.degrees(np.median(np.arccos(cosine)))
        offset = np.degrees(np.median(heading - true_heading, axis=0))
    return {
        "rotation": rotation_error.mean(),
        "in_turns": _mean(rotation_error[turn > TURN_RATE]),
        "on_straights": _mean(rotation_error[turn < STRAIGHT_RATE]),
        "direction": direction,
        "across": offset[0],
        "down": offset[1],
        "failed": 100 * _mean((rotation_error[directed] > FAILED_ROTATION) | (cosine < 0)),
        "steps": int(directed.sum()),
        "lost": int(impossible.any()),
    }


def _motions(poses: np.ndarray, first: Any, last: Any) -> np.ndarray:
    """Motions (m, 4, 4) between poses (n, 4, 4) with indices (m,) or slices of as many."""
    return np.linalg.inv(poses[first]) @ poses[last]


def _length(steps: np.ndarray) -> np.ndarray:
    """Lengths of steps (n, 4, 4), metres."""
    return np.linalg.norm(steps[:, :3, 3], axis=1)


def _directions(shifts: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) in the directions of shifts (n, 3); zero for no shift."""
    lengths = np.linalg.norm(shifts, axis=1, keepdims=True)
    return shifts / np.maximum(lengths, 1e-12)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else np.nan


def travelled(poses: np.ndarray) -> np.ndarray:
    """Length of a path (n, 4, 4) up to each pose, (n,), metres."""
    lengths = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(lengths)])


def angles(rotations: np.ndarray) -> np.ndarray:
    """Rotation angles in degrees of rotations (..., 3, 3) or poses (..., 4, 4).

    They are the lengths of the rotation vectors. The arccosine of the trace would be wrong by up to
    0.03 degrees for small angles, because it is flat there.
    """
    return np.degrees(Rotation.from_matrix(rotations[..., :3, :3]).magnitude())


KITTI_LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)  # metres
KITTI_EVERY = 10  # frames between the starts of segments


def kitti_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Errors of the KITTI odometry benchmark: {t_rel, r_rel}.

    t_rel: translation error, percent. r_rel: rotation error, degrees per 100 m. The errors are
    means over segments. At every tenth frame, one segment for each of KITTI_LENGTHS starts. It ends
    at the first frame that is more than this length of true path away. NaN if the path is too
    short.
    """
    estimated, true = _as_paths(estimated, true)
    along = travelled(true)
    starts = np.arange(0, len(true), KITTI_EVERY)
    first = np.repeat(starts, len(KITTI_LENGTHS))
    length = np.tile(KITTI_LENGTHS, len(starts))
    last = np.searchsorted(along, along[first] + length, side="right")
    fits = last < len(true)
    first, last, length = first[fits], last[fits], length[fits]
    if not len(first):
        return {"t_rel": np.nan, "r_rel": np.nan}
    error = np.linalg.inv(_motions(estimated, first, last)) @ _motions(true, first, last)
    return {
        "t_rel": float(100 * (_length(error) / length).mean()),
        "r_rel": float(100 * (angles(error) / length).mean()),
    }
