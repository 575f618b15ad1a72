"""A study with masks of one's own: what is run, whether the data is there, and the running of it."""

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from thesis_repro import InputError, kitti, longrun, masks, stages
from thesis_repro.masks import MaskSettings
from thesis_repro.settings import LIMITS, MOST_REPETITIONS
from thesis_repro.study import compare, jobs, runner, sources
from thesis_repro.study.sources import Source

MOST_WIDTH = LIMITS["WIDTHS"][1]


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

    def first_jobs(self) -> list[jobs.Job]:
        """The runs that need no result of others."""
        return jobs.first_jobs(self.kitti, self.sequences, dict.fromkeys(self.estimators, self.widths),
                               tested=self.tested, sources=self.sources, repetitions=self.repetitions)

    def second_jobs(self, runs: pd.DataFrame) -> list[jobs.Job]:
        """The controls that need the number of keypoints that masks leave in `runs`."""
        return [job for source in (self.sources if self.tested else ()) for job in jobs.keypoint_control_jobs(
            compare.keypoints_left(compare.of_source(runs, source.name), self.width_of(source)), self.kitti,
            self.frames, self.repetitions, self.estimators, source.name, self.width_of(source))]

    def width_of(self, source: Source) -> int | None:
        """The width (pixels) at which a source is put to the test; None for masks that come ready made."""
        return None if source.kind == "masks" else self.tested

    def run(self, folder: Path, processes: int = 1, scheduler: str | None = None) -> pd.DataFrame:
        """Run what the folder does not hold yet; returns the table of all runs, see `runner.run`.

        Raises InputError for a folder with results of another number of frames.
        """
        with longrun.claimed(folder):
            return self._run(folder, processes, scheduler)

    def _run(self, folder: Path, processes: int, scheduler: str | None) -> pd.DataFrame:
        stages.stage(folder, replace=False, frames=self.frames)
        first = self.first_jobs()

        def run(listed: list[jobs.Job]) -> pd.DataFrame:
            return runner.run(listed, self.kitti, self.sources, folder / "runs", frames=self.frames,
                              processes=processes, scheduler=scheduler)

        runs = run(first)
        second = self.second_jobs(runs)
        if not second:
            return runs
        made = runs.attrs["made"]
        runs = run([*first, *second])
        runs.attrs["made"] += made  # what the first call made, the second one kept
        runs.attrs["kept"] -= made
        return runs


def named(folders: Iterable[tuple[str, Path]], names: Iterable[str],
          settings: MaskSettings) -> tuple[Source, ...]:
    """Sources from (kind, folder), the first with the first name; those without one are called as their folder.

    settings: of all masks from label maps.
    Raises InputError for a name that cannot be a folder's, for two of the same, and for more names than folders.
    """
    folders, names = list(folders), list(names)
    if len(names) > len(folders):
        raise InputError(f"--name {names[len(folders)]}: {len(names)} names for {len(folders)} folders of masks; give "
                         "one --name for each --labels or --masks, in their order")
    for name in names:
        if not re.fullmatch(r"[\w+-]+", name):
            raise InputError(f"--name {name}: a name may have letters, digits, '_', '+' and '-'")
    folders = [(kind, folder.absolute()) for kind, folder in folders]
    names += [re.sub(r"[^\w+-]+", "-", folder.resolve().name).strip("-") or "masks"
              for _, folder in folders[len(names):]]
    twice = [name for name, count in Counter(name.lower() for name in names).items() if count > 1]
    if twice:
        raise InputError(f"--name: two folders of masks would be called {twice[0]!r}; give each a --name of its own, "
                         "in the order of --labels and --masks")
    return tuple(Source(folder, kind, name, settings) for (kind, folder), name in zip(folders, names, strict=True))


def checked(study: Study) -> Study:
    """The study, once everything is there that it needs. Raises InputError for the first thing that is not."""
    if study.frames is not None and study.frames < 3:
        raise InputError(f"--frames {study.frames}: must be 3 or more")
    for text, most, values in (("--repetitions", MOST_REPETITIONS, [study.repetitions]),
                               ("--widths", MOST_WIDTH, study.widths),
                               ("--controls", MOST_WIDTH, [1 if study.tested is None else study.tested])):
        for value in values:
            if not 1 <= value <= most:
                raise InputError(f"{text} {value}: must be 1 or more, and at most {most}")
    twice = [name for name, count in Counter(study.sequences).items() if count > 1]
    if twice:
        raise InputError(f"--sequences: {twice[0]} is named twice")
    whole = [kitti.Sequence(study.kitti, name) for name in study.sequences]
    short = [sequence for sequence in whole if len(sequence) < 3]
    if short:
        raise InputError(f"{short[0].folder}: {len(short[0])} frames; a study needs 3 or more")
    for sequence in whole if any(source.kind == "labels" for source in study.sources) else ():
        for width in (*study.widths, study.tested or 1):
            masks.check_width(width, sequence.size)
    sources.check(study.sources, [sequence.subset(study.frames) for sequence in whole])
    return study
