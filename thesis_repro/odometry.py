"""Monocular visual odometry as PySLAM does it (Section 3.7): Shi-Tomasi, Lucas-Kanade, essential matrix, pose.

`run(sequence)` is the plain way in; `run_many` makes many runs over one sequence for little more than the cost of
their estimators. THESIS agrees with PySLAM of August 2021 on every frame. What PySLAM crashes on has a rule here:

| frame                                        | rule                                                    | flag           |
|----------------------------------------------|---------------------------------------------------------|----------------|
| black, blown out, without contrast           | pose kept; frame skipped: the next one is compared with | flat frame     |
|                                              | the last good one, at the sum of their scales           |                |
| no keypoint found (an all-zero mask, say)    | the tracked points are kept and tracked on              | no keypoints   |
| no point to track                            | pose kept; starts again from this frame's keypoints     | no points      |
| fewer than five correspondences              | pose kept                                               | see pose.py    |
| none or several essential matrices           | pose kept                                               | see pose.py    |
| agreement no better than chance: a scene cut | pose kept                                               | scene cut      |
| moved less than the gate (PySLAM's own rule) | pose kept                                               | stationary     |
"""

import time
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from thesis_repro import InputError, keypoints, pose
from thesis_repro.files import progress

CHANCE = 0.05  # share of correspondences
FLAT = 4.0  # gray levels: a standard deviation below it is no picture of a street (real frames: above 50)


@dataclass(frozen=True)
class OdometrySettings:
    """What the odometry does; the defaults are the thesis's.

    detector: "shi-tomasi", or "orb" (detection only; points are still tracked).
    max_keypoints: limit of the detector, 0 for none. min_distance: between keypoints, pixels (Shi-Tomasi only).
    mask_mode: "detect" gives the mask to the detector, which fills its quota inside; "filter" drops what lies outside.
    redetect_below: detect again on a frame to which fewer points were tracked; all points are replaced then.
    estimator: "ransac", or OpenCV's "usac", "usac-accurate", "usac-magsac".
    threshold: of the estimator, in normalised coordinates.
    permute: seed that shuffles the correspondences before the estimator, whose own seed is fixed; None: not shuffled.
    pose: which points vote on the sign of the motion: "all" (PySLAM, audit row 13), "inliers"; or "refined": voted by
    the inliers, then fitted to them.
    scale_gate: metres; a smaller step leaves the pose as it was. shift_gate: the same for the mean shift of the
    points, pixels. min_inliers: the same for the inliers of the essential matrix.
    rotate_first: turn the pose before moving it.
    alignment: how the two paths are laid over each other for RMSE and MAE, see metrics.rmse.
    """

    detector: str = "shi-tomasi"
    max_keypoints: int = 2000
    min_distance: float = 3
    mask_mode: str = "detect"
    redetect_below: int = 2000
    estimator: str = "ransac"
    threshold: float = 0.0003
    permute: int | None = None
    pose: str = "all"
    scale_gate: float = 0.1
    shift_gate: float = 0.0
    min_inliers: int = 0
    rotate_first: bool = False
    alignment: str = "position"

    def __post_init__(self):
        for name, known in (("detector", ("shi-tomasi", "orb")), ("mask_mode", ("detect", "filter")),
                            ("estimator", tuple(pose.ESTIMATORS)), ("pose", ("all", "inliers", "refined")),
                            ("alignment", ("position", "pose"))):
            if getattr(self, name) not in known:
                raise InputError(f"odometry setting {name}: {getattr(self, name)!r} is unknown; "
                                 f"choose one of {', '.join(known)}")
        for name, least in (("max_keypoints", 0), ("min_distance", 0), ("redetect_below", 0), ("permute", 0),
                            ("scale_gate", 0), ("shift_gate", 0), ("min_inliers", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"odometry setting {name}: {value} is below {least}; give {least} or more")
        if not self.threshold > 0:
            raise InputError(f"odometry setting threshold: {self.threshold} is not above 0; the thesis has 0.0003")


THESIS = OdometrySettings()
PYSLAM_2024 = OdometrySettings(threshold=0.0004, rotate_first=True, shift_gate=1.5, min_inliers=6, scale_gate=0.015,
                               alignment="pose")
PRESETS = {"2021": THESIS, "2024": PYSLAM_2024}


@dataclass
class Step:
    """What one frame brought. Arrays of one length N: `previous`, `current` (N, 2) pixels, and `inliers` (N)."""

    frame: int
    scale: float = 0.0  # metres moved since the frame that the points come from
    points: int | None = None  # given to the tracker
    detected: int | None = None  # None: not detected on this frame
    previous: np.ndarray = field(default_factory=lambda: keypoints.NO_POINTS)
    current: np.ndarray = field(default_factory=lambda: keypoints.NO_POINTS)
    motion: pose.Motion = pose.Motion()
    pose: np.ndarray | None = None  # 4x4 camera to world, metres
    updated: bool = False
    flags: list = field(default_factory=list)
    seconds: dict = field(default_factory=lambda: dict.fromkeys(("detect", "track", "essential", "pose"), 0.0))

    @property
    def inliers(self):
        return np.zeros(len(self.current), bool) if self.motion.inliers is None else self.motion.inliers

    def row(self):
        """One row of Result.frames."""
        tracked = None if self.points is None else len(self.current)
        row = {"frame": self.frame, "points": self.points, "detected": self.detected, "tracked": tracked,
               "inliers": None if tracked is None else int(self.inliers.sum()),
               "pose_inliers": None if tracked is None else self.motion.pose_inliers,
               "scale": self.scale, "updated": self.updated, "flag": "; ".join(self.flags),
               **dict(zip("xyz", self.pose[:3, 3]))}
        row.update((f"r{i}{j}", self.pose[i, j]) for i in range(3) for j in range(3))
        row.update((f"{name}_seconds", value) for name, value in self.seconds.items())
        return row


class Odometry:
    """The camera's path, frame by frame.

    `step(frame, scale, mask)` takes the next gray frame (height, width), the metres moved since the frame before, and
    an optional mask of the same size (0: no keypoints there), and returns a Step. It is the three methods below, one
    after the other; only `motion` is expensive, and it depends on nothing but its own step.
    """

    def __init__(self, intrinsics, settings=THESIS, start=None, features=keypoints):
        """intrinsics: 3x3, pixels. start: pose of the first frame, 4x4. features: a shared keypoints source."""
        self.intrinsics = np.asarray(intrinsics, np.float64)
        self.settings = settings
        self.pose = np.eye(4) if start is None else np.array(start, np.float64)
        self.features = features
        self.count = 0
        self.previous = None  # the frame that self.points belong to
        self.points = keypoints.NO_POINTS
        self._gap = 0.0  # metres from there to the last frame seen
        pose.warm_up()

    def step(self, frame, scale=0.0, mask=None):
        step = self.observe(frame, scale, mask)
        self.estimate(step)
        return self.compose(step)

    def observe(self, frame, scale=0.0, mask=None):
        """Track the points to this frame and detect new ones; returns a Step without a motion."""
        step = Step(frame=self.count, scale=float(scale))
        self._check(frame, scale, mask)
        self.count += 1
        if self.previous is not None:
            step.scale += self._gap
        if frame[::8, ::8].std() < FLAT:
            step.flags.append("flat frame")
            self._gap = step.scale
            return step
        started, self._gap = time.perf_counter(), 0.0
        tracked = keypoints.NO_POINTS
        if len(self.points):
            step.points = len(self.points)
            tracked, found = self.features.track(self.previous, frame, self.points)
            step.previous, step.current = self.points[found], tracked[found]
            tracked = step.current
        elif self.previous is not None or step.frame > 0:
            step.points = 0
            step.flags.append("no points")
        step.seconds["track"] = time.perf_counter() - started
        if len(tracked) < self.settings.redetect_below or not len(tracked):
            started = time.perf_counter()
            detected = self.features.detect(frame, self.settings, mask)
            step.seconds["detect"] = time.perf_counter() - started
            step.detected = len(detected)
            if len(detected):
                tracked = detected
            else:
                step.flags.append("no keypoints")
        self.previous, self.points = frame, tracked
        return step

    def estimate(self, step):
        """The motion from the step's correspondences. Safe in threads: reads nothing that later steps change."""
        if not step.points:
            return
        chosen, started = self.settings, time.perf_counter()
        current = pose.normalise(step.current, self.intrinsics)
        previous = pose.normalise(step.previous, self.intrinsics)
        order = None
        if chosen.permute is not None:
            order = np.random.default_rng((chosen.permute, step.frame)).permutation(len(current))
            current, previous = current[order], previous[order]
        matrix, inliers, problem = pose.essential_matrix(current, previous, chosen.threshold, chosen.estimator)
        step.seconds["essential"] = time.perf_counter() - started
        if matrix is None:
            step.motion = pose.Motion(problem=problem)
            return
        started = time.perf_counter()
        if chosen.pose == "all":
            votes, rotation, translation = pose.recover_pose(matrix, current, previous)
        else:
            votes, rotation, translation = pose.recover_pose(matrix, current[inliers], previous[inliers])
        if chosen.pose == "refined":
            rotation, translation = pose.refine(rotation, translation, current[inliers], previous[inliers],
                                                chosen.threshold)
        if order is not None:
            shuffled, inliers = inliers, np.empty_like(inliers)
            inliers[order] = shuffled
        step.motion = pose.Motion(rotation, translation, inliers, votes)
        step.seconds["pose"] = time.perf_counter() - started

    def compose(self, step):
        """Move the pose by the step's motion, where it has one that can be believed."""
        motion, chosen = step.motion, self.settings
        if step.points:
            if motion.rotation is None:
                step.flags.append(motion.problem)
            elif _by_chance(motion.inliers):
                step.flags.append("scene cut")
            elif (step.scale <= chosen.scale_gate
                  or chosen.shift_gate and _mean_shift(step) < chosen.shift_gate):
                step.flags.append("stationary")
            elif motion.inliers.sum() < chosen.min_inliers:
                step.flags.append("few inliers")
            else:
                self.pose = self._moved(motion, step.scale)
                step.updated = True
        step.pose = self.pose
        return step

    def _moved(self, motion, scale):
        moved, rotation = np.eye(4), self.pose[:3, :3]
        moved[:3, :3] = rotation @ motion.rotation
        heading = moved[:3, :3] if self.settings.rotate_first else rotation
        moved[:3, 3] = self.pose[:3, 3] + scale * (heading @ motion.translation)
        return moved

    def _check(self, frame, scale, mask):
        if frame.dtype != np.uint8 or frame.ndim != 2:
            raise InputError(f"frame {self.count}: {frame.dtype} of shape {frame.shape}; "
                             "the odometry needs 8-bit gray, (height, width)")
        if not np.isfinite(scale) or scale < 0:
            raise InputError(f"frame {self.count}: the scale {scale} is no distance in metres")
        if mask is not None and (mask.shape != frame.shape or mask.dtype != np.uint8):
            raise InputError(f"frame {self.count}: the mask is {mask.dtype} of shape {mask.shape}, the frame uint8 of "
                             f"shape {frame.shape}; masks must be 8-bit and as large as their frames")
        if self.previous is not None and frame.shape != self.previous.shape:
            raise InputError(f"frame {self.count}: shape {frame.shape}, the frames before {self.previous.shape}; "
                             "all frames must have one size")


def _by_chance(inliers):
    return inliers.sum() < CHANCE * len(inliers)


def _mean_shift(step):
    return np.linalg.norm(step.current - step.previous, axis=1).mean()


@dataclass(frozen=True)
class Result:
    """poses: (n, 4, 4) camera to world, metres. frames: one row a frame, see Step.row; blank where not applicable."""

    poses: np.ndarray
    frames: pd.DataFrame
    settings: OdometrySettings = THESIS

    @property
    def flagged(self):
        """Frames by flag: a Series of counts, empty where nothing was remarkable."""
        return self.frames.loc[self.frames.flag != "", "flag"].str.split("; ").explode().value_counts()


def start_pose(sequence):
    """Where the estimate starts: the identity, as in PySLAM, or the first true pose where that is another one.

    The first pose of every complete KITTI sequence is the identity up to 1e-10, an excerpt's is not.
    """
    first = sequence.poses[0]
    return np.eye(4) if np.abs(first - np.eye(4)).max() < 1e-6 else first


def scales(sequence):
    """Metres between the true positions of a frame and the one before; 0 for the first. (n,)"""
    return np.concatenate([[0.0], [np.linalg.norm(step) for step in np.diff(sequence.poses[:, :3, 3], axis=0)]])


def run(sequence, settings=THESIS, masks=None, description=None):
    """The odometry over a kitti.Sequence; returns a Result.

    masks: anything that gives an (height, width) uint8 mask for a frame number (0: no keypoints there).
    description: of a progress bar; None for no bar.
    Raises InputError where a frame cannot be read or a mask has another size.
    """
    odometry = Odometry(sequence.intrinsics, settings, start_pose(sequence))
    rows, poses = [], []
    metres = scales(sequence)
    indices = range(len(sequence))
    for index in progress(indices, description) if description else indices:
        started = time.perf_counter()
        mask = None if masks is None else masks[index]
        mask_seconds = time.perf_counter() - started
        step = odometry.step(sequence.frame(index), metres[index], mask)
        rows.append({**step.row(), "mask_seconds": mask_seconds})
        poses.append(step.pose)
    return Result(np.array(poses), _table(rows), settings)


def _table(rows):
    frames = pd.DataFrame(rows)
    counts = ["points", "detected", "tracked", "inliers", "pose_inliers"]
    frames[counts] = frames[counts].astype("Int64")
    return frames
