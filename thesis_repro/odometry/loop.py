"""Monocular visual odometry as PySLAM has it (Section 3.7): four calls of OpenCV a frame.

The loop is `Odometry.step`. The rules for frames on which PySLAM would crash, and the flags that a
frame can get, are in the table in odometry/__init__.py.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np

from thesis_repro.errors import need
from thesis_repro.odometry import inputs
from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.odometry.step import NO_POINTS, Estimator, Matches, Motion, Step

PROBABILITY = 0.999  # that RANSAC has tried a sample without wrong matches
TERMINATION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)  # of the tracker
MIN_MATCHES = 5  # for an essential matrix
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
    return NO_POINTS if points is None else points.reshape(-1, 2)


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


class VoteOfAll(NamedTuple):
    """PySLAM's estimator: the motion that most matches vote for, outliers included."""

    calls: Calls = OPENCV

    def motion(self, essential: np.ndarray, matches: Matches, scale: float, moves: bool) -> Motion:
        """Return the motion of a step (see step.Estimator).

        If no match votes, PySLAM keeps the first of the four motions. Which one that is depends on
        the processor, so the motion gets a flag.
        """
        current, previous = matches.current, matches.previous
        votes, rotation, translation = self.calls.recover_pose(essential, current, previous)
        return Motion(rotation, translation, votes, "" if votes else "no votes")


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
        frame, 4x4; None for the identity. calls: functions in place of OpenCV's. The settings'
        detector holds unless `detect` is among them.
        Raises InputError for another matrix, and for a start that is no pose.
        """
        need("settings", settings, OdometrySettings)
        self.intrinsics = inputs.camera_matrix(intrinsics)
        self.settings = settings
        self.calls = calls or OPENCV
        if settings.detector and self.calls.detect is detect:
            self.calls = self.calls._replace(detect=settings.detector)
        self.estimator: Estimator = (settings.estimator or VoteOfAll)(self.calls)
        self.pose = inputs.first_pose(start)
        self.count = 0  # of frames so far
        self.previous: np.ndarray | None = None  # the last frame that was not skipped
        self.points = NO_POINTS  # in it
        self.metres = 0.0  # moved since then

    def __repr__(self) -> str:
        return f"Odometry: {self.count} frames so far, position {self.pose[:3, 3].round(2)} m"

    def step(self, frame: Any, scale: Any = None, mask: Any = None) -> Step:
        """Take the next frame. Returns a Step.

        frame: (height, width) uint8. scale: metres moved since the frame before; only the first
        frame needs none. mask: of the same size, uint8 or bool; keypoints lie only where it is not
        0.
        Raises InputError for a frame, scale, mask or keypoints of another kind.
        """
        frame = inputs.gray_frame(frame, self.count, self.intrinsics, self.previous)
        mask = inputs.allowed_pixels(mask, self.count, frame)
        self.metres += inputs.step_length(scale, self.count)
        step = Step(self.count, self.metres, flags=inputs.reasons_to_skip(frame, self.previous))
        self.count += 1
        if not step.flags:
            if step.frame > 0:
                self._track(step, frame)
            if step.points:
                self._estimate(step)
            self._detect(step, frame, mask)
            self.previous, self.metres = frame, 0.0
        step.pose = self.pose.copy()
        return step

    def _track(self, step: Step, frame: np.ndarray) -> None:
        """Track the points of the previous frame into this one (Section 3.7.2)."""
        step.points = len(self.points)
        if step.points == 0:
            step.flags.append("no points")
            return
        with step.timed("track"):
            found = self.calls.track(self.previous, frame, self.points, self.settings)
        tracked, was_found = inputs.matches(found, self.points, f"frame {step.frame}: the tracker")
        step.previous, step.current = self.points[was_found], tracked[was_found]

    def _estimate(self, step: Step) -> None:
        """Estimate the motion from the matched points, and move the pose (Section 3.7.3)."""
        threshold = self.settings.threshold
        current = normalise(step.current, self.intrinsics)
        previous = normalise(step.previous, self.intrinsics)
        order = self.settings.order(step.frame, len(current))
        step.matches = Matches(current, previous, threshold, order=order)
        if len(current) < MIN_MATCHES:
            step.flags.append("fewer than five correspondences")
            return
        with step.timed("essential"):
            search = getattr(self.estimator, "search", self.calls.find_essential_matrix)
            matrix, inliers = search(current[order], previous[order], threshold)
        if matrix is None or not np.isfinite(matrix).all():
            step.flags.append("no essential matrix")
            return
        if matrix.shape != (3, 3):  # from five matches, OpenCV returns all solutions in one array
            step.flags.append("several essential matrices")
            return
        step.essential = matrix
        agrees = np.empty(len(current), bool)
        agrees[order] = inliers.ravel() > 0
        step.matches = Matches(current, previous, threshold, agrees, order)
        agree_by_chance = step.matches.agree_by_chance()
        moves = step.scale > self.settings.scale_gate and not agree_by_chance
        with step.timed("pose"):
            step.motion = self.estimator.motion(matrix, step.matches, step.scale, moves)
        if moves:
            self._move(step)
        else:
            step.flags.append("no agreement" if agree_by_chance else STATIONARY)

    def _move(self, step: Step) -> None:
        """Move the pose by the motion over the step's length (Equations 2.2 and 2.3)."""
        rotation, translation = step.motion.rotation, step.motion.translation
        if step.motion.flag:
            step.flags.append(step.motion.flag)
        if np.trace(rotation) < 1 + 2 * np.cos(np.radians(MAX_TURN)):
            step.flags.append("too large a turn")
        moved = np.eye(4)
        moved[:3, :3] = self.pose[:3, :3] @ rotation
        moved[:3, 3] = self.pose[:3, 3] + step.scale * (self.pose[:3, :3] @ translation)
        self.pose = moved
        step.updated = True

    def _detect(self, step: Step, frame: np.ndarray, mask: np.ndarray | None) -> None:
        """Replace all points by new keypoints if too few were tracked (Section 3.7.1)."""
        points = step.current
        if len(points) < self.settings.redetect_below or not len(points):
            with step.timed("detect"):
                found = self.calls.detect(frame, self.settings, mask)
            detected = inputs.keypoints(found, frame, f"frame {step.frame}: the detector")
            step.detected = len(detected)
            if len(detected):
                points = detected
            else:
                step.flags.append("no keypoints")
        self.points, step.keypoints = points.copy(), points
