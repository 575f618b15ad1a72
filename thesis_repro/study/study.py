"""A study with your own masks: its settings, the check of its input, and its runs."""

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import pandas as pd

from thesis_repro.checks import oddities
from thesis_repro.data.kitti import Sequence
from thesis_repro.data.trajectories import write_kitti_poses, write_tum
from thesis_repro.errors import InputError
from thesis_repro.running import results
from thesis_repro.running.settings import MOST_REPETITIONS
from thesis_repro.study import jobs, runner, sources
from thesis_repro.study.sources import FileMasks, Source

PATHS = "paths"  # folder of the estimated paths


@dataclass(frozen=True)
class Study:
    """One or several sources of masks, compared with all keypoints.

    sequences: their names. widths: pixels, for masks from label maps. tested: width of the
    controls, None for no controls. estimators: some of `jobs.ESTIMATORS`. frames: number of frames
    of each sequence, None for all.
    """

    kitti: Path
    sequences: tuple[str, ...]
    sources: tuple[Source, ...]
    widths: tuple[int, ...]
    tested: int | None = None
    estimators: tuple[str, ...] = ("thesis",)
    repetitions: int = 1
    frames: int | None = None

    @cached_property
    def opened(self) -> list[Sequence]:
        """The sequences, cut to `frames` frames."""
        return [Sequence(self.kitti, name).subset(self.frames) for name in self.sequences]

    def check(self) -> None:
        """Raise InputError for the first problem with the settings, the sequences or the masks."""
        if not 1 <= self.repetitions <= MOST_REPETITIONS:
            raise InputError(
                f"--repetitions {self.repetitions}: must be 1 or more, and at most {MOST_REPETITIONS}"
            )
        if self.tested is not None and self.tested < 1:
            raise InputError(
                f"--controls {self.tested}: must be a dilation width, 1 or more pixels"
            )
        sequences = self.opened
        for sequence in sequences:
            if len(sequence) < 3:
                raise InputError(
                    f"{sequence.folder}: {len(sequence)} frames; a study needs 3 or more"
                )
        sources.check(
            self.sources, sequences, (*self.widths, self.tested) if self.tested else self.widths
        )

    @property
    def shown_width(self) -> int | None:
        """The dilation width (pixels) of the masks in figures: the tested width, or else the
        middle one.
        """
        return self.tested or (self.widths[len(self.widths) // 2] if self.widths else None)

    def masks(self) -> list[tuple[Sequence, list[FileMasks]]]:
        """Return each sequence with the masks of each source, at the `shown_width`."""
        return [
            (sequence, [source.masks(sequence, self.shown_width) for source in self.sources])
            for sequence in self.opened
        ]

    def shown_jobs(self, name: str) -> list[jobs.Job]:
        """Return the runs of a sequence whose paths are drawn: all keypoints and the masks of
        each source.
        """
        estimator = "refined" if "refined" in self.estimators else "thesis"
        return [
            jobs.Job(name, "baseline", estimator=estimator),
            *(
                jobs.Job(
                    name,
                    "masked",
                    self.shown_width if source.kind == "labels" else None,
                    estimator=estimator,
                    source=source.name,
                )
                for source in self.sources
            ),
        ]

    def write_paths(self, runs: pd.DataFrame, folder: Path) -> None:
        """Write the ground truth and repetition 0 of every run into folder/PATHS, in KITTI's
        and TUM's formats.
        """
        first_runs = runs[runs["repetition"] == 0]
        for sequence in self.opened:
            name = sequence.name
            estimated = runner.run_poses(
                first_runs[first_runs["sequence"] == name], folder / "runs"
            )
            for (_, run), poses in {(name, "truth"): sequence.poses, **estimated}.items():
                write_kitti_poses(folder / PATHS / "kitti" / name / f"{run}.txt", poses)
                write_tum(folder / PATHS / "tum" / name / f"{run}.txt", poses, sequence.times)

    def path_oddities(self, runs: pd.DataFrame, folder: Path) -> list[str]:
        """Return the warnings of `oddities.of_steps` and `oddities.of_path` for one run with
        all keypoints of each sequence.
        """
        baselines = runs[
            (runs["method"] == "baseline") & (runs["repetition"] == 0)
        ].drop_duplicates("sequence")
        true = {sequence.name: sequence.poses for sequence in self.opened}
        lines = [
            line
            for run in baselines.itertuples()
            for line in oddities.of_steps(run.sequence, run.flagged, run.frames)
        ]
        return lines + [
            line
            for (name, _), poses in runner.run_poses(baselines, folder / "runs").items()
            for line in oddities.of_path(name, poses, true[name])
        ]

    def first_jobs(self) -> list[jobs.Job]:
        """Return the jobs that need no other results."""
        return jobs.first_jobs(
            self.opened,
            dict.fromkeys(self.estimators, self.widths),
            tested=self.tested,
            sources=self.sources,
            repetitions=self.repetitions,
        )

    def run(self, folder: Path, processes: int = 1, scheduler: str | None = None) -> pd.DataFrame:
        """Run the jobs whose results are not in the folder yet; returns the table of all runs, see
        `runner.run`.

        Raises InputError for a folder with results of another number of frames.
        """
        run = partial(
            runner.run,
            sequences=self.opened,
            sources=self.sources,
            folder=folder / "runs",
            processes=processes,
            scheduler=scheduler,
        )
        with results.claimed(folder):
            results.stage(folder, replace=False, frames=self.frames)
            study_jobs = self.first_jobs()
            runs = run(study_jobs)
            if runs["mean_keypoints"].isna().all():
                raise InputError(
                    f"{self.kitti}: no frame has any structure (all are black, white or of one gray); "
                    "check how they were written"
                )
            if not (runs["method"] == "masked").any():
                raise InputError(
                    "every run with masks failed (see above), so there is nothing to compare"
                )
            if self.tested:
                made = runs.attrs["made"]
                study_jobs += runner.keypoint_controls(
                    runs,
                    self.opened,
                    self.sources,
                    self.repetitions,
                    self.tested,
                    self.estimators,
                )
                runs = run(study_jobs)
                # the second call counts the runs of the first one as kept
                runs.attrs["made"] += made
                runs.attrs["kept"] -= made
            self.write_paths(runs, folder)
        return runs
