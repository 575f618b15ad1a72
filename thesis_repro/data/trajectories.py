"""Trajectory files: reads and writes poses in the formats of KITTI and TUM, and reads times."""

import warnings
from pathlib import Path

import numpy as np

from thesis_repro.errors import InputError
from thesis_repro.running.files import write_text

MAX_POSITION = 1e9  # metres
ROTATION_TOLERANCE = 1e-3  # largest entry of R R^T - I; pose files have few digits
QUATERNION_TOLERANCE = 0.01  # of its length; files have few digits
MAX_DIFFERENCE = 0.01  # seconds between a pose and its frame, evo's default
# Matched poses of a file with times: least share of those within the common time, and of all. A
# file of keyframes may cover more frames than an excerpt has.
MIN_MATCHED = 0.3, 0.1


def _read_numbers(path: str | Path, columns: int, comments: str | None = None) -> np.ndarray:
    try:
        # some editors begin a file with a byte order mark
        with open(path, encoding="utf-8-sig") as file, warnings.catch_warnings(action="ignore"):
            rows = np.loadtxt(file, np.float64, comments=comments, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        ) from None
    if not rows.size or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise InputError(f"{path}: must hold {columns} finite numbers a line, one line a frame")
    return rows


def read_times(path: str | Path) -> np.ndarray:
    """Times of the frames, (n,), seconds, one a line. Raises InputError unless they increase."""
    times = _read_numbers(path, 1)[:, 0]
    _check_increase(path, times)
    return times


def _check_increase(path: str | Path, times: np.ndarray) -> None:
    steps_back = np.flatnonzero(np.diff(times) <= 0)
    if len(steps_back):
        raise InputError(
            f"{path}, line {steps_back[0] + 2}: time does not increase; mend or remove the file"
        )


def read_poses(path: str | Path) -> np.ndarray:
    """Camera-to-world poses, (n, 4, 4), metres, from 12 numbers a line: the first three rows of
    each pose.

    Raises InputError if a line is not a right-handed rotation and a position.
    """
    rows = _read_numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    bad_lines = np.flatnonzero(~are_poses(poses))
    if len(bad_lines):
        raise InputError(
            f"{path}, line {bad_lines[0] + 1}: must be a right-handed rotation and a position in metres"
        )
    return poses


def are_poses(poses: np.ndarray) -> np.ndarray:
    """Whether each of (n, 4, 4) is a right-handed rotation and a position in metres: (n,)
    booleans.
    """
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        is_rotation = (errors <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0)
    return is_rotation & (np.abs(positions).max(axis=1) <= MAX_POSITION)


def write_kitti_poses(path: str | Path, poses: np.ndarray) -> None:
    """Write poses (n, 4, 4) in KITTI's format: 12 numbers a line, row by row, with all digits."""
    _write_rows(path, np.asarray(poses)[:, :3].reshape(-1, 12))


def write_tum(path: str | Path, poses: np.ndarray, times: np.ndarray) -> None:
    """Write poses (n, 4, 4) and times (n,), seconds, in TUM's format: time, position,
    quaternion (x, y, z, w).
    """
    # takes 0.4 s to load, and every command loads this module
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(np.asarray(poses)[:, :3, :3]).as_quat(canonical=True)
    _write_rows(path, np.column_stack([times, np.asarray(poses)[:, :3, 3], quaternions]))


def read_tum(
    path: str | Path, times: np.ndarray, offset: float = 0.0, max_difference: float = MAX_DIFFERENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Read a file in TUM's format and match its poses to the frames' times (n,), seconds, with evo.

    offset: seconds, added to the file's times. max_difference: seconds between a pose and its
    frame. Returns the indices of the matched frames, (m,), and their poses, (m, 4, 4). Raises
    InputError for a line without a time after the line before, a position in metres and a unit
    quaternion, and if too few poses are matched (MIN_MATCHED), as with another unit of time.
    """
    from evo.core.sync import matching_time_indices  # takes 0.4 s to load
    from evo.core.trajectory import PoseTrajectory3D

    rows = _read_numbers(path, 8, "#")
    _check_increase(path, rows[:, 0])
    bad_lines = np.flatnonzero(
        (np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) > QUATERNION_TOLERANCE)
        | (np.abs(rows[:, 1:4]).max(axis=1) > MAX_POSITION)
    )
    if len(bad_lines):
        raise InputError(
            f"{path}, pose {bad_lines[0] + 1}: must be a time, a position in metres and a unit "
            "quaternion (x, y, z, w)"
        )
    trajectory = PoseTrajectory3D(rows[:, 1:4], np.roll(rows[:, 4:], 1, axis=1), rows[:, 0])
    rows[:, 0] += offset
    numbers, nearest = matching_time_indices(times, rows[:, 0], max_difference)
    # how many of the one lie within the time of the other
    shared = min(
        np.count_nonzero((values >= others[0]) & (values <= others[-1]))
        for values, others in ((times, rows[:, 0]), (rows[:, 0], times))
    )
    least = max(2, MIN_MATCHED[0] * shared, MIN_MATCHED[1] * min(len(rows), len(times)))
    if len(numbers) < least:
        raise InputError(
            f"{path}: {len(numbers)} of {len(rows)} poses are at the time of a frame, "
            f"{times[0]:g} to {times[-1]:g} s; its times are {rows[0, 0]:.10g} to {rows[-1, 0]:.10g}; "
            f"--t_offset {offset + times[0] - rows[0, 0]:.15g} takes its first pose for the first frame"
        )
    return np.array(numbers), np.array(trajectory.poses_se3)[nearest]


def _write_rows(path: str | Path, rows: np.ndarray) -> None:
    write_text(path, "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows))
