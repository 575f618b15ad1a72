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
from typing import Any

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
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError, cause
from thesis_repro.odometry.estimators import COMPARED
from thesis_repro.odometry.runs import is_flagged, poses_of
from thesis_repro.running import program, provenance
from thesis_repro.running.files import progress, write_text
from thesis_repro.running.workers import open_pool

NEARLY = 1.1  # controls keep as many keypoints if the ratio is within 1 / NEARLY to this
SETTINGS = "settings.json"  # of the runs in a folder
# The code that makes runs. What a method chooses stands in the record of each run, so a new entry
# in METHODS repeats nothing.
CODE = (
    "thesis_repro/odometry",
    "thesis_repro/masks",
    "thesis_repro/data",
    "thesis_repro/running/files.py",
    "opencv_exact",
    "keypoint_study/ablations.py",
    "keypoint_study/controls.py",
    "keypoint_study/sources.py",
)
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


def run_all(
    runs: Mapping[Job, Run | str],
    folder: Path,
    *,
    processes: int = 1,
    scheduler: str | None = None,
) -> Outcome:
    """Run what has no result yet; returns the table of all runs and how many ran.

    runs: of `jobs.runs_of`; a text is the reason why a job cannot run. folder: for the results, one
    file a run. Results of another sequence or odometry in it are moved aside; runs with other
    settings or masks are made again.
    processes, scheduler: see `workers.open_pool`; the results do not depend on them. The workers of
    a scheduler need this package, and all folders under the same paths. One thread a worker is
    best.

    Runs over the same sequence share one or several passes, with the results of separate runs. What
    is stopped repeats only the passes that it was in. A run that fails is printed with its reason
    and does not stop others.
    Raises InputError if another process is using the folder, if all runs fail, or if a worker is
    lost.
    """
    reasons = {job: run for job, run in runs.items() if isinstance(run, str)}
    possible = {job: run for job, run in runs.items() if not isinstance(run, str)}
    with provenance.claimed(folder):
        _prepare(possible, folder)
        waiting = {job: run for job, run in possible.items() if not _file(folder, job).is_file()}
        reasons |= _run(waiting, folder, processes, scheduler)
    warnings = _report(reasons)
    table = _read(possible, folder)
    if table.empty:
        first = next(iter(reasons.values()))
        raise InputError(f"all {len(runs)} runs failed; the first: {first}")
    made = sum(_file(folder, job).is_file() for job in waiting)
    return Outcome(table, made, reasons, warnings)


def _file(folder: Path, job: Job) -> Path:
    """Return the result file of a job, which is written when the job is done."""
    return folder / job.sequence / f"{job.name}.csv"


# Prepare: results of other inputs go


def _prepare(runs: Mapping[Job, Run], folder: Path) -> None:
    """Move aside, or delete, what was made from other inputs than runs have now."""
    sequences = {job.sequence: run.sequence for job, run in runs.items()}
    digest = cache(provenance.digest_of_files)
    for name, sequence in sequences.items():
        if not sequence.has_truth:
            raise InputError(
                f"{sequence.poses_path}: no such file; without ground truth, sequence {name} has no "
                "errors to compare; leave it out (the odometry command runs it)"
            )
        provenance.stage(folder / name, **_versions(), sequence=sequence.digest())
        records = {
            job.name: _record(run, digest) for job, run in runs.items() if job.sequence == name
        }
        _drop_changed(records, folder / name)


def _versions() -> dict[str, Any]:
    """Return what all runs depend on beside data: code, and other packages."""
    code = provenance.digest_of_code(*CODE)
    return {"code": code, **provenance.versions("opencv", "numpy", "numba")}


def _record(run: Run, digest: Callable) -> dict[str, Any]:
    """Return what a run depends on beside its sequence. digest: of files, which may remember."""
    parts = [part for part in (run.masks, run.brought) if part is not None]
    paths = chain(*(getattr(part, "paths", ()) for part in parts))
    record = {
        **run.settings.record(),
        "masks": [recorded(part) for part in parts],
        "files": digest(tuple(dict.fromkeys(paths))),
    }
    return dict(json.loads(json.dumps(record, default=float)))  # numbers of NumPy, tuples


def _drop_changed(records: dict[str, dict[str, Any]], folder: Path) -> None:
    """Delete the results of runs over one sequence whose records differ from those before."""
    path = folder / SETTINGS
    before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name, record in records.items():
        if before.get(name, record) != record:
            (folder / f"{name}.csv").unlink(missing_ok=True)
    if before | records != before:
        write_text(path, json.dumps(before | records, indent=1))


# Run: what has no result


def _run(
    runs: Mapping[Job, Run], folder: Path, processes: int, scheduler: str | None
) -> dict[Job, str]:
    """Make runs, here or on workers. Returns the reasons of the jobs that failed."""
    reasons: dict[Job, str] = {}
    with open_pool(processes, scheduler) as pool:
        passes = _in_passes(runs, pool.size)
        calls = [(of_pass, folder, _seen(of_pass, folder)) for of_pass in passes]
        frames = [sum(len(run.sequence) for run in of_pass.values()) for of_pass in passes]
        with progress(None, "odometry", total=sum(frames), unit="frame") as bar:
            for count, failed in zip(frames, pool.run(_run_pass, calls), strict=True):
                reasons |= failed
                bar.update(count)
    return reasons


def _in_passes(runs: Mapping[Job, Run], workers: int) -> list[dict[Job, Run]]:
    """Divide runs into parts, each for one pass over a sequence.

    Each of several workers gets about PIECES passes, so that all end at about the same time. Runs
    with the same keypoints stay in one pass, where they share most of their work. A single worker
    gets one pass a sequence. Own keypoints share nothing.
    """
    passes = [{job: run} for job, run in runs.items() if run.brought]
    sharing: dict[tuple, dict[Job, Run]] = {}  # by sequence and keypoints
    for job, run in runs.items():
        if not run.brought:
            keypoints = job.sequence, run.masks, run.settings.detection_values()
            sharing.setdefault(keypoints, {})[job] = run
    lengths = {job.sequence: len(run.sequence) for job, run in runs.items()}
    # work is measured in frames, of which a group of runs reads each once
    work = sum(lengths[sequence] for sequence, *_ in sharing)
    for name, length in lengths.items():
        groups = [group for (sequence, *_), group in sharing.items() if sequence == name]
        size = len(groups) if workers == 1 else round(work / (PIECES * workers) / length)
        size = max(1, size)  # groups of a pass
        for start in range(0, len(groups), size):
            parts = (group.items() for group in groups[start : start + size])
            passes.append(dict(chain(*parts)))
    return passes


def _seen(runs: Mapping[Job, Run], folder: Path) -> dict[str, Any]:
    """Return what a worker must see as the main process does: the record, code and packages."""
    sequence = next(iter(runs)).sequence
    return {"record": provenance.record(folder / sequence), **_versions()}


def _run_pass(runs: dict[Job, Run], folder: Path, seen: dict[str, Any]) -> dict[Job, str]:
    """Make runs over one sequence in one pass, here or on another machine.

    seen: see `_seen`. Returns the reasons of the jobs that failed.
    """
    reasons: dict[Job, str] = {}
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the processes already use every core
    try:
        if _seen(runs, folder) != seen:
            raise InputError(
                f"{folder}: this worker sees other files there, or has other code or versions of packages; "
                "give all workers the same folders under the same paths and the same packages"
            )
        for job, result in _frames_of(runs).items():
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


def _frames_of(runs: Mapping[Job, Run]) -> dict[Job, pd.DataFrame | str]:
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


# Read: the table of all runs


def _read(runs: Mapping[Job, Run], folder: Path) -> pd.DataFrame:
    """Return the table of the runs that have a result, one row a job."""
    rows = []
    for job, run in runs.items():
        path = _file(folder, job)
        if path.is_file():
            measured = _measured(path, path.stat().st_mtime_ns, run.sequence)
            rows.append({"sequence": job.sequence, "run": job.name, **asdict(job), **measured})
    return pd.DataFrame(rows)


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


def run_poses(runs: pd.DataFrame, folder: Path) -> dict[tuple[str, str], np.ndarray]:
    """Return {(sequence, run): estimated poses (n, 4, 4)} for each row of a table of runs."""
    return {
        (name, run): poses_of(pd.read_csv(folder / name / f"{run}.csv"))
        for name, run in zip(runs["sequence"], runs["run"], strict=True)
    }


# Controls without a mask


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
            limit = max(1, round(number))  # OpenCV takes 0 as "no limit"
            fewer = replace(job, max_keypoints=limit)
            spread = replace(job, method="spread", min_distance=min_distance(sequence, number))
            jobs += repeated([fewer, spread], estimators, repetitions)
    return jobs
