"""The one runner: it makes the runs that have no result yet, and the table of all runs.

They run here or on a cluster. Each finished run is one CSV file with one row a frame, and is not
run again. Errors are computed from these files.
"""

import inspect
import json
import textwrap
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pandas as pd

from keypoint_study import compare
from keypoint_study.controls import OtherFrame, min_distance
from keypoint_study.errors import path_errors
from keypoint_study.jobs import Job, in_passes, repeated
from keypoint_study.methods import METHODS
from keypoint_study.sources import UNMASKED, Source, by_name
from thesis_repro import odometry
from thesis_repro.data.kitti import TRUE_LABELS, Sequence
from thesis_repro.errors import InputError, cause
from thesis_repro.masks.folders import LabelMasks, MaskFolder
from thesis_repro.odometry import THESIS, OdometrySettings
from thesis_repro.odometry.estimators import COMPARED
from thesis_repro.odometry.runs import is_flagged, poses_of
from thesis_repro.running import program, provenance
from thesis_repro.running.files import listed, progress, write_text
from thesis_repro.running.workers import open_pool

# rooms whose code decides the poses
CODE = (
    "opencv_exact",
    "thesis_repro.odometry",
    "thesis_repro.masks",
    "thesis_repro.running.files",  # reads images
    "thesis_repro.data",
    "keypoint_study.controls",
    "keypoint_study.sources",
)
# without what reads poses, and with a table of names, whose entries a run records itself
WITHOUT = ("thesis_repro.odometry.metrics", "thesis_repro.odometry.estimators")
SETTINGS = "settings.json"  # of the runs in a folder


@dataclass(frozen=True)
class Outcome:
    """What `run_all` did.

    table: all runs that succeeded, one row a job. made, kept, failed_jobs: numbers of jobs that
    were run now, that had a result from before, and that failed. warnings: lines that say why they
    failed.
    """

    table: pd.DataFrame
    made: int
    kept: int
    failed_jobs: int
    warnings: list[str]


def _file(folder: Path, job: Job) -> Path:
    """Return the result file of a job, which is written when the job is done."""
    return folder / job.sequence / f"{job.name}.csv"


Run: TypeAlias = tuple[Sequence, OdometrySettings, Any]


def run_all(
    runs: Mapping[Job, Run],
    folder: Path,
    *,
    made_from: Mapping[str, Mapping[str, Any]] = {},
    failed: Mapping[Job, str] = {},
    processes: int = 1,
    scheduler: str | None = None,
) -> Outcome:
    """Run what has no result yet; returns the table of all runs and how many ran.

    runs: {job: (sequence, settings, masks)}. masks: None, `Masks`, or an object with a function
    `run(sequence, settings)` in place of the odometry.
    folder: for the results, one file a run. Results from other data or code in it are moved aside,
    and runs with other settings are made again. made_from: what the masks of a sequence come from,
    {sequence: inputs} or {sequence/source: inputs}, see `provenance.stage`. failed: reasons of jobs
    that cannot run.
    processes, scheduler: see `workers.open_pool`; the results do not depend on them. The workers of
    a scheduler need this package, and all folders under the same paths. One thread a worker is
    best.

    Runs over the same sequence share one or several passes (`odometry.run_many`), with the results
    of separate runs. What is stopped repeats only the passes that it was in. A run that fails is
    printed with its reason and does not stop others.
    Raises InputError if another process is using the folder, if all runs fail, or if a worker is
    lost.
    """
    sequences = {sequence.name: sequence for sequence, _, _ in runs.values()}
    total, reasons = len(runs) + len(failed), dict(failed)
    with provenance.claimed(folder):
        for sequence in sequences.values():
            _stage(folder, sequence, made_from)
            _drop_changed(runs, folder / sequence.name)
        waiting = {job: run for job, run in runs.items() if not _file(folder, job).is_file()}
        with open_pool(processes, scheduler) as pool:
            calls = []
            for jobs in in_passes(waiting, sequences, pool.size):
                sequence = sequences[jobs[0].sequence]
                record = provenance.record(folder / sequence.name)
                calls.append(({job: waiting[job][1:] for job in jobs}, sequence, folder, record))
            frames = [len(pass_runs) * len(sequence) for pass_runs, sequence, *_ in calls]
            with progress(None, "odometry", total=sum(frames), unit="frame") as bar:
                for count, of_pass in zip(frames, pool.run(_run_pass, calls), strict=True):
                    reasons |= of_pass
                    bar.update(count)
    warnings = _report(reasons)
    rows = []
    for job, (sequence, _, _) in runs.items():
        path = _file(folder, job)
        if path.is_file():
            numbers = _measures(path, path.stat().st_mtime_ns, sequence)
            rows.append({"sequence": job.sequence, "run": job.name, **asdict(job), **numbers})
    if not rows:
        first = next(iter(reasons.values()))
        raise InputError(f"all {total} odometry runs failed; the first: {first}")
    kept = len(runs) - len(waiting)
    return Outcome(pd.DataFrame(rows), len(rows) - kept, kept, total - len(rows), warnings)


def run_jobs(
    jobs: Iterable[Job],
    sequences: Iterable[Sequence],
    sources: Path | Iterable[Source],
    folder: Path,
    *,
    scale_gate: float = THESIS.scale_gate,
    masked_settings: Mapping[str, Any] = {},
    **workers: Any,
) -> Outcome:
    """Run the jobs of a study that have no result yet, see `run_all`.

    sequences: those of the jobs. sources: folder with one folder of label maps a sequence, or the
    sources of the jobs. scale_gate: metres, of all runs, see OdometrySettings. masked_settings:
    other settings of the runs with masks.
    """
    jobs = list(dict.fromkeys(jobs))
    sources_by_name = by_name(sources)
    names = {job.sequence for job in jobs}
    opened = {sequence.name: sequence for sequence in sequences if sequence.name in names}
    made_from: dict[str, dict[str, Any]] = {}
    for name, sequence in opened.items():
        true_maps = listed(sequence.folder / TRUE_LABELS)
        made_from[name] = {"true_labels": provenance.digest_of_files(true_maps)}
        for source in sources_by_name.values():
            place = f"{name}/{source.name}" if source.name else name
            made_from.setdefault(place, {}).update(source.record(name))

    runs, failed = chosen(jobs, opened, sources_by_name)
    for job, (sequence, settings, masks) in runs.items():
        settings = replace(settings, scale_gate=scale_gate)
        if masks is not None and job.method not in UNMASKED:
            settings = replace(settings, **masked_settings)
        runs[job] = sequence, settings, masks
    return run_all(runs, folder, made_from=made_from, failed=failed, **workers)


def chosen(
    jobs: Iterable[Job], sequences: Mapping[str, Sequence], sources: Mapping[str, Source]
) -> tuple[dict[Job, Run], dict[Job, str]]:
    """Return {job: run} for `run_all`, and {job: reason} for masks that cannot be made.

    Jobs with the same masks get the same object, by which `run_many` recognises that they share
    work.
    """

    @cache
    def choose(method: str, sequence: str, source: str, width: int | None) -> Any:
        try:
            given = sources.get(source) or next(iter(sources.values()))
            return METHODS[method].choose(sequences[sequence], given, width)
        except InputError as error:
            return str(error)

    runs: dict[Job, Run] = {}
    reasons = {}
    for job in jobs:
        choice = choose(job.method, job.sequence, job.source, job.dilation_width)
        if isinstance(choice, str):
            reasons[job] = choice
        else:
            settings, masks = choice
            runs[job] = sequences[job.sequence], job.changed(settings), masks
    return runs, reasons


@cache  # a study calls `run_jobs` again, with more jobs
def _measures(path: Path, changed: int, sequence: Sequence) -> dict[str, Any]:
    """Return what a table of runs has from the file of a run: errors, keypoints, flagged frames.

    changed: when the file was changed, ns. The errors are `path_errors`.
    """
    # an empty flag stays a text, an empty number becomes NaN
    numbers = {"detected": "", "tracked": ""}
    frames = pd.read_csv(path, keep_default_na=False, na_values=numbers)
    return {
        "frames": len(frames),
        **path_errors(poses_of(frames), sequence.poses),
        "mean_keypoints": frames["detected"].mean(),
        "flagged": int(is_flagged(frames).sum()),
    }


def keypoint_controls(
    runs: pd.DataFrame,
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    repetitions: int,
    width: int,
    estimators: Iterable[str] = COMPARED,
) -> list[Job]:
    """Return jobs without a mask that keep as many keypoints as the masks of each source leave.

    "fewer" keeps the strongest keypoints; "spread" keeps keypoints farther apart. runs: with the
    masks. width: pixels, of the masks from label maps that leave as many keypoints.
    """
    jobs: list[Job] = []
    for source in sources:
        keypoints = compare.keypoints_left(compare.of_source(runs, source.name))
        width_of_source = width if source.has_width else None
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


def _report(reasons: Mapping[Job, str]) -> list[str]:
    """Print and return one line for the failed runs of a sequence that have the same reason."""
    by_reason: dict[tuple[str, str], list[str]] = {}
    for job, reason in reasons.items():
        by_reason.setdefault((job.sequence, reason), []).append(job.name)
    lines = []
    for (name, reason), runs in by_reason.items():
        shown = textwrap.shorten(", ".join(runs), 80, placeholder=" ...")
        lines.append(f"sequence {name}, {shown}: failed: {reason}")
        program.log.warning(lines[-1])
    return lines


def _stage(folder: Path, sequence: Sequence, made_from: Mapping[str, Mapping[str, Any]]) -> None:
    """Move aside the results of a sequence that were made from other data or code.

    Each source has a subfolder, so a change of one source does not move the runs of other
    sources.
    """
    if not sequence.has_truth:
        raise InputError(
            f"{sequence.poses_path}: no such file; without ground truth, sequence {sequence.name} has no "
            "errors to compare; leave it out (the odometry command runs it)"
        )
    provenance.stage(
        folder / sequence.name,
        **_versions(),
        sequence=sequence.digest(),
        **made_from.get(sequence.name, {}),
    )
    for place, inputs in made_from.items():
        if place.startswith(f"{sequence.name}/"):
            provenance.stage(folder / place, **inputs)


def _drop_changed(runs: Mapping[Job, Run], folder: Path) -> None:
    """Delete the results of runs of a sequence that were made with other settings or masks."""
    now = {
        job.name: {**settings.record(), "code": _code(settings.estimator), "masks": _record(masks)}
        for job, (_, settings, masks) in runs.items()
        if job.sequence == folder.name
    }
    now = json.loads(json.dumps(now, default=float))  # numbers of numpy
    path = folder / SETTINGS
    before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name, settings in now.items():
        if before.get(name, settings) != settings:
            (folder / f"{name}.csv").unlink(missing_ok=True)
    if before | now != before:
        write_text(path, json.dumps(before | now, indent=1))


def _record(masks: Any) -> Any:
    return masks.record() if isinstance(masks, LabelMasks | MaskFolder | OtherFrame) else None


def _code(estimator: Any) -> str:
    """Return the code of an estimator, which a person may have added to the table of names."""
    parts = inspect.getmro(estimator) if inspect.isclass(estimator) else [estimator]
    code = ""
    for part in parts:
        # the thesis's (None), what is Python's own, and what was typed into a console have none
        with suppress(OSError, TypeError):
            code += inspect.getsource(part)
    return code


def _versions() -> dict[str, Any]:
    return {
        "code": provenance.digest_of_code(*CODE, without=WITHOUT),
        **provenance.made_with("opencv", "numpy", "numba"),
    }


def _run_pass(
    runs: dict[Job, tuple[OdometrySettings, Any]], sequence: Sequence, folder: Path, record: dict
) -> dict[Job, str]:
    """Make runs over one sequence in one pass, here or on another machine.

    Every file of masks is read first, because a bad file in the middle would stop the whole pass.
    record: of the sequence's results, as the main process sees it. Returns the reasons of the jobs
    that failed.
    """
    reasons: dict[Job, str] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the processes already use every core
    try:
        provenance.check_worker(folder / sequence.name, record, **_versions())
        known: set[Any] = set()
        for job, (_, masks) in runs.items():
            try:
                if hasattr(masks, "check_files"):
                    masks.check_files(known)
            except InputError as error:
                reasons[job] = str(error)
        good = {job: run for job, run in runs.items() if job not in reasons}
        brought = {job: run for job, run in good.items() if hasattr(run[1], "run")}
        made = {job: own.run(sequence, settings) for job, (settings, own) in brought.items()}
        if rest := {job: run for job, run in good.items() if job not in brought}:
            made |= odometry.run_many(sequence, rest)
        for job, result in made.items():
            # without keypoints, the path is a point, whatever the method
            if result.frames["detected"].isna().all() and job.method != "paths":
                reasons[job] = (
                    f"{sequence.folder}: no frame has any structure (all are black, white or of "
                    "one gray); check how they were written"
                )
            else:
                write_text(_file(folder, job), result.frames.to_csv(index=False))
    except Exception as error:  # report any error as the reason, and let other passes run
        unfinished = [job for job in runs if not _file(folder, job).is_file()]
        reasons = dict.fromkeys(unfinished, cause(error)) | reasons
    finally:
        cv2.setNumThreads(threads)
    return reasons


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return {(sequence, run): estimated poses (n, 4, 4)} for each row of a table of runs."""
    return {
        (name, run): poses_of(pd.read_csv(folder / name / f"{run}.csv"))
        for name, run in zip(runs["sequence"], runs["run"], strict=True)
    }
