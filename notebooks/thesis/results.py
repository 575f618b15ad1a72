"""What chapter 4 is drawn from: its runs, their paths, and what figures say of the data.

Notebook 8 makes the runs. Finished ones are only read, so after a change of a drawing it draws all
figures again within seconds.
"""

from typing import Any

import matplotlib.pyplot as plt
import pandas as pd

from thesis import chapter4, domain_gap, tables, trainings
from thesis_repro.data import kitti
from thesis_repro.report import findings, style, texts
from thesis_repro.running.files import write_text
from thesis_repro.running.settings import Settings
from thesis_repro.study import compare, runner
from thesis_repro.study.jobs import CONTROL_WIDTH, Job
from thesis_repro.study.methods import AS_SLAM_SYSTEMS


def is_decisive(job: Job, tested: int) -> bool:
    """Return whether a run is made in the embedded world, where no conclusion rests on the others.

    Each job is run once. Section 4.2 compares all keypoints, masks of the `tested` width and
    plainly reduced keypoints: these are repeated. The masks that published systems use
    (`methods.AS_SLAM_SYSTEMS`) are compared on real frames only.
    """
    if job.method in AS_SLAM_SYSTEMS:
        return False
    is_tested = job.method == "masked" and job.dilation_width == tested
    is_compared = job.method in ("baseline", "reduced") or is_tested
    return job.repetition == 0 or is_compared


def notes(settings: Settings, runs: pd.DataFrame, mask_settings: dict[str, Any]) -> tuple[str, str]:
    """Return what stands at the foot of figures and tables, and how to name the thesis's numbers.

    mask_settings: those that are not the thesis's.
    """
    note = settings.data_note
    if mask_settings:
        changed = ", ".join(f"{name} {value}" for name, value in mask_settings.items())
        note += f"; masks: {changed}"
    if settings.kitti_is_embedded:
        return note, "thesis, another data set"
    frames = runs.groupby("sequence")["frames"].first()
    lengths = ", ".join(f"{name} ({count} frames)" for name, count in frames.items())
    return f"{note}; {lengths}", "thesis, complete KITTI sequences"


def figure_paths(settings: Settings, methods: dict[str, pd.DataFrame], method: str) -> plt.Figure:
    """Figures 4.6, 4.11, 4.12: the paths of one method, read from the odometry's results.

    methods: {one of `chapter4.METHODS`: its runs}. The paths of all three are read for each figure,
    so that errors are enlarged alike.
    """
    runs = pd.concat(methods.values())
    poses = runner.run_poses(runs, settings.build / "odometry")
    truths = {}
    for name, frames in runs.groupby("sequence")["frames"].first().items():
        sequence = kitti.Sequence(settings.kitti, str(name)).subset(int(frames))
        truths[str(name)] = sequence.poses[:, :3, 3]
    positions = {run: path[:, :3, 3] for run, path in poses.items()}
    return chapter4.figure_paths(truths, methods[method], positions)


def write_findings(
    settings: Settings, runs: pd.DataFrame, shuffled: pd.DataFrame, note: str
) -> str:
    """Write the findings of a run (see `findings.text`) beside the figures, and return them."""
    procedure = pd.DataFrame(tables.procedure(runs, shuffled))
    shown = {
        "error": procedure["name"],
        "mean change (%)": procedure["mean"].round(1),
        "median (%)": procedure["median"].round(1),
        "improved": procedure["improved"].astype(str) + f" of {procedure['sequences'][0]}",
        "with a failed run": procedure["failed"],
        "means of all repetitions (%)": _range(procedure, "lowest", "highest"),
        "null: mean (%)": procedure["null_mean"].round(1),
        "null: middle (%)": _range(procedure, "null_low", "null_high"),
        "null: improved": procedure["null_improved"].round(1),
    }
    quality = pd.DataFrame(domain_gap.label_map_quality(settings.build))
    columns = ["domain", "images", "classes", "mean_iou", "seen"]
    label_maps = [style.markdown(quality[columns].round(3))] if len(quality) else []
    of_trainings = trainings.summary() if settings.figures_in_git else None
    more = texts.render(
        "findings_of_thesis.md.j2",
        widths=procedure["widths"][0],
        studies=procedure["studies"][0],
        level=compare.LEVEL,
        procedure=style.markdown(pd.DataFrame(shown)),
        label_maps=label_maps,
        trainings=[] if of_trainings is None else [style.markdown(of_trainings)],
        count=trainings.read()["training"].nunique(),
        thesis_width=CONTROL_WIDTH,
    )
    embedded = settings.kitti_is_embedded
    text = findings.text(runs, compare.comparisons(runs), note, embedded, more)
    write_text(settings.figures / "findings.md", text)
    return text


def _range(table: pd.DataFrame, low: str, high: str) -> list[str]:
    return [f"{row[low]:+.1f} to {row[high]:+.1f}" for _, row in table.iterrows()]
