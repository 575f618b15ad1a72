"""The odometry runs of a study, as a plain list of jobs.

Chapter 4 runs every sequence with all keypoints, with masks of each width and with plainly reduced keypoints. The
controls beside them ask whether it is the segmentation that helps. Some jobs need the number of keypoints that masks
leave (`reduced_jobs`, `keypoint_control_jobs`), so they follow in a second list.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pandas as pd

from thesis_repro.kitti import Sequence
from thesis_repro.odometry import THESIS, OdometrySettings
from thesis_repro.study import controls
from thesis_repro.study.sources import Source

# Pixels: the width of Section 3.6 and of Figures 3.6 and 4.5, at which masks are put to the test. It was fixed before
# any run. (The code of appendix A.8 dilates by 5, audit row 26.)
CONTROL_WIDTH = 10
ESTIMATORS = {"thesis": "thesis's estimator", "refined": "refined estimator"}  # the second spreads far less
KEYPOINT_CONTROLS = ("fewer", "spread")  # as many keypoints as masks leave, without a mask
UNMASKED = ("baseline", "reduced", *KEYPOINT_CONTROLS)
PIECES = 4  # passes for each of several workers, at the least


@dataclass(frozen=True)
class Job:
    """One run of the odometry over one sequence. What is None or left out is as in the thesis.

    method: "baseline", "masked" or "reduced" as in the thesis, or one of the controls.
    dilation_width: pixels, of masks from label maps; of KEYPOINT_CONTROLS, of the masks that leave as many keypoints.
    source: name of where the masks come from, or those that a limit of keypoints was taken from; empty where there is
    only one. max_keypoints, min_distance: of the detector. estimator: "thesis" or "refined", see OdometrySettings.
    repetition: 0 is the thesis's single run; any other number is the seed that shuffles the matched points.
    """

    sequence: str
    method: str
    dilation_width: int | None = None
    max_keypoints: int | None = None
    min_distance: float | None = None
    estimator: str = "thesis"
    repetition: int = 0
    source: str = ""

    @property
    def name(self) -> str:
        """Unique in its sequence, and the stem of its file: masked-05-0, mine/mirrored-10-refined-1, spread-7.5-0."""
        has_no_mask = self.dilation_width is None or self.method in UNMASKED
        width = None if has_no_mask else f"{self.dilation_width:02d}"
        distance = None if self.min_distance is None else f"{self.min_distance:g}"
        estimator = None if self.estimator == "thesis" else self.estimator
        parts = (self.method, width, self.max_keypoints, distance, estimator, self.repetition)
        name = "-".join(str(part) for part in parts if part is not None)
        return f"{self.source}/{name}" if self.source else name

    @property
    def settings(self) -> OdometrySettings:
        """The settings of the odometry: the thesis's, but for what the job itself says."""
        changes: dict[str, Any] = {"max_keypoints": self.max_keypoints, "min_distance": self.min_distance,
                                   "shuffle_seed": self.repetition or None, "estimator": self.estimator,
                                   "fallback": self.method == "fallback"}
        return replace(THESIS, **{name: value for name, value in changes.items() if value is not None})

    def masks(self, sequence: Sequence, sources: Mapping[str, Source]) -> controls.ControlMasks | None:
        """Its masks; None where the detector may look everywhere. sources: by name."""
        if self.method in UNMASKED:
            return None
        source = sources[self.source]
        if self.method == "masked":
            return source.masks(sequence, self.dilation_width)
        return controls.masks(self.method, source, sequence, self.dilation_width)


def first_jobs(kitti: Path, names: Iterable[str], widths: Mapping[str, Iterable[int]], *, tested: int | None = None,
               sources: Iterable[Source] = (Source(Path()),), repetitions: int = 1) -> list[Job]:
    """The runs that need no result of others: all keypoints, masks of every width and the controls that are masks.

    names: of the sequences. widths: pixels, of masks from label maps, by estimator: {"thesis": range(1, 16)}.
    tested: width (pixels) of the controls, None for no controls; it joins the widths of every estimator.
    sources: of masks, side by side; all keypoints are run once for all of them.
    """
    jobs: list[Job] = []
    for name in names:
        jobs += _repeated([Job(name, "baseline")], widths, repetitions)
        for source in sources:
            if source.kind == "masks":  # they have no width
                estimators_of: dict[int | None, list[str]] = {None: list(widths)}
            else:
                every = set().union(*widths.values(), [tested] if tested else [])
                estimators_of = {width: [estimator for estimator, its_widths in widths.items()
                                         if width in {*its_widths, tested}] for width in sorted(every)}
            for width, estimators in estimators_of.items():
                jobs += _repeated([Job(name, "masked", width, source=source.name)], estimators, repetitions)
            methods = [method for method in controls.MASKS if tested and not (
                source.kind == "masks" and method in controls.OF_LABEL_MAPS
                or method == "true-labels" and not controls.true_labels(kitti, name).is_dir())]
            jobs += _repeated([Job(name, method, None if source.kind == "masks" else tested, source=source.name)
                               for method in methods], widths, repetitions)
    return jobs


def _repeated(jobs: Iterable[Job], estimators: Iterable[str], repetitions: int) -> list[Job]:
    return [replace(job, estimator=estimator, repetition=repetition) for job in jobs for estimator in estimators
            for repetition in range(repetitions)]


def reduced_jobs(best: pd.DataFrame, repetitions: int = 1) -> list[Job]:
    """The detector limited to each sequence's mean number of keypoints at its best width (Figure 4.12).

    best: the table of `thesis_tables.best_widths`.
    """
    return [Job(name, "reduced", max_keypoints=_whole(number), repetition=repetition)
            for name, number in best["mean_keypoints"].items() for repetition in range(repetitions)]


def keypoint_control_jobs(keypoints: Mapping[str, float], kitti: Path, frames: int | None = None,
                          repetitions: int = 1, estimators: Iterable[str] = tuple(ESTIMATORS), source: str = "",
                          width: int | None = None) -> list[Job]:
    """As many keypoints as masks leave, {sequence: mean number}, without a mask: the strongest, or spread out.

    "fewer" limits their number; "spread" keeps them farther apart. width: pixels, of those masks.
    """
    jobs: list[Job] = []
    for name, number in keypoints.items():
        distance = controls.min_distance(Sequence(kitti, name).subset(frames), number)
        jobs += _repeated([Job(name, "fewer", width, max_keypoints=_whole(number), source=source),
                           Job(name, "spread", width, min_distance=distance, source=source)], estimators, repetitions)
    return jobs


def _whole(number: float) -> int:
    return max(1, round(number))  # 0 would lift the detector's limit


def in_passes(jobs: Iterable[Job], frames: Mapping[str, int], workers: int) -> list[list[Job]]:
    """Jobs cut into lists for one pass over a sequence each; frames: of each sequence.

    A pass is at most 1 / PIECES of a worker's share, so that no worker is alone at the end; jobs with the same
    keypoints stay together, since they share most. A worker on its own takes each sequence whole.
    """
    groups: dict[str, dict[Job, list[Job]]] = {name: {} for name in frames}
    for job in jobs:
        groups[job.sequence].setdefault(replace(job, estimator="", repetition=0), []).append(job)
    everything = sum(len(groups[name]) * frames[name] for name in frames)
    passes = []
    for name, of_name in groups.items():
        share = len(of_name) * frames[name] / max(everything, 1)
        pieces = min(len(of_name), math.ceil(share * (PIECES * workers if workers > 1 else 1)))
        ends = [index * len(of_name) // max(pieces, 1) for index in range(pieces + 1)]
        listed = list(of_name.values())
        passes += [sum(listed[start:end], []) for start, end in pairwise(ends)]
    return passes
