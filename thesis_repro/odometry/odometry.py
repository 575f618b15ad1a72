"""The odometry, frame by frame: keypoints, the motion between two frames, and the new pose."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from thesis_repro.data.kitti import check_camera, is_camera_matrix
from thesis_repro.data.trajectories import are_poses
from thesis_repro.errors import InputError, need
from thesis_repro.odometry import keypoints, pose
from thesis_repro.odometry.estimators import ESTIMATORS, Essential
from thesis_repro.odometry.pose import Motion
from thesis_repro.odometry.refined.fit import RefinedMotion, fit, with_uncertainty
from thesis_repro.odometry.refined.guided import ransac_with_prior
from thesis_repro.odometry.refined.motion_prior import MotionPrior, check_consistency, is_consistent
from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.running import messages

TIMED_PARTS = ("detect", "track", "essential", "pose")
ROTATION_COLUMNS = [f"r{i}{j}" for i in range(3) for j in range(3)]
# flags of a step that used the fallback, and of one that is shorter than the gate
ALL_KEYPOINTS, STATIONARY = "all keypoints used", "stationary"
MIN_CONTRAST = 4.0  # standard deviation in gray levels; real frames have more than 50


@dataclass(eq=False)
class Step:
    """Results for one frame.

    Its N correspondences are `previous` and `current`, (N, 2) pixels; `inliers` is (N,).
    Later steps do not depend on its arrays.
    """

    frame: int
    scale: float = 0.0  # metres moved since the previous frame that was not skipped
    points: int | None = None  # number of points given to the tracker
    detected: int | None = None  # number of new keypoints; None if the detector did not run
    previous: np.ndarray = field(default_factory=lambda: keypoints.NO_POINTS)
    current: np.ndarray = field(default_factory=lambda: keypoints.NO_POINTS)
    # current and previous in normalised image coordinates, once they were asked for
    normalised: tuple[np.ndarray, np.ndarray] | None = None
    # tracked into the next frame
    keypoints: np.ndarray = field(default_factory=lambda: keypoints.NO_POINTS)
    motion: Any = Motion()  # a RefinedMotion if it was refined
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))  # camera to world, metres
    updated: bool = False  # whether this step moved the pose
    flags: list[str] = field(default_factory=list)
    # if a fallback is possible, finds the matches of all keypoints; copies of the step share them
    all_matches: Callable[[], "_Matches"] | None = None
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TIMED_PARTS, 0.0))

    @property
    def inliers(self) -> np.ndarray:
        """Correspondences that agree with the essential matrix, (N,) booleans."""
        if self.motion.inliers is None:
            return np.zeros(len(self.current), bool)
        return self.motion.inliers

    def copy(self) -> "Step":
        """Copy with the same correspondences, for another estimator."""
        return replace(self, flags=list(self.flags), seconds=dict(self.seconds))

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


class Odometry:
    """Monocular visual odometry, frame by frame.

    `step(frame, scale, mask)` takes the next gray frame (height, width), the distance moved since
    the previous frame in metres, and an optional mask of the same size, uint8 or bool (keypoints
    are forbidden where it is 0). It returns a Step. It calls `observe`, `estimate` and `compose`.
    `estimate` uses no state of earlier steps. With settings.fallback, `compose` may estimate a
    step anew.
    """

    def __init__(
        self,
        intrinsics: np.ndarray,
        settings: OdometrySettings = THESIS,
        start: np.ndarray | None = None,
        shared: keypoints.SharedKeypoints | None = None,
    ):
        """Start before the first frame.

        intrinsics: 3x3, pixels, as (fx, 0, u), (0, fy, v), (0, 0, 1). start: pose of the first
        frame, 4x4. shared: keypoints shared with other runs. Raises InputError for another matrix,
        and for a start that is no pose.
        """
        need("settings", settings, OdometrySettings)
        self.intrinsics = np.array(intrinsics, np.float64)
        self.settings = settings
        self.pose = np.eye(4) if start is None else np.array(start, np.float64)
        if not is_camera_matrix(self.intrinsics):
            raise InputError(
                "intrinsics: must be (fx, 0, u), (0, fy, v), (0, 0, 1) in pixels, not "
                f"{self.intrinsics.tolist()}"
            )
        is_pose = self.pose.shape == (4, 4) and are_poses(self.pose[None]).all()
        if not is_pose or not np.array_equal(self.pose[3], [0, 0, 0, 1]):
            raise InputError("start: must be a pose, 4x4: a right-handed rotation and a position")
        self.prior = (
            MotionPrior.straight_ahead()
        )  # used by the refined estimator and the fallback only
        self.shared = shared
        self.count = 0
        self.previous: np.ndarray | None = None  # the frame in which self.points lie
        self.points = keypoints.NO_POINTS
        self.gap = 0.0  # metres moved during skipped (flat) frames
        warm_up(settings.estimator == "refined" or settings.fallback)

    def step(self, frame: np.ndarray, scale: float = 0.0, mask: np.ndarray | None = None) -> Step:
        """Take the next frame: `observe`, `estimate` and `compose`."""
        with messages.held_signals():
            step = self.observe(frame, scale, mask)
            self.estimate(step)
            return self.compose(step)

    def observe(
        self, frame: np.ndarray, scale: float = 0.0, mask: np.ndarray | None = None
    ) -> Step:
        """Track the points into this frame and detect new keypoints.

        Returns a Step without a motion.
        """
        frame = np.asarray(frame)  # cv2.imread returns None for a missing file
        if mask is not None:
            mask = np.asarray(mask)
            if mask.dtype == bool:
                mask = mask.view(np.uint8)
        need(f"frame {self.count}: scale", np.asarray(scale)[()], Real)
        scale = float(scale)
        self._check(frame, scale, mask)
        if self.shared is None:  # shared keypoints know a frame by its identity
            frame = frame.copy()  # the caller may read the next frame into the same array
        step = Step(frame=self.count, scale=scale)
        self.count += 1
        if self.previous is not None:
            step.scale += self.gap
        if frame[::8, ::8].std() < MIN_CONTRAST:
            step.flags.append("flat frame")
            self.gap = step.scale
            return step
        self.gap = 0.0
        if self.settings.fallback and mask is not None and self.previous is not None:
            find = partial(_matches_without_mask, self.previous, frame, self.settings)
            step.all_matches = cache(find)
        self._track(step, frame)
        points = step.current
        if len(points) < self.settings.redetect_below or not len(points):
            started = time.perf_counter()
            detected = self._tracker.detect(frame, self.settings, mask)
            step.seconds["detect"] = time.perf_counter() - started
            step.detected = len(detected)
            if len(detected):
                points = detected
            else:
                step.flags.append("no keypoints")
        self.previous = frame
        self.points, step.keypoints = points.copy(), points
        return step

    @property
    def _tracker(self) -> Any:
        """What detects and tracks: the shared keypoints or the module, with the same functions."""
        return self.shared or keypoints

    def _track(self, step: Step, frame: np.ndarray) -> None:
        """Track the points of the previous frame into this one: the step's correspondences."""
        started = time.perf_counter()
        if self.previous is not None and len(self.points):
            step.points = len(self.points)
            tracked, was_tracked = self._tracker.track(
                self.previous, frame, self.points, self.settings.window, self.settings.levels
            )
            step.previous = self.points.compress(was_tracked, axis=0)
            step.current = tracked.compress(was_tracked, axis=0)
            self._normalised(step)  # copies of the step, in other runs, share it
        elif self.previous is not None or step.frame > 0:
            step.points = 0
            step.flags.append("no points")
        step.seconds["track"] = time.perf_counter() - started

    def _normalised(self, step: Step) -> tuple[np.ndarray, np.ndarray]:
        """The step's correspondences (current, previous) in normalised coordinates."""
        if step.normalised is None:
            current = pose.normalise(step.current, self.intrinsics)
            step.normalised = current, pose.normalise(step.previous, self.intrinsics)
        return step.normalised

    def estimate(self, step: Step, essential: Essential | None = None) -> Essential | None:
        """Estimate the motion from the step's correspondences. Returns the essential matrix.

        essential: the result of another Odometry for the same correspondences. Its settings may
        differ in passes.AFTER_ESSENTIAL only.
        """
        if not step.points:
            return None
        if essential is None:
            essential = _essential(step, self._normalised(step), self.settings)
        step.seconds["essential"] = essential.seconds
        if essential.matrix is None:
            step.motion = Motion(problem=essential.problem)
            return essential
        started = time.perf_counter()
        estimator = ESTIMATORS[self.settings.estimator]
        step.motion = estimator.motion(essential, self.settings.threshold)
        step.seconds["pose"] = time.perf_counter() - started
        return essential

    def compose(self, step: Step) -> Step:
        """Move the pose by the step's motion, or keep it if a rule says so.

        The rules are in the table in odometry/__init__.py.
        """
        is_long = step.scale > self.settings.scale_gate
        if step.all_matches is not None and is_long and self._in_doubt(step):
            self._use_all_keypoints(step, step.all_matches())
        step.all_matches = None  # it holds two frames
        if step.points:
            flag = self._flag_if_kept(step)
            if flag is None:
                self._move(step)
            else:
                step.flags.append(flag)
        step.pose = self.pose.copy()
        self.prior = self.prior.copy()  # step.motion has the arrays of the original
        return step

    def _flag_if_kept(self, step: Step) -> str | None:
        """Flag of a step that keeps the pose; None if the step moves it."""
        motion = step.motion
        if motion.rotation is None:
            return motion.problem
        if _by_chance(motion.inliers):
            return "no agreement"
        if step.scale <= self.settings.scale_gate:
            return STATIONARY
        return None

    def _move(self, step: Step) -> None:
        """Move the pose, and flag a motion that is doubtful."""
        if self.settings.estimator == "refined":
            self._check_consistency(step)
        elif self.settings.fallback:
            motion = step.motion
            self.prior = MotionPrior(motion.rotation, motion.translation, step.scale)
        self._check_turn(step)
        self._check_parallax(step)
        rotation = self.pose[:3, :3]
        moved = np.eye(4)
        moved[:3, :3] = rotation @ step.motion.rotation
        moved[:3, 3] = self.pose[:3, 3] + step.scale * (rotation @ step.motion.translation)
        self.pose = moved
        step.updated = True

    def _in_doubt(self, step: Step) -> bool:
        """Whether the masked keypoints do not determine the motion, or it is not consistent."""
        motion = step.motion
        if motion.rotation is None or _by_chance(motion.inliers):
            return True
        if not isinstance(motion, RefinedMotion):
            refined = with_uncertainty(
                motion.rotation,
                motion.translation,
                *self._normalised(step),
                motion.inliers,
                self.settings.threshold,
            )
            motion = replace(refined, translation=motion.translation)
        return not is_consistent(motion, step.scale, self.prior)

    def _use_all_keypoints(self, step: Step, matches: "_Matches") -> None:
        """Estimate the step anew, without a mask."""
        if not matches.points:
            return
        step.points, step.previous, step.current = matches
        step.normalised = None
        step.flags.append(ALL_KEYPOINTS)
        self.estimate(step)

    def _check_consistency(self, step: Step) -> None:
        """Compare the motion with the previous step's, and replace or flag it."""
        started = time.perf_counter()
        step.motion, self.prior, flag = check_consistency(
            step.motion, *self._normalised(step), step.scale, self.settings.threshold, self.prior
        )
        if flag:
            step.flags.append(flag)
        step.seconds["pose"] += time.perf_counter() - started

    def _check_turn(self, step: Step) -> None:
        """Flag a step that turns more than a car can."""
        cosine = (np.trace(step.motion.rotation) - 1) / 2
        if cosine < np.cos(np.radians(MAX_TURN)):
            step.flags.append("too large a turn")

    def _check_parallax(self, step: Step) -> None:
        """Flag a step without parallax.

        Its points do not tell in which direction it went, or whether it was a zoom.
        """
        largest = MAX_TRACKING_ERROR / self.intrinsics[0, 0]
        share, zoom = pose.rotation_and_zoom(*self._normalised(step), step.inliers, largest)
        if share >= 0.95:
            step.flags.append("zoom" if abs(zoom - 1) > MIN_ZOOM else "no parallax")

    def _check(self, frame: np.ndarray, scale: float, mask: np.ndarray | None) -> None:
        """Raise InputError unless frame, scale and mask fit the camera and the frames before."""
        if frame.dtype != np.uint8 or frame.ndim != 2:
            raise InputError(
                f"frame {self.count}: {frame.dtype} of shape {frame.shape}; "
                "the odometry needs 8-bit gray, (height, width)"
            )
        check_camera("intrinsics", self.intrinsics, f"frame {self.count}", frame.shape)
        if not np.isfinite(scale) or scale < 0:
            raise InputError(f"frame {self.count}: scale {scale} is not a distance in metres")
        if mask is not None and (mask.shape != frame.shape or mask.dtype != np.uint8):
            raise InputError(
                f"frame {self.count}: the mask is {mask.dtype} of shape {mask.shape}, the frame uint8 of "
                f"shape {frame.shape}; masks must be 8-bit and as large as their frames"
            )
        if self.previous is not None and frame.shape != self.previous.shape:
            raise InputError(
                f"frame {self.count}: shape {frame.shape}, earlier frames {self.previous.shape}; "
                "all frames must have the same size"
            )
        if mask is not None and np.count_nonzero(mask) > np.count_nonzero(mask == mask.max()):
            raise InputError(
                f"frame {self.count}: the mask holds {len(np.unique(mask))} different values; a mask has "
                "0 and 255 (keypoint_mask makes masks from label maps)"
            )


class _Matches(NamedTuple):
    """Correspondences of two frames, (N, 2) pixels, found for a number of points."""

    points: int
    previous: np.ndarray
    current: np.ndarray


def _matches_without_mask(
    previous_frame: np.ndarray, frame: np.ndarray, settings: OdometrySettings
) -> _Matches:
    """Correspondences of all keypoints of the previous frame."""
    points = keypoints.detect(previous_frame, settings)
    if not len(points):
        return _Matches(0, points, points)
    tracked, was_tracked = keypoints.track(
        previous_frame, frame, points, settings.window, settings.levels
    )
    return _Matches(len(points), points[was_tracked], tracked[was_tracked])


def _essential(
    step: Step, normalised: tuple[np.ndarray, np.ndarray], settings: OdometrySettings
) -> Essential:
    """Essential matrix of a step's correspondences, which are shuffled if the settings say so."""
    started = time.perf_counter()
    order: np.ndarray | slice = slice(None)
    if settings.shuffle_seed is not None:
        random = np.random.default_rng((settings.shuffle_seed, step.frame))
        order = random.permutation(len(step.current))
    current, previous = (points[order] for points in normalised)
    matrix, inliers, problem = pose.essential_matrix(current, previous, settings.threshold)
    seconds = time.perf_counter() - started
    return Essential(current, previous, order, matrix, inliers, problem, seconds)


def _by_chance(inliers: np.ndarray) -> bool:
    """Whether there are no more inliers (N booleans) than two unrelated frames have."""
    # With PySLAM's threshold, two unrelated frames have 7 inliers among 20 points, 9 among 100, 12
    # among 300, and 24 to 43 among 1600. In consecutive real frames, 45 to 85 % of the points are
    # inliers.
    return inliers.sum() <= 8 + 0.03 * len(inliers)


# pixels. If the camera only turned or zoomed, 95 % of the inliers lie nearer to such a motion. In
# all steps longer than the gate, the same share lies within 1.2 pixels or more on eight sequences
# of KITTI, and 0.55 or more in the embedded world.
MAX_TRACKING_ERROR = 0.45
MIN_ZOOM = 0.001  # a zoom is larger; a rotation alone gives up to 0.0004
MAX_TURN = 6.0  # degrees a frame; KITTI's car turns by at most 4.8


@lru_cache
def warm_up(refined: bool) -> None:
    """Load or compile the compiled functions.

    So the measured time of the first frame does not include it.
    """
    keypoints.detect(np.zeros((8, 8), np.uint8), THESIS)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 2))
    pose.essential_matrix(points, points + 0.01 * points[::-1], 1e-3)
    pose.recover_pose(np.diag([1.0, 1.0, 0.0]), points, points)
    pose.rotation_and_zoom(points, points, np.ones(8, bool), 1.0)
    if refined:
        ahead = np.array([0.0, 0.0, 1.0])
        fit(np.eye(3), ahead, points, points, np.ones(8, bool), 1.0)
        ransac_with_prior(points, points[::-1], 1.0, np.eye(3), ahead, 180.0, 180.0)
