"""The runs of a study, as a list of jobs.

Chapter 4 runs every sequence with all keypoints, with masks of each width and with a reduced number
of keypoints. The controls test whether it is the segmentation that helps. Those without a mask need
the number of keypoints that masks leave, so they are made once the masked runs are done
(`runner.keypoint_controls`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from keypoint_study.controls import recorded
from keypoint_study.methods import (
    CONTROL_WIDTH,
    LABEL_MAPS,
    MASK_CONTROLS,
    METHODS,
    Asked,
    changed,
)
from keypoint_study.sources import Source
from thesis_repro.data.kitti import TRUE_LABELS
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import THESIS, OdometrySettings, estimators

# {name: title}
ESTIMATOR_TITLES = {name: estimator.title for name, estimator in estimators.ESTIMATORS.items()}


@dataclass(frozen=True)
class Job:
    """One run of the odometry over one sequence. The defaults are the thesis's settings.

    method: one of METHODS.
    dilation_width: pixels, for masks from label maps, None for CONTROL_WIDTH; for "fewer" and
    "spread", the width of the masks that leave as many keypoints. source: name of the source of the
    masks, or of the masks that gave the number of keypoints; empty if there is only one source.
    max_keypoints: how many the method is asked for, 0 for no limit. min_distance: pixels, of the
    detector.
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

    def changes(self) -> dict[str, Any]:
        """Return the settings of the odometry that the job asks for."""
        asked: dict[str, Any] = {
            "estimator": estimators.ESTIMATORS[self.estimator].make,
            "min_distance": self.min_distance,
            "shuffle_seed": self.repetition or None,
        }
        return {name: value for name, value in asked.items() if value is not None}


class Run(NamedTuple):
    """A run. masks: `odometry.Masks`. brought: own keypoints."""

    sequence: Sequence
    settings: OdometrySettings
    masks: Any = None
    brought: Source | None = None


def runs_of(
    jobs: Iterable[Job],
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    settings: Mapping[str, Any] = {},
    masked_settings: Mapping[str, Any] = {},
) -> dict[Job, Run | str]:
    """Return the runs of jobs, or the reason why one cannot run, as `runner.run_all` takes them.

    sources: of the jobs. settings: changes of all runs; masked_settings: of those with masks. Masks
    with equal records are one object, by which `odometry.run_many` recognises that runs share work.
    """
    by_name = {source.name: source for source in sources}
    default = next(iter(by_name.values()))
    opened = {sequence.name: sequence for sequence in sequences}
    chosen: dict[Job, Run | str] = {}  # what jobs share that differ in estimator and shuffle alone
    known: dict[Any, Any] = {}  # masks
    runs: dict[Job, Run | str] = {}
    for job in jobs:
        alike = replace(job, estimator="thesis", repetition=0)
        if alike not in chosen:
            source = by_name.get(job.source, default)
            chosen[alike] = _choose(job, opened[job.sequence], source, known)
        run = chosen[alike]
        if not isinstance(run, str):
            of_masks = masked_settings if run.masks is not None else {}
            changes = {**settings, **job.changes(), **of_masks}
            run = run._replace(settings=changed(run.settings, changes))
        runs[job] = run
    return runs


def _choose(job: Job, sequence: Sequence, source: Source, known: dict[Any, Any]) -> Run | str:
    """Return the run of a job with its method's settings, or the reason why it cannot run.

    known: masks, by what they are made from.
    """
    if job.method == "keypoints":
        return Run(sequence, THESIS, brought=source)
    width = CONTROL_WIDTH if job.dilation_width is None else job.dilation_width
    asked = Asked(sequence, source, width, job.max_keypoints or 0)
    try:
        settings, masks = METHODS[job.method].choose(asked)
    except InputError as error:
        return str(error)
    if masks is not None:
        key = sequence.name, str(recorded(masks)), tuple(getattr(masks, "paths", ()))
        masks = known.setdefault(key, masks)
    return Run(sequence, settings, masks)


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
    sources: of masks or keypoints. All keypoints are run once for all sources.
    """
    all_widths = set(chain(*widths.values()))
    if tested:
        all_widths.add(tested)
    jobs: list[Job] = []
    for sequence in sequences:
        jobs.append(Job(sequence.name, "baseline"))
        for source in sources:
            if source.kind == "keypoints":
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
        if job.method != "masked" or job.dilation_width in (None, tested, *widths[job.estimator])
    ]


def mask_controls(source: Source, sequence: Sequence, width: int | None) -> dict[str, int | None]:
    """Return {method: its width} of the controls that are masks, which a source allows.

    width: pixels, of masks from label maps.
    """
    allowed: dict[str, int | None] = {}
    for name in MASK_CONTROLS:
        is_of_labels = METHODS[name].group == LABEL_MAPS
        if source.has_label_maps or not is_of_labels:
            allowed[name] = width if source.has_width or is_of_labels else None
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
