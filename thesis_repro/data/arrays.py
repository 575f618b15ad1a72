"""What stands for a sequence, and a sequence whose frames are in memory."""

import hashlib
from collections.abc import Iterator
from numbers import Real
from typing import Any, Protocol

import numpy as np

from thesis_repro.data.geometry import are_poses
from thesis_repro.errors import InputError
from thesis_repro.running import program

FRAME_TIME = 0.1  # seconds between frames, where nobody says when they were taken
# What drives stays below them; KITTI's car reaches 2.8 m a frame and 26 m/s.
MAX_STEP, MAX_SPEED = 50.0, 100.0  # metres a frame, metres a second


class SequenceLike(Protocol):
    """What stands for a sequence: any object with these names, such as one that decodes a video.

    If has_truth is False, nothing asks for poses.
    """

    @property
    def intrinsics(self) -> np.ndarray:
        """Camera matrix, (3, 3), pixels: (fx, 0, u), (0, fy, v), (0, 0, 1)."""

    @property
    def scales(self) -> np.ndarray:
        """Lengths of the steps, (n,), metres since the frame before; the first one is 0."""

    @property
    def has_truth(self) -> bool:
        """Whether there are true poses."""

    @property
    def poses(self) -> np.ndarray:
        """True camera-to-world poses, (n, 4, 4), metres. The estimate starts at the first one."""

    def __len__(self) -> int:
        """Return the number of frames, n."""

    def frame(self, index: int, /) -> np.ndarray:
        """Return frame `index`, 8-bit gray, (height, width)."""

    def visible(self, index: int, /) -> np.ndarray | None:
        """Return where keypoints may lie in it, as a mask of 0 and 255; None: everywhere."""


class ArraySequence:
    """A sequence of frames in memory: `Sequence.from_arrays(frames, intrinsics, ...)`."""

    def __init__(
        self,
        frames: Any,
        intrinsics: Any,
        scales: Any = None,
        poses: Any = None,
        speed: float | None = None,
        times: Any = None,
        name: str = "frames in memory",
    ) -> None:
        """Check everything but the frames, which the odometry checks when it takes them.

        frames: a list or an array, or any object with a length whose item i is frame i, (height,
        width) uint8. intrinsics: 3x3, pixels, (fx, 0, u), (0, fy, v), (0, 0, 1).
        How long the steps are: scales, (n,), metres since the frame before, the first one 0; or
        poses, (n, 4, 4), true camera-to-world poses, metres; or speed, metres a second, with times,
        (n,), seconds; or none of them, for one metre a frame. name: in tables and messages.
        Raises InputError for something else.
        """
        if not hasattr(frames, "__len__") or not len(frames):
            raise InputError("frames: must be a list or an array of one frame or more")
        given = [value for value in (scales, poses, speed) if value is not None]
        if len(given) > 1:
            raise InputError("scales, poses, speed: give one of them, for the lengths of steps")
        if speed is not None and times is None:
            raise InputError("speed: needs the times of the frames, in seconds")
        if speed is not None and not (isinstance(speed, Real) and 0 < speed < np.inf):
            raise InputError(f"speed {speed!r}: must be a number of metres a second, above 0")
        self._frames, self.intrinsics = frames, np.array(intrinsics, float)
        self.name = self.poses_path = name
        self.times = _numbers("times", times, FRAME_TIME * np.arange(len(frames)))
        if not (np.diff(self.times) > 0).all():
            raise InputError("times: must increase from frame to frame, seconds")
        self.scales = _numbers("scales", scales, step_lengths(self.times, speed))
        self.has_truth = poses is not None
        if self.has_truth:
            self._poses = _numbers("poses", poses, np.empty((len(frames), 4, 4)))
            if not are_poses(self._poses).all():
                raise InputError("poses: must be camera to world, a rotation and a position each")
            self.scales = distances(self._poses)
        impossible = are_impossible(self.scales[1:], None if times is None else np.diff(self.times))
        if impossible.any():
            program.log.warning(
                f"{name}: {impossible.sum()} of {len(frames) - 1} steps are impossible; the first is "
                f"{self.scales[1:][impossible][0]:.3g} m; are lengths in metres, times in seconds, and the "
                "speed in metres a second?"
            )

    @property
    def poses(self) -> np.ndarray:
        """True camera-to-world poses, (n, 4, 4), metres. Raises InputError if there are none."""
        if not self.has_truth:
            raise InputError(f"{self.name}: no poses were given; ground truth is needed")
        return self._poses

    @property
    def size(self) -> tuple[int, ...]:
        """Size (height, width) of the first frame."""
        return self.frame(0).shape

    def __repr__(self) -> str:
        truth = "with" if self.has_truth else "without"
        return f"Sequence {self.name}: {len(self)} frames {truth} true poses"

    def __len__(self) -> int:
        return len(self._frames)

    def frame(self, index: int) -> np.ndarray:
        """Frame `index`, a copy. The odometry checks what it is."""
        return np.array(self._frames[index])

    def __getitem__(self, index: int) -> np.ndarray:
        return self.frame(index)

    def __iter__(self) -> Iterator[np.ndarray]:
        return map(self.frame, range(len(self)))

    def visible(self, index: int) -> np.ndarray | None:
        """Where keypoints may lie in frame `index`: None, everywhere."""
        return None

    def digest(self) -> str:
        """What tells the sequence from others in a record of results."""
        digest = hashlib.sha256(self.intrinsics.tobytes() + self.scales.tobytes())
        if self.has_truth:
            digest.update(self._poses.tobytes())
        for frame in self:
            digest.update(frame.tobytes())
        return digest.hexdigest()[:12]


def distances(poses: np.ndarray) -> np.ndarray:
    """Distances between consecutive positions of poses (n, 4, 4), (n,), metres; the first is 0."""
    return np.array([0.0, *(np.linalg.norm(step) for step in np.diff(poses[:, :3, 3], axis=0))])


def step_lengths(times: np.ndarray, speed: float | None) -> np.ndarray:
    """Lengths of steps (n,), metres, at a speed, metres a second; None: 1 m. The first one is 0.

    times: of the frames, (n,), seconds.
    """
    lengths = np.ones(len(times) - 1)
    if speed is not None:
        lengths = speed * np.diff(times)
    return np.array([0.0, *lengths])


def are_impossible(lengths: np.ndarray, intervals: np.ndarray | None) -> np.ndarray:
    """Whether steps, (n,), metres, are longer or faster than what drives.

    intervals: seconds, (n,); None if nobody stated them.
    """
    impossible = lengths > MAX_STEP
    return impossible if intervals is None else impossible | (lengths > MAX_SPEED * intervals)


def _numbers(name: str, values: Any, default: np.ndarray) -> np.ndarray:
    """Return finite numbers of the default's shape, or the default for None."""
    if values is None:
        return default
    array = np.array(values)
    is_right = array.dtype.kind in "biuf" and array.shape == default.shape  # dates are no seconds
    if not is_right or not np.isfinite(array).all():
        raise InputError(
            f"{name}: {array.dtype} {array.shape}; must be finite numbers, {default.shape}"
        )
    return array.astype(float)
