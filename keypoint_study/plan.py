"""A study with your own masks: its settings, the check of its input, and its runs."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from keypoint_study import jobs, runner, sources
from keypoint_study.sources import Source
from thesis_repro import checks
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import THESIS
from thesis_repro.running import provenance

RUNS = "runs"  # folder of the results of the runs


@dataclass(frozen=True)
class Study:
    """One or several sources of masks or own keypoints, compared with all keypoints.

    sequences: their names. widths: pixels, for masks from label maps. tested: width of the
    controls, None for no controls. estimators: their names. frames: number of frames of each
    sequence, None for all. scale_gate: metres, see OdometrySettings. masked_settings: other
    settings of the odometry, for all runs with masks.
    """

    kitti: Path
    sequences: tuple[str, ...]
    sources: tuple[Source, ...]
    widths: tuple[int, ...]
    tested: int | None = None
    estimators: tuple[str, ...] = ("thesis",)
    repetitions: int = 1
    frames: int | None = None
    scale_gate: float = THESIS.scale_gate
    masked_settings: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def opened(self) -> list[Sequence]:
        """The sequences, cut to `frames` frames."""
        return [Sequence(self.kitti, name).subset(self.frames) for name in self.sequences]

    def check(self) -> None:
        """Raise InputError for the first problem with the settings, the sequences or the masks."""
        for sequence in self.opened:
            if not sequence.has_truth:
                raise InputError(
                    f"{sequence.poses_path}: no such file; a study needs true poses, without them the "
                    "odometry command runs"
                )
            if len(sequence) < 3:
                raise InputError(
                    f"{sequence.folder}: {len(sequence)} frames; a study needs 3 or more"
                )
        widths = list(self.widths)
        if self.tested is not None:
            widths.append(self.tested)
        sources.check(self.sources, self.opened, widths)

    def run(self, folder: Path, processes: int = 1, scheduler: str | None = None) -> runner.Outcome:
        """Run the jobs whose results are not in the folder yet, see `runner.run_all`.

        Raises InputError for a folder with results of another number of frames, and if the true
        poses of a sequence fit better inverted.
        """
        settings = {"scale_gate": self.scale_gate, **self.masked_settings}
        where: dict[str, Any] = {"processes": processes, "scheduler": scheduler}
        with provenance.claimed(folder):
            provenance.stage(folder, replace=False, frames=self.frames, **settings)
            listed = jobs.first_jobs(
                self.opened,
                dict.fromkeys(self.estimators, self.widths),
                tested=self.tested,
                sources=self.sources,
                repetitions=self.repetitions,
            )
            runs = self._runs_of(listed)
            outcome = first = runner.run_all(runs, folder / RUNS, **where)
            if (first.table["method"] == "baseline").all():
                raise InputError(
                    "every run but those with all keypoints failed (see above), so there is nothing to "
                    "compare"
                )
            self._check_truths(first.table, folder)
            if self.tested:
                as_many = runner.keypoint_controls(
                    first.table,
                    self.opened,
                    self.sources,
                    self.repetitions,
                    self.tested,
                    self.estimators,
                )
                done = {job: run for job, run in runs.items() if job not in first.reasons}
                both = done | self._runs_of(as_many)
                outcome = runner.run_all(both, folder / RUNS, **where).after(first)
        numbers = runner.number_warnings(outcome.table, self.sources)
        return replace(outcome, warnings=[*outcome.warnings, *numbers])

    def _runs_of(self, listed: list[jobs.Job]) -> dict[jobs.Job, jobs.Run | str]:
        """Return the runs of jobs with the settings of the study."""
        settings = {"scale_gate": self.scale_gate}
        return jobs.runs_of(listed, self.opened, self.sources, settings, self.masked_settings)

    def _check_truths(self, table: pd.DataFrame, folder: Path) -> None:
        """Raise InputError if a truth fits the paths of every estimator better inverted."""
        runs = table[(table["method"] == "baseline") & (table["repetition"] == 0)]
        poses = runner.run_poses(runs, folder / RUNS)
        for sequence in self.opened:
            told = [
                checks.inverted_truth(sequence, estimate)
                for (name, _), estimate in poses.items()
                if name == sequence.name
            ]
            if told and all(told):
                raise InputError(told[0][0])

    @property
    def shown_width(self) -> int | None:
        """The dilation width (pixels) of the masks in figures.

        It is the tested width, or else the middle one; None for only ready-made masks.
        """
        if self.tested or not self.widths:
            return self.tested
        return self.widths[len(self.widths) // 2]
