"""KITTI odometry: frames, camera, times and ground truth of a sequence or a raw drive."""

import operator
from collections.abc import Iterator
from copy import copy
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from thesis_repro.data import cameras, kitti_raw
from thesis_repro.data.geometry import CAMERAS, check_camera, is_camera_matrix
from thesis_repro.data.layout import (
    IMAGE_FOLDERS,
    folders_with_frames,
    frame_folder,
    frames_in,
    locate,
    say_once,
    sequences_folder,
)
from thesis_repro.data.memory import FRAME_TIME, ArraySequence, distances, step_lengths
from thesis_repro.data.trajectories import (
    have_times,
    read_line,
    read_poses,
    read_poses_at,
    read_times,
)
from thesis_repro.errors import InputError
from thesis_repro.running import provenance
from thesis_repro.running.files import read_gray

# names of cameras' lines in the calibration
CALIBRATION_KEYS = {
    **{name: f"P{name[-1]}" for name in IMAGE_FOLDERS},
    **{name: f"P_rect_{name[-2:]}" for name in kitti_raw.IMAGE_FOLDERS},
}
TRUE_LABELS = "labels_0"  # exact label maps beside image_0, which only the embedded world has
# Pixels near a border where keypoints are left out: half a window of the tracker, which would see
# the border's edge
BORDER_MARGIN = 10
BORDER_SAMPLES, BLACK = 12, 8  # frames, and the largest gray value of a border


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
            f"{sequences_folder(root)}: no sequence holds frames (image_0 or image_2) and ground truth"
        )
    return names


def with_frames(root: str | Path) -> list[str]:
    """Names of all sequences with frames, in sorted order.

    KITTI publishes no ground truth for 11 to 21. Raises InputError if the folder has another
    layout.
    """
    if not sequences_folder(root).is_dir():
        raise InputError(
            f"{root}: must be the folder that holds sequences/NN/image_0 and poses/NN.txt, or raw drives"
        )
    return [folder.name for folder in folders_with_frames(sequences_folder(root))]


class Sequence:
    """One odometry sequence in the official layout, or one raw drive (see kitti_raw).

    The official layout is sequences/NN/image_0, calib.txt, times.txt and poses/NN.txt.

    Frames are PNG or JPEG files. Colour frames are read as gray. Without
    times.txt, `times` assumes ten frames a second, as in KITTI. Without a file of poses,
    `has_truth` is False. The ground truth belongs to the camera of image_0; the camera of image_2
    is 6 cm beside it. The constructor reads and checks all files except the frames. Raises
    InputError, naming the file, if a file is missing or malformed.

    `Sequence.from_arrays(frames, intrinsics, ...)` is for frames in memory.
    """

    from_arrays = ArraySequence

    def __init__(
        self,
        root: str | Path | None,
        name: str | int | Path,
        camera: str | None = None,
        speed: float | None = None,
        fps: float | None = None,
        truth: str | Path | None = None,
        calibration: str | Path | None = None,
    ) -> None:
        """Find, read and check the files of a sequence, except its frames.

        root: folder that holds sequences and poses. name: the sequence, "06", "6" or 6.
        For a sequence outside of KITTI, root is None and name is a folder. The folder is a raw
        drive, or holds calib.txt, the frames (in image_0 or in the folder itself) and optionally
        times.txt and poses.txt.
        camera: one of IMAGE_FOLDERS, see `frame_folder`. speed: metres a second, for a sequence
        without ground truth; the default is one metre a frame. fps: frames a second, for a
        sequence without times.txt. truth: file of the ground truth, in any form that poses.txt may
        have. calibration: file of a camera, see `cameras.read_camera`; its distortion is taken out
        of the frames.
        """
        self.root, self.folder, self.poses_path = locate(root, str(name))
        if truth is not None:
            self.poses_path = Path(truth)
        self.name, self.speed = self.folder.name, speed
        self.border: np.ndarray | None = None  # see `without_border`
        image_folder = frame_folder(self.folder, camera)
        self.frame_paths = frames_in(image_folder)
        camera_folder, self.calibration_path = image_folder, self.folder / "calib.txt"
        self.times_path = self.folder / "times.txt"
        if kitti_raw.is_drive(self.folder):
            camera_folder = image_folder.parent
            self.calibration_path = kitti_raw.calibration(self.folder)
            self.times_path = camera_folder / kitti_raw.TIMES
        if calibration is not None:
            self.calibration_path = Path(calibration)
            matrix, distortion, stated_size = cameras.read_camera(calibration)
        else:
            matrix = read_intrinsics(self.calibration_path, camera_folder.name)
            distortion, stated_size = np.empty(0), None
        self.intrinsics, self.distortion, self.stated_size = matrix, distortion, stated_size
        self.has_times = self.times_path.exists()
        self.times = self._read_times(self.times_path, fps)
        self.has_truth = truth is not None or self.poses_path.exists()
        if self.has_truth:
            self._read_truth(self.poses_path)
        if speed is not None:
            self._check_speed(speed, self.has_times or fps is not None)

    def _read_times(self, path: Path, fps: float | None) -> np.ndarray:
        if self.has_times:
            if fps is not None:
                raise InputError(f"fps {fps:g}: leave it out; {path} has the times of the frames")
            read = kitti_raw.read_times if path.name == kitti_raw.TIMES else read_times
            times = read(path)
            check_count(path, len(times), self.frame_paths)
            return times
        if fps is None:
            say_once(
                f"{path}: no such file, so {1 / FRAME_TIME:g} frames a second are assumed (--fps gives "
                "another number)"
            )
            return FRAME_TIME * np.arange(len(self))
        if not 0 < fps < np.inf:
            raise InputError(f"fps {fps:g}: must be a number of frames a second, above 0")
        return np.arange(len(self)) / fps

    def _read_truth(self, path: Path) -> None:
        """Read the ground truth. Frames before and after poses with times are left out."""
        is_drive = path.match(kitti_raw.OXTS)
        if is_drive or not have_times(path):
            self._poses = kitti_raw.read_poses(self.folder) if is_drive else read_poses(path)
            check_count(path, len(self._poses), self.frame_paths)
            return
        indices, self._poses = read_poses_at(path, self.times)
        first, end = indices[0], indices[-1] + 1
        gaps = np.setdiff1d(np.arange(first, end), indices)
        if len(gaps):
            raise InputError(f"{path}: {self.frame_paths[gaps[0]].name} has no pose within 0.01 s")
        if len(indices) < len(self):
            say_once(f"{path}: has poses of {len(indices)} of {len(self)} frames, which are used")
        self.frame_paths = self.frame_paths[first:end]
        self.times = self.times[first:end]

    def _check_speed(self, speed: float, has_times: bool) -> None:
        if not 0 < speed < np.inf:
            raise InputError(f"speed {speed:g}: must be a number of metres a second, above 0")
        if self.has_truth:
            raise InputError(
                f"speed {speed}: leave it out; {self.poses_path} has the true step lengths"
            )
        if not has_times:
            raise InputError(
                f"speed {speed}: needs the times of the frames (times.txt), or their number a second "
                "(--fps)"
            )

    @property
    def poses(self) -> np.ndarray:
        """Ground truth: camera-to-world poses, (n, 4, 4), metres.

        Raises InputError if there is none.
        """
        if not self.has_truth:
            raise InputError(f"{self.poses_path}: no such file; ground truth is needed")
        return self._poses

    @property
    def scales(self) -> np.ndarray:
        """Distances between the true positions of consecutive frames, (n,), metres; the first is 0.

        Without ground truth, they follow from the speed, or are 1.
        """
        if self.has_truth:
            return distances(self.poses)
        return step_lengths(self.times, self.speed)

    @property
    def files(self) -> list[Path]:
        """All files of the sequence.

        Frames and calibration, and the files of times and poses if they exist.
        """
        texts = self.calibration_path, self.times_path, self.poses_path
        paths = [*self.frame_paths, *filter(Path.is_file, texts)]
        if kitti_raw.is_drive(self.folder):
            paths += kitti_raw.files(self.folder)
        return paths

    def digest(self) -> str:
        """What tells the sequence from others in a record of results."""
        return provenance.digest_of_files(self.files)

    @property
    def label_names(self) -> list[str]:
        """File names of label maps and masks: the names of the frames, with the ending .png."""
        return [f"{path.stem}.png" for path in self.frame_paths]

    def __len__(self) -> int:
        return len(self.frame_paths)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Size (height, width) of the first frame. Raises InputError as `check_camera` does."""
        first = self.frame_paths[0]
        size = read_gray(first, np.uint16).shape
        check_camera(self.calibration_path, self.intrinsics, first, size, self.stated_size)
        return size

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width).

        Raises InputError if it is unreadable or has another size.
        """
        path = self.frame_paths[index]
        if self._white:
            image = cv2.convertScaleAbs(read_gray(path, np.uint16), alpha=255 / self._white)
        else:
            image = read_gray(path)
        check_size(path, image.shape, self.size)
        return self.undistorted(image)

    @cached_property
    def _white(self) -> int:
        """Gray value that becomes 255: the largest one of the first frame; 0 for 8-bit frames."""
        first = read_gray(self.frame_paths[0], np.uint16)
        if first.dtype == np.uint8:
            return 0
        say_once(
            f"{self.folder}: frames have 16 bits; {first.max()}, the first one's maximum, is white"
        )
        return int(first.max())

    def undistorted(self, image: np.ndarray, interpolation: int = cv2.INTER_LINEAR) -> np.ndarray:
        """Image of the frame's size without the camera's distortion, as OpenCV takes it out.

        Frames are so already. For masks and label maps made from files, give cv2.INTER_NEAREST.
        """
        if not self.distortion.any():
            return image
        return cv2.remap(image, *self._maps, interpolation)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        camera, size = self.intrinsics, self.size[::-1]
        return cv2.initUndistortRectifyMap(
            camera, self.distortion, None, camera, size, cv2.CV_16SC2
        )

    def __getitem__(self, index: int) -> np.ndarray:
        return self.frame(operator.index(index))

    def __iter__(self) -> Iterator[np.ndarray]:
        return map(self.frame, range(len(self)))

    def visible(self, index: int) -> np.ndarray | None:
        """Where keypoints may lie in frame `index`, (height, width) uint8: 255, elsewhere 0.

        They lie neither in transparent parts, nor outside of what the camera saw if its distortion
        is taken out, nor in the border (`without_border`), nor within BORDER_MARGIN pixels of
        these. None: everywhere.
        """
        hidden = np.zeros(self.size, bool) if self.border is None else self.border.copy()
        if self._has_alpha:
            pixels = cv2.imread(str(self.frame_paths[index]), cv2.IMREAD_UNCHANGED)
            if pixels.ndim == 3 and pixels.shape[2] == 4:
                hidden |= self.undistorted((pixels[..., 3] == 0).astype(np.uint8)) > 0
        if self.distortion.any():
            hidden |= self.undistorted(np.full(self.size, 255, np.uint8)) == 0
        if not hidden.any():
            return None
        margin = np.ones([2 * BORDER_MARGIN + 1] * 2, np.uint8)
        return 255 - cv2.dilate(hidden * np.uint8(255), margin)

    @cached_property
    def _has_alpha(self) -> bool:
        pixels = cv2.imread(str(self.frame_paths[0]), cv2.IMREAD_UNCHANGED)
        return pixels is not None and pixels.ndim == 3 and pixels.shape[2] == 4

    def without_border(self) -> "Sequence":
        """Copy without keypoints in parts that are black in all frames, nor close to them.

        Undistortion leaves such borders. Raises InputError if there are none.
        """
        sample = np.unique(np.linspace(0, len(self) - 1, BORDER_SAMPLES).astype(int))
        border = np.max([self.frame(index) for index in sample], axis=0) <= BLACK
        if not border.any() or border.all():
            raise InputError(f"{self.folder}: frames have no black border; do not leave it out")
        bordered = copy(self)
        bordered.border = border
        return bordered

    def subset(self, count: int | None) -> "Sequence":
        """Copy of the sequence with its first `count` frames; None for all frames."""
        short = copy(self)
        short.frame_paths, short.times = self.frame_paths[:count], self.times[:count]
        if self.has_truth:
            short._poses = self._poses[:count]
        return short


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
    form = ", f 0 u 0 0 f v 0 0 0 1 0, of a camera without distortion"
    key = f"{CALIBRATION_KEYS.get(camera, 'P0')}:"
    matrix = read_line(path, key, 12, form).reshape(3, 4)[:, :3]
    if not is_camera_matrix(matrix):
        raise InputError(f"{path}: line '{key}' must hold 12 numbers{form}")
    return matrix
