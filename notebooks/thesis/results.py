"""Chapter 4 drawn from saved tables: figures, tables, the comparison and the findings.

Notebook 8 shows them one by one and saves the tables of runs. `python -m thesis.results`, with the
folder notebooks in PYTHONPATH, draws all of them again, so a change of a drawing needs no run.
"""

from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from thesis import chapter4, gap, plots, tables, thesis_tables, timing, trainings
from thesis_repro.data import kitti
from thesis_repro.report import comparison, findings, style
from thesis_repro.running import messages
from thesis_repro.running.files import needed, write_text
from thesis_repro.running.settings import Settings, read_settings
from thesis_repro.study import compare, runner

PATHS = {"figure_4_06": "baseline", "figure_4_11": "masked", "figure_4_12": "reduced"}


def read_runs(settings: Settings, name: str = "runs") -> pd.DataFrame:
    """Read a table of runs from the build folder: "runs" or "shuffled_runs", to the bit."""
    path = needed(settings.build / f"{name}.csv", "08_results")
    texts = {"sequence": str, "source": str}
    runs = pd.read_csv(path, dtype=texts, float_precision="round_trip")
    return runs.fillna({"source": ""})


class Notes(NamedTuple):
    """What figures and tables say about their data."""

    note: str  # at the foot of each
    reported_as: str  # how to name the thesis's numbers beside those of the run


def notes(settings: Settings, runs: pd.DataFrame) -> Notes:
    """Return the notes of a run."""
    if settings.kitti_is_embedded:
        return Notes(settings.data_note, "thesis, another data set")
    frames = runs.groupby("sequence")["frames"].first()
    lengths = ", ".join(f"{name} ({count} frames)" for name, count in frames.items())
    return Notes(f"{settings.data_note}; {lengths}", "thesis, complete KITTI sequences")


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


def findings_text(settings: Settings, runs: pd.DataFrame, shuffled: pd.DataFrame) -> str:
    """Return the findings of a run (see `findings.text`)."""
    other_trainings = []
    if settings.figures_in_git:
        other_trainings = trainings.summary()
    return findings.text(
        runs,
        compare.comparisons(runs),
        notes(settings, runs).note,
        settings.kitti_is_embedded,
        gap.label_map_quality(settings.build),
        other_trainings,
        tables.procedure(runs, shuffled),
    )


@style.applied()
def write(settings: Settings) -> None:
    """Write the figures and tables of chapter 4 and the findings of a finished run."""
    runs, shuffled = read_runs(settings), read_runs(settings, "shuffled_runs")
    note, reported_as = notes(settings, runs)
    compared = compare.comparisons(runs)
    figures = {
        "figure_4_07": chapter4.figure_4_07(runs),
        "figure_4_09": chapter4.figure_against_width(runs, "rmse"),
        "figure_4_10": chapter4.figure_against_width(runs, "mae"),
        "figure_4_13": chapter4.figure_of_methods(runs, "rmse"),
        "figure_4_14": chapter4.figure_of_sequences(runs, "rmse"),
        "figure_4_15": chapter4.figure_of_methods(runs, "mae"),
        "figure_4_16": chapter4.figure_of_sequences(runs, "mae"),
        "comparison": comparison.figure_comparison(compared),
    }
    paths = read_paths(settings, runs)
    figures |= {name: paths.figure(method) for name, method in PATHS.items()}
    numbers = {
        "table_4_1": tables.table_4_1(runs, reported_as),
        "table_4_2": tables.table_of_change(runs, shuffled, "rmse", reported_as),
        "table_4_3": tables.table_of_change(runs, shuffled, "mae", reported_as),
        "widths": comparison.table_widths(runs),
        "comparison": comparison.table_comparison(compared),
    }
    style.save_all(figures, numbers, settings.figures, note)
    text = findings_text(settings, runs, shuffled)
    write_text(settings.figures / "findings.md", text)
    _write_timings(settings, note)
    history = settings.build / "model" / "history.csv"
    if history.is_file():  # a run with the model of the package has none
        figure_4_01 = plots.figure_4_01(pd.read_csv(history))
        style.save_all({"figure_4_01": figure_4_01}, {}, settings.figures, settings.data_note)


def _write_timings(settings: Settings, note: str) -> None:
    """Write Figure 4.17 and the table of the time of a frame, from the recorded times."""
    timings = timing.folder(settings)
    seconds = pd.read_csv(timings / "seconds.csv", dtype={"sequence": str})
    measured = pd.read_csv(timings / "budget.csv")
    timed_on = f"{note}; timed on {seconds['processor'].iloc[0]}"
    style.save_all({"figure_4_17": plots.figure_4_17(seconds)}, {}, settings.figures, timed_on)
    budget = tables.table_budget(measured)
    timed_on = f"{note}; timed on {measured['processor'].iloc[0]}"
    style.save_table(budget, settings.figures, "budget", timed_on)


if __name__ == "__main__":
    messages.run_main(lambda: write(read_settings()))
