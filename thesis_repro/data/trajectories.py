"""Trajectory files: reads and writes poses in the formats of KITTI and TUM, and reads times."""

import warnings
from collections.abc import Iterable
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


def _read_numbers(
    path: str | Path, columns: int, comments: str | None = None
) -> tuple[np.ndarray, list[int]]:
    """Return the numbers of a file, (n, columns), and the number of the line of each row.

    Empty lines are skipped, and what follows the sign of a comment.
    """
    try:
        # some editors begin a file with a byte order mark
        with open(path, encoding="utf-8-sig") as file:
            lines = filled_lines(file, comments)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read: {reason}") from None
    rows = _parsed(list(lines.values()), columns)
    if rows is not None:
        return rows, list(lines)
    place = ""
    for number, line in lines.items():
        if _parsed([line], columns) is None:
            place = f", line {number}"
            break
    raise InputError(f"{path}{place}: must hold {columns} finite numbers a line, one line a frame")


def filled_lines(file: Iterable[str], comments: str | None = None) -> dict[int, str]:
    """Return {number: line} of the lines that are not empty, without comments.

    comments: the sign with which a comment begins. Lines count from 1, as in an editor.
    """
    lines = {}
    for number, line in enumerate(file, 1):
        if comments is not None:
            line = line.partition(comments)[0]
        if line.strip():
            lines[number] = line
    return lines


def _parsed(lines: list[str], columns: int) -> np.ndarray | None:
    """Return the numbers in lines, (n, columns), or None if there are others than asked for."""
    try:
        with warnings.catch_warnings(action="ignore"):
            rows = np.loadtxt(lines, np.float64, comments=None, ndmin=2)
    except ValueError:
        return None
    if not rows.size or rows.shape[1] != columns or not np.isfinite(rows).all():
        return None
    return rows


def read_times(path: str | Path) -> np.ndarray:
    """Times of the frames, (n,), seconds, one a line. Raises InputError unless they increase."""
    rows, line_numbers = _read_numbers(path, 1)
    _check_increase(path, rows[:, 0], line_numbers)
    return rows[:, 0]


def _check_increase(path: str | Path, times: np.ndarray, line_numbers: list[int]) -> None:
    steps_back = np.flatnonzero(np.diff(times) <= 0)
    if len(steps_back):
        raise InputError(
            f"{path}, line {line_numbers[steps_back[0] + 1]}: time does not increase; mend or remove "
            "the file"
        )


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
        is_orthogonal = errors <= ROTATION_TOLERANCE
        is_right_handed = np.linalg.det(rotations) > 0
    is_near = np.abs(positions).max(axis=1) <= MAX_POSITION
    return is_orthogonal & is_right_handed & is_near


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


def read_tum(
    path: str | Path, times: np.ndarray, offset: float = 0.0, max_difference: float = MAX_DIFFERENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Read a file in TUM's format and match its poses to the frames with evo.

    times: of the frames, (n,), seconds. offset: seconds, added to the file's times. max_difference:
    seconds between a pose and its frame. Returns the indices of the matched frames, (m,), and their
    poses, (m, 4, 4). Raises InputError for a line without a time after the line before, a position
    in metres and a unit quaternion, and if too few poses are matched (MIN_MATCHED), as with another
    unit of time.
    """
    from evo.core.sync import matching_time_indices  # takes 0.4 s to load
    from evo.core.trajectory import PoseTrajectory3D

    rows, line_numbers = _read_numbers(path, 8, "#")
    stamps, positions, quaternions = rows[:, 0], rows[:, 1:4], rows[:, 4:]
    _check_increase(path, stamps, line_numbers)
    is_far = np.abs(positions).max(axis=1) > MAX_POSITION
    lengths = np.linalg.norm(quaternions, axis=1)
    is_no_unit = np.abs(lengths - 1) > QUATERNION_TOLERANCE
    bad_rows = np.flatnonzero(is_far | is_no_unit)
    if len(bad_rows):
        raise InputError(
            f"{path}, line {line_numbers[bad_rows[0]]}: must be a time, a position in metres and a unit "
            "quaternion (x, y, z, w)"
        )
    w_first = np.roll(quaternions, 1, axis=1)
    poses = np.array(PoseTrajectory3D(positions, w_first, stamps).poses_se3)
    stamps = stamps + offset
    numbers, nearest = matching_time_indices(times, stamps, max_difference)
    if len(numbers) < _least_matched(times, stamps):
        raise InputError(
            f"{path}: {len(numbers)} of {len(rows)} poses are at the time of a frame, "
            f"{times[0]:g} to {times[-1]:g} s; its times are {stamps[0]:.10g} to {stamps[-1]:.10g}; "
            f"--t_offset {offset + times[0] - stamps[0]:.15g} takes its first pose for the first frame"
        )
    return np.array(numbers), poses[nearest]


def _least_matched(times: np.ndarray, stamps: np.ndarray) -> float:
    """Return how many poses of a file with time stamps must match frames at times (MIN_MATCHED)."""
    frames_within = np.count_nonzero((times >= stamps[0]) & (times <= stamps[-1]))
    poses_within = np.count_nonzero((stamps >= times[0]) & (stamps <= times[-1]))
    of_common = MIN_MATCHED[0] * min(frames_within, poses_within)
    of_all = MIN_MATCHED[1] * min(len(stamps), len(times))
    return max(2, of_common, of_all)


def _write_rows(path: str | Path, rows: np.ndarray) -> None:
    lines = [" ".join(map(repr, numbers)) for numbers in rows.astype(float).tolist()]
    write_text(path, "".join(f"{line}\n" for line in lines))
