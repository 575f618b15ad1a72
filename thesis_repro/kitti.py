"""KITTI odometry: one sequence's frames, camera, times and true poses, and trajectory files."""

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path
from statistics import median_low

import numpy as np

from thesis_repro import InputError
from thesis_repro.files import images, numbers_of, read_gray, write_text


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels at the stated image size (Section 3.7.2); KITTI's gray images have no distortion."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


_CAMERA_00 = Camera(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
_CAMERA_03 = Camera(1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
_CAMERA_04 = Camera(1226, 370, 707.0912, 707.0912, 601.8873, 183.1104)
CAMERAS = {"00": _CAMERA_00, "01": _CAMERA_00, "02": _CAMERA_00, "03": _CAMERA_03,
           **{f"{n:02d}": _CAMERA_04 for n in range(4, 11)}}

# Frames of the complete sequences (those with ground truth).
FRAME_COUNTS = dict(zip(CAMERAS, (4541, 1101, 4661, 801, 271, 2761, 1101, 1101, 4071, 1591, 1201), strict=True))


IMAGE_FOLDERS = ("image_0", "image_2", "image_1", "image_3")  # left gray, left colour, then the right ones
MIN_FRAME_SIDE = 16  # pixels: in smaller frames no keypoint can be tracked
MAX_MISSING_NAMED = 10_000  # frames
MAX_SPEED = 10_000  # metres a second
MAX_POSITION = 1e9  # metres
ROTATION_TOLERANCE = 1e-3  # of R R^T against the identity: a file has few digits
FRAME_TIME = 0.1  # seconds between KITTI's frames, and between those of a sequence that has no times


def sequences(root: str | Path) -> list[str]:
    """Names of the sequences under root/sequences that hold frames, sorted, less those of `without_truth`.

    Raises InputError when there are none.
    """
    names = [name for name in _with_frames(root) if _has_truth(root, name)]
    if not names:
        raise InputError(f"{Path(root) / 'sequences'}: no sequence holds frames (image_0 or image_2) and true poses; "
                         "the images and the poses of the odometry benchmark are needed")
    return names


def without_truth(root: str | Path) -> list[str]:
    """Names of the sequences that hold frames but have no true poses, sorted: the benchmark keeps those of 11 to 21 to
    itself, and a sequence of one's own may have none.

    The odometry runs over them, but there is nothing to compare it with. 00 to 10 without poses are not among them:
    there a file is missing.
    """
    return [name for name in _with_frames(root) if not _has_truth(root, name)]


def _with_frames(root):
    root = Path(root)
    if not (root / "sequences").is_dir():
        raise InputError(f"{root}: holds no folder 'sequences'; KITTI must name the folder that holds "
                         "sequences/NN/image_0 and poses/NN.txt")
    return sorted(folder.name for folder in (root / "sequences").iterdir()
                  if folder.is_dir() and (images_of(folder).name in IMAGE_FOLDERS or images(folder)))


def _has_truth(root, name):
    return name in FRAME_COUNTS or (Path(root) / "poses" / f"{name}.txt").is_file()


def images_of(folder: str | Path, camera: str | None = None) -> Path:
    """Where the frames of a sequence's folder are: in the one of IMAGE_FOLDERS that `camera` names, or else in the
    first of them that is there, or else in the folder itself.

    Raises InputError for another camera.
    """
    if camera is not None and camera not in IMAGE_FOLDERS:
        raise InputError(f"camera {camera!r}: unknown; choose one of {', '.join(sorted(IMAGE_FOLDERS))}")
    candidates = [Path(folder) / name for name in ([camera] if camera else IMAGE_FOLDERS)]
    return next((path for path in candidates if path.is_dir()), candidates[0] if camera else Path(folder))


class Sequence:
    """One odometry sequence in the official layout: sequences/NN/image_0, calib.txt, times.txt and poses/NN.txt.

    Frames are PNG or JPEG, numbered without gaps; without gray ones in image_0 the colour ones of image_2 are read, as
    gray. Times increase, and poses are rotations of right-handed axes with positions in metres. (The true poses
    are those of image_0's camera, 6 cm beside the other's.) Where there is no times.txt, `times` has KITTI's ten
    frames a second. Where there is no file of poses, `has_truth` is False.
    Everything but the frames is read and checked when the object is made; frames are read when asked for.
    Raises InputError, naming the file, for whatever is missing or malformed.
    """

    def __init__(self, root: str | Path | None, name: str | Path, camera: str | None = None,
                 speed: float | None = None) -> None:
        """root: the folder that holds sequences and poses, and name: of the sequence, where "6" is as good as "06".
        Or root None, and name a folder of one's own that holds calib.txt, the frames (in image_0 or itself) and
        perhaps times.txt and poses.txt.

        camera: one of IMAGE_FOLDERS; by default see `images_of`. speed: metres a second, for a sequence without true
        poses; by default one metre a frame.
        """
        self.root, self.folder, self.poses_path = _places(root, name)
        self.name = self.folder.name
        self.speed = speed
        if not self.folder.is_dir():
            raise InputError(f"{self.folder / (camera or 'image_0')}: no such folder; sequence {self.name} must hold "
                             "its frames there (gray in image_0 or colour in image_2)")
        where = images_of(self.folder, camera)
        if not where.is_dir():
            raise InputError(f"{where}: no such folder; sequence {self.name} must hold its frames there")
        self.frame_paths = images(where)
        if not self.frame_paths:
            raise InputError(f"{where}: holds no PNG or JPEG frames; sequence {self.name} is empty")
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
        if speed is not None:
            self._check_speed(speed)

    def _check_speed(self, speed):
        if self.has_truth:
            raise InputError(f"speed: sequence {self.name} has true poses ({self.poses_path}), from which the length "
                             "of each step is taken; give none")
        if not 0 < speed <= MAX_SPEED:
            raise InputError(f"speed: {speed} is none; give metres a second, above 0 and at most {MAX_SPEED:,}")
        if not self.has_times:
            raise InputError(f"{self.folder / 'times.txt'}: no such file; a speed needs the times of the frames, in "
                             "seconds, one a line")

    @property
    def poses(self) -> np.ndarray:
        """True camera-to-world poses, (n, 4, 4), metres. Raises InputError where there are none."""
        if not self.has_truth:
            raise InputError(f"{self.poses_path}: no such file; sequence {self.name} has no true poses, and this needs "
                             "them")
        return self._poses

    @property
    def assumed_steps(self) -> np.ndarray:
        """Metres from the frame before, (n,), 0 for the first, where no truth says them: those of the speed, or 1."""
        if self.speed is None:
            return np.concatenate([[0.0], np.ones(len(self) - 1)])
        return np.concatenate([[0.0], self.speed * np.diff(self.times)])

    @property
    def label_names(self) -> list[str]:
        """What the label map or mask of each frame is called: as the frame, but always .png."""
        return [f"{path.stem}.png" for path in self.frame_paths]

    def __len__(self) -> int:
        return len(self.frame_paths)

    def __repr__(self) -> str:
        return f"Sequence({str(self.root)!r}, {self.name!r}): {len(self)} frames"

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first frame; every frame must have it.

        Raises InputError where it is less than MIN_FRAME_SIDE, and where the camera cannot be that of such frames.
        """
        height, width = read_gray(self.frame_paths[0]).shape
        check_camera(self.folder / "calib.txt", self.intrinsics, self.frame_paths[0], (height, width))
        return height, width

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width). Raises InputError when unreadable or of another size."""
        image = read_gray(self.frame_paths[index])
        check_size(self.frame_paths[index], image.shape, self.size)
        return image

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames in order."""
        for index in range(len(self)):
            yield self.frame(index)

    def subset(self, count: int | None) -> "Sequence":
        """The same sequence cut to its first `count` frames (all of them where it has fewer, or for None)."""
        short = copy(self)
        short.frame_paths, short.times = self.frame_paths[:count], self.times[:count]
        if self.has_truth:
            short._poses = self._poses[:count]
        return short


def _places(root, name):
    """(root, folder, file of true poses) of a sequence, see Sequence."""
    if root is None:
        folder = Path(name).resolve()
        if folder.parent.name != "sequences":
            return folder.parent, folder, folder / "poses.txt"
        root, name = folder.parent.parent, folder.name  # it is one of KITTI's after all
    root, name = Path(root), str(name)
    if name in ("", ".", "..") or "/" in name:
        raise InputError(f"sequence {name!r}: is no name of a folder in {root / 'sequences'}; give one, such as 00")
    if name.isdigit() and not (root / "sequences" / name).is_dir():
        name = name.zfill(2)
    return root, root / "sequences" / name, root / "poses" / f"{name}.txt"


def true_poses(root: str | Path | None, name: str | Path) -> np.ndarray:
    """The true poses of a sequence, (n, 4, 4), whose frames need not be there; root and name as Sequence takes them.

    Raises InputError where there are none.
    """
    path = _places(root, name)[2]
    if not path.is_file():
        raise InputError(f"{path}: no such file; without true poses there is nothing to compare with")
    return read_poses(path)


def check_numbering(paths: list[Path]) -> None:
    """Raise InputError for frames that count by one with a gap, and for two of one number.

    (Every fifth frame, say, or times are no count.)
    """
    numbers = numbers_of(paths) or []
    for index, (before, after) in enumerate(pairwise(numbers), 1):
        if before == after:
            raise InputError(f"{paths[index]}: has the number of {paths[index - 1].name}; take one of them away")
    missing = missing_frames(paths)
    if missing:
        index = next(index for index, (before, after) in enumerate(pairwise(numbers), 1) if after - before > 1)
        count = f"{len(missing)}{' or more' * (len(missing) == MAX_MISSING_NAMED)}"
        more = f" ({count} are missing in all)" if len(missing) > 1 else ""
        raise InputError(f"{missing[0]}: is missing between {paths[index - 1].name} and {paths[index].name}{more}; "
                         "copy it again, for the odometry needs every frame")


def missing_frames(paths: list[Path], count: int | None = None) -> list[Path]:
    """The files that are not there of frames that count by one.

    count: of all frames, which then begin with 0 (KITTI's) or with 1, or else where the first of `paths` does: those
    before the first and after the last are found too. No more than MAX_MISSING_NAMED are named.
    """
    numbers = numbers_of(paths)
    steps = [after - before for before, after in pairwise(numbers or [])]
    if not numbers or steps and median_low(steps) != 1 or count is None and len(steps) < 2:
        return []
    first, last = numbers[0], numbers[-1]
    if count is not None:
        first = next((start for start in (0, 1) if start <= first and last < start + count), first)
        last = max(last, first + count - 1)
    stem = paths[0].stem.rstrip("0123456789")
    digits = min(len(path.stem) for path in paths) - len(stem)
    there = set(numbers)
    names = (paths[0].with_name(f"{stem}{number:0{digits}d}{paths[0].suffix}") for number in range(first, last + 1)
             if number not in there)
    return list(islice(names, MAX_MISSING_NAMED))


def check_count(path: Path, count: int, frame_paths: list[Path]) -> None:
    """Raise InputError, naming the first missing frame where there is a count, unless a file has a line a frame."""
    if count == len(frame_paths):
        return
    missing = missing_frames(frame_paths, count) if count > len(frame_paths) else []
    about = f" (the first without one: {missing[0].name})" if missing else ""
    raise InputError(f"{path}: {count} lines for {len(frame_paths)} frames in {frame_paths[0].parent}{about}; "
                     "one line a frame is needed")


def check_size(path: Path, size: tuple[int, ...], first_size: tuple[int, int]) -> None:
    """Raise InputError for a frame whose (height, width) is not that of the sequence's first one."""
    if size != first_size:
        raise InputError(f"{path}: {_size(size)} pixels, but the first frame of the sequence has {_size(first_size)}; "
                         "all frames must have one size")


def _size(shape):
    return f"{shape[1]}x{shape[0]}"


def _read_text(path):
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check its name, or copy it from the data set again") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it holds bytes that are none"
        raise InputError(f"{path}: cannot be read as text ({reason}); check the file and its permissions") from None


def _read_numbers(path, columns):
    rows = []
    for number, line in enumerate(_read_text(path).splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise InputError(f"{path}, line {number}: expected {columns} finite number{'s' * (columns > 1)}, "
                             f"found {line.strip()[:60]!r}; copy the file again")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: is empty; one line a frame is needed")
    return np.array(rows, np.float64)


def read_intrinsics(path: str | Path, camera: str = "image_0") -> np.ndarray:
    """The camera matrix of image_0 (Equation 2.4), the first 3x3 of P0, or of another camera: (3, 3), pixels.

    Raises InputError for a file without it, and for numbers that are no camera's without distortion and skew.
    """
    key = f"P{camera[-1]}" if camera in IMAGE_FOLDERS else "P0"
    for line in _read_text(path).splitlines():
        if line.startswith(f"{key}:"):
            try:
                values = np.array([float(word) for word in line[3:].split()], np.float64)
            except ValueError:
                values = np.empty(0)
            matrix = values.reshape(3, 4)[:, :3] if values.shape == (12,) and np.isfinite(values).all() else None
            if matrix is None or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
                raise InputError(f"{path}: {key} must be 12 finite numbers with positive focal lengths, "
                                 f"found {line.strip()[:60]!r}; copy the file again")
            if matrix[0, 1] or matrix[1, 0] or not np.array_equal(matrix[2], [0, 0, 1]):
                raise InputError(f"{path}: {key} must be f 0 u 0, 0 f v 0, 0 0 1 0 of a camera without distortion and "
                                 f"skew, found {line.strip()[:60]!r}; copy the file again")
            return matrix
    raise InputError(f"{path}: has no line '{key}:' with the projection matrix of {camera}; copy the file again")


def check_camera(path: Path, intrinsics: np.ndarray, frame: Path, size: tuple[int, int]) -> None:
    """Raise InputError where a camera matrix cannot be that of frames of (height, width), or these are too small."""
    height, width = size
    if min(size) < MIN_FRAME_SIDE:
        raise InputError(f"{frame}: {_size(size)} pixels are too few for an odometry; a side needs {MIN_FRAME_SIDE} or "
                         "more")
    (fx, _, u), (_, fy, v), _ = intrinsics
    if not (0 <= u <= width and 0 <= v <= height and all(width / 100 < focal < width * 100 for focal in (fx, fy))):
        raise InputError(f"{path}: focal lengths {fx:g}, {fy:g} and centre {u:g}, {v:g} are not those of a camera with "
                         f"frames of {_size(size)} pixels; take the file of these frames")


def read_times(path: str | Path) -> np.ndarray:
    """The times of frames, (n,), seconds: one number a line. Raises InputError unless they increase."""
    times = _read_numbers(path, 1)[:, 0]
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        raise InputError(f"{path}, line {late[0] + 2}: time does not increase; copy the file again, or take it away: "
                         f"then frames count as {FRAME_TIME:g} s apart")
    return times


def read_poses(path: str | Path) -> np.ndarray:
    """Camera-to-world poses, (n, 4, 4), metres: one line of 12 numbers, the first three rows, a frame.

    Raises InputError for what is no rotation (mirrored ones among it) and no position.
    """
    rows = _read_numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    for index in np.flatnonzero(~(error <= ROTATION_TOLERANCE))[:1]:
        raise InputError(f"{path}, line {index + 1}: is no rotation (off by {error[index]:.2g}); the file is damaged "
                         "or in another form than KITTI's")
    for index in np.flatnonzero(np.linalg.det(rotations) < 0)[:1]:
        raise InputError(f"{path}, line {index + 1}: is a mirrored rotation, of axes that are left-handed; KITTI's x "
                         "points to the right, y down and z ahead")
    for index in np.flatnonzero(np.abs(poses[:, :3, 3]).max(axis=1) > MAX_POSITION)[:1]:
        raise InputError(f"{path}, line {index + 1}: is no position in metres; the file is damaged")
    return poses


def write_kitti_poses(path: str | Path, poses: np.ndarray) -> None:
    """Write (n, 4, 4) poses as KITTI does: 12 numbers a line, row by row, all digits kept."""
    _write_rows(path, np.asarray(poses)[:, :3].reshape(-1, 12))


def write_tum(path: str | Path, poses: np.ndarray, times: np.ndarray) -> None:
    """Write (n, 4, 4) poses with their times (n,), seconds, in TUM form: time, position, quaternion (x, y, z, w)."""
    from scipy.spatial.transform import Rotation  # loads in 0.4 s, and every command loads this module

    quaternions = Rotation.from_matrix(np.asarray(poses)[:, :3, :3]).as_quat(canonical=True)
    _write_rows(path, np.column_stack([times, np.asarray(poses)[:, :3, 3], quaternions]))


def _write_rows(path, rows):
    write_text(path, "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows))
