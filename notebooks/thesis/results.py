"""What chapter 4 is drawn from: its runs, their paths, and what figures say of the data.

Notebook 8 makes the runs. Finished ones are only read, so after a change of a drawing it draws all
figures again within seconds.
"""

from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from thesis import chapter4, gap, tables, thesis_tables, trainings
from thesis_repro.data import kitti
from thesis_repro.masks import KEEP
from thesis_repro.report import findings
from thesis_repro.running.files import write_text
from thesis_repro.running.settings import Settings
from thesis_repro.study import compare, runner
from thesis_repro.study.jobs import Job


def is_decisive(job: Job, tested: int) -> bool:
    """Return whether a conclusion rests on a run, so that it is made also in the embedded world.

    Each job is run once. The refined estimator decides, and Section 4.2 compares all keypoints,
    masks of the `tested` width and plainly reduced keypoints: these are repeated. The masks of
    other systems are compared on real frames only.
    """
    if job.method in KEEP:
        return False
    is_tested = job.method == "masked" and job.dilation_width == tested
    is_compared = job.method in ("baseline", "reduced") or is_tested
    return job.repetition == 0 or job.estimator == "refined" or is_compared


class Notes(NamedTuple):
    """What figures and tables say about their data."""

    note: str  # at the foot of each
    reported_as: str  # how to name the thesis's numbers beside those of the run


def notes(settings: Settings, runs: pd.DataFrame, mask_settings: str = "") -> Notes:
    """Return the notes of a run. mask_settings: those that are not the thesis's, as a text."""
    note = settings.data_note
    if mask_settings:
        note += f"; masks: {mask_settings}"
    if settings.kitti_is_embedded:
        return Notes(note, "thesis, another data set")
    frames = runs.groupby("sequence")["frames"].first()
    lengths = ", ".join(f"{name} ({count} frames)" for name, count in frames.items())
    return Notes(f"{note}; {lengths}", "thesis, complete KITTI sequences")


class Paths(NamedTuple):
    """What `chapter4.figure_paths` draws: see there."""

    truths: dict[str, np.ndarray]
    rows: dict[str, pd.DataFrame]  # {method: runs}
    positions: dict[tuple[str, str], np.ndarray]

    def figure(self, method: str) -> plt.Figure:
        """Draw the paths of one method."""
        return chapter4.figure_paths(self.truths, self.rows[method], self.positions, method)


def read_paths(settings: Settings, runs: pd.DataFrame) -> Paths:
    """Read the paths of Figures 4.6, 4.11 and 4.12 from the folder of the odometry's results.

    Those of all three methods are read for each figure, so that errors are enlarged alike.
    """
    rows = {method: compare.of_method(runs, method) for method in chapter4.METHODS}
    rows["masked"] = thesis_tables.of_chosen_width(rows["masked"])
    poses = runner.run_poses(pd.concat(rows.values()), settings.build / "odometry")
    truths = {}
    for name, frames in runs.groupby("sequence")["frames"].first().items():
        sequence = kitti.Sequence(settings.kitti, str(name)).subset(int(frames))
        truths[str(name)] = sequence.poses[:, :3, 3]
    return Paths(truths, rows, {run: path[:, :3, 3] for run, path in poses.items()})


def write_findings(
    settings: Settings, runs: pd.DataFrame, shuffled: pd.DataFrame, note: str
) -> str:
    """Write the findings of a run (see `findings.text`) beside the figures, and return them."""
    other_trainings = []
    if settings.figures_in_git:
        other_trainings = trainings.summary()
    text = findings.text(
        runs,
        compare.comparisons(runs),
        note,
        settings.kitti_is_embedded,
        gap.label_map_quality(settings.build),
        other_trainings,
        tables.procedure(runs, shuffled),
    )
    write_text(settings.figures / "findings.md", text)
    return text
