"""Monocular visual odometry as PySLAM has it (Section 3.7): four calls of OpenCV a frame.

The loop is `Odometry.step`. The rules for frames on which PySLAM would crash, and the flags that a
frame can get, are in the table in odometry/__init__.py.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from thesis_repro.errors import need
from thesis_repro.odometry import types
from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.odometry.types import NO_POINTS, Matches, Motion, Step

PROBABILITY = 0.999  # that RANSAC has tried a sample without wrong matches
TERMINATION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)  # of the tracker
MIN_MATCHES = 5  # for an essential matrix
MIN_CONTRAST = 4.0  # standard deviation in gray levels; real frames have more than 50
MAX_TURN = 6.0  # degrees a frame; KITTI's car turns by at most 4.8
STATIONARY = "stationary"  # flag of a step that is shorter than the gate


# The four calls


def detect(
    frame: np.ndarray, settings: OdometrySettings = THESIS, mask: np.ndarray | None = None
) -> np.ndarray:
    """Find Shi-Tomasi keypoints, (N, 2) float32 pixels, strongest first (Equation 3.13).

    mask: (height, width) uint8; keypoints lie only where it is not 0.
    """
    points = cv2.goodFeaturesToTrack(
        frame,
        settings.max_keypoints,
        settings.quality,
        settings.min_distance,
        mask=mask,
        blockSize=settings.block_size,
    )
    if points is None:
        return NO_POINTS
    return points.reshape(-1, 2)


def track(
    previous: np.ndarray,
    current: np.ndarray,
    points: np.ndarray,
    settings: OdometrySettings = THESIS,
) -> tuple[np.ndarray, np.ndarray]:
    """Track points (N, 2) into the current frame by Lucas-Kanade (Equation 3.15).

    Returns the tracked points, (N, 2) float32, and whether each was found, (N,) booleans.
    """
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        previous,
        current,
        points,
        None,
        winSize=(settings.window, settings.window),
        maxLevel=settings.levels,
        criteria=TERMINATION,
    )
    return tracked, status.ravel() == 1


def find_essential_matrix(
    current: np.ndarray, previous: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Estimate the essential matrix of matches (N, 2) by RANSAC (Equation 2.5).

    Returns (matrix, inliers); the matrix is None, or several in one array, if there is no single
    one. Points of the current frame come first, as in PySLAM.
    """
    return cv2.findEssentialMat(current, previous, 1.0, (0, 0), cv2.RANSAC, PROBABILITY, threshold)


def recover_pose(
    matrix: np.ndarray, current: np.ndarray, previous: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray]:
    """Let matches (N, 2) vote for one of the four motions of an essential matrix: (votes, R, t)."""
    votes, rotation, translation, _ = cv2.recoverPose(matrix, current, previous)
    return votes, rotation, translation.ravel()


class Calls(NamedTuple):
    """The four functions that a step calls.

    Others may take their places, such as your own keypoints or matches.
    """

    detect: Callable = detect
    track: Callable = track
    find_essential_matrix: Callable = find_essential_matrix
    recover_pose: Callable = recover_pose


OPENCV = Calls()


def normalise(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Normalised image coordinates (N, 2), in double precision, of pixels (N, 2) (Equation 2.4).

    u * (1 / fx) + (-cx / fx) equals the product of the inverse camera matrix and (u, v, 1) to the
    last bit. The formula (u - cx) / fx does not. RANSAC amplifies a difference in the last bit, so
    the trajectory would be another one.
    """
    focal_lengths = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    return points * (1 / focal_lengths) + (-intrinsics[:2, 2] / focal_lengths)


# The loop


class Estimator(Protocol):
    """Completes the motion of a step: an essential matrix allows four motions."""

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step.

        scale: metres. moves: whether the step will move the pose.
        """


class VoteOfAll:
    """The motion that most matches vote for, outliers included, as in PySLAM."""

    def __init__(self, calls: Calls = OPENCV):
        self.calls = calls

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step (see Estimator)."""
        votes, rotation, translation = self.calls.recover_pose(
            essential, matches.current, matches.previous
        )
        return Motion(rotation, translation, votes)


class Odometry:
    """Monocular visual odometry, frame by frame: each frame is a call of `step`."""

    def __init__(
        self,
        intrinsics: Any,
        settings: OdometrySettings = THESIS,
        start: Any = None,
        calls: Calls | None = None,
    ):
        """Start before the first frame.

        intrinsics: 3x3, pixels, as (fx, 0, u), (0, fy, v), (0, 0, 1). start: pose of the first
        frame, 4x4; None for the identity. calls: functions in place of OpenCV's.
        Raises InputError for another matrix, and for a start that is no pose.
        """
        need("settings", settings, OdometrySettings)
        self.intrinsics = types.camera_matrix(intrinsics)
        self.settings = settings
        self.calls = calls or OPENCV._replace(detect=settings.detect_function())
        self.estimator: Estimator = settings.new_estimator(self.calls)
        self.pose = types.start_pose(start)
        self.count = 0  # of frames so far
        self.previous: np.ndarray | None = None  # the frame in which self.points lie
        self.points = NO_POINTS
        self.skipped_metres = 0.0  # moved during flat frames

    def step(self, frame: Any, scale: Any = 0.0, mask: Any = None) -> Step:
        """Take the next frame. Returns a Step.

        frame: (height, width) uint8. scale: metres moved since the frame before. mask: of the same
        size, uint8 or bool; keypoints lie only where it is not 0.
        Raises InputError for a frame, scale or mask of another kind.
        """
        frame = types.gray_frame(frame, self.count, self.intrinsics, self.previous)
        mask = types.allowed_pixels(mask, self.count, frame)
        step = Step(self.count, types.step_length(scale, self.count))
        if self.previous is not None:
            step.scale += self.skipped_metres
        self.count += 1
        if frame[::8, ::8].std() < MIN_CONTRAST:
            step.flags.append("flat frame")
            self.skipped_metres = step.scale
        else:
            self.skipped_metres = 0.0
            self._track(step, frame)
            self._estimate(step)
            self._detect(step, frame, mask)
            self.previous = frame
        step.pose = self.pose.copy()
        return step

    def _track(self, step: Step, frame: np.ndarray) -> None:
        """Track the points of the previous frame into this one (Section 3.7.2)."""
        if step.frame == 0:
            return
        step.points = len(self.points)
        if step.points == 0:
            step.flags.append("no points")
            return
        started = time.perf_counter()
        tracked, was_found = self.calls.track(self.previous, frame, self.points, self.settings)
        step.seconds["track"] = time.perf_counter() - started
        step.previous = self.points[was_found]
        step.current = tracked[was_found]

    def _estimate(self, step: Step) -> None:
        """Estimate the motion from the matches (Section 3.7.3), and move the pose."""
        if not step.points:
            return
        current = normalise(step.current, self.intrinsics)
        previous = normalise(step.previous, self.intrinsics)
        order = self._order(step)
        step.matches = Matches(current, previous, self.settings.threshold, order=order)
        started = time.perf_counter()
        matrix, inliers = None, None
        if len(current) >= MIN_MATCHES:
            matrix, inliers = self.calls.find_essential_matrix(
                current[order], previous[order], self.settings.threshold
            )
        step.seconds["essential"] = time.perf_counter() - started
        flag = _flag_of_matrix(matrix, len(current))
        if flag:
            step.flags.append(flag)
            return
        agrees = np.empty(len(current), bool)
        agrees[order] = inliers.ravel() > 0
        step.matches = replace(step.matches, inliers=agrees)
        self._complete(step, matrix)

    def _complete(self, step: Step, matrix: np.ndarray) -> None:
        """Complete the motion from an essential matrix, and move the pose (Equations 2.2, 2.3)."""
        kept = ""
        if _by_chance(step.inliers):
            kept = "no agreement"
        elif step.scale <= self.settings.scale_gate:
            kept = STATIONARY
        started = time.perf_counter()
        step.motion = self.estimator.motion(matrix, step.matches, step.scale, not kept)
        step.seconds["pose"] = time.perf_counter() - started
        if kept:
            step.flags.append(kept)
            return
        if step.motion.flag:
            step.flags.append(step.motion.flag)
        rotation, translation = step.motion.rotation, step.motion.translation
        if np.trace(rotation) < 1 + 2 * np.cos(np.radians(MAX_TURN)):
            step.flags.append("too large a turn")
        moved = self.pose.copy()
        moved[:3, :3] = self.pose[:3, :3] @ rotation
        moved[:3, 3] = self.pose[:3, 3] + step.scale * (self.pose[:3, :3] @ translation)
        self.pose = moved
        step.updated = True

    def _detect(self, step: Step, frame: np.ndarray, mask: np.ndarray | None) -> None:
        """Replace all points by new keypoints if too few were tracked (Section 3.7.1)."""
        points = step.current
        if len(points) < self.settings.redetect_below or not len(points):
            started = time.perf_counter()
            detected = self.calls.detect(frame, self.settings, mask)
            step.seconds["detect"] = time.perf_counter() - started
            step.detected = len(detected)
            if len(detected):
                points = detected
            else:
                step.flags.append("no keypoints")
        self.points, step.keypoints = points.copy(), points

    def _order(self, step: Step) -> np.ndarray | slice:
        """The order in which RANSAC takes the matches, (N,) indices; a slice: as they are."""
        if self.settings.shuffle_seed is None:
            return slice(None)
        random = np.random.default_rng((self.settings.shuffle_seed, step.frame))
        return random.permutation(len(step.current))


def _flag_of_matrix(matrix: np.ndarray | None, matches: int) -> str:
    """Say why an essential matrix cannot be used; empty if it can."""
    if matches < MIN_MATCHES:
        return "fewer than five correspondences"
    if matrix is None or not np.isfinite(matrix).all():
        return "no essential matrix"
    if matrix.shape != (3, 3):  # from five matches, OpenCV returns all solutions in one array
        return "several essential matrices"
    return ""


def _by_chance(inliers: np.ndarray) -> bool:
    """Whether there are no more inliers (N booleans) than two unrelated frames have.

    With PySLAM's threshold, two unrelated frames have 7 inliers among 20 points, 9 among 100, 12
    among 300, and 24 to 43 among 1600. In consecutive real frames, 45 to 85 % of the points are
    inliers.
    """
    return inliers.sum() <= 8 + 0.03 * len(inliers)
