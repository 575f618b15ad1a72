"""A study with your own masks: its settings, the check of its input, and its runs."""

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import pandas as pd

from thesis_repro.checks import oddities, polarity
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.mask_files import MaskFolder
from thesis_repro.running import results
from thesis_repro.running.settings import MOST_REPETITIONS
from thesis_repro.study import compare, jobs, runner, sources
from thesis_repro.study.sources import FileMasks, Source

LONGEST_NAME = 200  # bytes of a sequence's name, which results have in the names of their files
RUNS = "runs"  # folder of the results of the runs


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
            if sequence.name in compare.COLUMNS:
                raise InputError(
                    f"{sequence.folder}: has the name of a column of the tables; rename the sequence"
                )
            if len(os.fsencode(sequence.name)) > LONGEST_NAME:
                raise InputError(
                    f"{sequence.folder}: its name is too long for names of files; make a link to it with "
                    "a shorter one"
                )
        widths = list(self.widths)
        if self.tested:
            widths.append(self.tested)
        sources.check(self.sources, sequences, widths)

    @property
    def shown_width(self) -> int | None:
        """The dilation width (pixels) of the masks in figures.

        It is the tested width, or else the middle one; None for only ready-made masks.
        """
        if self.tested:
            return self.tested
        if not self.widths:
            return None
        return self.widths[len(self.widths) // 2]

    def shown_masks(self) -> list[tuple[Sequence, list[FileMasks]]]:
        """Return each sequence with the masks of each source, at the `shown_width`."""
        return [
            (sequence, [source.masks(sequence, self.shown_width) for source in self.sources])
            for sequence in self.opened
        ]

    def of_unknown_polarity(self) -> list[str]:
        """Return the names of the sources whose ready-made masks may be inverted, or look so.

        Their shape says on no sequence that they are right, or on one that they are inverted.
        """
        shapes: dict[str, set[str]] = {}
        for _, sequence_masks in self.shown_masks():
            for source, masks in zip(self.sources, sequence_masks, strict=True):
                if isinstance(masks, MaskFolder):
                    with suppress(InputError):  # the runs report a file that cannot be read
                        shapes.setdefault(source.name, set()).add(oddities.polarity_of(masks))
        return [
            name
            for name, found in shapes.items()
            if polarity.RIGHT not in found or found & polarity.INVERTED.keys()
        ]

    def shown_jobs(self, name: str) -> list[jobs.Job]:
        """Return the runs of a sequence whose paths are drawn.

        They are all keypoints and the masks of each source.
        """
        estimator = "thesis"
        if "refined" in self.estimators:
            estimator = "refined"
        shown = [jobs.Job(name, "baseline", estimator=estimator)]
        for source in self.sources:
            width = self.shown_width if source.has_label_maps else None
            shown.append(jobs.Job(name, "masked", width, estimator=estimator, source=source.name))
        return shown

    def path_oddities(self, runs: pd.DataFrame, folder: Path) -> list[str]:
        """Return the warnings of `oddities.of_steps` and `oddities.of_path`.

        They are about one run with all keypoints of each sequence.
        """
        unshuffled = runs[(runs["method"] == "baseline") & (runs["repetition"] == 0)]
        baselines = unshuffled.drop_duplicates("sequence")
        warnings = []
        for run in baselines.itertuples():
            warnings += oddities.of_steps(run.sequence, run.flagged, run.frames)
        true = {sequence.name: sequence.poses for sequence in self.opened}
        for (name, _), poses in runner.run_poses(baselines, folder / RUNS).items():
            warnings += oddities.of_path(name, poses, true[name])
        return warnings

    def first_jobs(self) -> list[jobs.Job]:
        """Return the jobs that need no other results."""
        return jobs.first_jobs(
            self.opened,
            dict.fromkeys(self.estimators, self.widths),
            tested=self.tested,
            sources=self.sources,
            repetitions=self.repetitions,
        )

    def run(self, folder: Path, processes: int = 1, scheduler: str | None = None) -> runner.Outcome:
        """Run the jobs whose results are not in the folder yet, see `runner.run_jobs`.

        Raises InputError for a folder with results of another number of frames.
        """
        run_jobs = partial(
            runner.run_jobs,
            sequences=self.opened,
            sources=self.sources,
            folder=folder / RUNS,
            processes=processes,
            scheduler=scheduler,
        )
        with results.claimed(folder):
            results.stage(folder, replace=False, frames=self.frames)
            first_jobs = self.first_jobs()
            first = run_jobs(first_jobs)
            self._check_runs(first.table)
            if not self.tested:
                return first
            more_jobs = runner.keypoint_controls(
                first.table,
                self.opened,
                self.sources,
                self.repetitions,
                self.tested,
                self.estimators,
            )
            both = run_jobs(first_jobs + more_jobs)
        # the second call counts the runs of the first one as kept
        return replace(both, made=both.made + first.made, kept=both.kept - first.made)

    def _check_runs(self, runs: pd.DataFrame) -> None:
        """Raise InputError if the runs leave nothing to compare."""
        if not (runs["method"] == "masked").any():
            raise InputError(
                "every run with masks failed (see above), so there is nothing to compare"
            )
