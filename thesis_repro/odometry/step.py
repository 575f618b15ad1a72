"""A step of the odometry: its matches, its motion, and what comes out of it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

NO_POINTS = np.empty((0, 2), np.float32)
TIMED_PARTS = ("detect", "track", "essential", "pose")
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
    """What one step of the odometry found, from the previous frame to this one.

    keypoints: of this frame, (M, 2), (u, v) in pixels; they are tracked into the next one.
    previous, current: the N matches of this step, (N, 2) pixels: keypoints of the previous frame,
    and where they are in this one. matches: the same in normalised coordinates, x = K^-1 (u, v, 1).
    inliers: matches that agree with the essential matrix, (N,) booleans.
    essential: the essential matrix, (3, 3), or None. With x of the normalised coordinates,
    x_previous^T E x_current = 0, because PySLAM gives OpenCV the current points first. (Called as
    usual, OpenCV would return the transpose.)
    motion: rotation R and translation t of length 1, from this camera to the previous one:
    x_previous ~ R x_current + t / depth. Under the thesis's estimator, E is [t]x R times a number,
    because R and t are taken from E. The refined estimator fits them anew, so they differ from E.
    pose: camera to world, (4, 4), metres; the previous pose times (R, scale t), if `updated`.
    points, detected: numbers of points to track, and of new keypoints.

    "The previous frame" is the last one that was not skipped. The first frame has keypoints only.
    Later steps do not depend on these arrays.
    """

    frame: int
    scale: float = 0.0  # metres moved since the previous frame that was not skipped
    points: int | None = None  # number of points given to the tracker
    detected: int | None = None  # number of new keypoints; None if the detector did not run
    previous: np.ndarray = field(default_factory=lambda: NO_POINTS)
    current: np.ndarray = field(default_factory=lambda: NO_POINTS)
    matches: Matches | None = None
    essential: np.ndarray | None = None
    keypoints: np.ndarray = field(default_factory=lambda: NO_POINTS)  # tracked into the next frame
    motion: Motion = Motion()
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))  # camera to world, metres
    updated: bool = False  # whether this step moved the pose
    flags: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMED_PARTS, 0.0))

    def __repr__(self) -> str:
        x, y, z = self.pose[:3, 3]
        tracked, inliers = len(self.current), self.inliers.sum()
        return (
            f"Step: frame {self.frame}, {self.scale:.2f} m after the one before\n"
            f"  {self.points or 0} points, {tracked} tracked, {inliers} inliers; "
            f"{self.detected or 0} new keypoints\n"
            f"  position ({x:.2f}, {y:.2f}, {z:.2f}) m; flags: {', '.join(self.flags) or 'none'}"
        )

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
