"""What goes into the odometry and what comes out of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from thesis_repro.data.kitti import check_camera, is_camera_matrix
from thesis_repro.data.trajectories import are_poses
from thesis_repro.errors import InputError

NO_POINTS = np.empty((0, 2), np.float32)
TIMED_PARTS = ("detect", "track", "essential", "pose")
MIN_CONTRAST = 4.0  # standard deviation in gray levels; real frames have more than 50
EQUAL = "equal frame"  # flag of a frame that equals the one before
ROTATION_COLUMNS = [f"r{i}{j}" for i in range(3) for j in range(3)]


@dataclass(frozen=True, eq=False)
class Matches:
    """Points matched between two frames, in normalised image coordinates.

    current, previous: (N, 2). threshold: largest distance of an inlier. inliers: (N,) booleans,
    those that agree with the essential matrix; None before it is known. order: the order in which
    RANSAC takes the matches, (N,) indices; a slice: as they are.
    """

    current: np.ndarray
    previous: np.ndarray
    threshold: float
    inliers: Any = None
    order: np.ndarray | slice = field(default_factory=lambda: slice(None))

    def agree_by_chance(self) -> bool:
        """Return whether there are no more inliers than two unrelated frames have.

        With PySLAM's threshold, two unrelated frames have 7 inliers among 20 points, 9 among 100,
        12 among 300, and 24 to 43 among 1600. In consecutive real frames, 45 to 85 % of the points
        are inliers.
        """
        return self.inliers.sum() <= 8 + 0.03 * len(self.inliers)


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the camera between two frames.

    As in PySLAM, it takes coordinates of the current camera to coordinates of the previous camera,
    so it moves a camera-to-world pose without an inverse. rotation is None if it is not known.
    flag: what is doubtful about the motion.
    """

    rotation: Any = None  # 3x3
    translation: Any = None  # 3, unit length
    pose_inliers: int = 0  # matches in front of both cameras and not too far away
    flag: str = ""


def motion_of_vote(votes: int, rotation: np.ndarray, translation: np.ndarray) -> Motion:
    """Return the motion that won a vote.

    If no match votes, PySLAM keeps the first of the four motions. Which one that is depends on the
    processor, so the motion gets a flag.
    """
    return Motion(rotation, translation, votes, "" if votes else "no votes")


class Estimator(Protocol):
    """Completes the motion of a step: an essential matrix allows four motions.

    With a method `search(current, previous, threshold)`, as loop.find_essential_matrix, it
    brings its own search in place of RANSAC. Flags such as "no agreement" follow from its inliers.
    """

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step.

        scale: metres. moves: whether the step will move the pose.
        """


@dataclass(eq=False)
class Step:
    """Results for one frame.

    Its N matched points are `previous` and `current`, (N, 2) pixels, and `matches`, the same in
    normalised coordinates. Later steps do not depend on its arrays.
    """

    frame: int
    scale: float = 0.0  # metres moved since the previous frame that was not skipped
    points: int | None = None  # number of points given to the tracker
    detected: int | None = None  # number of new keypoints; None if the detector did not run
    previous: np.ndarray = field(default_factory=lambda: NO_POINTS)
    current: np.ndarray = field(default_factory=lambda: NO_POINTS)
    matches: Matches | None = None
    keypoints: np.ndarray = field(default_factory=lambda: NO_POINTS)  # tracked into the next frame
    motion: Motion = Motion()
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))  # camera to world, metres
    updated: bool = False  # whether this step moved the pose
    flags: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMED_PARTS, 0.0))

    @property
    def inliers(self) -> np.ndarray:
        """Matches that agree with the essential matrix, (N,) booleans."""
        if self.matches is None or self.matches.inliers is None:
            return np.zeros(len(self.current), bool)
        return self.matches.inliers

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Measure the seconds of one of TIMED_PARTS."""
        started = time.perf_counter()
        yield
        self.seconds[part] += time.perf_counter() - started

    def row(self) -> dict[str, Any]:
        """One row of Result.frames."""
        tracked = inliers = pose_inliers = None
        if self.points is not None:
            tracked = len(self.current)
            inliers = int(self.inliers.sum())
            pose_inliers = self.motion.pose_inliers
        return {
            "frame": self.frame,
            "points": self.points,
            "detected": self.detected,
            "tracked": tracked,
            "inliers": inliers,
            "pose_inliers": pose_inliers,
            "scale": self.scale,
            "updated": self.updated,
            "flag": "; ".join(self.flags),
            **dict(zip("xyz", self.pose[:3, 3].tolist(), strict=True)),
            **dict(zip(ROTATION_COLUMNS, self.pose[:3, :3].ravel().tolist(), strict=True)),
            **{f"{name}_seconds": value for name, value in self.seconds.items()},
        }


FRAME_COLUMNS = tuple(Step(0).row())


def camera_matrix(intrinsics: Any) -> np.ndarray:
    """Return a camera matrix, (fx, 0, u), (0, fy, v), (0, 0, 1) in pixels, or raise InputError."""
    matrix = np.array(intrinsics, np.float64)
    if not is_camera_matrix(matrix):
        raise InputError(
            "intrinsics: must be (fx, 0, u), (0, fy, v), (0, 0, 1) in pixels, not "
            f"{matrix.tolist()}"
        )
    return matrix


def start_pose(start: Any) -> np.ndarray:
    """Return the pose of the first frame, 4x4 (None: the identity), or raise InputError."""
    if start is None:
        return np.eye(4)
    pose = np.array(start, np.float64)
    is_pose = pose.shape == (4, 4) and are_poses(pose[None]).all()
    if not is_pose or not np.array_equal(pose[3], [0, 0, 0, 1]):
        raise InputError("start: must be a pose, 4x4: a right-handed rotation and a position")
    return pose


def gray_frame(
    frame: Any, number: int, intrinsics: np.ndarray, previous: np.ndarray | None
) -> np.ndarray:
    """Return frame `number` as (height, width) uint8 that nobody changes, or raise InputError."""
    frame = np.asarray(frame)  # cv2.imread returns None for a missing file
    if frame.dtype != np.uint8 or frame.ndim != 2:
        raise InputError(
            f"frame {number}: {frame.dtype} of shape {frame.shape}; "
            "the odometry needs 8-bit gray, (height, width)"
        )
    check_camera("intrinsics", intrinsics, f"frame {number}", frame.shape)
    if previous is not None and frame.shape != previous.shape:
        raise InputError(
            f"frame {number}: shape {frame.shape}, earlier frames {previous.shape}; "
            "all frames must have the same size"
        )
    if frame.flags.writeable:  # the caller may read the next frame into the same array
        frame = frame.copy()
        frame.setflags(write=False)
    return frame


def reasons_to_skip(frame: np.ndarray, previous: np.ndarray | None) -> list[str]:
    """Return the flag of a frame without contrast, or of one that equals the frame before."""
    if frame[::8, ::8].std() < MIN_CONTRAST:
        return ["flat frame"]
    if previous is not None and np.array_equal(frame, previous):
        return [EQUAL]
    return []


def step_length(scale: Any, number: int) -> float:
    """Return the length of the step to frame `number`, metres, or raise InputError."""
    try:
        metres = float(scale)
    except (TypeError, ValueError):
        metres = np.nan
    if not np.isfinite(metres) or metres < 0:
        raise InputError(f"frame {number}: scale {scale!r} is not a distance in metres")
    return metres


def allowed_pixels(mask: Any, number: int, frame: np.ndarray) -> np.ndarray | None:
    """Return the mask of frame `number`, (height, width) uint8 or None, or raise InputError."""
    if mask is None:
        return None
    mask = np.asarray(mask)
    if mask.dtype == bool:
        mask = mask.view(np.uint8)
    if mask.shape != frame.shape or mask.dtype != np.uint8:
        raise InputError(
            f"frame {number}: the mask is {mask.dtype} of shape {mask.shape}, the frame uint8 of "
            f"shape {frame.shape}; masks must be 8-bit and as large as their frames"
        )
    if np.count_nonzero(mask) > np.count_nonzero(mask == mask.max()):
        raise InputError(
            f"frame {number}: the mask holds {len(np.unique(mask))} different values; a mask has "
            "0 and 255 (keypoint_mask makes masks from label maps)"
        )
    return mask
