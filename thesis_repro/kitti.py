"""KITTI odometry: the frames, camera, times and true poses of a sequence, and files of trajectories."""

import warnings
from collections import namedtuple
from collections.abc import Iterator
from copy import copy
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from statistics import median_low

import numpy as np

from thesis_repro import InputError
from thesis_repro.files import images, numbers_of, read_gray, write_text

# Intrinsics in pixels at the stated image size (Section 3.7.2); KITTI's gray images have no distortion.
Camera = namedtuple("Camera", "width height fx fy cx cy")
_CAMERA_00 = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
_CAMERA_03 = Camera(1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
_CAMERA_04 = Camera(1226, 370, 707.0912, 707.0912, 601.8873, 183.1104)
CAMERAS = {"00": _CAMERA_00, "01": _CAMERA_00, "02": _CAMERA_00, "03": _CAMERA_03,
           **{f"{n:02d}": _CAMERA_04 for n in range(4, 11)}}

# Numbers of frames of the complete sequences with ground truth.
FRAME_COUNTS = dict(zip(CAMERAS, (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201), strict=True))

IMAGE_FOLDERS = ("image_0", "image_2", "image_1", "image_3")  # left gray, left colour, then the right ones
MIN_FRAME_SIDE = 16  # pixels; keypoints cannot be tracked in smaller frames
MAX_MISSING_NAMED = 10_000  # frames
MAX_SPEED = 10_000  # metres a second
MAX_POSITION = 1e9  # metres
ROTATION_TOLERANCE = 1e-3  # largest difference of R R^T from the identity; files have few digits
FRAME_TIME = 0.1  # seconds between the frames of KITTI, and of a sequence without times.txt


def sequences(root: str | Path) -> list[str]:
    """Sorted names of the sequences that have frames and true poses. Raises InputError if there are none.

    00 to 10 are listed even without poses, so that `Sequence` reports the missing file.
    """
    names = [name for name in with_frames(root)
             if name in FRAME_COUNTS or (Path(root) / "poses" / f"{name}.txt").is_file()]
    if not names:
        raise InputError(f"{Path(root) / 'sequences'}: no sequence holds frames (image_0 or image_2) and true poses")
    return names


def with_frames(root: str | Path) -> list[str]:
    """Sorted names of all sequences that have frames (KITTI does not publish the poses of 11 to 21).

    Raises InputError for a folder of another layout.
    """
    root = Path(root)
    if not (root / "sequences").is_dir():
        raise InputError(f"{root}: must be the folder that holds sequences/NN/image_0 and poses/NN.txt")
    return sorted(folder.name for folder in (root / "sequences").iterdir()
                  if folder.is_dir() and (images_of(folder).name in IMAGE_FOLDERS or images(folder)))


def images_of(folder: str | Path, camera: str | None = None) -> Path:
    """The folder of a sequence's frames: `camera`, or by default the first of IMAGE_FOLDERS that exists, or else the
    sequence's folder itself. Raises InputError for an unknown camera and for a missing folder.
    """
    if camera is not None and camera not in IMAGE_FOLDERS:
        raise InputError(f"camera {camera!r}: unknown; choose one of {', '.join(sorted(IMAGE_FOLDERS))}")
    candidates = [Path(folder) / name for name in ([camera] if camera else IMAGE_FOLDERS)]
    where = next((path for path in candidates if path.is_dir()), candidates[0] if camera else Path(folder))
    if not where.is_dir():
        raise InputError(f"{where}: no such folder; the frames must be there")
    return where


class Sequence:
    """One odometry sequence in the official layout: sequences/NN/image_0, calib.txt, times.txt and poses/NN.txt.

    Frames are PNG or JPEG, numbered without gaps; colour is read as gray. Without times.txt, `times` assumes ten frames
    a second, as KITTI has. Without a file of poses, `has_truth` is False. (The true poses are those of the camera of
    image_0, which is 6 cm beside that of image_2.) Everything except the frames is read and checked on creation.
    Raises InputError, naming the file, if something is missing or malformed.
    """

    def __init__(self, root: str | Path | None, name: str | Path, camera: str | None = None,
                 speed: float | None = None) -> None:
        """root: folder that holds sequences and poses. name: of the sequence, "06" or "6".

        For a sequence outside of KITTI, root is None and name is its folder, with calib.txt, the frames (in image_0 or
        in the folder itself) and optionally times.txt and poses.txt.
        camera: one of IMAGE_FOLDERS, see `images_of`. speed: metres a second, for a sequence without true poses; by
        default one metre a frame is assumed.
        """
        self.root, self.folder, self.poses_path = _places(root, name)
        self.name, self.speed = self.folder.name, speed
        where = images_of(self.folder, camera)
        self.frame_paths = images(where)
        if not self.frame_paths:
            raise InputError(f"{where}: holds no PNG or JPEG frames")
        check_numbering(self.frame_paths)
        self.intrinsics = read_intrinsics(self.folder / "calib.txt", where.name)
        times = self.folder / "times.txt"
        self.has_times = times.is_file()
        self.times = read_times(times) if self.has_times else FRAME_TIME * np.arange(len(self))
        check_count(times, len(self.times), self.frame_paths)
        self.has_truth = self.poses_path.is_file()
        if self.has_truth:
            self._poses = read_poses(self.poses_path)
            check_count(self.poses_path, len(self._poses), self.frame_paths)
        if speed is not None and (self.has_truth or not self.has_times or not 0 < speed <= MAX_SPEED):
            raise InputError(f"speed {speed}: must be above 0 and at most {MAX_SPEED} m/s, and needs {times} and no "
                             f"{self.poses_path}, from which steps would be taken")

    @property
    def poses(self) -> np.ndarray:
        """True camera-to-world poses, (n, 4, 4), metres. Raises InputError if there are none."""
        if not self.has_truth:
            raise InputError(f"{self.poses_path}: no such file; true poses are needed")
        return self._poses

    @property
    def assumed_steps(self) -> np.ndarray:
        """Step lengths without true poses, metres, (n,): from the speed, or 1; 0 for the first frame."""
        steps = np.ones(len(self) - 1) if self.speed is None else self.speed * np.diff(self.times)
        return np.concatenate([[0.0], steps])

    @property
    def files(self) -> list[Path]:
        """All files of the sequence: frames, calibration, and times and true poses if they exist."""
        texts = self.folder / "calib.txt", self.folder / "times.txt", self.poses_path
        return [*self.frame_paths, *filter(Path.is_file, texts)]

    @property
    def label_names(self) -> list[str]:
        """File names of the label maps and masks: those of the frames, always with the ending .png."""
        return [f"{path.stem}.png" for path in self.frame_paths]

    def __len__(self) -> int:
        return len(self.frame_paths)

    def __repr__(self) -> str:
        return f"Sequence({str(self.root)!r}, {self.name!r}): {len(self)} frames"

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) of all frames, from the first one. Raises InputError as `check_camera` does."""
        size = read_gray(self.frame_paths[0]).shape
        check_camera(self.folder / "calib.txt", self.intrinsics, self.frame_paths[0], size)
        return size

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width). Raises InputError if unreadable or of another size."""
        image = read_gray(self.frame_paths[index])
        check_size(self.frame_paths[index], image.shape, self.size)
        return image

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames in order."""
        for index in range(len(self)):
            yield self.frame(index)

    def subset(self, count: int | None) -> "Sequence":
        """A copy with the first `count` frames only; None for all."""
        short = copy(self)
        short.frame_paths, short.times = self.frame_paths[:count], self.times[:count]
        if self.has_truth:
            short._poses = self._poses[:count]
        return short


def _places(root, name):
    """(root, folder, file of true poses) of a sequence; arguments as in Sequence."""
    if root is None:
        folder = Path(name).resolve()
        if folder.parent.name != "sequences":
            return folder.parent, folder, folder / "poses.txt"
        root, name = folder.parent.parent, folder.name  # a folder in KITTI's layout
    root, name = Path(root), str(name)
    if name in ("", ".", "..") or "/" in name:
        raise InputError(f"sequence {name!r}: must be the name of a folder in {root / 'sequences'}, such as 00")
    if name.isdigit() and not (root / "sequences" / name).is_dir():
        name = name.zfill(2)
    return root, root / "sequences" / name, root / "poses" / f"{name}.txt"


def name_of(root: str | Path, name: str) -> str:
    """The full name of a sequence, "06" for "6", under which its results are stored."""
    return _places(root, name)[1].name


def true_path(root: str | Path | None, name: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """True poses of a sequence, (n, 4, 4), and their times, (n,), seconds. The frames are not needed.

    root, name: as in Sequence. Without times.txt ten frames a second are assumed.
    """
    _, folder, path = _places(root, name)
    poses, times = read_poses(path), folder / "times.txt"
    return poses, read_times(times) if times.is_file() else FRAME_TIME * np.arange(len(poses))


def check_numbering(paths: list[Path]) -> None:
    """Raise InputError if two frames have the same number, or if one is missing in a series that counts by one.

    Names that do not count by one (every fifth frame, or times) are accepted.
    """
    for (before, first), (after, second) in pairwise(zip(numbers_of(paths) or [], paths)):
        if before == after:
            raise InputError(f"{second}: has the number of {first.name}; take one of them away")
    missing = missing_frames(paths)
    if missing:
        raise InputError(f"{missing[0]}: this frame is missing; the odometry needs every one")


def missing_frames(paths: list[Path], count: int | None = None) -> list[Path]:
    """Missing files of frames that count by one, at most MAX_MISSING_NAMED.

    count: the expected number of frames, if known. Then frames before the first and after the last are missing, too;
    numbers start at 0 (as in KITTI), at 1, or at the first of `paths`.
    """
    numbers = numbers_of(paths)
    steps = [after - before for before, after in pairwise(numbers or [])]
    if not numbers or steps and median_low(steps) != 1 or count is None and len(steps) < 2:
        return []
    first, end, there = numbers[0], numbers[-1] + 1, set(numbers)
    if count is not None:
        first = next((start for start in (0, 1) if start <= first and end <= start + count), first)
        end = max(end, first + count)
    missing = list(islice((number for number in range(first, end) if number not in there), MAX_MISSING_NAMED))
    stem = paths[0].stem.rstrip("0123456789")
    digits = min(len(path.stem) for path in paths) - len(stem)
    return [paths[0].with_name(f"{stem}{number:0{digits}d}{paths[0].suffix}") for number in missing]


def check_count(path: Path, count: int, frame_paths: list[Path]) -> None:
    """Raise InputError unless a file has one line a frame."""
    if count != len(frame_paths):
        missing = missing_frames(frame_paths, max(count, len(frame_paths)))
        first = f" (the first missing: {missing[0].name})" if missing else ""
        raise InputError(f"{path}: {count} lines for {len(frame_paths)} frames{first}; one line a frame is needed")


def check_size(path: Path, size: tuple[int, ...], wanted: tuple[int, int], of: str = "the first frame") -> None:
    """Raise InputError if an image has another (height, width) than `of`, the image named."""
    if size != wanted:
        raise InputError(f"{path}: {size[1]}x{size[0]} pixels; {of} has {wanted[1]}x{wanted[0]}")


def _read_numbers(path, columns):
    try:
        with open(path, encoding="utf-8") as file, warnings.catch_warnings(action="ignore"):
            rows = np.loadtxt(file, np.float64, comments=None, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not rows.size or rows.shape[1] != columns or not np.isfinite(rows).all():
        raise InputError(f"{path}: must hold {columns} finite numbers a line, one line a frame")
    return rows


def read_intrinsics(path: str | Path, camera: str = "image_0") -> np.ndarray:
    """The camera matrix (Equation 2.4), (3, 3), pixels: the first three columns of P0, or of another camera's P.

    Raises InputError if the file does not hold it, or if it is not that of a camera without distortion and skew.
    """
    key = f"P{camera[-1]}" if camera in IMAGE_FOLDERS else "P0"
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
        matrix = np.array([line[3:].split() for line in lines if line.startswith(f"{key}:")][0], np.float64)
        matrix = matrix.reshape(3, 4)[:, :3]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, IndexError):
        matrix = np.zeros((3, 3))
    (fx, _, u), (_, fy, v), _ = matrix
    plain = np.array([[fx, 0, u], [0, fy, v], [0, 0, 1]])
    if min(fx, fy) <= 0 or not np.isfinite(matrix).all() or not np.array_equal(matrix, plain):
        raise InputError(f"{path}: must hold a line '{key}: f 0 u 0 0 f v 0 0 0 1 0' of a camera without distortion")
    return matrix


def check_camera(path: Path, intrinsics: np.ndarray, frame: Path, size: tuple[int, int]) -> None:
    """Raise InputError if a camera matrix does not fit frames of (height, width), or if these are too small."""
    height, width = size
    if min(size) < MIN_FRAME_SIDE:
        raise InputError(f"{frame}: {width}x{height} pixels; a side needs {MIN_FRAME_SIDE} or more")
    (fx, _, u), (_, fy, v), _ = intrinsics
    if not (0 <= u <= width and 0 <= v <= height and all(width / 100 < focal < width * 100 for focal in (fx, fy))):
        raise InputError(f"{path}: focal lengths {fx:g}, {fy:g} and centre {u:g}, {v:g} do not fit frames of "
                         f"{width}x{height} pixels")


def read_times(path: str | Path) -> np.ndarray:
    """Times of the frames, (n,), seconds, from one number a line. Raises InputError unless they increase."""
    times = _read_numbers(path, 1)[:, 0]
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise InputError(f"{path}, line {late[0] + 2}: time does not increase; mend or remove the file")
    return times


def read_poses(path: str | Path) -> np.ndarray:
    """Camera-to-world poses, (n, 4, 4), metres, from 12 numbers a line: the first three rows of each pose.

    Raises InputError if a line is not a right-handed rotation and a position.
    """
    rows = _read_numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    rotations, positions = poses[:, :3, :3], poses[:, :3, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        right = (errors <= ROTATION_TOLERANCE) & (np.linalg.det(rotations) > 0)
    wrong = np.flatnonzero(~right | (np.abs(positions).max(axis=1) > MAX_POSITION))
    if len(wrong):
        raise InputError(f"{path}, line {wrong[0] + 1}: must be a right-handed rotation and a position in metres")
    return poses


def write_kitti_poses(path: str | Path, poses: np.ndarray) -> None:
    """Write (n, 4, 4) poses in KITTI's form: 12 numbers a line, row by row, with all digits."""
    _write_rows(path, np.asarray(poses)[:, :3].reshape(-1, 12))


def write_tum(path: str | Path, poses: np.ndarray, times: np.ndarray) -> None:
    """Write (n, 4, 4) poses and their times (n,), seconds, in TUM's form: time, position, quaternion (x, y, z, w)."""
    from scipy.spatial.transform import Rotation  # takes 0.4 s to load, and every command loads this module

    quaternions = Rotation.from_matrix(np.asarray(poses)[:, :3, :3]).as_quat(canonical=True)
    _write_rows(path, np.column_stack([times, np.asarray(poses)[:, :3, 3], quaternions]))


def read_tum(path: str | Path, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a file in TUM's form, matched to the times (n,), seconds, of frames as evo does.

    Returns the indices of the matched times, (m,), and their poses, (m, 4, 4). Raises InputError for fewer than two.
    """
    from evo import EvoException  # takes 0.4 s to load, as above
    from evo.core.sync import matching_time_indices
    from evo.tools import file_interface

    try:
        trajectory = file_interface.read_tum_trajectory_file(path)
    except EvoException as error:
        raise InputError(f"{path}: {error}") from None
    numbers, nearest = matching_time_indices(times, trajectory.timestamps)
    poses = np.array(trajectory.poses_se3)[nearest]
    if len(poses) < 2 or not np.isfinite(poses).all():
        raise InputError(f"{path}: {len(poses)} poses at the times of frames, {times[0]:g} to {times[-1]:g} s; two or "
                         "more finite ones are needed")
    return np.array(numbers), poses


def _write_rows(path, rows):
    write_text(path, "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows))
