"""Trajectory files: poses in the formats of KITTI, TUM and EuRoC, and times."""

import io
from pathlib import Path

import numpy as np

from thesis_repro.data.geometry import are_poses
from thesis_repro.errors import InputError
from thesis_repro.running.files import write_text

QUATERNION_TOLERANCE = 0.01  # of their length; files have few digits
WITHIN = 0.01  # seconds between a frame and its pose, evo's limit; TUM's own tool takes 0.02


def read_text(path: str | Path) -> str:
    """Text of a file. Raises InputError if it cannot be read, or is not UTF-8."""
    try:
        # some editors begin a file with a byte order mark
        return Path(path).read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read: {reason}") from None


def read_line(path: str | Path, key: str, count: int, form: str = "") -> np.ndarray:
    """Numbers, (count,), of a file's first line that begins with a key, such as "P0:".

    form: what is said of them beside. Raises InputError unless they are `count` finite numbers.
    """
    wanted = f"must hold a line '{key}' of {count} finite numbers{form}"
    try:
        lines = [line for line in read_text(path).splitlines() if line.startswith(key)]
        numbers = np.array(lines[0].removeprefix(key).split(), np.float64)
    except InputError as error:
        raise InputError(f"{error}; it {wanted}") from None
    except (ValueError, IndexError):
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise InputError(f"{path}: {wanted}")
    return numbers


def _read_numbers(path: str | Path, *columns: int) -> tuple[np.ndarray, list[int]]:
    """Return the numbers of a file, (n, columns), and the number of the line of each row.

    columns: their possible numbers, the same one in each line. Empty lines are skipped.
    """
    form = f"must hold {columns[0]} finite numbers a line, one line a frame"
    rows, line_numbers = [], []
    for number, line in enumerate(read_text(path).split("\n"), 1):
        if not line.strip():
            continue
        try:
            row = np.array(line.split(), np.float64)
        except ValueError:
            row = np.empty(0)
        if len(row) not in columns or not np.isfinite(row).all():
            raise InputError(f"{path}, line {number}: {form}")
        columns = (len(row),)
        rows.append(row)
        line_numbers.append(number)
    if not rows:
        raise InputError(f"{path}: {form}")
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
    """Camera-to-world poses, (n, 4, 4), metres, from 12 or 16 numbers a line.

    These are the first three or all four rows of each pose. Raises InputError if a line is not a
    right-handed rotation and a position.
    """
    rows, line_numbers = _read_numbers(path, 12, 16)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses.reshape(-1, 16)[:, : rows.shape[1]] = rows
    bad_rows = np.flatnonzero(~are_poses(poses))
    if len(bad_rows):
        raise InputError(
            f"{path}, line {line_numbers[bad_rows[0]]}: must be a right-handed rotation and a position "
            "in metres"
        )
    return poses


def read_truth(
    path: Path, times: np.ndarray | None, within: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Read a file of poses in any of the formats.

    times: of the frames, (n,), seconds; None if nobody stated them. Returns as `read_poses_at`;
    without times in the file, None and a pose a line. Raises InputError for a file with times and
    frames without.
    """
    if not have_times(path):
        return None, read_poses(path)
    if times is None:
        raise InputError(
            f"{path}: belongs to the frames by its times, but nothing states those of the frames; give their "
            "number a second (--fps), or write times.txt, seconds, a line a frame"
        )
    return read_poses_at(path, times, within)


def have_times(path: Path) -> bool:
    """Whether the poses of a file have times: in EuRoC's format (.csv), or in TUM's."""
    lines = [line for line in read_text(path).splitlines() if line.strip() and line[0] != "#"]
    return path.suffix == ".csv" or bool(lines and len(lines[0].split()) == 8)


def read_poses_at(
    path: Path, times: np.ndarray, within: float = WITHIN
) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the frames at times (n,), seconds, from a file in TUM's or EuRoC's format.

    A frame has the pose that is nearest in time, as evo associates them, and each pose is that of
    one frame. within: largest difference, seconds. Returns the indices of the frames that have a
    pose, (m,), and their poses, (m, 4, 4). Raises InputError if there are none, or for a malformed
    file.
    """
    # these take 0.4 s to load
    from evo import EvoException
    from evo.core.sync import SyncException, associate_trajectories
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools import file_interface

    nowhere = np.zeros((len(times), 3)), np.tile([1.0, 0, 0, 0], (len(times), 1))
    frames = PoseTrajectory3D(*nowhere, times.astype(float))
    lines = [" ".join(line.split()) for line in read_text(path).splitlines()]
    file = io.StringIO("\n".join(filter(None, lines)))
    read = file_interface.read_tum_trajectory_file
    if path.suffix == ".csv":
        read = file_interface.read_euroc_csv_trajectory
    try:
        truth = read(file)
        frames, truth = associate_trajectories(frames, truth, max_diff=within)
    except SyncException:
        ends = [f"{each[0]:.15g} to {each[-1]:.15g}" for each in (truth.timestamps, times)]
        raise InputError(
            f"{path}: no pose is within {within:g} s of a frame; its poses have the times {ends[0]}, the frames "
            f"{ends[1]}, seconds"
        ) from None
    except (EvoException, ValueError) as error:
        raise InputError(f"{path}: {error}") from None
    poses = np.array(truth.poses_se3)
    norms = np.linalg.norm(truth.orientations_quat_wxyz, axis=1)
    if not are_poses(poses).all() or not np.allclose(norms, 1, atol=QUATERNION_TOLERANCE):
        raise InputError(
            f"{path}: must hold finite positions and quaternions of length 1, not of {norms.min():g} to "
            f"{norms.max():g}"
        )
    # evo gives a frame several poses where these are fewer than the frames, but closer together
    nearest = np.abs(frames.timestamps - truth.timestamps).argsort(kind="stable")
    for stamps in (frames.timestamps, truth.timestamps):
        nearest = nearest[np.sort(np.unique(stamps[nearest], return_index=True)[1])]
    nearest = nearest[frames.timestamps[nearest].argsort()]
    return np.searchsorted(times, frames.timestamps[nearest]), poses[nearest]


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
