"""The odometry runs behind chapter 4: every sequence with all keypoints, with masks of each width, and plainly reduced.

Each finished run is one CSV file, so that a stopped or failed series goes on where it was.
"""

from dataclasses import asdict, dataclass, replace

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import InputError, metrics, odometry, stages
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks

# Section 4.2 counts what happens from frame to frame and the making of the mask, not the prediction
TIMED = ("mask", "detect", "track", "essential", "pose")
CODE = ("experiments", "keypoints", "kitti", "masks", "odometry", "pose")  # what a finished run depends on


@dataclass(frozen=True)
class Job:
    """One run of the odometry over one sequence."""

    sequence: str
    variant: str  # baseline, masked or reduced
    dilation_width: int | None = None  # of masked runs
    max_keypoints: int | None = None  # of reduced runs

    @property
    def name(self):
        size = self.dilation_width or self.max_keypoints
        return f"{self.variant}-{size:02d}" if size else self.variant


def first_jobs(names, widths):
    """The runs that depend on no other: baseline and masks of every width, for each sequence."""
    return [job for name in names
            for job in (Job(name, "baseline"), *(Job(name, "masked", dilation_width=width) for width in widths))]


def best_widths(summary):
    """The row of `summary` with the lowest RMSE of each sequence, as the thesis chooses its width (Section 4.2).

    The width is chosen by its error on the very sequence it is then judged on: a best of 15, not a test.
    """
    masked = summary[summary["variant"] == "masked"]
    return masked.loc[masked.groupby("sequence")["rmse"].idxmin()].set_index("sequence").sort_index()


def reduced_jobs(summary):
    """The detector limited to each sequence's mean number of keypoints at its best width (Figure 4.12)."""
    return [Job(name, "reduced", max_keypoints=max(1, round(row["mean_keypoints"])))
            for name, row in best_widths(summary).iterrows()]


def run(jobs, kitti, labels, folder, *, frames=None, processes=1, settings=odometry.THESIS):
    """Run the jobs that have no result yet, `processes` at a time; returns the summary of all that succeeded.

    kitti: the odometry root. labels: folder with one folder of label maps a sequence. folder: where results are kept.
    frames: how many of each sequence, None for all. A job that fails is printed with its reason and stops no other.
    """
    names = sorted({job.sequence for job in jobs})
    sequences = {name: Sequence(kitti, name).subset(frames) for name in names}
    for name, sequence in sequences.items():
        stages.stage(folder / name, code=stages.code(*CODE), frames=stages.listing(sequence.frame_paths),
                     poses=stages.content(sequence.root / "poses" / f"{name}.txt"), opencv=cv2.__version__,
                     labels=stages.made_from(labels / name), settings=asdict(settings))
    waiting = [job for job in jobs if not _result(folder, job).is_file()]
    # the longest first, so that no process works alone at the end
    waiting.sort(key=lambda job: -len(sequences[job.sequence]))
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered")(
        joblib.delayed(_run_job)(job, sequences[job.sequence], labels, folder, settings) for job in waiting)
    failures = {}
    for job, failure in progress(work, "odometry", total=len(waiting), unit="run"):
        if failure:
            failures[job] = failure
            print(f"sequence {job.sequence}, {job.name}: failed: {failure}")
    done = [job for job in jobs if job not in failures]
    if not done:
        raise InputError(f"all {len(jobs)} odometry runs failed; the first: {next(iter(failures.values()))}")
    return pd.DataFrame([_summarize(job, sequences[job.sequence], folder) for job in done])


def _result(folder, job):
    return folder / job.sequence / f"{job.name}.csv"


def _run_job(job, sequence, labels, folder, settings):
    cv2.setNumThreads(1)  # the processes already use every core, and one thread makes times comparable
    try:
        masks = None
        if job.variant == "masked":
            masks = LabelMasks(labels / job.sequence, sequence, job.dilation_width)
        if job.max_keypoints:
            settings = replace(settings, max_keypoints=job.max_keypoints)
        result = odometry.run(sequence, settings, masks)
    except Exception as error:  # whatever it is, the other runs go on and the reason is reported
        return job, f"{type(error).__name__}: {error}"
    write_text(_result(folder, job), result.frames.to_csv(index=False))
    return job, None


def _summarize(job, sequence, folder):
    frames = pd.read_csv(_result(folder, job), keep_default_na=False, na_values={"detected": "", "tracked": ""})
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = frames[[f"r{i}{j}" for i in range(3) for j in range(3)]].to_numpy().reshape(-1, 3, 3)
    poses[:, :3, 3] = frames[["x", "y", "z"]]
    return {
        "sequence": job.sequence, "run": job.name, "variant": job.variant, "dilation_width": job.dilation_width,
        "max_keypoints": job.max_keypoints, "frames": len(frames),
        "rmse": metrics.rmse(poses, sequence.poses), "mae": metrics.mae(poses, sequence.poses),
        "mean_keypoints": frames["detected"].mean(),
        "seconds": frames[[f"{part}_seconds" for part in TIMED]].to_numpy().sum(),
        "flagged": int((~frames["flag"].isin(["", "stationary"])).sum()),
    }


def paths(summary, folder):
    """Estimated positions (n, 3) of each row of a summary, keyed by sequence and run."""
    return {(row.sequence, row.run): pd.read_csv(folder / row.sequence / f"{row.run}.csv")[["x", "y", "z"]].to_numpy()
            for row in summary.itertuples()}


def true_paths(kitti, names, frames=None):
    """True positions (n, 3) in metres of each sequence."""
    return {name: Sequence(kitti, name).subset(frames).poses[:, :3, 3] for name in names}
