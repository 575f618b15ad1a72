"""Run the jobs of a study that have no result yet, and make the table of all runs.

They run here or on a cluster. Each finished run is one CSV file with one row a frame, and is not
run again.
"""

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry.runs import is_flagged, poses_of
from thesis_repro.running import messages, results
from thesis_repro.running.files import listed, progress, write_text
from thesis_repro.study import compare
from thesis_repro.study.errors import path_errors
from thesis_repro.study.jobs import ESTIMATORS, Job, in_passes, repeated
from thesis_repro.study.methods import (
    METHODS,
    ControlMasks,
    masks_of_method,
    min_distance,
    true_labels,
)
from thesis_repro.study.sources import UNMASKED, Source, by_name
from thesis_repro.study.workers import open_pool

# rooms whose code decides the poses
CODE = (
    "opencv_exact",
    "thesis_repro.odometry",
    "thesis_repro.masks",
    "thesis_repro.mask_files",
    "thesis_repro.running.files",  # reads images
    "thesis_repro.data",
    "thesis_repro.study.jobs",
    "thesis_repro.study.methods",
    "thesis_repro.study.sources",
)
READERS = ("thesis_repro.odometry.metrics",)  # read poses: a change of them repeats no run


@dataclass(frozen=True)
class Outcome:
    """What `run_jobs` did.

    table: all runs that succeeded, one row a job. made, kept, failed_jobs: numbers of jobs that
    were run now, that had a result from before, and that failed. warnings: lines that say why they
    failed.
    """

    table: pd.DataFrame
    made: int
    kept: int
    failed_jobs: int
    warnings: list[str]


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
    scale_gate: float = odometry.THESIS.scale_gate,
    masked_settings: Mapping[str, Any] = {},
) -> Outcome:
    """Run the jobs that have no result yet; returns the table of all runs and how many ran.

    sequences: those of the jobs. sources: folder with one folder of label maps a sequence, or the
    sources of the jobs.
    folder: for the results; results from other data, code or mask settings in it are moved aside.
    processes, scheduler: see `workers.open_pool`; the results do not depend on them. The workers of
    a scheduler need this package, and the three folders under the same paths. One thread a worker
    is best. scale_gate: metres, of all runs, see OdometrySettings. masked_settings: other settings
    of the runs with masks.

    Jobs over the same sequence share one or several passes (`odometry.run_many`), with the results
    of separate runs. A stopped study repeats only the passes that it was in. A job that fails is
    printed with its reason and does not stop other jobs.
    Raises InputError if another run is using the folder, if all jobs fail, or if a worker is lost.
    """
    jobs = list(dict.fromkeys(jobs))
    sources_by_name = by_name(sources)
    names = {job.sequence for job in jobs}
    opened = {sequence.name: sequence for sequence in sequences if sequence.name in names}
    with results.claimed(folder):
        for sequence in opened.values():
            _stage(folder, sequence, sources_by_name)
        waiting = _unfinished(jobs, folder)
        reasons = _run_passes(
            waiting,
            opened,
            sources_by_name,
            folder,
            processes,
            scheduler,
            scale_gate,
            masked_settings,
        )
    warnings = _report(reasons)
    rows = []
    for job in jobs:
        path = result_file(folder, job)
        if path.is_file():
            numbers = _measures_of_file(path, path.stat().st_mtime_ns, opened[job.sequence])
            rows.append({"sequence": job.sequence, "run": job.name, **asdict(job), **numbers})
    if not rows:
        first = next(iter(reasons.values()))
        raise InputError(f"all {len(jobs)} odometry runs failed; the first: {first}")
    kept = len(jobs) - len(waiting)
    return Outcome(pd.DataFrame(rows), len(rows) - kept, kept, len(jobs) - len(rows), warnings)


@cache  # a study calls `run_jobs` again, with more jobs
def _measures_of_file(path: Path, changed: int, sequence: Sequence) -> dict[str, Any]:
    """Return the `measures` of a result file. changed: when the file was changed, ns."""
    # an empty flag stays a text, an empty number becomes NaN
    numbers = {"detected": "", "tracked": ""}
    frames = pd.read_csv(path, keep_default_na=False, na_values=numbers)
    return measures(frames, sequence.poses)


def keypoint_controls(
    runs: pd.DataFrame,
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    repetitions: int,
    width: int,
    estimators: Iterable[str] = tuple(ESTIMATORS),
) -> list[Job]:
    """Return jobs without a mask that keep as many keypoints as the masks of each source leave.

    "fewer" keeps the strongest keypoints; "spread" keeps keypoints farther apart. runs: with the
    masks. width: pixels, of the masks from label maps that leave as many keypoints.
    """
    jobs: list[Job] = []
    for source in sources:
        keypoints = compare.keypoints_left(compare.of_source(runs, source.name))
        width_of_source = width if source.has_label_maps else None
        for sequence in sequences:
            if sequence.name not in keypoints:  # its runs with masks failed
                continue
            number = keypoints[sequence.name]
            job = Job(sequence.name, "fewer", width_of_source, source=source.name)
            fewer = replace(
                job, max_keypoints=max(1, round(number))
            )  # OpenCV takes 0 as "no limit"
            spread = replace(job, method="spread", min_distance=min_distance(sequence, number))
            jobs += repeated([fewer, spread], estimators, repetitions)
    return jobs


def _run_passes(
    jobs: list[Job],
    sequences: dict[str, Sequence],
    sources: dict[str, Source],
    folder: Path,
    processes: int,
    scheduler: str | None,
    scale_gate: float,
    masked_settings: Mapping[str, Any],
) -> dict[Job, str]:
    """Run jobs; returns which of them failed, and why."""

    def frames(pass_jobs: Iterable[Job]) -> int:
        return sum(len(sequences[job.sequence]) for job in pass_jobs)

    reasons: dict[Job, str] = {}
    with open_pool(processes, scheduler) as pool:
        calls = []
        for pass_jobs in in_passes(jobs, sequences, pool.size):
            sequence = sequences[pass_jobs[0].sequence]
            record = results.record(folder / sequence.name)
            calls.append(
                (pass_jobs, sequence, sources, folder, record, scale_gate, masked_settings)
            )
        with progress(None, "odometry", total=frames(jobs), unit="frame") as bar:
            for pass_jobs, pass_reasons in pool.run(_run_pass, calls):
                reasons |= pass_reasons
                bar.update(frames(pass_jobs))
    return reasons


def _report(reasons: Mapping[Job, str]) -> list[str]:
    """Print and return one line for the failed runs of a sequence that have the same reason."""
    by_reason: dict[tuple[str, str], list[str]] = {}
    for job, reason in reasons.items():
        by_reason.setdefault((job.sequence, reason), []).append(job.name)
    lines = []
    for (name, reason), runs in by_reason.items():
        shown = textwrap.shorten(", ".join(runs), 80, placeholder=" ...")
        lines.append(f"sequence {name}, {shown}: failed: {reason}")
        messages.log.warning(lines[-1])
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
    true_maps = listed(true_labels(sequence.root, sequence.name))
    records = {source.name: source.record(sequence.name) for source in sources.values()}
    results.stage(
        folder,
        **_versions(),
        sequence=results.digest_of_files(sequence.files),
        true_labels=results.digest_of_files(true_maps),
        **records.pop("", {}),
    )
    for source, record in records.items():
        results.stage(folder / source, **record)


def _versions() -> dict[str, Any]:
    return {
        "code": results.digest_of_code(*CODE, without=READERS),
        **results.made_with("opencv", "numpy", "numba"),
    }


def checked_masks(
    jobs: Iterable[Job], sequence: Sequence, sources: Mapping[str, Source]
) -> tuple[dict[Job, ControlMasks | None], dict[Job, str]]:
    """Return {job: masks} over a sequence, and {job: reason} for masks that cannot be made.

    The masks are None for jobs without masks. Every file is read here, because a bad file in the
    middle of a pass would stop the whole pass. Jobs with the same masks get the same object, by
    which `run_many` recognises that they share work.
    """
    check = cache(Source.check_file)  # several masks are made from one file

    @cache
    def checked(method: str, source_name: str, width: int | None) -> ControlMasks:
        masks = masks_of_method(method, sources[source_name], sequence, width)
        for path in masks.paths:
            check(sources[source_name], path, sequence.size)
        return masks

    masks_by_job: dict[Job, ControlMasks | None] = {}
    reasons = {}
    for job in jobs:
        try:
            masks_by_job[job] = None
            if METHODS[job.method].has_masks:
                masks_by_job[job] = checked(job.method, job.source, job.dilation_width)
        except InputError as error:
            del masks_by_job[job]
            reasons[job] = str(error)
    return masks_by_job, reasons


def _run_pass(
    jobs: list[Job],
    sequence: Sequence,
    sources: dict[str, Source],
    folder: Path,
    record: dict,
    scale_gate: float,
    masked_settings: Mapping[str, Any] = {},
) -> tuple[list[Job], dict[Job, str]]:
    """Run jobs of one sequence in one pass, here or on another machine.

    record: of the sequence's results, as the main process sees it. Returns the jobs, and the
    reasons of those that failed.
    """
    reasons: dict[Job, str] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the processes already use every core
    try:
        results.check_worker(folder / sequence.name, record, **_versions())
        masks_by_job, reasons = checked_masks(_unfinished(jobs, folder), sequence, sources)
        runs = {}
        for job, masks in masks_by_job.items():
            settings = replace(job.settings, scale_gate=scale_gate)
            if masks is not None:
                settings = replace(settings, **masked_settings)
            runs[job.name] = settings, masks
        if jobs[0].method in UNMASKED:
            source = sources[jobs[0].source]
            run_results = {name: source.run(sequence, own) for name, (own, _) in runs.items()}
        else:
            run_results = odometry.run_many(sequence, runs)
        for job in masks_by_job:
            frames = run_results[job.name].frames
            # without keypoints, the path is a point, whatever the method
            if frames["detected"].isna().all() and job.method != "paths":
                reasons[job] = (
                    f"{sequence.folder}: no frame has any structure (all are black, white or of "
                    "one gray); check how they were written"
                )
            else:
                write_text(result_file(folder, job), frames.to_csv(index=False))
    except Exception as error:  # report any error as the reason, and let other passes run
        reason = str(error)
        if not isinstance(error, InputError):
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        reasons = dict.fromkeys(_unfinished(jobs, folder), reason) | reasons
    finally:
        cv2.setNumThreads(threads)
    return jobs, reasons


def _unfinished(jobs: Iterable[Job], folder: Path) -> list[Job]:
    return [job for job in jobs if not result_file(folder, job).is_file()]


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


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return {(sequence, run): estimated poses (n, 4, 4)} for each row of a table of runs."""
    return {
        (name, run): poses_of(pd.read_csv(folder / name / f"{run}.csv"))
        for name, run in zip(runs["sequence"], runs["run"], strict=True)
    }
