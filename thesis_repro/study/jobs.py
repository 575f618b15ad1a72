"""The odometry runs behind chapter 4, as a plain list: every sequence with all keypoints, with masks of each width, and
plainly reduced; and the controls, which ask whether it is the segmentation that helps.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
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
    dilation_width: pixels, of masks from label maps; of KEYPOINT_CONTROLS, of the masks that leave as many keypoints. source: name of where the masks come from, or those that a limit
    of keypoints was taken from; empty where there is only one. max_keypoints, min_distance: of the detector.
    estimator: "all" or "refined", see OdometrySettings.
    repetition: 0 takes the correspondences in the order in which they come, which is the thesis's single run; any
    other number is the seed that shuffles them.
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
        """What the odometry does in this job: what the thesis does, but for what the job itself says."""
        said: dict[str, Any] = {"max_keypoints": self.max_keypoints, "min_distance": self.min_distance,
                                "shuffle_seed": self.repetition or None, "estimator": self.estimator}
        return replace(THESIS, **{name: value for name, value in said.items() if value is not None})

    def masks(self, sequence: Sequence, sources: Mapping[str, Source]) -> controls.ControlMasks | None:
        """Its masks; None where the detector may look everywhere. sources: by name."""
        if self.method in UNMASKED:
            return None
        source = sources[self.source]
        if self.method == "masked":
            return source.masks(sequence, self.dilation_width)
        return controls.masks(self.method, source, sequence, self.dilation_width)


def first_jobs(names: Iterable[str], widths: Iterable[int], repetitions: int = 1) -> list[Job]:
    """The thesis's runs that depend on no other: baseline and masks of every width, for each sequence."""
    methods = [("baseline", None), *(("masked", width) for width in widths)]
    return [Job(name, method, width, repetition=repetition) for name in names for method, width in methods
            for repetition in range(repetitions)]


def mask_control_jobs(kitti: Path, names: Iterable[str], repetitions: int = 1,
                      width: int = CONTROL_WIDTH) -> list[Job]:
    """The controls that depend on no other run, under both estimators; baseline and masks under the refined one.

    width: pixels, of all masks. Under the thesis's estimator baseline and masks are those of `first_jobs`, so this has
    to be one of its widths. The true label maps take part where a sequence has them, in a folder labels_0 beside its
    frames.
    """
    jobs = []
    for name in names:
        jobs += [Job(name, method, its_width, estimator="refined", repetition=repetition)
                 for method, its_width in (("baseline", None), ("masked", width))
                 for repetition in range(repetitions)]
        jobs += _repeated(mask_controls(kitti, name, width), ESTIMATORS, repetitions)
    return jobs


def mask_controls(kitti: Path, name: str, width: int | None, source: str = "") -> list[Job]:
    """A job of each control that is a mask, beside masks of a width; None: beside masks that come ready made."""
    left_out = list(controls.OF_LABEL_MAPS) if width is None else []
    if not controls.true_labels(kitti, name).is_dir():
        left_out.append("true-labels")
    return [Job(name, method, width, source=source) for method in controls.MASKS if method not in left_out]


def study_jobs(kitti: Path, names: Iterable[str], sources: Iterable[Source], widths: Iterable[int], *,
               tested: int | None = None, estimators: Iterable[str] = ("thesis",), repetitions: int = 1) -> list[Job]:
    """The runs of several sources side by side that depend on no other: all keypoints once, and each source's masks.

    widths: pixels, of masks from label maps. tested: that of the mask controls, None for none; where it is given, it
    is one of the widths too.
    """
    jobs: list[Job] = []
    widths, sources = sorted({*widths, *([tested] if tested else [])}), list(sources)
    for name in names:
        jobs.append(Job(name, "baseline"))
        for source in sources:
            ready = source.kind == "masks"
            jobs += [Job(name, "masked", width, source=source.name) for width in ([None] if ready else widths)]
            if tested:
                jobs += mask_controls(kitti, name, None if ready else tested, source.name)
    return _repeated(jobs, estimators, repetitions)


def _repeated(jobs: Iterable[Job], estimators: Iterable[str], repetitions: int) -> list[Job]:
    estimators = list(estimators)
    return [replace(job, estimator=estimator, repetition=repetition) for job in jobs for estimator in estimators
            for repetition in range(repetitions)]


def reduced_jobs(best: pd.DataFrame, repetitions: int = 1) -> list[Job]:
    """The detector limited to each sequence's mean number of keypoints at its best width (Figure 4.12).

    best: the table of `results.best_widths`.
    """
    return [Job(name, "reduced", max_keypoints=_whole(number), repetition=repetition)
            for name, number in best["mean_keypoints"].items() for repetition in range(repetitions)]


def keypoint_control_jobs(keypoints: Mapping[str, float], kitti: Path, frames: int | None = None,
                          repetitions: int = 1, estimators: Iterable[str] = tuple(ESTIMATORS), source: str = "",
                          width: int | None = None) -> list[Job]:
    """As many keypoints as masks leave, {sequence: number}, without a mask: the strongest, or spread out.

    "fewer" limits their number; "spread" keeps them farther apart. width: pixels, of those masks.
    """
    jobs = []
    for name, number in keypoints.items():
        distance = controls.min_distance(Sequence(kitti, name).subset(frames), number)
        jobs += keypoint_controls(name, number, distance, repetitions, estimators, source, width)
    return jobs


def keypoint_controls(name: str, number: float, distance: float, repetitions: int,
                      estimators: Iterable[str] = tuple(ESTIMATORS), source: str = "", width: int | None = None
                      ) -> list[Job]:
    """`keypoint_control_jobs` of one sequence; distance: pixels, that leaves `number` keypoints."""
    return _repeated([Job(name, "fewer", width, max_keypoints=_whole(number), source=source),
                      Job(name, "spread", width, min_distance=distance, source=source)], estimators, repetitions)


def _whole(number: float) -> int:
    return max(1, round(number))  # 0 would lift the detector's limit


def in_passes(jobs: Iterable[Job], frames: Mapping[str, int], workers: int) -> list[list[Job]]:
    """Jobs cut into lists for one pass over a sequence each, the longest first; frames: of each sequence.

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
        passes += [[job for group in some for job in group] for some in _cut(list(of_name.values()), pieces)]
    return longest_first(passes, frames)


def longest_first(passes: list[list[Job]], frames: Mapping[str, int]) -> list[list[Job]]:
    """The passes in the order in which they are to be started."""
    return sorted(passes, key=lambda jobs: -len(jobs) * frames[jobs[0].sequence])


def _cut(some: list, pieces: int) -> Iterator[list]:
    for index in range(pieces):
        yield some[index * len(some) // pieces:(index + 1) * len(some) // pieces]
