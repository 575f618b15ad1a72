"""A study with masks of one's own: what is run, whether the data is there, and the running of it."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from thesis_repro import InputError, check, longrun, stages
from thesis_repro.kitti import Sequence, write_kitti_poses, write_tum
from thesis_repro.settings import MOST_REPETITIONS
from thesis_repro.study import compare, jobs, runner, sources
from thesis_repro.study.sources import FileMasks, Source

PATHS = "paths"  # folder of each run's path


@dataclass(frozen=True)
class Study:
    """Sources of masks side by side, against all keypoints.

    sequences: names. widths: pixels, of masks from label maps. tested: width of the controls, None for none.
    estimators, of `jobs.ESTIMATORS`. frames: of each sequence, None for all.
    """

    kitti: Path
    sequences: tuple[str, ...]
    sources: tuple[Source, ...]
    widths: tuple[int, ...]
    tested: int | None = None
    estimators: tuple[str, ...] = ("thesis",)
    repetitions: int = 1
    frames: int | None = None

    def opened(self) -> list[Sequence]:
        """The sequences, cut to their frames."""
        return [Sequence(self.kitti, name).subset(self.frames) for name in self.sequences]

    def check(self) -> None:
        """Raise InputError for the first thing that a run would need and that is not there."""
        if self.frames is not None and self.frames < 3:
            raise InputError(f"--frames {self.frames}: must be 3 or more")
        if not 1 <= self.repetitions <= MOST_REPETITIONS:
            raise InputError(f"--repetitions {self.repetitions}: must be 1 or more, and at most {MOST_REPETITIONS}")
        sequences = self.opened()
        for sequence in sequences:
            if len(sequence) < 3:
                raise InputError(f"{sequence.folder}: {len(sequence)} frames; a study needs 3 or more")
        sources.check(self.sources, sequences, {*self.widths, *([] if self.tested is None else [self.tested])})

    @property
    def shown_width(self) -> int | None:
        """The dilation width (pixels) that is shown of masks: the tested one, or else the middle one."""
        return self.tested or (self.widths[len(self.widths) // 2] if self.widths else None)

    def masks(self) -> list[tuple[Sequence, list[FileMasks]]]:
        """Each sequence with the masks of each source, of the width that is shown."""
        return [(sequence, [source.masks(sequence, self.shown_width) for source in self.sources])
                for sequence in self.opened()]

    def shown_jobs(self, name: str) -> list[jobs.Job]:
        """The runs of a sequence whose paths are drawn: all keypoints, and the masks of each source."""
        estimator = "refined" if "refined" in self.estimators else "thesis"
        return [jobs.Job(name, "baseline", estimator=estimator), *(
            jobs.Job(name, "masked", self.shown_width if source.kind == "labels" else None, estimator=estimator,
                     source=source.name) for source in self.sources)]

    def write_paths(self, runs: pd.DataFrame, folder: Path) -> None:
        """Write repetition 0 of every run, and the truth, into folder/PATHS, in KITTI's and in TUM's form."""
        estimated = runner.run_poses(runs[runs["repetition"] == 0], folder / "runs")
        for sequence in self.opened():
            name = sequence.name
            of_sequence = {run: poses for (its_sequence, run), poses in estimated.items() if its_sequence == name}
            for run, poses in {"truth": sequence.poses, **of_sequence}.items():
                write_kitti_poses(folder / PATHS / "kitti" / name / f"{run}.txt", poses)
                write_tum(folder / PATHS / "tum" / name / f"{run}.txt", poses, sequence.times)

    def path_oddities(self, runs: pd.DataFrame, folder: Path) -> list[str]:
        """`check.path_oddities` of the runs with all keypoints."""
        chosen = runs[(runs["method"] == "baseline") & (runs["repetition"] == 0)].drop_duplicates("sequence")
        return [line for (name, _), poses in runner.run_poses(chosen, folder / "runs").items()
                for line in check.path_oddities(name, poses, Sequence(self.kitti, name).poses[:len(poses)])]

    def first_jobs(self) -> list[jobs.Job]:
        """The runs that need no result of others."""
        return jobs.first_jobs(self.kitti, self.sequences, dict.fromkeys(self.estimators, self.widths),
                               tested=self.tested, sources=self.sources, repetitions=self.repetitions)

    def second_jobs(self, runs: pd.DataFrame) -> list[jobs.Job]:
        """The controls that need the number of keypoints that masks leave in `runs`."""
        second: list[jobs.Job] = []
        for source in self.sources if self.tested else ():
            width = None if source.kind == "masks" else self.tested
            left = compare.keypoints_left(compare.of_source(runs, source.name))
            second += jobs.keypoint_control_jobs(left, self.kitti, self.frames, self.repetitions, self.estimators,
                                                 source.name, width)
        return second

    def run(self, folder: Path, processes: int = 1, scheduler: str | None = None) -> pd.DataFrame:
        """Run what the folder does not hold yet; returns the table of all runs, see `runner.run`.

        Raises InputError for a folder with results of another number of frames.
        """
        def run(listed: list[jobs.Job]) -> pd.DataFrame:
            return runner.run(listed, self.kitti, self.sources, folder / "runs", frames=self.frames,
                              processes=processes, scheduler=scheduler)

        with longrun.claimed(folder):
            stages.stage(folder, replace=False, frames=self.frames)
            runs = run(self.first_jobs())
            if runs["mean_keypoints"].isna().all():
                raise InputError(f"{self.kitti}: no frame has any structure (all are black, blown out or of one gray); "
                                 "check how they were written")
            second, made = self.second_jobs(runs), runs.attrs["made"]
            if second:
                runs = run([*self.first_jobs(), *second])
                runs.attrs["made"] += made  # what the first call made, the second one kept
                runs.attrs["kept"] -= made
            self.write_paths(runs, folder)
        return runs
