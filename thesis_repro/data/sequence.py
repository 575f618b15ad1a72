"""A sequence: frames, camera, times and ground truth, in any of the layouts of `layout.LAYOUTS`."""

import operator
from collections.abc import Iterator
from copy import copy
from functools import cached_property, partial
from pathlib import Path

import cv2
import numpy as np

from thesis_repro.data import cameras, layout
from thesis_repro.data.arrays import FRAME_TIME, ArraySequence, distances, step_lengths
from thesis_repro.data.frames import Files, eight_bits, say_once, white_level
from thesis_repro.data.geometry import check_camera
from thesis_repro.data.trajectories import WITHIN, read_truth
from thesis_repro.errors import InputError
from thesis_repro.running import provenance
from thesis_repro.running.files import read_gray, read_unchanged

# Pixels near hidden parts where keypoints are left out: half a window of the tracker, which would
# see their edge
MARGIN = 10


class Sequence:
    """A sequence in one of the layouts of `layout.LAYOUTS`, or a folder of own frames.

    Frames are PNG or JPEG files. Colour frames are read as gray. Without a file of times, `times`
    assumes ten frames a second, as in KITTI. Without a file of poses, `has_truth` is False. KITTI's
    ground truth belongs to the left gray camera; the left colour camera is 6 cm beside it. The
    constructor reads and checks all files except the frames. Raises InputError, naming the file, if
    a file is missing or malformed.

    `Sequence.from_arrays(frames, intrinsics, ...)` is for frames in memory.
    """

    from_arrays = ArraySequence

    def __init__(
        self,
        root: str | Path | None,
        name: str | int | Path,
        camera: str | None = None,
        *,
        speed: float | None = None,
        fps: float | None = None,
        truth: str | Path | None = None,
        calibration: str | Path | None = None,
        truth_within: float = WITHIN,
    ) -> None:
        """Find, read and check the files of a sequence, except its frames.

        root: folder that holds sequences and poses. name: the sequence, "06", "6" or 6.
        For a sequence outside of a root, root is None and name is a folder.
        camera: one of the layout's, such as image_2; the default is the left one. speed: metres a
        second, in place of ground truth; without both, a step is a metre. fps: frames a
        second, for a sequence without a file of times. truth: file of the ground truth, in any form
        that poses.txt may have. calibration: file of a camera, see `cameras.read_camera`; its
        distortion is taken out of the frames. truth_within: seconds between a frame and its pose,
        at most, if poses have times. Frames without a pose are left out.
        """
        folder = layout.locate(root, name)
        files = layout.files(folder, camera)
        calibration_path, poses_path = files.calibration, files.poses
        read_camera, read_poses = files.read_camera, files.read_poses
        if calibration is not None:
            calibration_path = Path(calibration)
            read_camera = partial(cameras.read_camera, name=files.camera)
        if truth is not None:
            poses_path, read_poses = Path(truth), read_truth
        lens = read_camera(calibration_path)
        texts = [calibration_path, files.times, poses_path, *files.others]
        times, has_times = _read_times(files, fps)
        has_truth = truth is not None or (speed is None and poses_path.exists())
        if speed is not None:
            _check_speed(speed, has_times, has_truth, poses_path)
        kept, poses = np.arange(len(files.frames)), None
        if has_truth:
            indices, poses = read_poses(poses_path, times if has_times else None, truth_within)
            if poses_path.suffix == ".csv":
                body_path, body = _camera_in_body(files, calibration_path, lens)
                poses = _poses_of_camera(poses, poses_path, body, body_path)
                texts.append(body_path)
            elif lens.body is not None:
                say_once(
                    f"{poses_path}: poses are the camera's; those of the body need EuRoC's .csv"
                )
            if indices is None:
                check_count(poses_path, len(poses), files.frames)
            else:
                _tell_missing(poses_path, indices, files.frames, truth_within)
                kept = indices

        self.folder, self.name, self.speed = folder, folder.name, speed
        self.frame_paths = [files.frames[index] for index in kept]
        self.times, self.has_times = times[kept], has_times
        self.lens, self.intrinsics = lens, lens.matrix
        self.has_truth, self._poses = has_truth, poses
        self.calibration_path, self.poses_path = calibration_path, poses_path
        self._texts = dict.fromkeys(texts)

    @property
    def poses(self) -> np.ndarray:
        """Ground truth: camera-to-world poses, (n, 4, 4), metres.

        Raises InputError if there is none.
        """
        if self._poses is None:
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

        Frames and calibration, and those of times and poses that exist.
        """
        return [*self.frame_paths, *filter(Path.is_file, self._texts)]

    def digest(self) -> str:
        """What tells the sequence from others in a record of results."""
        return provenance.digest_of_files(self.files)

    @property
    def label_names(self) -> list[str]:
        """File names of label maps and masks: the names of the frames, with the ending .png."""
        return [f"{path.stem}.png" for path in self.frame_paths]

    def __repr__(self) -> str:
        truth = "with" if self.has_truth else "without"
        return f"Sequence {self.name}: {len(self)} frames {truth} true poses, {self.folder}"

    def __len__(self) -> int:
        return len(self.frame_paths)

    @cached_property
    def size(self) -> tuple[int, int]:
        """Size (height, width) of the first frame. Raises InputError as `check_camera` does."""
        first = self.frame_paths[0]
        size = read_gray(first, np.uint16).shape
        check_camera(self.calibration_path, self.intrinsics, first, size, self.lens.size)
        return size

    def frame(self, index: int) -> np.ndarray:
        """Frame `index` as 8-bit gray, (height, width).

        Raises InputError if it is unreadable or has another size.
        """
        path = self.frame_paths[index]
        image = eight_bits(read_gray(path, np.uint16 if self._white else np.uint8), self._white)
        check_size(path, image.shape, self.size)
        return self.undistorted(image)

    @cached_property
    def _white(self) -> int:
        return white_level(self.frame_paths[0])

    def undistorted(self, image: np.ndarray) -> np.ndarray:
        """Image of the frame's size without the camera's distortion; frames are so already."""
        return cameras.undistorted(image, self.lens)

    def __getitem__(self, index: int) -> np.ndarray:
        if isinstance(index, slice):
            raise InputError(
                f"sequence {self.name}: takes no slice; subset(n) has the first n frames"
            )
        return self.frame(operator.index(index))

    def __iter__(self) -> Iterator[np.ndarray]:
        return map(self.frame, range(len(self)))

    def visible(self, index: int) -> np.ndarray | None:
        """Where keypoints may lie in frame `index`, (height, width) uint8: 255, elsewhere 0.

        They lie neither in transparent parts, nor outside of what the camera saw if its distortion
        is taken out, nor within MARGIN pixels of these. None: everywhere.
        """
        hidden = np.zeros(self.size, bool)
        if self._has_alpha:
            pixels = read_unchanged(self.frame_paths[index])
            if pixels.ndim == 3 and pixels.shape[2] == 4:
                hidden |= self.undistorted((pixels[..., 3] == 0).astype(np.uint8)) > 0
        if self.lens.distortion.any():
            hidden |= self.undistorted(np.full(self.size, 255, np.uint8)) == 0
        if not hidden.any():
            return None
        margin = np.ones([2 * MARGIN + 1] * 2, np.uint8)
        return 255 - cv2.dilate(hidden * np.uint8(255), margin)

    @cached_property
    def _has_alpha(self) -> bool:
        pixels = read_unchanged(self.frame_paths[0])
        return pixels.ndim == 3 and pixels.shape[2] == 4

    def subset(self, count: int | None) -> "Sequence":
        """Copy of the sequence with its first `count` frames, 1 or more; None for all frames."""
        if count is not None and count < 1:
            raise InputError(f"sequence {self.name}: subset({count}); must be 1 frame or more")
        short = copy(self)
        short.frame_paths, short.times = self.frame_paths[:count], self.times[:count]
        if self._poses is not None:
            short._poses = self._poses[:count]
        return short


def _read_times(files: Files, fps: float | None) -> tuple[np.ndarray, bool]:
    """Times of the frames, (n,), seconds, and whether somebody said what they are."""
    count = len(files.frames)
    if files.times.exists():
        if fps is not None:
            raise InputError(
                f"fps {fps:g}: leave it out; {files.times} has the times of the frames"
            )
        times = files.read_times(files.times)
        check_count(files.times, len(times), files.frames)
        return times, True
    if fps is not None:
        if not 0 < fps < np.inf:
            raise InputError(f"fps {fps:g}: must be a number of frames a second, above 0")
        return np.arange(count) / fps, True
    say_once(
        f"{files.times}: no such file, so {1 / FRAME_TIME:g} frames a second are assumed (--fps gives another "
        "number)"
    )
    return FRAME_TIME * np.arange(count), False


def _check_speed(speed: float, has_times: bool, has_truth: bool, poses_path: Path) -> None:
    if not 0 < speed < np.inf:
        raise InputError(f"speed {speed:g}: must be a number of metres a second, above 0")
    if has_truth:
        raise InputError(f"speed {speed}: leave it out; {poses_path} has the true step lengths")
    if poses_path.exists():
        say_once(f"{poses_path}: true poses are not used, because of the speed")
    if not has_times:
        raise InputError(
            f"speed {speed}: needs the times of the frames (times.txt), or their number a second (--fps)"
        )


def _camera_in_body(
    files: Files, calibration_path: Path, lens: cameras.Camera
) -> tuple[Path, np.ndarray | None]:
    """File that states the camera's pose in the body (T_BS), and the pose.

    Another calibration without one leaves that of the layout as it is.
    """
    if lens.body is None and files.calibration.is_file():
        return files.calibration, files.read_camera(files.calibration).body
    return calibration_path, lens.body


def _poses_of_camera(
    poses: np.ndarray, path: Path, body: np.ndarray | None, body_path: Path
) -> np.ndarray:
    """Poses of the camera, (n, 4, 4), of those of a body, which EuRoC's files (.csv) hold."""
    if body is None:
        say_once(
            f"{path}: holds poses of a body, which are taken as the camera's, because {body_path} has no "
            "T_BS, the camera's pose in the body",
            warns=True,
        )
        return poses
    say_once(f"{path}: poses of the body become the camera's by T_BS of {body_path}")
    return poses @ body


def _tell_missing(path: Path, indices: np.ndarray, frames: list[Path], within: float) -> None:
    """Say which frames have no pose, and are left out. indices: of those that have one."""
    if len(indices) == len(frames):
        return
    line = f"{path}: has poses of {len(indices)} of {len(frames)} frames, which are used"
    inner = np.setdiff1d(np.arange(indices[0], indices[-1] + 1), indices)
    if len(inner):
        line += (
            f"; {len(inner)} between them, the first one {frames[inner[0]].name}, have none within "
            f"{within:g} s"
        )
    say_once(line)


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
