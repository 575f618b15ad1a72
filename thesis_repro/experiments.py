"""The odometry runs behind chapter 4: every sequence with all keypoints, with masks of each width, and plainly reduced.

Each finished run is one CSV file, so that a stopped or failed series goes on where it was.
"""

import time
from dataclasses import asdict, dataclass, replace

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import InputError, metrics, odometry, stages
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks, forget_edges

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
    """Run the jobs that have no result yet; returns the summary of all that succeeded, one row a job.

    The jobs of one sequence go over it together (`odometry.run_many`: the bits of separate runs at a third of the
    cost), and `processes` sequences at a time. kitti: the odometry root. labels: folder with one folder of label maps
    a sequence. folder: where results are kept. frames: how many of each sequence, None for all.
    A job that fails is printed with its reason and does not stop the others.
    """
    sequences = _open(jobs, kitti, labels, folder, frames, settings)
    waiting = {name: [job for job in jobs if job.sequence == name and not _result(folder, job).is_file()]
               for name in sequences}
    # the longest first, so that no process works alone at the end
    names = sorted((name for name in waiting if waiting[name]), key=lambda name: -len(sequences[name]))
    threads = -(-processes // max(1, len(names)))
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered")(
        joblib.delayed(_run_jobs)(waiting[name], sequences[name], labels, folder, settings, threads) for name in names)
    failures = {}
    for failed in progress(work, "odometry", total=len(names), unit="sequence"):
        failures.update(failed)
    for job, reason in failures.items():
        print(f"sequence {job.sequence}, {job.name}: failed: {reason}")
    done = [job for job in jobs if job not in failures]
    if not done:
        raise InputError(f"all {len(jobs)} odometry runs failed; the first: {next(iter(failures.values()))}")
    return pd.DataFrame([_summarize(job, sequences[job.sequence], folder) for job in done])


def _open(jobs, kitti, labels, folder, frames, settings):
    """The jobs' sequences by name; what the folder holds of other data, settings or code is deleted."""
    sequences = {name: Sequence(kitti, name).subset(frames) for name in sorted({job.sequence for job in jobs})}
    for name, sequence in sequences.items():
        stages.stage(folder / name, code=stages.code(*CODE), frames=stages.listing(sequence.frame_paths),
                     poses=stages.content(sequence.root / "poses" / f"{name}.txt"), opencv=cv2.__version__,
                     labels=stages.made_from(labels / name), settings=asdict(settings))
    return sequences


def _result(folder, job):
    return folder / job.sequence / f"{job.name}.csv"


def _variant(job, sequence, labels, settings):
    """What the odometry needs to know of a job: (settings, masks)."""
    if job.max_keypoints:
        settings = replace(settings, max_keypoints=job.max_keypoints)
    masked = job.variant == "masked"
    return settings, LabelMasks(labels / job.sequence, sequence, job.dilation_width) if masked else None


def _run_jobs(jobs, sequence, labels, folder, settings, threads):
    """Run the jobs of one sequence in one pass; returns {job: reason} of those that failed."""
    cv2.setNumThreads(1)  # the processes already use every core
    variants, failures = {}, {}
    for job in jobs:
        try:
            variants[job] = _variant(job, sequence, labels, settings)
        except InputError as error:
            failures[job] = str(error)
    if not variants:
        return failures
    checkpoint = folder / sequence.name / "checkpoint"
    try:
        results = odometry.run_many(sequence, {job.name: variant for job, variant in variants.items()},
                                    checkpoint=checkpoint, workers=threads)
    except Exception as error:  # whatever it is, the other sequences go on and the reason is reported
        return failures | {job: f"{type(error).__name__}: {error}" for job in variants}
    for job in variants:
        write_text(_result(folder, job), results[job.name].frames.to_csv(index=False))
    checkpoint.unlink(missing_ok=True)
    return failures


def time_runs(jobs, kitti, labels, folder, *, frames, processes=1, settings=odometry.THESIS):
    """What each job costs as a run of its own: a table of sequence, run, variant, dilation_width and seconds.

    Only the first `frames` frames are timed; the first two steps are left out, since they load compiled code. The jobs
    of a sequence take turns at every frame, so that what else the machine does falls on all of them alike.
    To be called after `run`, whose folder it shares.
    """
    files = {name: folder / name / f"seconds-{frames}.csv" for name in sorted({job.sequence for job in jobs})}
    waiting = [name for name in files if not files[name].is_file()]
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered")(
        joblib.delayed(_time_jobs)([job for job in jobs if job.sequence == name],
                                   Sequence(kitti, name).subset(frames), labels, files[name], settings)
        for name in waiting)
    for _ in progress(work, "timing", total=len(waiting), unit="sequence"):
        pass
    return pd.concat([pd.read_csv(path, dtype={"sequence": str}) for path in files.values()], ignore_index=True)


def _time_jobs(jobs, sequence, labels, path, settings):
    cv2.setNumThreads(1)  # one thread makes times comparable
    scales = odometry.scales(sequence)
    variants = {job: _variant(job, sequence, labels, settings) for job in jobs}
    runs = {job: odometry.Odometry(sequence.intrinsics, chosen) for job, (chosen, _) in variants.items()}
    seconds = dict.fromkeys(jobs, 0.0)
    for index in range(len(sequence)):
        frame = sequence.frame(index)
        for job, (_, masks) in variants.items():
            forget_edges()  # each run of its own would have to make them
            started = time.perf_counter()
            mask = None if masks is None else masks[index]
            mask_seconds = time.perf_counter() - started
            step = runs[job].step(frame, scales[index], mask)
            if index > 1:
                # Section 4.2 counts what happens from frame to frame and the making of the mask, not the prediction
                seconds[job] += mask_seconds + sum(step.seconds.values())
    table = pd.DataFrame([{"sequence": job.sequence, "run": job.name, "variant": job.variant,
                           "dilation_width": job.dilation_width, "seconds": seconds[job]} for job in jobs])
    write_text(path, table.to_csv(index=False))


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
        "flagged": int((~frames["flag"].isin(["", "stationary"])).sum()),
    }


def paths(summary, folder):
    """Estimated positions (n, 3) of each row of a summary, keyed by sequence and run."""
    return {(row.sequence, row.run): pd.read_csv(folder / row.sequence / f"{row.run}.csv")[["x", "y", "z"]].to_numpy()
            for row in summary.itertuples()}


def true_paths(kitti, names, frames=None):
    """True positions (n, 3) in metres of each sequence."""
    return {name: Sequence(kitti, name).subset(frames).poses[:, :3, 3] for name in names}
