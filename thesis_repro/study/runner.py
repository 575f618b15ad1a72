"""Run the jobs of a study that have no result yet, and make the table of all runs.

They run here or on a cluster. Each finished run is one CSV file with one row a frame. A study that
stopped or failed resumes from its checkpoints.
"""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics
from thesis_repro.odometry.runs import is_flagged, poses_of
from thesis_repro.running import messages, results
from thesis_repro.running.files import listed, progress
from thesis_repro.study import compare, controls, workers
from thesis_repro.study.jobs import (
    ESTIMATORS,
    UNMASKED,
    Job,
    MaskKey,
    in_passes,
    keypoint_control_jobs,
)
from thesis_repro.study.sources import Source, by_name

# pattern of the file names, one for each unfinished pass
CHECKPOINTS = f"pass-{'[0-9a-f]' * 12}.npz"


@dataclass(frozen=True)
class Outcome:
    """What `run_jobs` did.

    table: all runs that succeeded, one row a job. made, kept, failed: numbers of jobs that were run
    now, that had a result from before, and that failed. warnings: lines that say why they failed.
    """

    table: pd.DataFrame
    made: int
    kept: int
    failed: int
    warnings: list[str]


class Failure(NamedTuple):
    """Why a job failed. by_machine: the machine caused it, such as a full disk."""

    reason: str
    by_machine: bool = False


def result_file(folder: Path, job: Job) -> Path:
    """Return the result file of a job, which is written when the job is done."""
    return folder / job.sequence / f"{job.name}.csv"


def run_jobs(
    jobs: Iterable[Job],
    sequences: Iterable[Sequence],
    sources: Path | Iterable[Source],
    folder: Path,
    *,
    processes: int = 1,
    scheduler: str | None = None,
) -> Outcome:
    """Run the jobs that have no result yet; returns the table of all runs and how many ran.

    sequences: those of the jobs. sources: folder with one folder of label maps a sequence, or the
    sources of the jobs.
    folder: for the results; results from other data, code or mask settings in it are moved aside.
    processes: number of processes on this machine.
    scheduler: address of a Dask scheduler ("tcp://host:8786"), whose workers then do the work with
    the same results. They need this package, and the three folders under the same paths. One thread
    a worker is best.

    Jobs over the same sequence share one or several passes (`odometry.run_many`), with the results
    of separate runs. An interrupted pass resumes from its checkpoint. A job that fails is printed
    with its reason and does not stop other jobs.
    Raises InputError if another run is using the folder, if all jobs fail, or if the machine lacks
    disk space or memory. Finished results are kept.
    """
    jobs = list(dict.fromkeys(jobs))
    sources_by_name = by_name(sources)
    names = {job.sequence for job in jobs}
    opened = {sequence.name: sequence for sequence in sequences if sequence.name in names}
    with results.claimed(folder):
        for sequence in opened.values():
            _stage(folder, sequence, sources_by_name)
        finished = {job for job in jobs if results.has_table(result_file(folder, job))}
        failures = _run_passes(jobs, opened, sources_by_name, folder, processes, scheduler)
    rows = {}
    for job in jobs:
        path = result_file(folder, job)
        if not path.is_file():
            continue
        sequence = opened[job.sequence]
        numbers = _measures_of_file(path, path.stat().st_mtime_ns, sequence)
        if numbers is None:
            failures[job] = Failure(
                f"{sequence.folder}: no frame has any structure (all are black, white or of one "
                "gray); check how they were written"
            )
            continue
        rows[job] = {"sequence": job.sequence, "run": job.name, **asdict(job), **numbers}
    warnings = _report(failures)
    if not rows:
        first = next(iter(failures.values()))
        raise InputError(f"all {len(jobs)} odometry runs failed; the first: {first.reason}")
    kept = len(finished & rows.keys())
    return Outcome(
        pd.DataFrame(rows.values()),
        made=len(rows) - kept,
        kept=kept,
        failed=len(jobs) - len(rows),
        warnings=warnings,
    )


@cache  # a study calls `run_jobs` again, with more jobs
def _measures_of_file(path: Path, changed: int, sequence: Sequence) -> dict[str, Any] | None:
    """Return the `measures` of a result file, or None if no frame has any structure.

    changed: when the file was changed, ns.
    """
    # an empty flag stays a text, an empty number becomes NaN
    numbers = {"detected": "", "tracked": ""}
    frames = pd.read_csv(path, keep_default_na=False, na_values=numbers)
    if frames["detected"].isna().all():  # the path is a point, whatever the method
        return None
    return measures(frames, sequence.poses)


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
    jobs = []
    for source in sources:
        keypoints = compare.keypoints_left(compare.of_source(runs, source.name))
        width_of_source = width if source.has_label_maps else None
        jobs += keypoint_control_jobs(
            keypoints, sequences, repetitions, estimators, source.name, width_of_source
        )
    return jobs


def _run_passes(
    jobs: list[Job],
    sequences: dict[str, Sequence],
    sources: dict[str, Source],
    folder: Path,
    processes: int,
    scheduler: str | None,
) -> dict[Job, Failure]:
    """Run the jobs without a result; returns which of them failed, and why."""
    failures: dict[Job, Failure] = {}
    with workers.open_pool(processes, scheduler) as pool:
        passes = _passes(jobs, sequences, folder, pool.size)
        calls, frames = [], []
        for pass_jobs in passes:
            sequence = sequences[pass_jobs[0].sequence]
            record = results.record(folder / sequence.name)
            calls.append((pass_jobs, sequence, sources, folder, record))
            frames.append(len(pass_jobs) * len(sequence))
        with progress(None, "odometry", total=sum(frames), unit="frame") as bar:
            for index, pass_failures in pool.run(_run_pass, calls):
                messages.check_stop()
                if isinstance(pass_failures, str):  # the reason why the call was lost
                    pass_failures = dict.fromkeys(passes[index], Failure(pass_failures))
                failures |= pass_failures
                bar.update(frames[index])
    return failures


def _report(failures: Mapping[Job, Failure]) -> list[str]:
    """Print and return one line for the failed runs of a sequence that have the same reason.

    Raises InputError if the machine caused a failure.
    """
    by_reason: dict[tuple[str, str], list[str]] = {}
    for job, failure in failures.items():
        by_reason.setdefault((job.sequence, failure.reason), []).append(job.name)
    lines = []
    for (name, reason), runs in by_reason.items():
        shown = ", ".join(runs[:3])
        if len(runs) > 3:
            shown += f" and {len(runs) - 3} more"
        lines.append(f"sequence {name}, {shown}: failed: {reason}")
        messages.log.warning(lines[-1])
    for failure in failures.values():
        if failure.by_machine:  # a study without these runs could mislead
            raise InputError(failure.reason)
    return lines


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
        sequence=results.digest_of_files(sequence.files),
        true_labels=results.digest_of_files(true_labels),
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
        "code": results.digest_of_code("thesis_repro.odometry", "thesis_repro.study.jobs"),
        **results.made_with("opencv", "numpy", "numba"),
    }


def _passes(
    jobs: list[Job], sequences: Mapping[str, Sequence], folder: Path, workers: int
) -> list[list[Job]]:
    """Divide the jobs without a result into passes, the longest first.

    A pass with a checkpoint keeps its jobs.
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
    passes += in_passes(jobs_without_checkpoint, sequences, workers)

    def frames(pass_jobs: list[Job]) -> int:
        return len(pass_jobs) * len(sequences[pass_jobs[0].sequence])

    return sorted(passes, key=frames, reverse=True)


def checked_masks(
    jobs: Iterable[Job], sequence: Sequence, sources: Mapping[str, Source]
) -> tuple[dict[Job, controls.ControlMasks | None], dict[Job, Failure]]:
    """Return {job: masks} over a sequence, and {job: failure} for masks that cannot be made.

    The masks are None for jobs without masks. Every file is read here, because a bad file in the
    middle of a pass would stop the whole pass. Jobs with the same masks get the same object, by
    which `run_many` recognises that they share work.
    """
    masks_by_key: dict[MaskKey, controls.ControlMasks | None] = {}
    failures_by_key: dict[MaskKey, Failure] = {}
    checked_files: set[tuple[str, Path]] = set()
    masks_by_job, failures = {}, {}
    for job in jobs:
        key = job.mask_key
        if key not in masks_by_key and key not in failures_by_key:
            try:
                masks_by_key[key] = _masks_of_key(key, sequence, sources, checked_files)
            except InputError as error:
                failures_by_key[key] = Failure(str(error))
        if key in masks_by_key:
            masks_by_job[job] = masks_by_key[key]
        else:
            failures[job] = failures_by_key[key]
    return masks_by_job, failures


def _masks_of_key(
    key: MaskKey,
    sequence: Sequence,
    sources: Mapping[str, Source],
    checked_files: set[tuple[str, Path]],
) -> controls.ControlMasks | None:
    """Make masks and read all their files. Raises InputError for a bad file.

    checked_files: files that were read before, with the name of their source; new ones are added.
    """
    if key.method in UNMASKED:
        return None
    source = sources[key.source]
    masks = controls.masks_of_method(key.method, source, sequence, key.dilation_width)
    for path in masks.paths:
        if (source.name, path) not in checked_files:
            source.check_file(path, sequence.size)
            checked_files.add((source.name, path))
    return masks


def _run_pass(
    jobs: list[Job],
    sequence: Sequence,
    sources: dict[str, Source],
    folder: Path,
    record: dict,
) -> dict[Job, Failure]:
    """Run jobs of one sequence in one pass, here or on another machine; returns the failed ones.

    record: of the sequence's results, as the main process sees it.
    """
    cv2.setNumThreads(1)  # the processes already use every core
    failures: dict[Job, Failure] = {}
    try:
        results.check_worker(folder / sequence.name, record, **_versions())
        waiting = jobs
        # a checkpoint can be resumed only with all of its jobs
        if not _checkpoint(folder / sequence.name, jobs).is_file():
            waiting = _unfinished(jobs, folder)
        masks_by_job, failures = checked_masks(waiting, sequence, sources)
        if not masks_by_job:  # also if Dask repeats a finished pass because it lost the answer
            return failures
        checkpoint = _checkpoint(folder / sequence.name, masks_by_job)
        run_results = odometry.run_many(
            sequence,
            {job.name: (job.settings, masks) for job, masks in masks_by_job.items()},
            checkpoint=checkpoint,
        )
        for job in _unfinished(masks_by_job, folder):
            frames = run_results.pop(job.name).frames
            results.write_table(result_file(folder, job), frames)
        checkpoint.unlink(missing_ok=True)
    except Exception as error:  # report any error as the reason, and let other passes run
        failures = dict.fromkeys(_unfinished(jobs, folder), _failure_of(error)) | failures
    return failures


def _checkpoint(folder: Path, jobs: Iterable[Job]) -> Path:
    """Return the checkpoint of a pass with these jobs. folder: of the sequence's results."""
    names = "\n".join(job.name for job in jobs)
    digest = hashlib.sha256(names.encode()).hexdigest()[:12]
    return folder / f"pass-{digest}.npz"


def _unfinished(jobs: Iterable[Job], folder: Path) -> list[Job]:
    return [job for job in jobs if not result_file(folder, job).is_file()]


def _failure_of(error: Exception) -> Failure:
    reason = messages.explain(error)
    if reason is None:
        return Failure(f"{type(error).__name__}: {error}")
    return Failure(reason, by_machine=not isinstance(error, InputError))


def measures(frames: pd.DataFrame, true: np.ndarray) -> dict[str, Any]:
    """Return what a table of runs has from a run's frames: errors, keypoints, flagged frames.

    frames: the table of `odometry.Result`. true: poses (n, 4, 4). The errors are `path_errors`.
    """
    return {
        "frames": len(frames),
        **path_errors(poses_of(frames), true),
        "mean_keypoints": frames["detected"].mean(),
        "flagged": int(is_flagged(frames).sum()),
    }


def path_errors(poses: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Return the errors of a path; poses, true: (n, 4, 4).

    They are those of `metrics.errors` and `metrics.step_errors`; t_rel (percent) and r_rel (degrees
    per 100 m) are those of `metrics.kitti_errors`. A lost run has its RMSE in place of the aligned
    ATE: the alignment absorbs a wrong turn near the start of the path, so that a lost run would
    look better than any other.
    """
    errors = metrics.errors(poses, true)
    step_errors = metrics.step_errors(poses, true)
    if step_errors["lost"]:
        errors["se3"] = errors["rmse"]
    kitti = metrics.kitti_errors(poses, true)
    return {**errors, **step_errors, "t_rel": kitti["t_rel"], "r_rel": kitti["r_rel"]}


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return {(sequence, run): estimated poses (n, 4, 4)} for each row of a table of runs."""
    paths = {}
    for name, run in zip(runs["sequence"], runs["run"], strict=True):
        paths[name, run] = poses_of(pd.read_csv(folder / name / f"{run}.csv"))
    return paths
