"""Trajectory files: reads and writes poses in the formats of KITTI and TUM, and reads times."""

import warnings
from pathlib import Path

import numpy as np

from thesis_repro import InputError
from thesis_repro.files import write_text

MAX_POSITION = 1e9  # metres
ROTATION_TOLERANCE = 1e-3  # largest entry of R R^T - I; pose files have few digits


def _read_numbers(path, columns):
    try:
        with open(path, encoding="utf-8") as file, warnings.catch_warnings(action="ignore"):
            rows = np.loadtxt(file, np.float64, comments=None, ndmin=2)
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
    steps_back = np.flatnonzero(np.diff(times) <= 0)
    if len(steps_back):
        raise InputError(
            f"{path}, line {steps_back[0] + 2}: time does not increase; mend or remove the file"
        )
    return times


def read_poses(path: str | Path) -> np.ndarray:
    """Camera-to-world poses, (n, 4, 4), metres, from 12 numbers a line: the first three rows of
    each pose.

    Raises InputError if a line is not a right-handed rotation and a position.
    """
    rows = _read_numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        is_rotation = (errors <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0)
    bad_lines = np.flatnonzero(~is_rotation | (np.abs(positions).max(axis=1) > MAX_POSITION))
    if len(bad_lines):
        raise InputError(
            f"{path}, line {bad_lines[0] + 1}: must be a right-handed rotation and a position in metres"
        )
    return poses


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


def read_tum(path: str | Path, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read a file in TUM's format and match its poses to the frames' times (n,), seconds, with evo.

    Returns the indices of the matched frames, (m,), and their poses, (m, 4, 4). Raises InputError
    if m is below two.
    """
    from evo import EvoException  # takes 0.4 s to load
    from evo.core.sync import matching_time_indices
    from evo.tools import file_interface

    try:
        trajectory = file_interface.read_tum_trajectory_file(path)
    except EvoException as error:
        raise InputError(f"{path}: {error}") from None
    numbers, nearest = matching_time_indices(times, trajectory.timestamps)
    poses = np.array(trajectory.poses_se3)[nearest]
    if len(poses) < 2 or not np.isfinite(poses).all():
        raise InputError(
            f"{path}: {len(poses)} poses at the frames' times, {times[0]:g} to {times[-1]:g} s; at least "
            "two finite poses are needed"
        )
    return np.array(numbers), poses


def _write_rows(path, rows):
    write_text(path, "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows))
