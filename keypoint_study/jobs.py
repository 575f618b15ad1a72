"""The odometry runs of a study, as a list of jobs.

Chapter 4 runs every sequence with all keypoints, with masks of each width and with a reduced number
of keypoints. The controls test whether it is the segmentation that helps. Those without a mask need
the number of keypoints that masks leave, so they are made once the masked runs are done
(`runner.keypoint_controls`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from keypoint_study.methods import MASK_CONTROLS, OF_LABEL_MAPS
from keypoint_study.sources import UNMASKED, Source
from thesis_repro.data.kitti import TRUE_LABELS, Sequence
from thesis_repro.odometry import OdometrySettings, estimators

# Pixels: the dilation width of Section 3.6 and Figures 3.6 and 4.5, at which masks are tested. It
# was fixed before any run. (The code of appendix A.8 dilates by 5, audit row 26.)
CONTROL_WIDTH = 10
# {name: title}
ESTIMATORS = {name: estimator.title for name, estimator in estimators.ESTIMATORS.items()}
# Passes for each of several workers. Every pass decodes and tracks anew: a sequence on two workers
# takes 13 % more CPU time than in one pass, and with 4 pieces 35 %.
PIECES = 2


@dataclass(frozen=True)
class Job:
    """One run of the odometry over one sequence. The defaults are the thesis's settings.

    method: one of METHODS.
    dilation_width: pixels, for masks from label maps; for "fewer" and "spread", the width of the
    masks that leave as many keypoints. source: name of the source of the masks, or of the masks
    that gave the number of keypoints; empty if there is only one source. max_keypoints,
    min_distance (pixels): limits of the detector.
    estimator: one of estimators.ESTIMATORS.
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
        """The name of the run's file, unique in its sequence.

        Examples: masked-05-0, mine/mirrored-10-refined-1, spread-7.5-0.
        """
        parts = [self.method]
        limits = (self.max_keypoints, self.min_distance)
        if self.dilation_width is not None and limits == (None, None):
            parts.append(f"{self.dilation_width:02d}")
        parts += [f"{limit:g}" for limit in limits if limit is not None]
        if self.estimator != "thesis":
            parts.append(self.estimator)
        parts.append(str(self.repetition))
        name = "-".join(parts)
        if self.source:
            return f"{self.source}/{name}"
        return name

    def changed(self, settings: OdometrySettings) -> OdometrySettings:
        """Return settings of the odometry with the changes that the job asks for."""
        changes: dict[str, Any] = {
            "estimator": estimators.ESTIMATORS[self.estimator].make,
            "max_keypoints": self.max_keypoints,
            "min_distance": self.min_distance,
            "shuffle_seed": self.repetition or None,
        }
        given = {name: value for name, value in changes.items() if value is not None}
        return replace(settings, **given)


def first_jobs(
    sequences: Iterable[Sequence],
    widths: Mapping[str, Iterable[int]],
    *,
    tested: int | None = None,
    sources: Iterable[Source] = (Source(Path()),),
    repetitions: int = 1,
) -> list[Job]:
    """Return the jobs that need no other results.

    These are all keypoints, masks of every width, and the controls that are masks.
    widths: pixels, for masks from label maps, by estimator: {"thesis": range(1, 16)}.
    tested: width (pixels) of the controls, None for no controls; it is added to the widths of every
    estimator.
    sources: of masks, keypoints or paths. All keypoints are run once for all sources.
    """
    all_widths = set(chain(*widths.values()))
    if tested:
        all_widths.add(tested)
    jobs: list[Job] = []
    for sequence in sequences:
        jobs.append(Job(sequence.name, "baseline"))
        for source in sources:
            if source.kind in UNMASKED:
                jobs.append(Job(sequence.name, source.kind, source=source.name))
                continue
            masks = Job(sequence.name, "masked", source=source.name)
            of_source = sorted(all_widths) if source.has_width else [None]
            jobs += [replace(masks, dilation_width=width) for width in of_source]
            if tested:
                controls = mask_controls(source, sequence, tested).items()
                jobs += [
                    replace(masks, method=name, dilation_width=width) for name, width in controls
                ]
    return [
        job
        for job in repeated(jobs, widths, repetitions)
        # a path has nothing to shuffle
        if (job.method != "paths" or job.repetition == 0)
        and (job.method != "masked" or job.dilation_width in (None, tested, *widths[job.estimator]))
    ]


def mask_controls(source: Source, sequence: Sequence, width: int | None) -> dict[str, int | None]:
    """Return {method: its width} of the controls that are masks, which a source allows.

    width: pixels, of masks from label maps.
    """
    allowed = {
        method: width if source.has_width or method in OF_LABEL_MAPS else None
        for method in MASK_CONTROLS
        if source.has_label_maps or method not in OF_LABEL_MAPS
    }
    if not (sequence.folder / TRUE_LABELS).is_dir():
        allowed.pop("true-labels", None)
    return allowed


def repeated(jobs: Iterable[Job], estimators: Iterable[str], repetitions: int) -> list[Job]:
    """Return jobs with each estimator and repetition."""
    return [
        replace(job, estimator=estimator, repetition=repetition)
        for job in jobs
        for estimator in estimators
        for repetition in range(repetitions)
    ]


def in_passes(
    jobs: Iterable[Job], sequences: Mapping[str, Sequence], workers: int
) -> list[list[Job]]:
    """Divide jobs into lists, each for one pass over a sequence. sequences: by name.

    Each of several workers gets about PIECES passes, so that all end at about the same time. Jobs
    with the same keypoints stay in one pass, where they share most of their work. A single worker
    gets one pass a sequence. Own keypoints and paths share nothing.
    """
    groups: dict[Job, list[Job]] = {}
    passes: list[list[Job]] = []
    for job in jobs:
        if job.method in UNMASKED:
            passes.append([job])
            continue
        same_keypoints = replace(job, estimator="", repetition=0)
        groups.setdefault(same_keypoints, []).append(job)
    # work is measured in frames, of which a group of jobs reads each once
    work = sum(len(sequences[key.sequence]) for key in groups)
    for name, sequence in sequences.items():
        groups_of_sequence = [group for key, group in groups.items() if key.sequence == name]
        size = len(groups) or 1
        if workers > 1:
            size = max(1, round(work / (PIECES * workers) / len(sequence)))
        starts = range(0, len(groups_of_sequence), size)
        passes += [list(chain(*groups_of_sequence[start : start + size])) for start in starts]
    return passes
