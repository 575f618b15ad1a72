"""Runs the jobs of a study that have no result yet, here or on a cluster, and makes the tidy table of all runs.

Each finished run is one CSV file, one row a frame. A stopped or failed study goes on where it was.
"""

import hashlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import InputError, longrun, odometry, stages
from thesis_repro.files import listed, progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.odometry import metrics
from thesis_repro.odometry.passes import poses_of
from thesis_repro.odometry.refined import boresight
from thesis_repro.study import cluster, controls
from thesis_repro.study.jobs import Job, in_passes
from thesis_repro.study.sources import Source

STATES = f"pass-{'[0-9a-f]' * 12}.npz"  # the names that `_state` gives


def _result(folder: Path, job: Job) -> Path:
    """One row a frame, written when the job is done."""
    return folder / job.sequence / f"{job.name}.csv"


def _state(folder: Path, jobs: list[Job]) -> Path:
    """The checkpoint of jobs that go over their sequence together."""
    digest = hashlib.sha256("\n".join(job.name for job in jobs).encode()).hexdigest()[:12]
    return folder / jobs[0].sequence / f"pass-{digest}.npz"


def run(jobs: Iterable[Job], kitti: Path, labels: Path | Iterable[Source], folder: Path, *,
        frames: int | None = None, processes: int = 1, scheduler: str | None = None) -> pd.DataFrame:
    """Run the jobs that have no result yet; returns the table of all runs that succeeded, one row a job.

    kitti: the odometry root. labels: folder with one folder of label maps a sequence, or the sources that the jobs
    name. folder: where results are kept; those of other data, code or settings of masks are deleted.
    frames: how many of each sequence, None for all. processes: how many work at once on this machine.
    scheduler: address of a Dask scheduler ("tcp://host:8786"); its workers do the work then, with the same results.
    They need this package, and the three folders under the same paths. One thread a worker is best.

    Jobs over one sequence go over it together (`odometry.run_many`: the bits of separate runs at a fraction of the
    cost), in as many passes as it takes to keep everyone busy. A job that fails is printed with its reason and does
    not stop the others. What was running when everything stopped goes on from its checkpoint.
    The table's `attrs` say how many jobs were "made" now, "kept" from before, and "failed".
    Raises InputError where another run is at work in the folder, where all jobs fail, or where the machine lacks
    something, such as space or memory; what is finished is kept.
    """
    jobs, sources = list(dict.fromkeys(jobs)), by_name(labels)
    sequences = {name: Sequence(kitti, name).subset(frames) for name in sorted({job.sequence for job in jobs})}
    files = {job: _result(folder, job) for job in jobs}
    with longrun.claimed(folder):
        for sequence in sequences.values():
            _stage(folder, sequence, sources)
        for job, path in files.items():
            table = stages.kept_table(path, len(sequences[job.sequence]))
            if table is None or not np.isfinite(poses_of(table)).all():
                path.unlink(missing_ok=True)  # what is missing is made again
        finished = sum(path.is_file() for path in files.values())
        failures = _run_passes(jobs, sequences, sources, folder, processes, scheduler)
    done = {job: path for job, path in files.items() if path.is_file()}
    if not done:
        raise InputError(f"all {len(jobs)} odometry runs failed; the first: {next(iter(failures.values()))}")
    runs = pd.DataFrame([_row(job, sequences[job.sequence], path) for job, path in done.items()])
    runs.attrs = {"made": len(done) - finished, "kept": finished, "failed": len(jobs) - len(done)}
    return runs


def _run_passes(jobs: list[Job], sequences: dict[str, Sequence], sources: dict[str, Source], folder: Path,
                processes: int, scheduler: str | None) -> dict[Job, str]:
    """Run what has no result, and print what fails; returns the reasons."""
    failures: dict[Job, str] = {}
    lengths = {name: len(sequence) for name, sequence in sequences.items()}
    with cluster.open_pool(processes, scheduler) as pool:
        passes = _passes(jobs, lengths, folder, pool.size)
        threads = -(-pool.size // max(1, len(passes)))
        names = [of_pass[0].sequence for of_pass in passes]
        calls = [(of_pass, sequences[name], sources, folder, stages.record(folder / name), threads)
                 for of_pass, name in zip(passes, names)]
        work = [len(of_pass) * lengths[name] for of_pass, name in zip(passes, names)]  # a frame of each run
        with progress(None, "odometry", total=sum(work), unit="frame") as bar:
            for index, failed in pool.run(_run_pass, calls):
                failures |= failed if isinstance(failed, dict) else dict.fromkeys(passes[index], failed)
                bar.update(work[index])
    by_reason: dict[tuple[str, str], list[str]] = {}
    for job, reason in failures.items():
        by_reason.setdefault((job.sequence, reason), []).append(job.name)
    for (name, reason), of_reason in by_reason.items():
        more = f" and {len(of_reason) - 3} more" * (len(of_reason) > 3)
        longrun.say(f"sequence {name}, {', '.join(of_reason[:3])}{more}: failed: {reason}", warning=True)
    for reason in failures.values():
        if isinstance(reason, _Lacking):  # no answer can be trusted that is left out for want of space
            raise InputError(reason)
    return failures


class _Lacking(str):
    """Why a pass failed that the machine is at fault for."""


def by_name(labels: Path | Iterable[Source]) -> dict[str, Source]:
    """The sources by name; a folder is the only one, and its name is empty."""
    return {source.name: source for source in ([Source(labels)] if isinstance(labels, Path) else labels)}


def _stage(folder: Path, sequence: Sequence, sources: dict[str, Source]) -> None:
    """Delete what the folder holds of a sequence that was made from other data, code or settings.

    Each source has a folder of its own in that of the sequence, so a change of one source leaves the others' runs.
    """
    if not sequence.has_truth:
        raise InputError(f"{sequence.poses_path}: no such file; without true poses sequence {sequence.name} has no "
                         "errors to compare; leave it out (the odometry command runs it)")
    true_labels, folder = controls.true_labels(sequence.root, sequence.name), folder / sequence.name
    records = {source.name: source.record(sequence.name) for source in sources.values()}
    stages.stage(folder, **_versions(), sequence=stages.listing(sequence.files),
                 true_labels=stages.listing(listed(true_labels)) if true_labels.is_dir() else None,
                 **records.pop("", {}))
    for source, record in records.items():
        if stages.record(folder / source) != record:  # so a state may have masks of other files
            for state in folder.glob(STATES):
                state.unlink()
        stages.stage(folder / source, **record)


def _versions() -> dict[str, Any]:
    return {"code": stages.code("odometry", "study/jobs"),
            **stages.made_with("opencv-python-headless", "numpy", "numba")}


def _passes(jobs: list[Job], frames: Mapping[str, int], folder: Path, workers: int) -> list[list[Job]]:
    """What is to be run, as lists of jobs, each for one pass over its sequence, the longest first.

    A pass that was stopped goes on as it was. The rest is cut anew. frames: of each sequence.
    """
    passes: list[list[Job]] = []
    rest: list[Job] = []
    for name in frames:
        of_name = {job.name: job for job in jobs if job.sequence == name}
        waiting = {key: job for key, job in of_name.items() if not _result(folder, job).is_file()}
        for state in sorted((folder / name).glob(STATES)):
            checkpoint = None
            with suppress(InputError):  # it is damaged
                checkpoint = stages.resume(state, arrays=False)
            keys = checkpoint[0]["job"]["runs"] if checkpoint else []
            if not of_name.keys() >= set(keys):
                continue  # somebody may ask for these again
            if waiting.keys().isdisjoint(keys):
                state.unlink()
            else:
                passes.append([of_name[key] for key in keys])
                waiting = {key: job for key, job in waiting.items() if key not in keys}
        rest += waiting.values()
    return sorted(passes + in_passes(rest, frames, workers), key=lambda jobs: -len(jobs) * frames[jobs[0].sequence])


def masks_of(jobs: Iterable[Job], sequence: Sequence, sources: Mapping[str, Source]
             ) -> tuple[dict[Job, controls.ControlMasks | None], dict[Job, str]]:
    """The masks of each job over a sequence, {job: masks}, and {job: reason} of those whose masks cannot be made.

    Every file is read here, since a bad one in the middle of a pass would stop all of it. Jobs with the same masks get
    the same object: so `run_many` knows that they share the work.
    """
    check = cache(lambda source, path: sources[source].check_file(path, sequence.size))

    @cache
    def read(job: Job) -> controls.ControlMasks | str | None:
        try:
            its_masks = job.masks(sequence, sources)
            for path in its_masks.paths if its_masks is not None else ():
                check(job.source, path)
        except InputError as error:
            return str(error)
        return its_masks

    masks = {job: read(Job("", job.method, job.dilation_width, source=job.source)) for job in jobs}
    reasons = {job: reason for job, reason in masks.items() if isinstance(reason, str)}
    return {job: its_masks for job, its_masks in masks.items() if not isinstance(its_masks, str)}, reasons


def _run_pass(jobs: list[Job], sequence: Sequence, sources: dict[str, Source], folder: Path, record: dict, threads: int
              ) -> dict[Job, str]:
    """Run jobs of one sequence in one pass, here or on another machine; returns {job: reason} of those that failed."""
    cv2.setNumThreads(1)  # the processes already use every core
    state = _state(folder, jobs)
    failures: dict[Job, str] = {}
    try:
        stages.check_worker(folder / sequence.name, record, **_versions())
        # all of them where there is a checkpoint to go on from, for it is one of all of them
        waiting = jobs if state.is_file() else [job for job in jobs if not _result(folder, job).is_file()]
        masks, failures = masks_of(waiting, sequence, sources)
        if not masks:  # or Dask does again what it lost the answer of
            return failures
        results = odometry.run_many(sequence, {job.name: (job.settings, its_masks) for job, its_masks in masks.items()},
                                    checkpoint=state, workers=threads)
        for job in masks:
            if not _result(folder, job).is_file():
                write_text(_result(folder, job), results.pop(job.name).frames.to_csv(index=False))
        state.unlink(missing_ok=True)
    except Exception as error:  # whatever it is, the others go on and the reason is reported
        reason = longrun.explain(error)
        if reason is None:
            reason = f"{type(error).__name__}: {error}"
        elif not isinstance(error, InputError):
            reason = _Lacking(reason)
        failures = dict.fromkeys((job for job in jobs if not _result(folder, job).is_file()), reason) | failures
    return failures


def _row(job: Job, sequence: Sequence, result: Path) -> dict[str, Any]:
    frames = pd.read_csv(result, keep_default_na=False, na_values={"detected": "", "tracked": ""})
    return {"sequence": job.sequence, "run": job.name, **asdict(job), **measures(frames, sequence.poses)}


def measures(frames: pd.DataFrame, true: np.ndarray) -> dict[str, Any]:
    """What a table of runs has of a run's table of frames: its length, errors, keypoints and flagged frames.

    true: poses (n, 4, 4). Errors are those of `metrics.errors` and `metrics.step_errors`; t_rel (percent) and r_rel
    (degrees per 100 m) those of `metrics.kitti_errors`.
    """
    poses = poses_of(frames)
    kitti = metrics.kitti_errors(poses, true)
    return {"frames": len(frames), **metrics.errors(poses, true), **metrics.step_errors(poses, true),
            "t_rel": kitti["translation_percent"], "r_rel": kitti["rotation_deg_per_100m"],
            "mean_keypoints": frames["detected"].mean(),
            "flagged": int((~frames["flag"].isin(["", "stationary"])).sum())}


def with_boresight_correction(runs: pd.DataFrame, kitti: Path, folder: Path, frames: int | None = None) -> pd.DataFrame:
    """The runs with a further column, rmse_boresight_corrected: the RMSE (m) with the mounting angle removed.

    The angle between camera and ground truth is constant over a recording day. For each sequence it is estimated from
    the refined runs with all keypoints of the *other* sequences of its day, and it is the same for every method. It is
    taken as 0 where there are no others, or where they do not determine it.
    folder, frames: as given to `run`. The column is missing (NaN) where all keypoints were not run under the refined
    estimator.
    """
    references = refined_paths(runs, kitti, folder, frames)
    of_run = run_poses(runs[runs["sequence"].isin(references)], folder)
    angles = {name: boresight.angles_of_day(name, references) for name in references}
    corrected = {key: metrics.rmse(boresight.corrected(poses, angles[key[0]]), references[key[0]][1])
                 for key, poses in of_run.items()}
    return runs.assign(rmse_boresight_corrected=[corrected.get(key, np.nan)
                                                 for key in zip(runs["sequence"], runs["run"], strict=True)])


def refined_paths(runs: pd.DataFrame, kitti: Path, folder: Path, frames: int | None = None
                  ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{sequence: (estimated, true)} of all keypoints under the refined estimator, poses (n, 4, 4), for `boresight`."""
    chosen = runs[(runs["method"] == "baseline") & (runs["estimator"] == "refined") & (runs["repetition"] == 0)]
    return {name: (poses, Sequence(kitti, name).subset(frames).poses)
            for (name, _), poses in run_poses(chosen, folder).items()}


def paths(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Estimated positions (n, 3), metres, of each row of a table of runs, keyed by sequence and run."""
    return {key: poses[:, :3, 3] for key, poses in run_poses(runs, folder).items()}


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Estimated poses (n, 4, 4) of each row of a table of runs, keyed by sequence and run."""
    return {(name, run): poses_of(pd.read_csv(folder / name / f"{run}.csv"))
            for name, run in zip(runs["sequence"], runs["run"], strict=True)}
