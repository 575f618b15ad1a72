"""Trajectory files: reads and writes poses in the formats of KITTI and TUM, and reads times."""

from pathlib import Path

import numpy as np

from thesis_repro.errors import InputError
from thesis_repro.running.files import write_text

MAX_POSITION = 1e9  # metres
ROTATION_TOLERANCE = 1e-3  # largest entry of R R^T - I; pose files have few digits


def text_of(path: str | Path) -> str:
    """Text of a file. Raises InputError if it cannot be read, or is not UTF-8."""
    try:
        # some editors begin a file with a byte order mark
        return Path(path).read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read: {reason}") from None


def _read_numbers(path: str | Path, columns: int) -> tuple[np.ndarray, list[int]]:
    """Return the numbers of a file, (n, columns), and the number of the line of each row.

    Empty lines are skipped.
    """
    rows, line_numbers = [], []
    for number, line in enumerate(text_of(path).split("\n"), 1):
        if not line.strip():
            continue
        try:
            row = np.array(line.split(), np.float64)
        except ValueError:
            row = np.empty(0)
        if len(row) != columns or not np.isfinite(row).all():
            raise InputError(
                f"{path}, line {number}: must hold {columns} finite numbers a line, one line a frame"
            )
        rows.append(row)
        line_numbers.append(number)
    if not rows:
        raise InputError(f"{path}: must hold {columns} finite numbers a line, one line a frame")
    return np.array(rows), line_numbers


def read_times(path: str | Path) -> np.ndarray:
    """Times of the frames, (n,), seconds, one a line. Raises InputError unless they increase."""
    rows, line_numbers = _read_numbers(path, 1)
    times = rows[:, 0]
    steps_back = np.flatnonzero(np.diff(times) <= 0)
    if len(steps_back):
        raise InputError(
            f"{path}, line {line_numbers[steps_back[0] + 1]}: time does not increase; mend or remove "
            "the file"
        )
    return times


def read_poses(path: str | Path) -> np.ndarray:
    """Camera-to-world poses, (n, 4, 4), metres, from 12 numbers a line.

    These are the first three rows of each pose. Raises InputError if a line is not a right-handed
    rotation and a position.
    """
    rows, line_numbers = _read_numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    bad_rows = np.flatnonzero(~are_poses(poses))
    if len(bad_rows):
        raise InputError(
            f"{path}, line {line_numbers[bad_rows[0]]}: must be a right-handed rotation and a position "
            "in metres"
        )
    return poses


def are_poses(poses: np.ndarray) -> np.ndarray:
    """Whether each of (n, 4, 4) is a right-handed rotation and a position in metres.

    Returns (n,) booleans.
    """
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        products = rotations @ rotations.transpose(0, 2, 1)
        errors = np.abs(products - np.eye(3)).max(axis=(1, 2))
        is_right_handed = np.linalg.det(rotations) > 0
    is_near = np.abs(positions).max(axis=1) <= MAX_POSITION
    return (errors <= ROTATION_TOLERANCE) & is_right_handed & is_near


def write_kitti_poses(path: str | Path, poses: np.ndarray) -> None:
    """Write poses (n, 4, 4) in KITTI's format: 12 numbers a line, row by row, with all digits."""
    _write_rows(path, np.asarray(poses)[:, :3].reshape(-1, 12))


def write_tum(path: str | Path, poses: np.ndarray, times: np.ndarray) -> None:
    """Write poses (n, 4, 4) and times (n,), seconds, in TUM's format.

    A line has the time, the position and the quaternion (x, y, z, w).
    """
    # takes 0.4 s to load, and every command loads this module
    from scipy.spatial.transform import Rotation

    poses = np.asarray(poses)
    positions, rotations = poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3])
    quaternions = rotations.as_quat(canonical=True)
    _write_rows(path, np.column_stack([times, positions, quaternions]))


def _write_rows(path: str | Path, rows: np.ndarray) -> None:
    lines = [" ".join(map(repr, numbers)) for numbers in rows.astype(float).tolist()]
    write_text(path, "".join(f"{line}\n" for line in lines))
