"""KITTI odometry: frames, camera, times and ground truth of a sequence or a raw drive."""

from collections import namedtuple
from collections.abc import Iterator
from copy import copy
from functools import cached_property
from itertools import pairwise
from numbers import Integral
from pathlib import Path
from statistics import median_low

import numpy as np

from thesis_repro.data import kitti_raw
from thesis_repro.data.trajectories import read_poses, read_times, text_of
from thesis_repro.errors import InputError, need
from thesis_repro.running.files import images, numbers_of, read_gray

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
# width and height that go with a focal length and a centre's u, which tell KITTI's cameras apart
KNOWN_SIZES = {
    (round(camera.fx, 3), round(camera.cx, 3)): (camera.width, camera.height)
    for camera in CAMERAS.values()
}

# left gray, left colour, then the right ones
IMAGE_FOLDERS = ("image_0", "image_2", "image_1", "image_3")
TRUE_LABELS = "labels_0"  # exact label maps beside image_0, which only the embedded world has
MIN_FRAME_SIDE = 16  # pixels; keypoints cannot be tracked in smaller frames
MAX_SPEED = 10_000  # metres a second
MAX_FPS = 10_000  # frames a second
FRAME_TIME = 0.1  # seconds between frames, assumed for a sequence without times.txt


def sequences(root: str | Path) -> list[str]:
    """Names of the sequences with frames and ground truth, in sorted order.

    00 to 10 are listed even without a file of poses, so that `Sequence` reports the missing file.
    Raises InputError if there are none.
    """
    names = []
    for name in with_frames(root):
        _, _, poses = locate(root, name)
        if name in CAMERAS or poses.exists():
            names.append(name)
    if not names:
        raise InputError(
            f"{folder_of(root)}: no sequence holds frames (image_0 or image_2) and ground truth"
        )
    return names


def with_frames(root: str | Path) -> list[str]:
    """Names of all sequences with frames, in sorted order.

    KITTI publishes no ground truth for 11 to 21. Raises InputError if the folder has another
    layout.
    """
    if not folder_of(root).is_dir():
        raise InputError(
            f"{root}: must be the folder that holds sequences/NN/image_0 and poses/NN.txt, or raw drives"
        )
    return [folder.name for folder in folders_with_frames(folder_of(root))]


def folders_with_frames(parent: Path) -> list[Path]:
    """Folders of sequences in a folder, in sorted order."""
    return sorted(folder for folder in parent.iterdir() if folder.is_dir() and has_frames(folder))


def has_frames(folder: Path) -> bool:
    """Whether a folder is that of a sequence, or holds images itself."""
    return images_of(folder) != folder or bool(images(folder))


def folder_of(root: str | Path) -> Path:
    """Folder of a root's sequences.

    It is the root itself if it holds raw drives, else root/sequences, which may hold raw drives as
    well.
    """
    root = Path(root)
    folder = root / "sequences"
    if not folder.is_dir() and any(map(kitti_raw.is_drive, root.glob("*"))):
        return root
    return folder


def images_of(folder: str | Path, camera: str | None = None) -> Path:
    """Folder of a sequence's frames.

    The default is the left camera's, gray or else colour. If neither exists, it is the sequence's
    folder itself. Raises InputError if the camera is unknown, or if the folder is missing.
    """
    folder = Path(folder)
    cameras, inner = IMAGE_FOLDERS, ""
    if kitti_raw.is_drive(folder):
        cameras, inner = kitti_raw.IMAGE_FOLDERS, kitti_raw.FRAMES
    gray, color = (folder / name / inner for name in cameras[:2])
    frame_folder = folder
    if camera is not None:
        if camera not in cameras:
            known = ", ".join(sorted(cameras))
            raise InputError(f"camera {camera!r}: unknown; choose one of {known}")
        frame_folder = folder / camera / inner
    elif gray.is_dir():
        frame_folder = gray
    elif color.is_dir():
        frame_folder = color
    if not frame_folder.is_dir():
        raise InputError(f"{frame_folder}: no such folder; it must hold the frames")
    return frame_folder


def camera_of(frame_folder: Path) -> str:
    """Name of the camera that took the frames in a folder, such as "image_0" or "image_02"."""
    if frame_folder.name == kitti_raw.FRAMES:
        return frame_folder.parent.name
    return frame_folder.name


def texts_of(folder: Path, frame_folder: Path) -> tuple[Path, Path]:
    """Files of the calibration and of the times of a sequence, given the folder of its frames."""
    if kitti_raw.is_drive(folder):
        return kitti_raw.calibration(folder), frame_folder.parent / kitti_raw.TIMES
    return folder / "calib.txt", folder / "times.txt"


class Sequence:
    """One odometry sequence in the official layout, or one raw drive (see kitti_raw).

    The official layout is sequences/NN/image_0, calib.txt, times.txt and poses/NN.txt.

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
        fps: float | None = None,
    ) -> None:
        """Find, read and check the files of a sequence, except its frames.

        root: folder that holds sequences and poses. name: the sequence, "06" or "6".
        For a sequence outside of KITTI, root is None and name is a folder. The folder is a raw
        drive, or holds calib.txt, the frames (in image_0 or in the folder itself) and optionally
        times.txt and poses.txt.
        camera: one of IMAGE_FOLDERS, see `images_of`. speed: metres a second, for a sequence
        without ground truth; the default is one metre a frame. fps: frames a second, for a
        sequence without times.txt.
        """
        need("sequence", name, str | Path)
        self.root, self.folder, self.poses_path = locate(root, name)
        self.name, self.speed = self.folder.name, speed
        frame_folder = images_of(self.folder, camera)
        self.frame_paths = images(frame_folder)
        if not self.frame_paths:
            raise InputError(f"{frame_folder}: holds no PNG or JPEG frames")
        check_numbering(self.frame_paths)
        self.calibration_path, times_path = texts_of(self.folder, frame_folder)
        self.intrinsics = read_intrinsics(self.calibration_path, camera_of(frame_folder))
        self.has_times = times_path.exists()
        self.times = self._read_times(times_path, fps)
        self.has_truth = self.poses_path.exists()
        if self.has_truth:
            self._poses = truth_of(self.poses_path)
            check_count(self.poses_path, len(self._poses), self.frame_paths)
        if speed is not None:
            self._check_speed(speed, self.has_times or fps is not None)

    def _read_times(self, path: Path, fps: float | None) -> np.ndarray:
        if self.has_times:
            if fps is not None:
                raise InputError(f"fps {fps:g}: leave it out; {path} has the times of the frames")
            times = times_of(path)
            check_count(path, len(times), self.frame_paths)
            return times
        if fps is None:
            return FRAME_TIME * np.arange(len(self))
        if not 0 < fps <= MAX_FPS:
            raise InputError(f"fps {fps:g}: must be above 0 and at most {MAX_FPS} frames a second")
        return np.arange(len(self)) / fps

    def _check_speed(self, speed: float, has_times: bool) -> None:
        if self.has_truth:
            raise InputError(
                f"speed {speed}: leave it out; {self.poses_path} has the true step lengths"
            )
        if not has_times:
            raise InputError(
                f"speed {speed}: needs the times of the frames (times.txt), or their number a second "
                "(--fps)"
            )
        if not 0 < speed <= MAX_SPEED:
            raise InputError(f"speed {speed}: must be above 0 and at most {MAX_SPEED} m/s")

    @property
    def poses(self) -> np.ndarray:
        """Ground truth: camera-to-world poses, (n, 4, 4), metres.

        Raises InputError if there is none.
        """
        if not self.has_truth:
            raise InputError(f"{self.poses_path}: no such file; ground truth is needed")
        return self._poses

    @property
    def assumed_steps(self) -> np.ndarray:
        """Step lengths without ground truth, (n,), metres: from the speed, or 1.

        The first one is 0.
        """
        steps = np.ones(len(self) - 1)
        if self.speed is not None:
            steps = self.speed * np.diff(self.times)
        return np.concatenate([[0.0], steps])

    @property
    def files(self) -> list[Path]:
        """All files of the sequence.

        Frames and calibration, and the files of times and poses if they exist.
        """
        paths = list(self.frame_paths)
        texts = *texts_of(self.folder, self.frame_paths[0].parent), self.poses_path
        paths += filter(Path.is_file, texts)
        if kitti_raw.is_drive(self.folder):
            paths += kitti_raw.files(self.folder)
        return paths

    @property
    def label_names(self) -> list[str]:
        """File names of label maps and masks: the names of the frames, with the ending .png."""
        return [f"{path.stem}.png" for path in self.frame_paths]

    def __len__(self) -> int:
        return len(self.frame_paths)

    @property
    def description(self) -> str:
        """One line that says what the sequence holds, and what is assumed for what it lacks."""
        line = f"sequence {self.name}: {len(self)} frames of {self.size[1]}x{self.size[0]}"
        if not self.has_truth:
            line += "; no ground truth, so step lengths follow from --speed, or are 1 m"
        if not self.has_times:
            line += f"; no times, so {1 / FRAME_TIME:g} frames a second"
        return line

    def __repr__(self) -> str:
        return f"Sequence({str(self.root)!r}, {self.name!r}): {len(self)} frames"

    @cached_property
    def size(self) -> tuple[int, int]:
        """Size (height, width) of the first frame. Raises InputError as `check_camera` does."""
        size = read_gray(self.frame_paths[0]).shape
        check_camera(self.calibration_path, self.intrinsics, self.frame_paths[0], size)
        return size

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width).

        Raises InputError if it is unreadable or has another size.
        """
        image = read_gray(self.frame_paths[index])
        check_size(self.frame_paths[index], image.shape, self.size)
        return image

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames in order."""
        for index in range(len(self)):
            yield self.frame(index)

    def subset(self, count: int | None) -> "Sequence":
        """Copy of the sequence with its first `count` frames; None for all frames.

        Raises InputError for another count than a whole number from 1 on.
        """
        if count is not None and not (isinstance(count, Integral) and count > 0):
            raise InputError(f"frames {count!r}: must be a whole number, 1 or more; None takes all")
        short = copy(self)
        short.frame_paths, short.times = self.frame_paths[:count], self.times[:count]
        if self.has_truth:
            short._poses = self._poses[:count]
        return short


def locate(root: str | Path | None, name: str | Path) -> tuple[Path, Path, Path]:
    """Root, folder and poses of a sequence.

    The poses are a file, or the OXTS's folder of a raw drive. The arguments are those of Sequence.
    """
    folder = Path(name).resolve()
    poses = folder / "poses.txt"
    if root is None and folder.parent.name == "sequences":
        root, name = folder.parent.parent, folder.name  # the folder belongs to a KITTI root
    if root is not None:
        root, name = Path(root), str(name)
        if name in ("", ".", "..") or "/" in name:
            raise InputError(
                f"sequence {name!r}: must be the name of a folder in {folder_of(root)}, such as 00"
            )
        if name.isdigit() and not (folder_of(root) / name).is_dir():
            name = name.zfill(2)
        folder, poses = folder_of(root) / name, root / "poses" / f"{name}.txt"
    if kitti_raw.is_drive(folder):
        poses = folder / kitti_raw.OXTS
    return root or folder.parent, folder, poses


def name_of(root: str | Path, name: str) -> str:
    """Full name of a sequence, "06" for "6". Its results are stored under this name."""
    return locate(root, name)[1].name


def truth_of(path: Path) -> np.ndarray:
    """Ground truth, (n, 4, 4), from a file of poses, or from the folder of a raw drive's OXTS."""
    if path.match(kitti_raw.OXTS):
        return kitti_raw.read_poses(path.parents[1])
    return read_poses(path)


def times_of(path: Path) -> np.ndarray:
    """Times, (n,), seconds, from a file of seconds, or from a raw drive's file of time stamps."""
    if path.name == kitti_raw.TIMES:
        return kitti_raw.read_times(path)
    return read_times(path)


def check_numbering(paths: list[Path]) -> None:
    """Raise InputError if two frames have the same number, or if a number is missing.

    A number can be missing only if frames count by one. Names that do not count by one are
    accepted, for example every fifth frame, or times.
    """
    numbers = numbers_of(paths) or []
    steps = [after - before for before, after in pairwise(numbers)]
    if 0 in steps:
        first = steps.index(0)
        raise InputError(
            f"{paths[first + 1]}: has the same number as {paths[first].name}; remove one of them"
        )
    if len(steps) < 2 or median_low(steps) != 1:
        return
    for number, step, path in zip(numbers, steps, paths):
        if step != 1:
            letters = path.stem.rstrip("0123456789")
            digits = min(len(path.stem) for path in paths) - len(letters)
            name = f"{letters}{number + 1:0{digits}d}{path.suffix}"
            count = numbers[-1] - numbers[0] + 1 - len(paths)
            raise InputError(
                f"{path.with_name(name)}: this frame is missing ({count} are); the odometry needs all "
                "frames"
            )


def check_count(path: Path, count: int, frame_paths: list[Path]) -> None:
    """Raise InputError unless a file has `count` lines for as many frames."""
    if count != len(frame_paths):
        raise InputError(
            f"{path}: {count} lines for {len(frame_paths)} frames, {frame_paths[0].name} to "
            f"{frame_paths[-1].name}; one line a frame is needed"
        )


def check_size(
    path: Path, size: tuple[int, ...], expected: tuple[int, int], image: str = "the first frame"
) -> None:
    """Raise InputError if an image has another size than expected.

    `image` names the image with the expected size.
    """
    if size != expected:
        raise InputError(
            f"{path}: {size[1]}x{size[0]} pixels; {image} has {expected[1]}x{expected[0]}"
        )


def read_intrinsics(path: str | Path, camera: str = "image_0") -> np.ndarray:
    """Camera matrix (Equation 2.4), (3, 3), pixels.

    It is the first three columns of P0, or of P1 to P3 for another camera; of a raw drive's
    camera, of P_rect_00 to P_rect_03. Raises InputError if the line is missing, or if the camera
    has distortion or skew.
    """
    key = "P0"
    if camera in IMAGE_FOLDERS:
        key = f"P{camera[-1]}"
    elif camera in kitti_raw.IMAGE_FOLDERS:
        key = f"P_rect_{camera[-2:]}"
    form = f"must hold a line '{key}: f 0 u 0 0 f v 0 0 0 1 0' of a camera without distortion"
    try:
        lines = [line for line in text_of(path).splitlines() if line.startswith(f"{key}:")]
        matrix = np.array(lines[0].split()[1:], np.float64).reshape(3, 4)[:, :3]
    except InputError as error:
        raise InputError(f"{error}; it {form}") from None
    except (ValueError, IndexError):
        matrix = np.zeros((3, 3))
    if not is_camera_matrix(matrix):
        raise InputError(f"{path}: {form}")
    return matrix


def is_camera_matrix(matrix: np.ndarray) -> bool:
    """Whether a matrix is that of Equation 2.4, (3, 3), without skew."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    (fx, _, u), (_, fy, v), _ = matrix
    return min(fx, fy) > 0 and np.array_equal(matrix, [[fx, 0, u], [0, fy, v], [0, 0, 1]])


def check_camera(
    path: Path | str, intrinsics: np.ndarray, frame: Path | str, size: tuple[int, int]
) -> None:
    """Raise InputError if frames are too small or do not fit the camera matrix.

    size: height and width.
    """
    height, width = size
    if min(size) < MIN_FRAME_SIDE:
        raise InputError(
            f"{frame}: {width}x{height} pixels; each side needs {MIN_FRAME_SIDE} or more"
        )
    (fx, _, u), (_, fy, v), _ = intrinsics
    of_kitti = KNOWN_SIZES.get((round(fx, 3), round(u, 3)))
    if of_kitti and of_kitti != (width, height):
        raise InputError(
            f"{path}: is KITTI's for frames of {of_kitti[0]}x{of_kitti[1]} pixels, but these have "
            f"{width}x{height}; scale or shift focal lengths and centre as the frames were"
        )
    center_fits = 0 <= u <= width and 0 <= v <= height
    focal_lengths_fit = all(width / 100 < focal < width * 100 for focal in (fx, fy))
    if not (center_fits and focal_lengths_fit):
        raise InputError(
            f"{path}: focal lengths {fx:g}, {fy:g} and centre {u:g}, {v:g} do not fit frames of "
            f"{width}x{height} pixels"
        )
