"""Run the jobs of a study that have no result yet, here or on a cluster, and make the table of all
runs.

Each finished run is one CSV file with one row a frame. A study that stopped or failed resumes from
its checkpoints.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics
from thesis_repro.odometry.passes import poses_of
from thesis_repro.running import console, results
from thesis_repro.running.files import listed, progress, write_text
from thesis_repro.study import compare, controls, workers
from thesis_repro.study.jobs import ESTIMATORS, Job, in_passes, keypoint_control_jobs
from thesis_repro.study.sources import Source

# pattern of the file names, one for each unfinished pass
CHECKPOINTS = f"pass-{'[0-9a-f]' * 12}.npz"


def result_file(folder: Path, job: Job) -> Path:
    """Return the result file of a job, which is written when the job is done."""
    return folder / job.sequence / f"{job.name}.csv"


def run(
    jobs: Iterable[Job],
    sequences: Iterable[Sequence],
    sources: Path | Iterable[Source],
    folder: Path,
    *,
    processes: int = 1,
    scheduler: str | None = None,
) -> pd.DataFrame:
    """Run the jobs that have no result yet; returns the table of all runs that succeeded, one row a
    job.

    sequences: those of the jobs. sources: folder with one folder of label maps a sequence, or the
    sources of the jobs.
    folder: for the results; results from other data, code or mask settings in it are moved aside.
    processes: number of processes on this machine.
    scheduler: address of a Dask scheduler ("tcp://host:8786"), whose workers then do the work with
    the same results. They need this package, and the three folders under the same paths. One thread
    a worker is best.

    Jobs over the same sequence share one or several passes (`odometry.run_many`), with the results
    of separate runs. An interrupted pass resumes from its checkpoint. A job that fails is printed
    with its reason and does not stop other jobs. The table's `attrs` say how many jobs were "made"
    now, "kept" from before, and "failed".
    Raises InputError if another run is using the folder, if all jobs fail, or if the machine lacks
    disk space or memory. Finished results are kept.
    """
    jobs, sources_by_name = list(dict.fromkeys(jobs)), by_name(sources)
    names = {job.sequence for job in jobs}
    opened = {sequence.name: sequence for sequence in sequences if sequence.name in names}
    files = {job: result_file(folder, job) for job in jobs}
    with results.claimed(folder):
        for sequence in opened.values():
            _stage(folder, sequence, sources_by_name)
        for job, path in files.items():
            table = results.kept_table(path, len(opened[job.sequence]))
            if table is None or not np.isfinite(poses_of(table)).all():
                path.unlink(missing_ok=True)  # missing results are made again
        finished = sum(path.is_file() for path in files.values())
        failures = _run_passes(jobs, opened, sources_by_name, folder, processes, scheduler)
    rows = []
    for job, path in files.items():
        if path.is_file():
            table = pd.read_csv(
                path, keep_default_na=False, na_values={"detected": "", "tracked": ""}
            )
            errors = measures(table, opened[job.sequence].poses)
            rows.append({"sequence": job.sequence, "run": job.name, **asdict(job), **errors})
    if not rows:
        raise InputError(
            f"all {len(jobs)} odometry runs failed; the first: {next(iter(failures.values()))}"
        )
    runs = pd.DataFrame(rows)
    runs.attrs = {"made": len(rows) - finished, "kept": finished, "failed": len(jobs) - len(rows)}
    return runs


def keypoint_controls(
    runs: pd.DataFrame,
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    repetitions: int,
    width: int,
    estimators: Iterable[str] = tuple(ESTIMATORS),
) -> list[Job]:
    """Return the `keypoint_control_jobs` of each source, from runs with its masks.

    width: pixels, of the masks from label maps that leave as many keypoints.
    """
    return [
        job
        for source in sources
        for job in keypoint_control_jobs(
            compare.keypoints_left(compare.of_source(runs, source.name)),
            sequences,
            repetitions,
            estimators,
            source.name,
            width if source.kind == "labels" else None,
        )
    ]


def _run_passes(
    jobs: list[Job],
    sequences: dict[str, Sequence],
    sources: dict[str, Source],
    folder: Path,
    processes: int,
    scheduler: str | None,
) -> dict[Job, str]:
    """Run the jobs without a result and print which of them failed; returns {job: reason} for
    the failed ones.
    """
    failures: dict[Job, str] = {}
    with workers.open_pool(processes, scheduler) as pool:
        passes = _passes(jobs, sequences, folder, pool.size)
        calls, frames = [], []
        for pass_jobs in passes:
            sequence = sequences[pass_jobs[0].sequence]
            calls.append(
                (
                    pass_jobs,
                    sequence,
                    sources,
                    folder,
                    results.record(folder / sequence.name),
                )
            )
            frames.append(len(pass_jobs) * len(sequence))
        with progress(None, "odometry", total=sum(frames), unit="frame") as bar:
            for index, failed in pool.run(_run_pass, calls):
                console.check_stop()
                failures |= (
                    failed if isinstance(failed, dict) else dict.fromkeys(passes[index], failed)
                )
                bar.update(frames[index])
    by_reason: dict[tuple[str, str], list[str]] = {}
    for job, reason in failures.items():
        by_reason.setdefault((job.sequence, reason), []).append(job.name)
    for (name, reason), runs in by_reason.items():
        more = f" and {len(runs) - 3} more" * (len(runs) > 3)
        console.log.warning(f"sequence {name}, {', '.join(runs[:3])}{more}: failed: {reason}")
    for reason in failures.values():
        if isinstance(reason, _MachineFault):  # a study without these runs could mislead
            raise InputError(reason)
    return failures


class _MachineFault(str):
    """The reason of a failure that the machine caused, such as a full disk."""


def by_name(sources: Path | Iterable[Source]) -> dict[str, Source]:
    """Return the sources by name. A folder becomes a single source with an empty name."""
    return {
        source.name: source
        for source in ([Source(sources)] if isinstance(sources, Path) else sources)
    }


def _stage(folder: Path, sequence: Sequence, sources: dict[str, Source]) -> None:
    """Move aside the results of a sequence that were made from other data, code or settings.

    Each source has a subfolder, so a change of one source does not move the runs of other
    sources.
    """
    if not sequence.has_truth:
        raise InputError(
            f"{sequence.poses_path}: no such file; without ground truth, sequence {sequence.name} has no "
            "errors to compare; leave it out (the odometry command runs it)"
        )
    folder /= sequence.name
    true_labels = listed(controls.true_labels(sequence.root, sequence.name))
    records = {source.name: source.record(sequence.name) for source in sources.values()}
    results.stage(
        folder,
        **_versions(),
        sequence=results.listing(sequence.files),
        true_labels=results.listing(true_labels),
        **records.pop("", {}),
    )
    for source, record in records.items():
        # a checkpoint may come from the source's old masks
        if results.record(folder / source) != record:
            for checkpoint in folder.glob(CHECKPOINTS):
                checkpoint.unlink()
        results.stage(folder / source, **record)


def _versions() -> dict[str, Any]:
    return {
        "code": results.code("thesis_repro.odometry", "thesis_repro.study.jobs"),
        **results.made_with("opencv", "numpy", "numba"),
    }


def _passes(
    jobs: list[Job], sequences: Mapping[str, Sequence], folder: Path, workers: int
) -> list[list[Job]]:
    """Divide the jobs without a result into passes, the longest first. A pass with a checkpoint
    keeps its jobs.
    """
    passes: list[list[Job]] = []
    jobs_without_checkpoint: list[Job] = []
    for name in sequences:
        sequence_jobs = {job.name: job for job in jobs if job.sequence == name}
        waiting = {
            key: job for key, job in sequence_jobs.items() if not result_file(folder, job).is_file()
        }
        for path in sorted((folder / name).glob(CHECKPOINTS)):
            keys = results.resume(path)[0]["runs"]
            if not sequence_jobs.keys() >= set(keys):
                continue  # it holds jobs that are not requested now but may be later
            if waiting.keys().isdisjoint(keys):
                path.unlink()
            else:
                passes.append([sequence_jobs[key] for key in keys])
                waiting = {key: job for key, job in waiting.items() if key not in keys}
        jobs_without_checkpoint += waiting.values()
    return sorted(
        passes + in_passes(jobs_without_checkpoint, sequences, workers),
        key=lambda pass_jobs: -len(pass_jobs) * len(sequences[pass_jobs[0].sequence]),
    )


def masks_of(
    jobs: Iterable[Job], sequence: Sequence, sources: Mapping[str, Source]
) -> tuple[dict[Job, controls.ControlMasks | None], dict[Job, str]]:
    """Return {job: masks} over a sequence, and {job: reason} for the jobs whose masks cannot be
    made.

    Every file is read here, because a bad file in the middle of a pass would stop the whole pass.
    Jobs with the same masks get the same object, by which `run_many` recognises that they share
    work.
    """
    check_file = cache(lambda source, path: sources[source].check_file(path, sequence.size))

    @cache
    def checked_masks(job: Job) -> controls.ControlMasks | str | None:
        try:
            masks = job.masks(sequence, sources)
            for path in masks.paths if masks is not None else ():
                check_file(job.source, path)
        except InputError as error:
            return str(error)
        return masks

    masks_by_job, failures = {}, {}
    for job in jobs:
        masks = checked_masks(Job("", job.method, job.dilation_width, source=job.source))
        if isinstance(masks, str):
            failures[job] = masks
        else:
            masks_by_job[job] = masks
    return masks_by_job, failures


def _run_pass(
    jobs: list[Job],
    sequence: Sequence,
    sources: dict[str, Source],
    folder: Path,
    record: dict,
) -> dict[Job, str]:
    """Run jobs of one sequence in one pass, here or on another machine; returns {job: reason}
    for the failed ones.
    """
    cv2.setNumThreads(1)  # the processes already use every core
    digest = hashlib.sha256("\n".join(job.name for job in jobs).encode()).hexdigest()[:12]
    checkpoint = folder / sequence.name / f"pass-{digest}.npz"
    failures: dict[Job, str] = {}
    try:
        results.check_worker(folder / sequence.name, record, **_versions())
        # a checkpoint can be resumed only with all of its jobs
        waiting = (
            jobs
            if checkpoint.is_file()
            else [job for job in jobs if not result_file(folder, job).is_file()]
        )
        masks_by_job, failures = masks_of(waiting, sequence, sources)
        if not masks_by_job:  # also if Dask repeats a finished pass because it lost the answer
            return failures
        run_results = odometry.run_many(
            sequence,
            {job.name: (job.settings, masks) for job, masks in masks_by_job.items()},
            checkpoint=checkpoint,
        )
        for job in masks_by_job:
            if not result_file(folder, job).is_file():
                write_text(
                    result_file(folder, job), run_results.pop(job.name).frames.to_csv(index=False)
                )
        checkpoint.unlink(missing_ok=True)
    except Exception as error:  # report any error as the reason, and let other passes run
        reason = console.explain(error)
        if reason is None:
            reason = f"{type(error).__name__}: {error}"
        elif not isinstance(error, InputError):
            reason = _MachineFault(reason)
        failures = (
            dict.fromkeys((job for job in jobs if not result_file(folder, job).is_file()), reason)
            | failures
        )
    return failures


def measures(frames: pd.DataFrame, true: np.ndarray) -> dict[str, Any]:
    """Return the columns of a table of runs that come from a run's table of frames: errors,
    keypoints, flagged frames.

    true: poses (n, 4, 4). The errors are those of `metrics.errors` and `metrics.step_errors`; t_rel
    (percent) and r_rel (degrees per 100 m) are those of `metrics.kitti_errors`.
    """
    poses = poses_of(frames)
    kitti = metrics.kitti_errors(poses, true)
    return {
        "frames": len(frames),
        **metrics.errors(poses, true),
        **metrics.step_errors(poses, true),
        "t_rel": kitti["translation_percent"],
        "r_rel": kitti["rotation_deg_per_100m"],
        "mean_keypoints": frames["detected"].mean(),
        "flagged": int((~frames["flag"].isin(["", "stationary"])).sum()),
    }


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return {(sequence, run): estimated poses (n, 4, 4)} for each row of a table of runs."""
    return {
        (name, run): poses_of(pd.read_csv(folder / name / f"{run}.csv"))
        for name, run in zip(runs["sequence"], runs["run"], strict=True)
    }
