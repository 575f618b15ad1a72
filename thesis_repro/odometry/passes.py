"""Passes of the odometry over a sequence: a single run, or many for little more than the cost of their estimators."""

import hashlib
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import pandas as pd

from thesis_repro import InputError, stages
from thesis_repro.files import progress
from thesis_repro.kitti import Sequence
from thesis_repro.odometry import keypoints
from thesis_repro.odometry.odometry import FRAME_COLUMNS, ROTATION_COLUMNS, Odometry, Step
from thesis_repro.odometry.refined.motion_prior import MotionPrior
from thesis_repro.odometry.settings import THESIS, OdometrySettings

CHECKPOINT = 300  # frames
# What the keypoints depend on, and what the essential matrix depends on besides. Runs that agree in these share them.
KEYPOINT_SETTINGS = ("detector", "max_keypoints", "min_distance", "quality", "block_size", "window", "levels",
                     "mask_mode", "redetect_below", "fallback")
ESSENTIAL_SETTINGS = ("essential_method", "threshold", "shuffle_seed")
SHARED_TIMES = ("detect_seconds", "track_seconds")  # belong to no run of a pass
DTYPES = {"frame": int, "updated": bool,
          **dict.fromkeys(("points", "detected", "tracked", "inliers", "pose_inliers"), "Int64")}
NUMBER_COLUMNS = [*(column for column in FRAME_COLUMNS if column != "flag"), "mask_seconds"]


class Masks(Protocol):
    """Anything that gives a (height, width) uint8 mask for a frame number; 0: no keypoints there."""

    def __getitem__(self, index: int, /) -> np.ndarray: ...


@dataclass(frozen=True)
class Result:
    """poses: (n, 4, 4) camera to world, metres. frames: one row a frame, see Step.row; blank where not applicable."""

    poses: np.ndarray
    frames: pd.DataFrame
    settings: OdometrySettings = THESIS

    @property
    def flagged(self) -> pd.Series:
        """Frames by flag: a Series of counts, empty where nothing was remarkable."""
        return self.frames.loc[self.frames.flag != "", "flag"].str.split("; ").explode().value_counts()

    def with_poses(self, poses: np.ndarray) -> "Result":
        """The same run with other poses (n, 4, 4), in the table of frames as well."""
        columns = dict(zip("xyz", poses[:, :3, 3].T, strict=True)) | dict(
            zip(ROTATION_COLUMNS, poses[:, :3, :3].reshape(-1, 9).T, strict=True))
        return replace(self, poses=poses, frames=self.frames.assign(**columns))


def start_pose(sequence: Sequence) -> np.ndarray:
    """Where the estimate starts: the identity, as in PySLAM, or the first true pose where that is another one.

    The first pose of every complete KITTI sequence is the identity up to 1e-10, an excerpt's is not.
    """
    if not sequence.has_truth:
        return np.eye(4)
    first = sequence.poses[0]
    return np.eye(4) if np.abs(first - np.eye(4)).max() < 1e-6 else first


def scales(sequence: Sequence) -> np.ndarray:
    """Metres between the true positions of a frame and the one before; 0 for the first. (n,)

    Without truth they are the sequence's `assumed_steps`.
    """
    if not sequence.has_truth:
        return sequence.assumed_steps
    return np.concatenate([[0.0], [np.linalg.norm(step) for step in np.diff(sequence.poses[:, :3, 3], axis=0)]])


def run(sequence: Sequence, settings: OdometrySettings = THESIS, masks: Masks | None = None,
        description: str | None = None) -> Result:
    """The odometry over a kitti.Sequence; returns a Result.

    masks: anything that gives an (height, width) uint8 mask for a frame number (0: no keypoints there).
    description: of a progress bar; None for no bar.
    Raises InputError where a frame cannot be read or a mask has another size.
    """
    return _run(sequence, {"": (settings, masks)}, None, description, None, 1)[""]


def run_many(sequence: Sequence, runs: Mapping[str, tuple[OdometrySettings, Masks | None]],
             description: str | None = None, checkpoint: Path | None = None, workers: int = 1) -> dict[str, Result]:
    """Many runs over one sequence, {name: (settings, masks)}, as {name: Result}: the bits of separate runs.

    Frames are decoded, corner strengths computed and points tracked once for all runs, so the times of detection and
    tracking belong to no run and are blank. Runs with the same masks (one object) and settings that differ only after
    the tracking also share their masks and keypoints. Those that differ only in `estimator` share their essential
    matrices.
    workers: threads for the estimators, which are most of what remains.
    checkpoint: a file to keep the state in, every CHECKPOINT frames; a killed run that is started again with the same
    file, sequence and settings goes on from there. Whoever names the file deletes it once the results are stored,
    and gives other masks another file.
    """
    return _run(sequence, runs, keypoints.SharedKeypoints(), description, checkpoint, workers)


@dataclass
class _Run:
    """One run of a pass, and what came of it so far: a row of numbers a frame, for a long sequence has a million."""

    odometry: Odometry
    masks: Masks | None
    numbers: np.ndarray
    flags: dict[int, str] = field(default_factory=dict)


@dataclass
class _Estimate:
    """Runs of one essential matrix at one frame: each with its own copy of the step, and the thread at work on it."""

    runs: list[_Run]
    steps: list[Step]
    mask_seconds: float
    future: Future | None = None

    def work(self) -> None:
        essential = None
        for run, step in zip(self.runs, self.steps, strict=True):
            essential = run.odometry.estimate(step, essential)

    def finish(self) -> None:
        if self.future is not None:
            self.future.result()  # raises what the thread raised
        for run, step in zip(self.runs, self.steps, strict=True):
            row = run.odometry.compose(step).row()
            flag = row.pop("flag")
            run.numbers[step.frame] = [np.nan if value is None else value
                                       for value in (*row.values(), self.mask_seconds)]
            if flag:
                run.flags[step.frame] = flag


def _run(sequence: Sequence, runs: Mapping[str, tuple[OdometrySettings, Masks | None]],
         shared: keypoints.SharedKeypoints | None, description: str | None, checkpoint: Path | None,
         workers: int) -> dict[str, Result]:
    members = {name: _Run(Odometry(sequence.intrinsics, settings, start_pose(sequence), shared), masks,
                          np.full((len(sequence), len(NUMBER_COLUMNS)), np.nan))
               for name, (settings, masks) in runs.items()}
    groups = _groups(members.values())
    leaders = [alike[0][0] for alike in groups]  # the first of those with the same keypoints finds them for all
    metres = scales(sequence)
    job = _job(sequence, members)
    done = _resume(checkpoint, job, members, leaders)
    with ThreadPoolExecutor(workers) as pool:
        waiting: list[_Estimate] = []
        indices: Iterable[int] = range(done, len(sequence))
        if description is not None:
            indices = progress(indices, description, total=len(sequence), initial=done)
        for index in indices:
            frame = sequence.frame(index)
            if shared is not None:
                shared.expect(frame, [(leader.odometry.previous, leader.odometry.points) for leader in leaders])
            observed = []
            for leader, group in zip(leaders, groups, strict=True):
                started = time.perf_counter()
                mask = None if leader.masks is None else leader.masks[index]
                mask_seconds = time.perf_counter() - started
                step = leader.odometry.observe(frame, metres[index], mask)
                for alike in group:
                    estimate = _Estimate(alike, [step.copy() for _ in alike], mask_seconds)
                    if workers > 1:
                        estimate.future = pool.submit(estimate.work)
                    else:
                        estimate.work()
                    observed.append(estimate)
            # What is tracked next does not depend on the pose, so the estimators may be one frame behind.
            _finish(waiting)
            waiting = observed
            if checkpoint and (index + 1) % CHECKPOINT == 0:
                _finish(waiting)
                waiting = []
                _store(checkpoint, job, index + 1, members, leaders)
        _finish(waiting)
    return {name: _result(member, SHARED_TIMES if shared else ()) for name, member in members.items()}


def _groups(members: Iterable[_Run]) -> list[list[list[_Run]]]:
    """A list for each set of keypoints, in it a list of runs for each essential matrix."""
    groups: dict[tuple, dict[tuple, list[_Run]]] = {}
    for member in members:
        settings = member.odometry.settings
        observed = (id(member.masks), *(getattr(settings, key) for key in KEYPOINT_SETTINGS))
        estimated = tuple(getattr(settings, key) for key in ESSENTIAL_SETTINGS)
        groups.setdefault(observed, {}).setdefault(estimated, []).append(member)
    return [list(group.values()) for group in groups.values()]


def _finish(estimates: Iterable[_Estimate]) -> None:
    for estimate in estimates:
        estimate.finish()


# Going on after a stop


def _job(sequence: Sequence, members: Mapping[str, _Run]) -> dict[str, Any]:
    """Everything that has to be the same for a checkpoint to go on from."""
    arrays = (sequence.intrinsics, start_pose(sequence), scales(sequence))
    numbers = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    return {"sequence": sequence.name, "frames": len(sequence), "numbers": numbers, "opencv": cv2.__version__,
            "columns": NUMBER_COLUMNS,
            "runs": {name: asdict(member.odometry.settings) for name, member in members.items()}}


def _store(checkpoint: Path, job: dict, done: int, members: Mapping[str, _Run], leaders: list[_Run]) -> None:
    last = leaders[0].odometry  # which frame was the last to be tracked to, all runs agree
    arrays = {"numbers": np.array([member.numbers[:done] for member in members.values()]),
              "poses": np.array([member.odometry.pose for member in members.values()]),
              **{f"prior {part}": np.array([getattr(member.odometry.prior, part) for member in members.values()])
                 for part in MotionPrior._fields},
              **{f"points {index}": leader.odometry.points for index, leader in enumerate(leaders)}}
    if last.previous is not None:
        arrays["previous"] = last.previous
    flags = {name: member.flags for name, member in members.items()}
    stages.store(checkpoint, {"job": job, "done": done, "gap": last.gap, "flags": flags}, arrays)


def _resume(checkpoint: Path | None, job: dict, members: Mapping[str, _Run], leaders: list[_Run]) -> int:
    """Number of frames done according to the checkpoint, 0 where there is none of this job."""
    try:
        stored = stages.resume(checkpoint) if checkpoint else None
    except InputError:  # damaged: start from the beginning
        stored = None
    if stored is None or stored[0].get("job") != job:
        return 0
    state, arrays = stored
    done = int(state["done"])
    priors = zip(*(arrays[f"prior {part}"] for part in MotionPrior._fields), strict=True)
    for (name, member), numbers, pose, prior in zip(members.items(), arrays["numbers"], arrays["poses"], priors,
                                                    strict=True):
        member.numbers[:done] = numbers
        member.flags.update({int(index): flag for index, flag in state["flags"][name].items()})
        member.odometry.pose, member.odometry.prior = pose, MotionPrior(*prior)
    for index, leader in enumerate(leaders):
        follower = leader.odometry
        follower.count, follower.gap = done, state["gap"]
        follower.previous, follower.points = arrays.get("previous"), arrays[f"points {index}"]
    return done


def _result(member: _Run, blank: Iterable[str]) -> Result:
    columns = dict(zip(NUMBER_COLUMNS, member.numbers.T, strict=True))
    columns |= dict.fromkeys(blank, np.full(len(member.numbers), np.nan))
    columns["flag"] = [member.flags.get(index, "") for index in range(len(member.numbers))]
    for name, dtype in DTYPES.items():
        columns[name] = pd.array(columns[name], dtype)
    frames = pd.DataFrame(columns, columns=[*FRAME_COLUMNS, "mask_seconds"])
    return Result(poses_of(frames), frames, member.odometry.settings)


def poses_of(frames: pd.DataFrame) -> np.ndarray:
    """The poses (n, 4, 4) in a table of one row a frame."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = frames[ROTATION_COLUMNS].to_numpy().reshape(-1, 3, 3)
    poses[:, :3, 3] = frames[["x", "y", "z"]]
    return poses
