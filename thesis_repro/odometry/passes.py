"""Run the odometry over a sequence: one run, or many runs in one pass.

The runs of a pass share detection and tracking.
"""

import time
from collections.abc import Iterable, Mapping, Sized
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import pandas as pd

from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import keypoints
from thesis_repro.odometry.odometry import (
    FRAME_COLUMNS,
    ROTATION_COLUMNS,
    STATIONARY,
    Odometry,
    Step,
)
from thesis_repro.odometry.refined.motion_prior import MotionPrior
from thesis_repro.odometry.settings import THESIS, OdometrySettings
from thesis_repro.running import messages, results
from thesis_repro.running.files import progress

CHECKPOINT = 300  # frames
# Settings that act only after the essential matrix: runs that differ in nothing else share it.
AFTER_ESSENTIAL = {"estimator", "scale_gate"}
# Settings that act only after the keypoints: runs that differ in nothing else share keypoints. Runs
# that differ in any other setting, so also in a new one, share nothing of both.
AFTER_KEYPOINTS = AFTER_ESSENTIAL | {"threshold", "shuffle_seed"}
SHARED_TIMES = ("detect_seconds", "track_seconds")  # measured for all runs of a pass together
DTYPES = {
    "frame": int,
    "updated": bool,
    **dict.fromkeys(("points", "detected", "tracked", "inliers", "pose_inliers"), "Int64"),
}
NUMBER_COLUMNS = [*(column for column in FRAME_COLUMNS if column != "flag"), "mask_seconds"]


@runtime_checkable
class Masks(Protocol):
    """An object whose item i is the mask of frame i, (height, width) uint8.

    Keypoints are forbidden where it is 0.
    """

    def __getitem__(self, index: int, /) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class Result:
    """Result of one run.

    poses: (n, 4, 4) camera to world, metres. frames: one row a frame, see Step.row; missing values
    are blank. A result equals only itself; compare poses with np.array_equal.
    """

    poses: np.ndarray
    frames: pd.DataFrame
    settings: OdometrySettings = THESIS

    @property
    def flagged(self) -> pd.Series:
        """Number of frames by flag."""
        texts = self.frames["flag"]
        flags = texts[texts != ""].str.split("; ").explode()
        return flags.value_counts()

    @property
    def failed(self) -> int:
        """Number of frames with a flag other than "stationary"."""
        return int(is_flagged(self.frames).sum())


def is_flagged(frames: pd.DataFrame) -> pd.Series:
    """Whether a frame has a flag other than "stationary", booleans (n,), see Result.frames."""
    return ~frames["flag"].isin(["", STATIONARY])


def start_pose(sequence: Sequence) -> np.ndarray:
    """First pose of the estimate.

    It is the identity, as in PySLAM, unless the ground truth starts at another pose. Complete KITTI
    sequences start at the identity (up to 1e-10); excerpts do not.
    """
    if not sequence.has_truth:
        return np.eye(4)
    first = sequence.poses[0]
    if np.abs(first - np.eye(4)).max() < 1e-6:
        return np.eye(4)
    return first


def scales(sequence: Sequence) -> np.ndarray:
    """Distances between the true positions of consecutive frames, (n,), metres. The first one is 0.

    Without ground truth, these are the sequence's `assumed_steps`.
    """
    if not sequence.has_truth:
        return sequence.assumed_steps
    lengths = np.zeros(len(sequence.poses))
    for index, step in enumerate(np.diff(sequence.poses[:, :3, 3], axis=0)):
        lengths[index + 1] = np.linalg.norm(step)
    return lengths


def run(
    sequence: Sequence,
    settings: OdometrySettings = THESIS,
    masks: Masks | None = None,
    description: str | None = None,
) -> Result:
    """Run the odometry over a kitti.Sequence. Returns a Result.

    masks: see Masks. description: text of the progress bar; None for no bar.
    Raises InputError if a frame cannot be read, if a mask and its frame differ in size, if there
    are fewer masks than frames, and for another kind of sequence, settings or masks.
    """
    results_by_name = _run_pass(sequence, {"": (settings, masks)}, None, description, None)
    return results_by_name[""]


def run_many(
    sequence: Sequence,
    runs: Mapping[str, tuple[OdometrySettings, Masks | None]],
    description: str | None = None,
    checkpoint: Path | None = None,
) -> dict[str, Result]:
    """Make many runs, {name: (settings, masks)}, over one sequence. Returns {name: Result}.

    The results equal those of separate runs. Frames are decoded, corner strengths computed and
    points tracked once for all runs. The times of detection and tracking are blank, because they
    cannot be measured for a single run. Runs with the same masks object that differ only in
    AFTER_KEYPOINTS share masks and keypoints. If they differ only in AFTER_ESSENTIAL, they share
    essential matrices, too. checkpoint: file in which the state is stored every CHECKPOINT frames,
    and from which a stopped pass resumes. The caller deletes the file after storing the results,
    and uses another file for another sequence, other settings or other masks.
    """
    return _run_pass(sequence, runs, keypoints.SharedKeypoints(), description, checkpoint)


@dataclass
class _Run:
    """One run of a pass and its results so far, one row of numbers a frame."""

    odometry: Odometry
    masks: Masks | None
    numbers: np.ndarray
    flags: dict[int, str] = field(default_factory=dict)

    def finish(self, step: Step, mask_seconds: float) -> None:
        """Move the pose by an estimated step, and store its row."""
        row = self.odometry.compose(step).row() | {"mask_seconds": mask_seconds}
        flag = row.pop("flag")
        for column, value in enumerate(row.values()):
            if value is not None:
                self.numbers[step.frame, column] = value
        if flag:
            self.flags[step.frame] = flag


def _run_pass(
    sequence: Sequence,
    runs: Mapping[str, tuple[OdometrySettings, Masks | None]],
    shared: keypoints.SharedKeypoints | None,
    description: str | None,
    checkpoint: Path | None,
) -> dict[str, Result]:
    """Make runs in one pass. shared: None if the times of a single run are wanted."""
    if not hasattr(sequence, "frame"):
        raise InputError(
            f"sequence: must be a thesis_repro.Sequence, not {type(sequence).__name__}"
        )
    members = {}
    for name, (settings, masks) in runs.items():
        is_short = isinstance(masks, Sized) and len(masks) < len(sequence)
        if is_short or not isinstance(masks, Masks | None):
            raise InputError(
                f"masks: must be {len(sequence)} masks, one a frame, such as LabelMasks"
            )
        odometry = Odometry(sequence.intrinsics, settings, start_pose(sequence), shared)
        numbers = np.full((len(sequence), len(NUMBER_COLUMNS)), np.nan)
        members[name] = _Run(odometry, masks, numbers)
    groups = _groups(members.values())
    # the first run of each group detects and tracks for its group
    leaders = [group[0][0] for group in groups]
    step_lengths = scales(sequence)
    done = _resume(checkpoint, members, leaders)
    indices: Iterable[int] = range(done, len(sequence))
    if description is not None:
        indices = progress(indices, description, total=len(sequence), initial=done)
    for index in indices:
        messages.check_stop()
        with messages.held_signals():
            frame = sequence.frame(index)
            if shared is not None:
                starts = [(leader.odometry.previous, leader.odometry.points) for leader in leaders]
                shared.expect(frame, starts)
            for group in groups:
                _step_group(group, index, frame, step_lengths[index])
        if checkpoint and (index + 1) % CHECKPOINT == 0:
            _store(checkpoint, index + 1, members, leaders)
    blank = () if shared is None else SHARED_TIMES
    return {name: _result(member, blank) for name, member in members.items()}


# Lists of runs that share an essential matrix. The runs of all lists have the same keypoints.
_Group = list[list[_Run]]


def _step_group(group: _Group, index: int, frame: np.ndarray, scale: float) -> None:
    """Make one step of all runs with the same keypoints."""
    leader = group[0][0]
    started = time.perf_counter()
    mask = None if leader.masks is None else leader.masks[index]
    mask_seconds = time.perf_counter() - started
    observed = leader.odometry.observe(frame, scale, mask)
    for runs_of_matrix in group:
        essential = None
        for run in runs_of_matrix:
            step = observed.copy()
            essential = run.odometry.estimate(step, essential)
            run.finish(step, mask_seconds)


def _groups(members: Iterable[_Run]) -> list[_Group]:
    """Groups of runs with the same keypoints."""
    groups: dict[tuple, dict[tuple, list[_Run]]] = {}
    for member in members:
        settings = member.odometry.settings
        keypoint_key = id(member.masks), *_all_but(AFTER_KEYPOINTS, settings)
        essential_key = _all_but(AFTER_ESSENTIAL, settings)
        groups.setdefault(keypoint_key, {}).setdefault(essential_key, []).append(member)
    return [list(group.values()) for group in groups.values()]


def _all_but(names: set[str], settings: OdometrySettings) -> tuple:
    """The values of all settings but those with the given names."""
    return tuple(value for name, value in vars(settings).items() if name not in names)


# Checkpoints


def _store(checkpoint: Path, done: int, members: Mapping[str, _Run], leaders: list[_Run]) -> None:
    """Write the state after `done` frames to a checkpoint."""
    last = leaders[0].odometry  # the previous frame is the same in all runs
    arrays = {
        "numbers": np.array([member.numbers[:done] for member in members.values()]),
        "poses": np.array([member.odometry.pose for member in members.values()]),
    }
    priors = [member.odometry.prior for member in members.values()]
    for part in MotionPrior._fields:
        arrays[f"prior {part}"] = np.array([getattr(prior, part) for prior in priors])
    for index, leader in enumerate(leaders):
        arrays[f"points {index}"] = leader.odometry.points
    if last.previous is not None:
        arrays["previous"] = last.previous
    flags = {name: member.flags for name, member in members.items()}
    state = {"runs": list(members), "done": done, "gap": last.gap, "flags": flags}
    results.store(checkpoint, state, arrays)


def _resume(checkpoint: Path | None, members: Mapping[str, _Run], leaders: list[_Run]) -> int:
    """Restore the state from a checkpoint. Returns the number of finished frames, 0 without one."""
    if checkpoint is None:
        return 0
    stored = results.resume(checkpoint)
    if stored is None:
        return 0
    state, arrays = stored
    done = int(state["done"])
    priors = zip(*(arrays[f"prior {part}"] for part in MotionPrior._fields), strict=True)
    for (name, member), numbers, pose, prior in zip(
        members.items(), arrays["numbers"], arrays["poses"], priors, strict=True
    ):
        member.numbers[:done] = numbers
        member.flags.update({int(index): flag for index, flag in state["flags"][name].items()})
        member.odometry.pose = pose
        member.odometry.prior = MotionPrior(*prior)
    for index, leader in enumerate(leaders):
        odometry = leader.odometry
        odometry.count = done
        odometry.gap = state["gap"]
        odometry.previous = arrays.get("previous")
        odometry.points = arrays[f"points {index}"]
    return done


def _result(member: _Run, blank: Iterable[str]) -> Result:
    """Result of a run; the columns in `blank` are left out of its table."""
    columns = dict(zip(NUMBER_COLUMNS, member.numbers.T, strict=True))
    columns |= dict.fromkeys(blank, np.full(len(member.numbers), np.nan))
    columns["flag"] = [member.flags.get(index, "") for index in range(len(member.numbers))]
    for name, dtype in DTYPES.items():
        columns[name] = pd.array(columns[name], dtype)
    frames = pd.DataFrame(columns, columns=[*FRAME_COLUMNS, "mask_seconds"])
    return Result(poses_of(frames), frames, member.odometry.settings)


def poses_of(frames: pd.DataFrame) -> np.ndarray:
    """Poses (n, 4, 4) from a table with one row a frame (Result.frames)."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = frames[ROTATION_COLUMNS].to_numpy().reshape(-1, 3, 3)
    poses[:, :3, 3] = frames[["x", "y", "z"]]
    return poses
