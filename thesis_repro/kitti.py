"""KITTI odometry: one sequence's frames, camera, times and true poses, and trajectory files."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from thesis_repro import InputError
from thesis_repro.files import listed, read_gray, write_text


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


# The benchmark keeps the true poses of these to itself, and without them there is no scale.
WITHOUT_TRUTH = frozenset(f"{number}" for number in range(11, 22))


def sequences(root: str | Path) -> list[str]:
    """Names of the sequences under root/sequences that hold image_0, sorted, less those without published poses.

    Raises InputError when there are none.
    """
    root = Path(root)
    if not (root / "sequences").is_dir():
        raise InputError(f"{root}: holds no folder 'sequences'; KITTI must name the folder that holds "
                         "sequences/NN/image_0 and poses/NN.txt")
    names = sorted(folder.name for folder in (root / "sequences").iterdir() if (folder / "image_0").is_dir()
                   and (folder.name not in WITHOUT_TRUTH or (root / "poses" / f"{folder.name}.txt").is_file()))
    if not names:
        raise InputError(f"{root / 'sequences'}: no sequence holds a folder image_0; "
                         "the gray images of the odometry benchmark are needed")
    return names


class Sequence:
    """One odometry sequence in the official layout: sequences/NN/image_0, calib.txt, times.txt and poses/NN.txt.

    Everything but the frames is read and checked when the object is made; frames are read when asked for.
    Raises InputError, naming the file, for whatever is missing or malformed.
    """

    def __init__(self, root: str | Path, name: str) -> None:
        self.root = Path(root)
        self.name = str(name)
        self.folder = self.root / "sequences" / self.name
        images = self.folder / "image_0"
        if not images.is_dir():
            raise InputError(f"{images}: no such folder; sequence {self.name} must hold its gray frames there")
        self.frame_paths = listed(images)
        if not self.frame_paths:
            raise InputError(f"{images}: holds no PNG frames; sequence {self.name} is empty")
        self.intrinsics = _read_intrinsics(self.folder / "calib.txt")
        self.times = _read_numbers(self.folder / "times.txt", 1)[:, 0]
        self._check_count(self.folder / "times.txt", len(self.times))
        self.poses = read_poses(self.root / "poses" / f"{self.name}.txt")
        self._check_count(self.root / "poses" / f"{self.name}.txt", len(self.poses))

    def _check_count(self, path, count):
        if count != len(self):
            raise InputError(f"{path}: {count} lines for {len(self)} frames in {self.frame_paths[0].parent}; "
                             "one line a frame is needed")

    def __len__(self) -> int:
        return len(self.frame_paths)

    def __repr__(self) -> str:
        return f"Sequence({str(self.root)!r}, {self.name!r}): {len(self)} frames"

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first frame; every frame must have it."""
        return read_gray(self.frame_paths[0]).shape

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width). Raises InputError when unreadable or of another size."""
        image = read_gray(self.frame_paths[index])
        if image.shape != self.size:
            raise InputError(f"{self.frame_paths[index]}: {_size(image.shape)} pixels, but the first frame of the "
                             f"sequence has {_size(self.size)}; all frames must have one size")
        return image

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames in order."""
        for index in range(len(self)):
            yield self.frame(index)

    def subset(self, count: int | None) -> "Sequence":
        """The same sequence cut to its first `count` frames (all of them where it has fewer, or for None)."""
        short = object.__new__(Sequence)
        short.__dict__.update(root=self.root, name=self.name, folder=self.folder, intrinsics=self.intrinsics,
                              frame_paths=self.frame_paths[:count], times=self.times[:count],
                              poses=self.poses[:count])
        return short


def _size(shape):
    return f"{shape[1]}x{shape[0]}"


def _read_text(path):
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; it is part of the official KITTI odometry layout") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({error})") from None


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
                             f"found {line.strip()[:60]!r}")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: is empty; one line a frame is needed")
    return np.array(rows, np.float64)


def _read_intrinsics(path):
    """The camera matrix of image_0 (Equation 2.4): the first 3x3 of P0."""
    for line in _read_text(path).splitlines():
        if line.startswith("P0:"):
            try:
                values = np.array([float(word) for word in line[3:].split()], np.float64)
            except ValueError:
                values = np.empty(0)
            matrix = values.reshape(3, 4)[:, :3] if values.shape == (12,) and np.isfinite(values).all() else None
            if matrix is None or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
                raise InputError(f"{path}: P0 must be 12 finite numbers with positive focal lengths, "
                                 f"found {line.strip()[:60]!r}")
            return matrix
    raise InputError(f"{path}: has no line 'P0:' with the projection matrix of image_0")


def read_poses(path: str | Path) -> np.ndarray:
    """Camera-to-world poses, (n, 4, 4), metres: one line of 12 numbers, the first three rows, a frame."""
    rows = _read_numbers(path, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses


def write_kitti_poses(path: str | Path, poses: np.ndarray) -> None:
    """Write (n, 4, 4) poses as KITTI does: 12 numbers a line, row by row, all digits kept."""
    lines = (" ".join(repr(float(value)) for value in pose[:3].ravel()) for pose in poses)
    write_text(path, "".join(f"{line}\n" for line in lines))


def write_tum(path: str | Path, poses: np.ndarray, times: np.ndarray) -> None:
    """Write (n, 4, 4) poses with their times (n,), seconds, in TUM form: time, position, quaternion (x, y, z, w)."""
    lines = []
    for time, pose in zip(times, poses, strict=True):
        turn = cv2.Rodrigues(np.asarray(pose[:3, :3], np.float64))[0].ravel()
        angle = np.linalg.norm(turn)
        quaternion = [*(turn / angle * np.sin(angle / 2) if angle > 0 else turn / 2), np.cos(angle / 2)]
        lines.append(" ".join(repr(float(value)) for value in (time, *pose[:3, 3], *quaternion)))
    write_text(path, "".join(f"{line}\n" for line in lines))
