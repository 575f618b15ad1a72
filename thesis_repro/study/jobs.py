"""The odometry runs of a study, as a list of jobs.

Chapter 4 runs every sequence with all keypoints, with masks of each width and with a reduced number
of keypoints. The controls test whether it is the segmentation that helps. `reduced_jobs` and
`keypoint_control_jobs` need the number of keypoints that masks leave, so they are made once the
masked runs are done.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import THESIS, OdometrySettings, estimators
from thesis_repro.study import controls
from thesis_repro.study.sources import Source

# Pixels: the dilation width of Section 3.6 and Figures 3.6 and 4.5, at which masks are tested. It
# was fixed before any run. (The code of appendix A.8 dilates by 5, audit row 26.)
CONTROL_WIDTH = 10
# the second varies far less
# {name: title} of the estimators that studies compare
ESTIMATORS = {
    name: estimator.title
    for name, estimator in estimators.ESTIMATORS.items()
    if estimator.is_compared
}
KEYPOINT_CONTROLS = ("fewer", "spread")  # as many keypoints as masks leave, without a mask
UNMASKED = ("baseline", "reduced", *KEYPOINT_CONTROLS)
PIECES = 4  # passes for each of several workers


@dataclass(frozen=True)
class Job:
    """One run of the odometry over one sequence. The defaults are the thesis's settings.

    method: "baseline", "masked" or "reduced" as in the thesis, or one of the controls.
    dilation_width: pixels, for masks from label maps; for KEYPOINT_CONTROLS, the width of the masks
    that leave as many keypoints. source: name of the source of the masks, or of the masks that gave
    the number of keypoints; empty if there is only one source. max_keypoints, min_distance
    (pixels): limits of the detector.
    estimator: "thesis" or "refined", see OdometrySettings.
    repetition: 0 is the thesis's single run; any other number is the seed that shuffles the matched
    points.
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
        """The name of the run's file, unique in its sequence: masked-05-0,
        mine/mirrored-10-refined-1, spread-7.5-0.
        """
        has_no_mask = self.dilation_width is None or self.method in UNMASKED
        width = None if has_no_mask else f"{self.dilation_width:02d}"
        distance = None if self.min_distance is None else f"{self.min_distance:g}"
        estimator = None if self.estimator == "thesis" else self.estimator
        parts = (self.method, width, self.max_keypoints, distance, estimator, self.repetition)
        name = "-".join(str(part) for part in parts if part is not None)
        return f"{self.source}/{name}" if self.source else name

    @property
    def settings(self) -> OdometrySettings:
        """The thesis's settings of the odometry, with the changes that the job asks for."""
        changes: dict[str, Any] = {
            "max_keypoints": self.max_keypoints,
            "min_distance": self.min_distance,
            "shuffle_seed": self.repetition or None,
            "estimator": self.estimator,
            "fallback": self.method == "fallback",
        }
        return replace(
            THESIS, **{name: value for name, value in changes.items() if value is not None}
        )

    def masks(
        self, sequence: Sequence, sources: Mapping[str, Source]
    ) -> controls.ControlMasks | None:
        """Return the job's masks, or None for a job without masks. sources: by name."""
        if self.method in UNMASKED:
            return None
        return controls.masks(self.method, sources[self.source], sequence, self.dilation_width)


def first_jobs(
    sequences: Iterable[Sequence],
    widths: Mapping[str, Iterable[int]],
    *,
    tested: int | None = None,
    sources: Iterable[Source] = (Source(Path()),),
    repetitions: int = 1,
) -> list[Job]:
    """Return the jobs that need no other results: all keypoints, masks of every width, and controls
    that are masks.

    widths: pixels, for masks from label maps, by estimator: {"thesis":
    range(1, 16)}.
    tested: width (pixels) of the controls, None for no controls; it is added to the widths of every
    estimator.
    sources: of masks. All keypoints are run once for all sources.
    """
    jobs: list[Job] = []
    for sequence in sequences:
        name = sequence.name
        jobs += _repeated([Job(name, "baseline")], widths, repetitions)
        for source in sources:
            has_widths = source.kind == "labels"
            all_widths = (
                sorted(set().union(*widths.values(), [tested] if tested else []))
                if has_widths
                else [None]
            )
            for width in all_widths:
                estimators = [
                    estimator
                    for estimator, requested_widths in widths.items()
                    if width in (None, tested) or width in requested_widths
                ]
                jobs += _repeated(
                    [Job(name, "masked", width, source=source.name)], estimators, repetitions
                )
            for method in controls.MASK_CONTROLS if tested else ():
                if method in controls.OF_LABEL_MAPS and not has_widths:
                    continue
                if (
                    method == "true-labels"
                    and not controls.true_labels(sequence.root, name).is_dir()
                ):
                    continue
                jobs += _repeated(
                    [Job(name, method, tested if has_widths else None, source=source.name)],
                    widths,
                    repetitions,
                )
    return jobs


def _repeated(jobs: Iterable[Job], estimators: Iterable[str], repetitions: int) -> list[Job]:
    return [
        replace(job, estimator=estimator, repetition=repetition)
        for job in jobs
        for estimator in estimators
        for repetition in range(repetitions)
    ]


def reduced_jobs(best: pd.DataFrame, repetitions: int = 1) -> list[Job]:
    """Return jobs that limit the detector to each sequence's mean number of keypoints at its best
    width (Figure 4.12).

    best: the table of `thesis_tables.best_widths`.
    """
    # OpenCV takes 0 as "no limit"
    return _repeated(
        [
            Job(name, "reduced", max_keypoints=max(1, round(number)))
            for name, number in best["mean_keypoints"].items()
        ],
        ["thesis"],
        repetitions,
    )


def keypoint_control_jobs(
    keypoints: Mapping[str, float],
    sequences: Iterable[Sequence],
    repetitions: int = 1,
    estimators: Iterable[str] = tuple(ESTIMATORS),
    source: str = "",
    width: int | None = None,
) -> list[Job]:
    """Return jobs without a mask that keep as many keypoints as masks leave.

    "fewer" keeps the strongest keypoints; "spread" keeps keypoints farther apart.
    keypoints: {sequence: mean number that masks leave}. width: of these masks, pixels.
    """
    jobs: list[Job] = []
    for sequence in sequences:
        name = sequence.name
        if name not in keypoints:  # its runs with masks failed
            continue
        number = keypoints[name]
        distance = controls.min_distance(sequence, number)
        jobs += _repeated(
            [
                Job(name, "fewer", width, max_keypoints=max(1, round(number)), source=source),
                Job(name, "spread", width, min_distance=distance, source=source),
            ],
            estimators,
            repetitions,
        )
    return jobs


def in_passes(
    jobs: Iterable[Job], sequences: Mapping[str, Sequence], workers: int
) -> list[list[Job]]:
    """Divide jobs into lists, each for one pass over a sequence. sequences: by name.

    Each of several workers gets about PIECES passes, so that all end at about the same time. Jobs
    with the same keypoints stay in one pass, where they share most of their work, unless that would
    leave workers without one. A single worker gets one pass a sequence.
    """
    jobs = list(jobs)
    unshared: dict[str, Any] = {"estimator": "", "repetition": 0}
    if len({replace(job, **unshared) for job in jobs}) < workers:
        unshared = {"estimator": ""}
    groups: dict[str, dict[Job, list[Job]]] = {}
    for job in jobs:
        keypoints = replace(job, **unshared)
        groups.setdefault(job.sequence, {}).setdefault(keypoints, []).append(job)
    total = sum(len(job_lists) * len(sequences[name]) for name, job_lists in groups.items())
    passes = []
    for name, by_keypoints in groups.items():
        job_lists = list(by_keypoints.values())
        size = (
            max(1, round(total / (PIECES * workers) / len(sequences[name])))
            if workers > 1
            else len(job_lists)
        )
        passes += [
            sum(job_lists[start : start + size], []) for start in range(0, len(job_lists), size)
        ]
    return passes
