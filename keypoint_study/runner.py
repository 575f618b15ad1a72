"""The one runner: it makes the runs that have no result yet, and the table of all runs.

They run here or on a cluster. Each finished run is one CSV file, which is not made again. Errors
are computed from these files.
"""

import json
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd

from keypoint_study import comparisons
from keypoint_study.controls import min_distance, recorded
from keypoint_study.jobs import Job, Run, repeated
from keypoint_study.methods import CONTROL, METHODS, of_group
from keypoint_study.path_errors import path_errors
from keypoint_study.sources import Source
from thesis_repro import odometry
from thesis_repro.data.layout import layout_of
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError, cause
from thesis_repro.odometry.estimators import COMPARED
from thesis_repro.odometry.runs import is_flagged, poses_of
from thesis_repro.running import program, provenance
from thesis_repro.running.code_used import digest_of_code
from thesis_repro.running.files import progress, write_text
from thesis_repro.running.workers import open_pool

NEARLY = 1.1  # controls keep as many keypoints if the ratio is within 1 / NEARLY to this
SETTINGS = "settings.json"  # of the runs in a folder
# Passes for each of several workers. Every pass decodes and tracks anew: a sequence on two workers
# takes 13 % more CPU time than in one pass, and with 4 pieces 35 %.
PIECES = 2


@dataclass(frozen=True)
class Outcome:
    """What `run_all` did.

    table: all runs that succeeded, one row a job. made: number of jobs that were run now; the
    others had a result from before. reasons: of the jobs that failed. warnings: lines that say so.
    """

    table: pd.DataFrame
    made: int
    reasons: dict[Job, str]
    warnings: list[str]

    @property
    def kept(self) -> int:
        """Number of runs that had a result from before."""
        return len(self.table) - self.made

    def after(self, first: "Outcome") -> "Outcome":
        """Return the outcome of both calls, of which this one had the runs of the first, too."""
        return Outcome(
            self.table,
            self.made + first.made,
            first.reasons | self.reasons,
            first.warnings + self.warnings,
        )


class Measure(NamedTuple):
    """What is measured of runs.

    name: of the progress bar. code: the function whose module measures, for records. make: from
    {job: run}, runs over one sequence, to {job: table of its file, or the reason why it has none}.
    rows: from a job's file, when that was changed (ns), and the sequence to its rows of the table.
    needs_truth: whether it needs true poses. divided: whether several workers may share a sequence;
    not if its runs are compared with something that all of them share.
    """

    name: str
    code: Callable
    make: Callable[[Mapping[Job, Run]], dict[Job, pd.DataFrame | str]]
    rows: Callable[[Job, Path, int, Sequence], list[dict[str, Any]]]
    needs_truth: bool = True
    divided: bool = True


def run_all(
    runs: Mapping[Job, Run | str],
    folder: Path,
    measure: Measure | None = None,
    *,
    processes: int = 1,
    scheduler: str | None = None,
) -> Outcome:
    """Run what has no result yet; returns the table of all runs and how many ran.

    runs: of `jobs.runs_of`; a text is the reason why a job cannot run. measure: PATH if not given.
    folder: for the results, one file a run. Results of another sequence, measure or odometry in it
    are moved aside; runs with other settings, masks or code of these are made again.
    processes, scheduler: see `workers.open_pool`; the results do not depend on them. The workers of
    a scheduler need this package, and all folders under the same paths. One thread a worker is
    best.

    Runs over the same sequence share one or several passes, with the results of separate runs. What
    is stopped repeats only the passes that it was in. A run that fails is printed with its reason
    and does not stop others.
    Raises InputError if another process is using the folder, if all runs fail, or if a worker is
    lost.
    """
    measure = measure or PATH
    reasons = {job: run for job, run in runs.items() if isinstance(run, str)}
    possible = {job: run for job, run in runs.items() if not isinstance(run, str)}
    sequences = {run.sequence.name: run.sequence for run in possible.values()}
    with provenance.claimed(folder):
        for name, sequence in sequences.items():
            if measure.needs_truth and not sequence.has_truth:
                raise InputError(
                    f"{sequence.poses_path}: no such file; without ground truth, sequence {name} has no "
                    "errors to compare; leave it out (the odometry command runs it)"
                )
            versions = _versions(measure, sequence)
            provenance.stage(folder / name, **versions, sequence=sequence.digest())
        _drop_changed(possible, folder)
        waiting = {job: run for job, run in possible.items() if not _file(folder, job).is_file()}
        with open_pool(processes, scheduler) as pool:
            calls = [
                (measure, of_pass, folder, _seen(measure, of_pass, folder))
                for of_pass in _in_passes(waiting, pool.size if measure.divided else 0)
            ]
            frames = [
                sum(len(run.sequence) for run in of_pass.values()) for _, of_pass, *_ in calls
            ]
            with progress(None, measure.name, total=sum(frames), unit="frame") as bar:
                for count, failed in zip(frames, pool.run(_run_pass, calls), strict=True):
                    reasons |= failed
                    bar.update(count)
    warnings = _report(reasons)
    rows = []
    for job, run in possible.items():
        path = _file(folder, job)
        if path.is_file():
            rows += measure.rows(job, path, path.stat().st_mtime_ns, run.sequence)
    if not rows:
        first = next(iter(reasons.values()))
        raise InputError(f"all {len(runs)} runs failed; the first: {first}")
    made = sum(_file(folder, job).is_file() for job in waiting)
    return Outcome(pd.DataFrame(rows), made, reasons, warnings)


def _file(folder: Path, job: Job) -> Path:
    """Return the result file of a job, which is written when the job is done."""
    return folder / job.sequence / f"{job.name}.csv"


def _versions(measure: Measure, sequence: Sequence, *used: Any) -> dict[str, Any]:
    """Return what the runs over a sequence depend on beside data: code, and other packages."""
    return {
        "code": digest_of_code(measure.code, *reader_of(sequence), *used),
        **provenance.versions("opencv", "numpy", "numba"),
    }


def reader_of(sequence: Any) -> list[Any]:
    """Return what reads a sequence: its class and, if it is in a folder, the layout of this."""
    folder = getattr(sequence, "folder", None)
    return [type(sequence), *([layout_of(folder)] if folder else [])]


def record_of(run: Run, digest: Callable = provenance.digest_of_files) -> dict[str, Any]:
    """Return what a run depends on beside its sequence. digest: of files, which may remember."""
    _, settings, masks, brought = run
    parts = [part for part in (masks, brought) if part is not None]
    paths = chain(*(getattr(part, "paths", ()) for part in parts))
    return {
        **settings.record(),
        "masks": [recorded(part) for part in parts],
        "files": digest(tuple(dict.fromkeys(paths))),
        "code": digest_of_code(settings.detector, settings.estimator, *parts),
    }


def _drop_changed(runs: Mapping[Job, Run], folder: Path) -> None:
    """Delete the results of runs that were made with other settings, masks or code of these."""
    digest = cache(provenance.digest_of_files)
    known: dict[Any, Any] = {}  # of runs that differ in numbers alone
    now: dict[str, dict[str, Any]] = {}
    for job, run in runs.items():
        sequence, settings, *rest = run
        key = id(settings.detector), id(settings.estimator), *map(id, rest)
        if key not in known:
            known[key] = record_of(run, digest)
        record = {**known[key], **settings.record()}
        now.setdefault(sequence.name, {})[job.name] = json.loads(
            json.dumps(record, default=float)
        )  # of numpy
    for name, records in now.items():
        path = folder / name / SETTINGS
        before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        for of_run, record in records.items():
            if before.get(of_run, record) != record:
                (folder / name / f"{of_run}.csv").unlink(missing_ok=True)
        if before | records != before:
            write_text(path, json.dumps(before | records, indent=1))


def _in_passes(runs: Mapping[Job, Run], workers: int) -> list[dict[Job, Run]]:
    """Divide runs into parts, each for one pass over a sequence.

    Each of several workers gets about PIECES passes, so that all end at about the same time. Runs
    with the same keypoints stay in one pass, where they share most of their work. A single worker
    gets one pass a sequence. What runs in place of the odometry shares nothing. workers: 0 if all
    runs of a sequence must be in one pass; the longest sequence is then the first.
    """
    passes: list[dict[Job, Run]] = []
    groups: dict[str, dict[Any, dict[Job, Run]]] = {}  # of the same keypoints, by sequence
    for job, run in runs.items():
        if run.brought and workers:
            passes.append({job: run})
            continue
        keypoints = id(run.masks), *run.settings.detection_values()
        groups.setdefault(job.sequence, {}).setdefault(keypoints, {})[job] = run
    lengths = {job.sequence: len(run.sequence) for job, run in runs.items()}
    if not workers:
        groups = dict(sorted(groups.items(), key=lambda each: -lengths[each[0]]))
    # work is measured in frames, of which a group of runs reads each once
    work = sum(lengths[name] * len(of_sequence) for name, of_sequence in groups.items())
    for name, by_keypoints in groups.items():
        of_sequence = list(by_keypoints.values())
        size = len(of_sequence)
        if workers > 1:
            size = max(1, round(work / (PIECES * workers) / lengths[name]))
        for start in range(0, len(of_sequence), size):
            parts = (group.items() for group in of_sequence[start : start + size])
            passes.append(dict(chain(*parts)))
    return passes


def _seen(measure: Measure, runs: Mapping[Job, Run], folder: Path) -> dict[str, Any]:
    """Return what a worker must see as the main process does: records, code and packages."""
    ((sequence, *_), *_) = runs.values()
    used = chain(
        *((run.settings.detector, run.settings.estimator, *run[2:]) for run in runs.values())
    )
    record = provenance.record(folder / sequence.name)
    return {"record": record, **_versions(measure, sequence, *used)}


def _run_pass(
    measure: Measure, runs: dict[Job, Run], folder: Path, seen: dict[str, Any]
) -> dict[Job, str]:
    """Make runs over one sequence in one pass, here or on another machine.

    seen: see `_seen`. Returns the reasons of the jobs that failed.
    """
    reasons: dict[Job, str] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the processes already use every core
    try:
        if _seen(measure, runs, folder) != seen:
            raise InputError(
                f"{folder}: this worker sees other files there, or has other code or versions of packages; "
                "give all workers the same folders under the same paths and the same packages"
            )
        for job, result in measure.make(runs).items():
            if isinstance(result, str):
                reasons[job] = result
            else:
                write_text(_file(folder, job), result.to_csv(index=False))
    except Exception as error:
        unfinished = [job for job in runs if not _file(folder, job).is_file()]
        reasons = dict.fromkeys(unfinished, cause(error)) | reasons
    finally:
        cv2.setNumThreads(threads)
    return reasons


def _paths(runs: Mapping[Job, Run]) -> dict[Job, pd.DataFrame | str]:
    """Return the frames of runs over one sequence, or the reasons why they failed."""
    failed: dict[Job, str] = {}
    together = {job: run for job, run in runs.items() if run.brought is None}
    made = {job: run.brought.run(*run[:2]) for job, run in runs.items() if run.brought}
    if together:
        sequence = next(iter(together.values())).sequence
        asked = {job: (run.settings, run.masks) for job, run in together.items()}
        made |= odometry.run_many(sequence, asked, failed=failed)
    for job, result in made.items():
        # without keypoints, the path is a point, whatever the method
        if result.frames["detected"].isna().all():
            failed[job] = (
                f"sequence {job.sequence}: no frame has any structure (all are black, white or of one "
                "gray); check how they were written"
            )
    return {job: failed.get(job) or made[job].frames for job in runs}


def _rows_of_path(job: Job, path: Path, changed: int, sequence: Sequence) -> list[dict[str, Any]]:
    measured = _measured(path, changed, sequence)
    return [{"sequence": job.sequence, "run": job.name, **asdict(job), **measured}]


@cache  # a study calls `run_all` again, with more jobs
def _measured(path: Path, changed: int, sequence: Sequence) -> dict[str, Any]:
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


PATH = Measure("odometry", odometry.run_many, _paths, _rows_of_path)


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


def number_warnings(runs: pd.DataFrame, sources: Iterable[Source]) -> list[str]:
    """Return a line for each control that keeps not as many keypoints as its source, as it should.

    The line names the sequence that differs most.
    """
    lines = []
    for source in sources:
        wanted = comparisons.keypoints_left(runs, source.name)
        of_source = runs[runs["source"] == source.name]
        for name in [name for name in of_group(CONTROL) if METHODS[name].numbered]:
            rows = of_source[of_source["method"] == name]
            ratios = rows.groupby("sequence")["mean_keypoints"].mean() / wanted
            off = np.log(ratios.dropna()).abs()
            if (off > np.log(NEARLY)).any():
                worst = off.idxmax()
                lines.append(
                    f"sequence {worst} {source.name}: the control {METHODS[name].title} keeps "
                    f"{ratios[worst]:.2f} times as many keypoints, which may explain a difference"
                )
                program.log.warning(lines[-1])
    return lines


def keypoint_controls(
    runs: pd.DataFrame,
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    repetitions: int,
    width: int,
    estimators: Iterable[str] = COMPARED,
) -> list[Job]:
    """Return jobs without a mask that keep as many keypoints as each source.

    "fewer" keeps the strongest keypoints; "spread" keeps keypoints farther apart. runs: with the
    masks. width: pixels, of the masks from label maps that leave as many keypoints.
    """
    jobs: list[Job] = []
    for source in sources:
        keypoints = comparisons.keypoints_left(runs, source.name)
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


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return {(sequence, run): estimated poses (n, 4, 4)} for each row of a table of runs."""
    return {
        (name, run): poses_of(pd.read_csv(folder / name / f"{run}.csv"))
        for name, run in zip(runs["sequence"], runs["run"], strict=True)
    }
