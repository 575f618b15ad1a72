"""KITTI odometry: frames, camera, times and ground truth of a sequence; reads and writes
trajectory files.
"""

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

# Intrinsics in pixels at the stated image size (Section 3.7.2); KITTI's gray images have no
# distortion.
Camera = namedtuple("Camera", "width height fx fy cx cy")
_CAMERA_00 = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
_CAMERA_03 = Camera(1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
_CAMERA_04 = Camera(1226, 370, 707.0912, 707.0912, 601.8873, 183.1104)
CAMERAS = {
    "00": _CAMERA_00,
    "01": _CAMERA_00,
    "02": _CAMERA_00,
    "03": _CAMERA_03,
    **{f"{n:02d}": _CAMERA_04 for n in range(4, 11)},
}

# Number of frames of each complete sequence with ground truth.
FRAME_COUNTS = dict(
    zip(CAMERAS, (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201), strict=True)
)

# left gray, left colour, then the right ones
IMAGE_FOLDERS = ("image_0", "image_2", "image_1", "image_3")
MIN_FRAME_SIDE = 16  # pixels; keypoints cannot be tracked in smaller frames
MAX_MISSING_NAMED = 10_000  # frames
MAX_SPEED = 10_000  # metres a second
MAX_POSITION = 1e9  # metres
ROTATION_TOLERANCE = 1e-3  # largest entry of R R^T - I; pose files have few digits
QUATERNION_TOLERANCE = 0.01  # of its length; files have few digits
# Matched poses of a file with times: least share of those within the common time, and of all. A
# file of keyframes may cover more frames than an excerpt has.
MIN_MATCHED = 0.3, 0.1
FRAME_TIME = 0.1  # seconds between frames, assumed for a sequence without times.txt


def sequences(root: str | Path) -> list[str]:
    """Names of the sequences with frames and ground truth, in sorted order. Raises InputError if
    there are none.

    00 to 10 are listed even without a file of poses, so that `Sequence` reports the missing file.
    """
    names = [
        name
        for name in with_frames(root)
        if name in FRAME_COUNTS or (Path(root) / "poses" / f"{name}.txt").is_file()
    ]
    if not names:
        raise InputError(
            f"{Path(root) / 'sequences'}: no sequence holds frames (image_0 or image_2) and ground truth"
        )
    return names


def with_frames(root: str | Path) -> list[str]:
    """Names of all sequences with frames, in sorted order. (KITTI publishes no ground truth for 11
    to 21.)

    Raises InputError if the folder has another layout.
    """
    root = Path(root)
    if not (root / "sequences").is_dir():
        raise InputError(
            f"{root}: must be the folder that holds sequences/NN/image_0 and poses/NN.txt"
        )
    return sorted(
        folder.name
        for folder in (root / "sequences").iterdir()
        if folder.is_dir() and (images_of(folder).name in IMAGE_FOLDERS or images(folder))
    )


def images_of(folder: str | Path, camera: str | None = None) -> Path:
    """Folder of a sequence's frames. Raises InputError if the camera is unknown or the folder is
    missing.

    The default is the left camera's, gray or else colour. If neither exists, it is the sequence's
    folder itself.
    """
    if camera is not None and camera not in IMAGE_FOLDERS:
        raise InputError(
            f"camera {camera!r}: unknown; choose one of {', '.join(sorted(IMAGE_FOLDERS))}"
        )
    candidates = [Path(folder) / name for name in ([camera] if camera else IMAGE_FOLDERS[:2])]
    frame_folder = next(
        (path for path in candidates if path.is_dir()), candidates[0] if camera else Path(folder)
    )
    if not frame_folder.is_dir():
        raise InputError(f"{frame_folder}: no such folder; it must hold the frames")
    return frame_folder


class Sequence:
    """One odometry sequence in the official layout: sequences/NN/image_0, calib.txt, times.txt and
    poses/NN.txt.

    Frames are PNG or JPEG files, numbered without gaps. Colour frames are read as gray. Without
    times.txt, `times` assumes ten frames a second, as in KITTI. Without a file of poses,
    `has_truth` is False. The ground truth belongs to the camera of image_0; the camera of image_2
    is 6 cm beside it. The constructor reads and checks all files except the frames. Raises
    InputError, naming the file, if a file is missing or malformed.
    """

    def __init__(
        self,
        root: str | Path | None,
        name: str | Path,
        camera: str | None = None,
        speed: float | None = None,
    ) -> None:
        """root: folder that holds sequences and poses. name: the sequence, "06" or "6".

        For a sequence outside of KITTI, root is None and name is a folder. The folder holds
        calib.txt, the frames (in image_0 or in the folder itself) and optionally times.txt and
        poses.txt.
        camera: one of IMAGE_FOLDERS, see `images_of`. speed: metres a second, for a sequence
        without ground truth; the default is one metre a frame.
        """
        self.root, self.folder, self.poses_path = _locate(root, name)
        self.name, self.speed = self.folder.name, speed
        frame_folder = images_of(self.folder, camera)
        self.frame_paths = images(frame_folder)
        if not self.frame_paths:
            raise InputError(
                f"{frame_folder}: holds no PNG or JPEG frames of the left camera, to which the ground "
                "truth belongs (--camera image_1 takes the right one)"
                if images_of(self.folder) == self.folder and (self.folder / "image_1").is_dir()
                else f"{frame_folder}: holds no PNG or JPEG frames"
            )
        check_numbering(self.frame_paths)
        self.intrinsics = read_intrinsics(self.folder / "calib.txt", frame_folder.name)
        times = self.folder / "times.txt"
        self.has_times = times.is_file()
        self.times = read_times(times) if self.has_times else FRAME_TIME * np.arange(len(self))
        check_count(times, len(self.times), self.frame_paths)
        self.has_truth = self.poses_path.is_file()
        if self.has_truth:
            self._poses = read_poses(self.poses_path)
            check_count(self.poses_path, len(self._poses), self.frame_paths)
        if speed is not None and (
            self.has_truth or not self.has_times or not 0 < speed <= MAX_SPEED
        ):
            raise InputError(
                f"speed {speed}: must be above 0 and at most {MAX_SPEED} m/s; needs {times}, and no "
                f"ground truth in {self.poses_path}"
            )

    @property
    def poses(self) -> np.ndarray:
        """Ground truth: camera-to-world poses, (n, 4, 4), metres. Raises InputError if there is
        none.
        """
        if not self.has_truth:
            raise InputError(f"{self.poses_path}: no such file; ground truth is needed")
        return self._poses

    @property
    def assumed_steps(self) -> np.ndarray:
        """Step lengths without ground truth, (n,), metres: from the speed, or 1. The first one
        is 0.
        """
        steps = np.ones(len(self) - 1) if self.speed is None else self.speed * np.diff(self.times)
        return np.concatenate([[0.0], steps])

    @property
    def files(self) -> list[Path]:
        """All files of the sequence: frames and calibration, and the files of times and poses
        if they exist.
        """
        texts = self.folder / "calib.txt", self.folder / "times.txt", self.poses_path
        return [*self.frame_paths, *filter(Path.is_file, texts)]

    @property
    def label_names(self) -> list[str]:
        """File names of label maps and masks: the names of the frames, with the ending .png."""
        return [f"{path.stem}.png" for path in self.frame_paths]

    def __len__(self) -> int:
        return len(self.frame_paths)

    def __repr__(self) -> str:
        return f"Sequence({str(self.root)!r}, {self.name!r}): {len(self)} frames"

    @cached_property
    def size(self) -> tuple[int, int]:
        """Size (height, width) of the first frame. Raises InputError as `check_camera` does."""
        size = read_gray(self.frame_paths[0]).shape
        check_camera(self.folder / "calib.txt", self.intrinsics, self.frame_paths[0], size)
        return size

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width). Raises InputError if it is unreadable
        or has another size.
        """
        image = read_gray(self.frame_paths[index])
        check_size(self.frame_paths[index], image.shape, self.size)
        return image

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames in order."""
        for index in range(len(self)):
            yield self.frame(index)

    def subset(self, count: int | None) -> "Sequence":
        """Copy of the sequence with its first `count` frames; None for all frames."""
        short = copy(self)
        short.frame_paths, short.times = self.frame_paths[:count], self.times[:count]
        if self.has_truth:
            short._poses = self._poses[:count]
        return short


def _locate(root, name):
    """Root, folder and file of poses of a sequence. The arguments are those of Sequence."""
    if root is None:
        folder = Path(name).resolve()
        if folder.parent.name != "sequences":
            return folder.parent, folder, folder / "poses.txt"
        root, name = folder.parent.parent, folder.name  # the folder belongs to a KITTI root
    root, name = Path(root), str(name)
    if name in ("", ".", "..") or "/" in name:
        raise InputError(
            f"sequence {name!r}: must be the name of a folder in {root / 'sequences'}, such as 00"
        )
    if name.isdigit() and not (root / "sequences" / name).is_dir():
        name = name.zfill(2)
    return root, root / "sequences" / name, root / "poses" / f"{name}.txt"


def name_of(root: str | Path, name: str) -> str:
    """Full name of a sequence, "06" for "6". Its results are stored under this name."""
    return _locate(root, name)[1].name


def true_path(root: str | Path | None, name: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Ground truth of a sequence without reading its frames: poses, (n, 4, 4), and their times,
    (n,), seconds.

    root, name: as in Sequence. Without times.txt, ten frames a second are assumed.
    """
    _, folder, path = _locate(root, name)
    poses, path_of_times = read_poses(path), folder / "times.txt"
    if not path_of_times.is_file():
        return poses, FRAME_TIME * np.arange(len(poses))
    times = read_times(path_of_times)
    if len(times) != len(poses):
        raise InputError(
            f"{path_of_times}: {len(times)} times for {len(poses)} poses in {path}; one a frame is needed"
        )
    return poses, times


def check_numbering(paths: list[Path]) -> None:
    """Raise InputError if two frames have the same number, or if frames count by one and a number
    is missing.

    Names that do not count by one are accepted, for example every fifth frame, or times.
    """
    for (number, path), (next_number, next_path) in pairwise(zip(numbers_of(paths) or [], paths)):
        if number == next_number:
            raise InputError(f"{next_path}: has the same number as {path.name}; remove one of them")
    missing = missing_frames(paths)
    if missing:
        raise InputError(f"{missing[0]}: this frame is missing; the odometry needs all frames")


def missing_frames(paths: list[Path], count: int | None = None) -> list[Path]:
    """Paths of the missing frames, if the frames' numbers count by one; at most MAX_MISSING_NAMED.

    count: the expected number of frames. If it is given, frames missing at the start and at the end
    are found as well. Numbers start at 0 (as in KITTI), at 1, or at the number of the first of
    `paths`.
    """
    numbers = numbers_of(paths)
    steps = [after - before for before, after in pairwise(numbers or [])]
    if not numbers or steps and median_low(steps) != 1 or count is None and len(steps) < 2:
        return []
    first, end, present = numbers[0], numbers[-1] + 1, set(numbers)
    if count is not None:
        first = next((start for start in (0, 1) if start <= first and end <= start + count), first)
        end = max(end, first + count)
    missing = list(
        islice((number for number in range(first, end) if number not in present), MAX_MISSING_NAMED)
    )
    stem = paths[0].stem.rstrip("0123456789")
    digits = min(len(path.stem) for path in paths) - len(stem)
    return [paths[0].with_name(f"{stem}{number:0{digits}d}{paths[0].suffix}") for number in missing]


def check_count(path: Path, count: int, frame_paths: list[Path]) -> None:
    """Raise InputError unless a file has `count` lines for as many frames."""
    if count != len(frame_paths):
        missing = missing_frames(frame_paths, max(count, len(frame_paths)))
        first = f" (the first missing: {missing[0].name})" if missing else ""
        raise InputError(
            f"{path}: {count} lines for {len(frame_paths)} frames{first}; one line a frame is needed"
        )


def check_size(
    path: Path, size: tuple[int, ...], expected: tuple[int, int], image: str = "the first frame"
) -> None:
    """Raise InputError if an image has another size than expected. `image` names the image with
    the expected size.
    """
    if size != expected:
        raise InputError(
            f"{path}: {size[1]}x{size[0]} pixels; {image} has {expected[1]}x{expected[0]}"
        )


def _read_numbers(path, columns, comments=None):
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


def read_intrinsics(path: str | Path, camera: str = "image_0") -> np.ndarray:
    """Camera matrix (Equation 2.4), (3, 3), pixels: the first three columns of P0, or of P1 to P3
    for another camera.

    Raises InputError if the line is missing, or if the camera has distortion or skew.
    """
    key = f"P{camera[-1]}" if camera in IMAGE_FOLDERS else "P0"
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
        matrix = np.array(
            [line[3:].split() for line in lines if line.startswith(f"{key}:")][0], np.float64
        )
        matrix = matrix.reshape(3, 4)[:, :3]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, IndexError):
        matrix = np.zeros((3, 3))
    if not is_camera_matrix(matrix):
        raise InputError(
            f"{path}: must hold a line '{key}: f 0 u 0 0 f v 0 0 0 1 0' of a camera without distortion"
        )
    return matrix


def is_camera_matrix(matrix: np.ndarray) -> bool:
    """Whether a matrix is that of Equation 2.4, (3, 3), without skew."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    (fx, _, u), (_, fy, v), _ = matrix
    return min(fx, fy) > 0 and np.array_equal(matrix, [[fx, 0, u], [0, fy, v], [0, 0, 1]])


def check_camera(path: Path, intrinsics: np.ndarray, frame: Path, size: tuple[int, int]) -> None:
    """Raise InputError if frames of (height, width) are too small or do not fit the camera
    matrix.
    """
    height, width = size
    if min(size) < MIN_FRAME_SIDE:
        raise InputError(
            f"{frame}: {width}x{height} pixels; each side needs {MIN_FRAME_SIDE} or more"
        )
    (fx, _, u), (_, fy, v), _ = intrinsics
    if not (
        0 <= u <= width
        and 0 <= v <= height
        and all(width / 100 < focal < width * 100 for focal in (fx, fy))
    ):
        raise InputError(
            f"{path}: focal lengths {fx:g}, {fy:g} and centre {u:g}, {v:g} do not fit frames of "
            f"{width}x{height} pixels"
        )


def read_times(path: str | Path) -> np.ndarray:
    """Times of the frames, (n,), seconds, one a line. Raises InputError unless they increase."""
    times = _read_numbers(path, 1)[:, 0]
    _check_increase(path, times)
    return times


def _check_increase(path, times):
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


def read_tum(path: str | Path, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read a file in TUM's format and match its poses to the frames' times (n,), seconds, with evo.

    Returns the indices of the matched frames, (m,), and their poses, (m, 4, 4). Raises InputError
    for a line without a time after the line before, a position in metres and a unit quaternion, and
    if too few poses are matched (MIN_MATCHED), as with another unit of time.
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
    numbers, nearest = matching_time_indices(times, rows[:, 0])
    # how many of the one lie within the time of the other
    shared = min(
        np.count_nonzero((values >= others[0]) & (values <= others[-1]))
        for values, others in ((times, rows[:, 0]), (rows[:, 0], times))
    )
    least = max(2, MIN_MATCHED[0] * shared, MIN_MATCHED[1] * min(len(rows), len(times)))
    if len(numbers) < least:
        raise InputError(
            f"{path}: {len(numbers)} of {len(rows)} poses are at the time of a frame, "
            f"{times[0]:g} to {times[-1]:g} s; its times are {rows[0, 0]:.10g} to {rows[-1, 0]:.10g}"
        )
    return np.array(numbers), np.array(trajectory.poses_se3)[nearest]


def _write_rows(path, rows):
    write_text(path, "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows))
