"""Run the odometry over a sequence: one run, or many runs in one pass, which share their work."""

import time
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from types import MethodType
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd

from thesis_repro.data.arrays import SequenceLike
from thesis_repro.data.trajectories import write_kitti_poses, write_tum
from thesis_repro.errors import InputError
from thesis_repro.odometry.inputs import EQUAL, unchangeable
from thesis_repro.odometry.loop import STATIONARY, Calls, Odometry
from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.odometry.step import FRAME_COLUMNS, ROTATION_COLUMNS, TIMED_PARTS, Step
from thesis_repro.running.files import progress

# Frames from which faster calls with OpenCV's bits pay. To load them takes 1.7 s, to compile 42 s;
# each frame then takes 25 ms less (2,000 keypoints, one thread of a Zen 4).
FRAMES_TO_LOAD, FRAMES_TO_COMPILE = 70, 1700
NEEDED = ("intrinsics", "scales", "has_truth", "frame", "visible", "__len__")  # of a sequence
COUNTS = ("points", "detected", "tracked", "inliers", "pose_inliers")  # blank where there is none


@runtime_checkable
class Masks(Protocol):
    """An object whose item i is the mask of frame i, (height, width) uint8.

    Keypoints are forbidden where it is 0.
    """

    def __getitem__(self, index: int, /) -> np.ndarray: ...


MasksOrFunction = Masks | Callable[[int, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Result:
    """Result of one run.

    poses: estimated path, (n, 4, 4), camera to world, metres. frames: a table with one row a frame,
    see Step.row; missing values are blank. steps: of `run(..., keep_steps=True)`, one Step a frame.
    times: of the frames, (n,), seconds; None if the sequence has none. A result equals only itself;
    compare poses with np.array_equal.
    """

    poses: np.ndarray
    frames: pd.DataFrame
    settings: OdometrySettings = THESIS
    steps: Sequence[Step] = ()
    times: np.ndarray | None = None

    def __repr__(self) -> str:
        means = self.frames[["detected", "tracked", "inliers"]].astype(float).mean()
        path = np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum()
        return (
            f"Result: {len(self.poses)} frames, a path of {path:.2f} m\n"
            f"  mean of a frame: {means['detected']:.0f} keypoints detected, "
            f"{means['tracked']:.0f} points tracked, {means['inliers']:.0f} inliers\n"
            f"  flags: {self.flagged.to_dict() or 'none'}"
        )

    def write_kitti(self, path: str | Path) -> None:
        """Write the poses in KITTI's format: 12 numbers a line, one line a frame."""
        write_kitti_poses(path, self.poses)

    def write_tum(self, path: str | Path) -> None:
        """Write the poses in TUM's format: time, position, quaternion (x, y, z, w) a line.

        Raises InputError if the sequence has no times.
        """
        if self.times is None:
            raise InputError(
                f"{path}: TUM's format needs the sequence's times; write_kitti does not"
            )
        write_tum(path, self.poses, self.times)

    @property
    def flagged(self) -> pd.Series:
        """Number of frames by flag."""
        texts = self.frames["flag"]
        flags = texts[texts != ""].str.split("; ").explode()
        return flags.value_counts()

    @property
    def failed_steps(self) -> int:
        """Number of frames with a flag other than "stationary" and "equal frame"."""
        return int(is_flagged(self.frames).sum())

    @property
    def dropped_steps(self) -> int:
        """Number of steps that did not move the pose because they are shorter than the gate."""
        return int((self.frames["flag"] == STATIONARY).sum())


def is_flagged(frames: pd.DataFrame) -> pd.Series:
    """Whether a frame has a flag that tells of doubt, booleans (n,), see Result.frames."""
    return ~frames["flag"].isin(["", STATIONARY, EQUAL])


def start_pose(sequence: SequenceLike) -> np.ndarray:
    """First pose of the estimate.

    It is the identity, as in PySLAM, unless the ground truth starts at another pose. Complete KITTI
    sequences start at the identity (up to 1e-10); excerpts do not.
    """
    if sequence.has_truth and np.abs(sequence.poses[0] - np.eye(4)).max() >= 1e-6:
        return sequence.poses[0]
    return np.eye(4)


def run(
    sequence: SequenceLike,
    settings: OdometrySettings = THESIS,
    masks: MasksOrFunction | None = None,
    description: str | None = None,
    calls: Calls | None = None,
    keep_steps: bool = False,
) -> Result:
    """Run the odometry over a sequence. Returns a Result.

    masks: see Masks; or a function of the frame's number and the frame, such as a detector, that
    returns the mask. description: text of the progress bar; None for no bar. calls: functions in
    place of OpenCV's, see loop.Calls. Without them, a long run takes faster ones with the same
    bits. keep_steps: keep each Step, with its keypoints and matches, in Result.steps; without
    masks, about 150 kB a frame.
    Raises InputError if a frame cannot be read, if a mask and its frame differ in size, if there
    are more or fewer masks than frames, and for another kind of sequence, settings or masks.
    """
    check(sequence, masks)
    calls = calls or _faster_calls(len(sequence))
    odometry = Odometry(sequence.intrinsics, settings, start_pose(sequence), calls)
    step_lengths = sequence.scales
    rows, steps = [], []
    for index in progress(range(len(sequence)), description):
        frame = sequence.frame(index)
        mask, mask_seconds = _mask_of_frame(masks, index, frame, sequence.visible(index))
        step = odometry.step(frame, step_lengths[index], mask)
        rows.append([*step.row().values(), mask_seconds])
        if keep_steps:
            steps.append(step)
    return _result(sequence, rows, settings, steps)


def _faster_calls(frames: int) -> Calls | None:
    """Return faster calls with the bits of OpenCV's if they pay in a run of so many frames."""
    if frames < FRAMES_TO_LOAD:
        return None
    import opencv_exact  # loads Numba
    from thesis_repro.odometry import sharing

    if frames < FRAMES_TO_COMPILE and not opencv_exact.is_compiled():
        return None
    return Calls(
        track=sharing.track,
        find_essential_matrix=sharing.find_essential_matrix,
        recover_pose=sharing.recover_pose,
    )


def run_many(
    sequence: SequenceLike,
    runs: Mapping[Any, tuple[OdometrySettings, MasksOrFunction | None]],
    description: str | None = None,
    failed: dict[Any, str] | None = None,
) -> dict[Any, Result]:
    """Make many runs, {name: (settings, masks)}, over one sequence. Returns {name: Result}.

    masks: as in `run`. The results equal those of separate runs. What several runs ask for is done
    once: frames are decoded, a function of masks called, corner strengths computed, points tracked,
    and equal matches searched for an essential matrix. OpenCV's search and vote are replaced by
    faster ones with the same bits (opencv_exact).
    The times of the four calls are blank, because they cannot be measured for a single run.
    failed: gets {name: reason} of runs that a mask or keypoints end, and the others go on. Without
    it, the first such InputError is raised.
    """
    from thesis_repro.odometry.sharing import SharedCalls  # compiles functions on first use

    together = SharedCalls()
    odometries = {}
    for name, (settings, masks) in runs.items():
        check(sequence, masks)
        odometries[name] = Odometry(
            sequence.intrinsics, settings, start_pose(sequence), together.calls
        )
    step_lengths = sequence.scales
    rows: dict[Any, list[list]] = {name: [] for name in runs}
    for index in progress(range(len(sequence)), description):
        frame = unchangeable(np.asarray(sequence.frame(index)))  # one array, which all runs share
        together.expect(frame, odometries.values())
        visible = sequence.visible(index)
        made: dict[Any, tuple] = {}  # the masks of this frame
        for name, odometry in list(odometries.items()):
            masks = runs[name][1]
            try:
                source = _identity(masks)
                if source not in made:
                    made[source] = _mask_of_frame(masks, index, frame, visible)
                mask, mask_seconds = made[source]
                step = odometry.step(frame, step_lengths[index], mask)
            except InputError as error:
                if failed is None:
                    raise
                failed[name] = str(error)
                del odometries[name]
                continue
            step.seconds = dict.fromkeys(TIMED_PARTS, np.nan)
            rows[name].append([*step.row().values(), mask_seconds])
    return {name: _result(sequence, rows[name], runs[name][0]) for name in odometries}


def _identity(masks: Any) -> Any:
    """What tells masks from others. Each mention of an object's method makes a new object."""
    if isinstance(masks, MethodType):
        return id(masks.__self__), masks.__func__
    return id(masks)


def _mask_of_frame(
    masks: MasksOrFunction | None, index: int, frame: np.ndarray, visible: np.ndarray | None
) -> tuple[np.ndarray | None, float]:
    """The mask of a frame, within what is visible, and the seconds to make it."""
    started = time.perf_counter()
    mask = None
    if isinstance(masks, Masks):
        mask = masks[index]
    elif masks is not None:
        mask = masks(index, np.array(frame))  # which the function may draw on
    seconds = time.perf_counter() - started
    return inside(visible, mask), seconds


def inside(visible: np.ndarray | None, mask: Any) -> Any:
    """A mask without what is not visible (see Sequence.visible); both may be None: everywhere."""
    if visible is None or mask is None:
        return visible if mask is None else mask
    mask = np.asarray(mask)
    if mask.shape != visible.shape or mask.dtype not in (bool, np.uint8):  # the odometry names it
        return mask
    return mask & visible


def check(sequence: Any, masks: Any) -> None:
    """Raise InputError unless a sequence is one, and its masks are one a frame or None."""
    missing = [name for name in NEEDED if name not in dir(sequence)]
    if missing:
        raise InputError(
            f"sequence: must be a thesis_repro.Sequence, not {type(sequence).__name__}, which lacks "
            f"{', '.join(missing)} (see thesis_repro.SequenceLike)"
        )
    has_length = isinstance(masks, Sized)
    if has_length and len(masks) != len(sequence):
        raise InputError(f"masks: {len(masks)} for {len(sequence)} frames; must be one a frame")
    if not isinstance(masks, Masks | None) and (has_length or not callable(masks)):
        raise InputError(
            f"masks: must be {len(sequence)} masks, one a frame, such as LabelMasks, or a function "
            "of the frame's number and the frame"
        )


def _result(
    sequence: SequenceLike,
    rows: list[list],
    settings: OdometrySettings,
    steps: Sequence[Step] = (),
) -> Result:
    frames = pd.DataFrame(rows, columns=[*FRAME_COLUMNS, "mask_seconds"])
    frames = frames.astype(dict.fromkeys(COUNTS, "Int64"))
    return Result(poses_of(frames), frames, settings, steps, getattr(sequence, "times", None))


def poses_of(frames: pd.DataFrame) -> np.ndarray:
    """Poses (n, 4, 4) from a table with one row a frame (Result.frames)."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = frames[ROTATION_COLUMNS].to_numpy().reshape(-1, 3, 3)
    poses[:, :3, 3] = frames[["x", "y", "z"]]
    return poses
