"""Which few hundred keypoints? Errors against the number of keypoints, by how they are chosen.

A choice is compared with all keypoints, with the same estimator. The errors are the aligned ATE and
the rotational RPE over one frame, as they are for every run, lost or not. Sequences on which a
choice fails are counted beside the ratio, not mixed in. The verdict (`verdicts.verdict_on_few`) is
that of both errors and both estimators together. Its rule was fixed before the runs that the tables
show, but when a prototype's results on the same streets were known.
"""

from collections.abc import Collection, Iterable
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from keypoint_study import comparisons, jobs, ratios
from keypoint_study.jobs import Job, repeated, runs_of
from keypoint_study.methods import FEW, METHODS, of_group
from keypoint_study.report import style, texts
from keypoint_study.runner import run_all
from keypoint_study.sources import Source
from keypoint_study.verdicts import verdict_on_few
from thesis_repro import odometry
from thesis_repro.data.sequence import Sequence

COMPARED = {name: jobs.ESTIMATOR_TITLES[name] for name in ("thesis", "refined")}  # of the verdict
NUMBERS = (50, 100, 200, 400, 800)
REPETITIONS = 4  # three of them with the matched points shuffled
TIMED_RUNS = 5
# {method: its name in the tables}, if that is another one
CALLED = {"baseline": "all", "strongest-on": "mask", "spread-anywhere": "spread"}
# {name in the tables: title}
LABELS = {CALLED.get(name, name): METHODS[name].title for name in ("baseline", *of_group(FEW))}
# choices and numbers (0: no limit) of notebook 8, which compares them at one number
AT_200 = (
    ("all", 0),
    *((name, 200) for name in ("strongest", "random", "spread", "mask", "random-on")),
)
# those that are run with every second frame, too
EVERY_SECOND = (("all", 0), ("mask", 0), ("spread", 200))
NEAR = 0.8, 1.5  # of the panels that show ratios near 1 enlarged


def jobs_of(sequence: Sequence) -> dict[tuple[str, int], Job]:
    """Return {(choice, number of keypoints asked for, 0 for no limit): a job}."""
    few = of_group(FEW)
    asked = [("baseline", 0), ("strongest-on", 0)]
    asked += [(name, 0) for name in few if not METHODS[name].numbered]
    each = [name for name in few if METHODS[name].numbered and name != "random-on"]
    asked += [(name, number) for number in NUMBERS for name in each]
    asked.append(("random-on", 200))
    return {
        (CALLED.get(name, name), number): Job(sequence.name, name, max_keypoints=number)
        for name, number in asked
    }


def run_few(
    sequences: Iterable[Sequence],
    labels: Path,
    folder: Path,
    processes: int = 1,
    repetitions: int = REPETITIONS,
    only: Collection[tuple[str, int]] = (),
) -> pd.DataFrame:
    """Run all choices on sequences. Returns one row a run; finished runs are not repeated.

    labels: a folder with one folder of label maps a sequence. folder: of the results. only:
    (choice, number) of those that are run, all if none.
    """
    sequences = list(sequences)
    listed = [
        job
        for sequence in sequences
        for key, job in jobs_of(sequence).items()
        if not only or key in only
    ]
    runs = runs_of(repeated(listed, COMPARED, repetitions), sequences, [Source(labels)])
    table = run_all(runs, folder, processes=processes).table
    table = table.assign(
        choice=table["method"].replace(CALLED),
        number=table["max_keypoints"],
        keypoints=table["mean_keypoints"],
        failed=ratios.has_failed(table).astype(int),
    )
    what = ["sequence", "choice", "number", "estimator", "repetition", "keypoints"]
    return table[[*what, *comparisons.JUDGING_METRICS, "failed"]]


def time_steps(sequence: Sequence, labels: Path, frames: int = 40) -> pd.DataFrame:
    """Return the CPU time (milliseconds) of a frame for each choice: its fastest of some runs.

    With the thesis's estimator, one thread and the mask made from its label map, without the
    network. The choices take turns, so that other programs slow all of them alike. Random choices
    are left out, because they are drawn from all detected keypoints.
    """
    cv2.setNumThreads(1)
    excerpt = sequence.subset(frames)
    timed = {key: job for key, job in jobs_of(excerpt).items() if key[0] != "random"}
    runs: dict[Job, Any] = runs_of(timed.values(), [excerpt], [Source(labels)])
    least = dict.fromkeys(timed, np.inf)
    for _, (key, job) in product(range(TIMED_RUNS), timed.items()):
        start = process_time()
        odometry.run(excerpt, runs[job].settings, runs[job].masks)
        least[key] = min(least[key], process_time() - start)
    # whole milliseconds: repeated measurements differ by more than one
    times = (1000 * pd.Series(least) / len(excerpt)).round().astype(int)
    return times.rename_axis(["choice", "number"]).rename("milliseconds").reset_index()


def ratios_to_all(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row a choice, number, estimator and error: its ratio to all keypoints.

    runs: of `run_few`. low, high: of the interval. verdict: see `verdict_on`.
    """
    rows = []
    reference = runs[runs["choice"] == "all"]
    for (choice, number), chosen in runs.groupby(["choice", "number"], sort=False):
        word = "" if choice == "all" else verdict_on(chosen, reference)
        for estimator, of_estimator in chosen.groupby("estimator", sort=False):
            of_all = reference[reference["estimator"] == estimator]
            failed = of_estimator.set_index("sequence")["failed"] > 0
            for error in comparisons.JUDGING_METRICS:
                numbers = ratios.typical_ratio(ratios.ratios_of(of_estimator, of_all, error))
                row = {
                    "choice": choice,
                    "number": number,
                    "keypoints": of_estimator["keypoints"].mean(),
                    "estimator": estimator,
                    "error": error,
                    **{name: numbers[name] for name in ("ratio", "low", "high", "n", "above")},
                    "failed": ratios.count_failing(failed),
                    "verdict": word,
                }
                rows.append(row)
    return pd.DataFrame(rows)


def verdict_on(chosen: pd.DataFrame, reference: pd.DataFrame) -> str:
    """Return the verdict on some runs, compared with those of all keypoints.

    Both have the columns sequence, estimator, failed, and those of comparisons.JUDGING_METRICS.
    """
    narrow, fails_more, counts = [], False, []
    for estimator in COMPARED:
        arms = [rows[rows["estimator"] == estimator] for rows in (chosen, reference)]
        failing = [
            ratios.failing_sequences(rows.set_index("sequence")["failed"] > 0) for rows in arms
        ]
        fails_more |= failing[0] > failing[1]
        for error in comparisons.JUDGING_METRICS:
            of_streets = ratios.ratios_of(arms[0], arms[1], error)
            counts.append(len(of_streets))
            narrow.append((error, *ratios.narrow_interval(of_streets)))
    return verdict_on_few(min(counts), narrow, fails_more)


def table_of_few(rows: pd.DataFrame, times: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return one row a choice and number. rows: of `ratios_to_all`; times: `time_steps`."""
    keys = ["choice", "number"]
    milliseconds = {} if times is None else times.set_index(keys)["milliseconds"]
    lines = []
    for (choice, number), chosen in rows.groupby(keys, sort=False):
        mean = chosen["keypoints"].iloc[0]
        line: dict[str, Any] = {"keypoints": f"{mean:.0f}", "how chosen": LABELS[choice]}
        for row in chosen.to_dict("records"):
            name = f"{comparisons.JUDGING_METRICS[row['error']]}, {COMPARED[row['estimator']]}"
            line[name] = f"{texts.short(row)}, {row['above']} of {row['n']}"
        for row in chosen.drop_duplicates("estimator").itertuples():
            line[f"sequences that fail, {COMPARED[row.estimator]}"] = row.failed
        if times is not None:
            line["CPU time a frame (ms)"] = milliseconds.get((choice, number))
        lines.append(line | {"verdict": chosen["verdict"].iloc[0]})
    return pd.DataFrame(lines)


def figure_of_few(rows: pd.DataFrame) -> Figure:
    """Draw the ratios of both errors against the number of keypoints. rows: of `ratios_to_all`.

    If most ratios are near 1, they are drawn once more, enlarged; arrows there mark intervals that
    are cut.
    """
    of_few = rows[rows["choice"] != "all"]
    enlarged = (False, True) if of_few["ratio"].between(*NEAR).mean() > 0.5 else (False,)
    scales = list(product(comparisons.JUDGING_METRICS, enlarged))
    height = 1 + 2 * len(scales)
    drawing, panels = style.new_figure(len(scales), len(COMPARED), sharex=True, height=height)
    for (error, near), panel_row in zip(scales, panels, strict=True):
        for panel, estimator in zip(panel_row, COMPARED, strict=True):
            shown = rows[(rows["error"] == error) & (rows["estimator"] == estimator)]
            _draw_curves(panel, shown, near)
            title = f"{comparisons.METRIC_TITLES[error]}, {COMPARED[estimator]}"
            panel.set_title(f"the same, {NEAR[0]} to {NEAR[1]}" if near else title)
            if not near:
                style.ratio_axis(panel.yaxis, rows[["ratio", "low", "high"]].to_numpy())
        panel_row[0].set_ylabel("ratio to all keypoints")
    for panel in panels[-1]:
        panel.set_xlabel("keypoints a frame")
        panel.tick_params(labelbottom=True)
    style.legend_below(drawing, panels.ravel()[:1], 3)
    return drawing


def _draw_curves(panel: plt.Axes, rows: pd.DataFrame, near: bool) -> None:
    panel.axhline(1, color=style.GRAY, linewidth=0.8)
    for index, (choice, label) in list(enumerate(LABELS.items()))[1:]:  # all keypoints are the 1
        of_choice = rows[rows["choice"] == choice].sort_values("keypoints")
        look = style.line_style(index)
        color = look["color"]
        position = of_choice["keypoints"] * 1.03 ** (index - 3)  # side by side
        panel.plot(position, of_choice["ratio"], marker="o", markersize=4, label=label, **look)
        panel.vlines(position, of_choice["low"], of_choice["high"], color=color, linewidth=0.9)
        if near:
            cut = of_choice["low"] < NEAR[0], of_choice["high"] > NEAR[1]
            inside = of_choice["ratio"].between(*NEAR)
            for edge, marker, is_cut in zip(NEAR, "v^", cut, strict=True):
                for place in position[inside & is_cut]:
                    panel.plot(place, edge, marker, clip_on=False, color=color, markersize=4)
    if near:
        panel.set_ylim(*NEAR)
    panel.set_xscale("log")
    panel.set_xticks([50, 100, 200, 400, 800, 1900], ["50", "100", "200", "400", "800", "1900"])
    panel.minorticks_off()
