"""Which few hundred keypoints? Errors against the number of keypoints, by how they are chosen.

How it is decided. These rules were fixed before the runs that the tables show, but when a
prototype's results on the same streets were known:

1. A choice is compared with all keypoints, with the same estimator. The errors are the aligned ATE
   and the rotational RPE over one frame, as they are for every run, lost or not.
2. The ratio is formed as in `study.compare`. (It was the geometric mean with Student's t at first;
   see there why it changed. No answer of rules 4 and 5 changed with it.)
3. Runs that failed are counted beside it, not mixed in: those with a step that fails or a turn that
   no car makes (`metrics.step_errors`).
4. "As good as all keypoints" is said only if the 90 % interval (two one-sided tests at 5 %) lies
   within MARGINS, for both errors and both estimators, and no more runs failed than with all.

One rule was added when the results were known, because rule 4 also refuses choices that are better:

5. "No worse than all keypoints" asks rule 4's question of the upper end of the interval alone.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from thesis.ablations import FunctionMasks, random_keypoints
from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.mask_files import LabelMasks
from thesis_repro.odometry import THESIS
from thesis_repro.odometry.keypoints import filled, spread
from thesis_repro.report import style, texts
from thesis_repro.running import results
from thesis_repro.study import compare, jobs
from thesis_repro.study.jobs import CONTROL_WIDTH, Job
from thesis_repro.study.runner import Run, run_all
from thesis_repro.study.worth import FILL

ESTIMATORS = {name: jobs.ESTIMATORS[name] for name in ("thesis", "refined")}  # of rule 4
NUMBERS = (50, 100, 200, 400, 800)
SEEDS = (None, 1, 2, 3)  # of the shuffles
TIMED_RUNS = 5
LABELS = {
    "all": "all keypoints",
    "strongest": "the strongest",
    "random": "random ones",
    "spread": "spread over the frame",
    "mask": "the strongest on the mask",
    "filled": f"mask, filled to {FILL} a field",
}
COLUMNS = (
    "sequence",
    "choice",
    "number",
    "estimator",
    "repetition",
    "keypoints",
    "se3",
    "rotation",
    "failed",
)
MARGINS = {"se3": 1.25, "rotation": 1.1}  # a ratio between 1 / margin and margin is "as good"
NEAR = 0.8, 1.5  # of the panels that show ratios near 1 enlarged


def choices(sequence: Sequence, labels: Path) -> dict[tuple[str, int], tuple]:
    """Return {(choice, number of keypoints asked for, 0 for no limit): (settings, masks)}."""
    masks = LabelMasks(labels, sequence, CONTROL_WIDTH)
    chosen: dict[tuple[str, int], tuple] = {
        ("all", 0): (THESIS, None),
        ("mask", 0): (THESIS, masks),
        ("filled", 0): (replace(THESIS, detector=filled(FILL)), masks),
    }
    for number in NUMBERS:
        few = replace(THESIS, max_keypoints=number)
        drawn = FunctionMasks(partial(random_keypoints, sequence, number))
        chosen["strongest", number] = few, None
        chosen["random", number] = THESIS, drawn
        chosen["spread", number] = replace(THESIS, detector=spread(number)), None
        chosen["mask", number] = few, masks
    return chosen


def measure(
    sequences: Iterable[Sequence],
    labels: Path,
    folder: Path,
    processes: int = 1,
    seeds: Iterable[int | None] = SEEDS,
) -> pd.DataFrame:
    """Run all choices on sequences. Returns one row a run; finished sequences are not repeated.

    labels: a folder with one folder of label maps a sequence. folder: of the results. seeds: that
    shuffle the matched points, one run each; None leaves their order.
    """
    runs: dict[Job, Run] = {}
    made_from = {}
    for sequence in sequences:
        maps = labels / sequence.name
        made_from[sequence.name] = {
            "choices": results.digest_of_file(__file__),
            "labels": results.digest_of_files(sorted(maps.glob("*.png"))),
        }
        for (choice, number), (settings, masks) in choices(sequence, labels).items():
            for estimator, seed in product(ESTIMATORS, seeds):
                job = Job(
                    sequence.name,
                    f"{choice}-{number}",
                    estimator=estimator,
                    repetition=seed or 0,
                )
                runs[job] = sequence, job.changed(settings), masks
    table = run_all(runs, folder, made_from=made_from, processes=processes).table
    chosen = table["method"].str.rpartition("-")
    return table.assign(
        choice=chosen[0],
        number=chosen[2].astype(int),
        keypoints=table["mean_keypoints"],
        failed=compare.has_failed(table).astype(int),
    )[list(COLUMNS)]


def time_steps(sequence: Sequence, labels: Path, folder: Path, frames: int = 40) -> pd.DataFrame:
    """Return the CPU time (milliseconds) of a frame for each choice: its fastest of some runs.

    With the thesis's estimator, one thread and the mask made from its label map, without the
    network. The choices take turns, so that other programs slow all of them alike. Random choices
    are left out, because they are drawn from all detected keypoints.
    folder: that of `measure`, which is called before. Times in it are not measured again.
    """
    file = folder / sequence.name / "milliseconds.csv"
    if file.is_file():
        return pd.read_csv(file)
    cv2.setNumThreads(1)
    excerpt = sequence.subset(frames)
    timed = {key: run for key, run in choices(excerpt, labels).items() if key[0] != "random"}
    seconds: dict[tuple[str, int], list[float]] = {key: [] for key in timed}
    for _ in range(TIMED_RUNS):
        for key, (settings, masks) in timed.items():
            start = process_time()
            odometry.run(excerpt, settings, masks)
            seconds[key].append(process_time() - start)
    # whole ones: repeated measurements differ by more than a millisecond
    rows = [
        {"choice": choice, "number": number, "milliseconds": round(1000 * least / len(excerpt))}
        for (choice, number), least in ((key, min(runs)) for key, runs in seconds.items())
    ]
    times = pd.DataFrame(rows)
    results.write_table(file, times)
    return times


def table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row a choice, number, estimator and error: its ratio to all keypoints.

    runs: of `measure`. low, high: 95 %. as_good: whether the 90 % interval is within MARGINS.
    no_worse: whether its upper end is.
    """
    rows = []
    for estimator in ESTIMATORS:
        of_estimator = runs[runs["estimator"] == estimator]
        reference = of_estimator[of_estimator["choice"] == "all"]
        for (choice, number), chosen in of_estimator.groupby(["choice", "number"], sort=False):
            for error, margin in MARGINS.items():
                ratios = compare.ratios(chosen, reference, error)
                numbers = compare.typical_ratio(ratios)
                row = {
                    "choice": choice,
                    "number": number,
                    "keypoints": chosen["keypoints"].mean(),
                    "estimator": estimator,
                    "error": error,
                    **{name: numbers[name] for name in ("ratio", "low", "high", "n", "above")},
                    "failed": int(chosen["failed"].sum()),
                    "runs": len(chosen),
                    **within(ratios, margin),
                }
                rows.append(row)
    return pd.DataFrame(rows)


def within(ratios: pd.Series, margin: float) -> dict[str, bool]:
    """Say whether one-sided tests at 5 % place the ratio within the margin (rules 4, 5)."""
    _, low, high = compare.typical_interval(np.log(ratios), level=90)  # NaN for few sequences
    is_below = bool(high < np.log(margin))
    return {"as_good": is_below and bool(low > -np.log(margin)), "no_worse": is_below}


def summary(rows: pd.DataFrame, times: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return one row a choice and number, for readers. rows: of `table`; times: `time_steps`."""
    lines = []
    milliseconds = pd.Series(dtype=float)
    if times is not None:
        milliseconds = times.set_index(["choice", "number"])["milliseconds"]
    for (choice, number), chosen in rows.groupby(["choice", "number"], sort=False):
        line: dict[str, Any] = {
            "keypoints": f"{chosen['keypoints'].iloc[0]:.0f}",
            "how chosen": LABELS[choice],
        }
        for row in chosen.itertuples():
            name = f"{compare.METRICS[row.error]}, {ESTIMATORS[row.estimator]}"
            ratio, low, high = map(texts.number, (row.ratio, row.low, row.high))
            line[name] = f"{ratio} ({low}-{high}), {row.above} of {row.n}"
        for estimator, of_estimator in chosen.groupby("estimator", sort=False):
            failed, runs = of_estimator[["failed", "runs"]].iloc[0]
            line[f"failed, {ESTIMATORS[estimator]}"] = f"{failed} of {runs}"
        if times is not None:
            line["CPU time a frame (ms)"] = milliseconds.get((choice, number))
        line["as good"] = _answer(rows, choice, number, "as_good")
        line["no worse"] = _answer(rows, choice, number, "no_worse")
        lines.append(line)
    return pd.DataFrame(lines)


def _answer(rows: pd.DataFrame, choice: str, number: int, rule: str) -> str:
    """Return "yes" if a rule, a column of `table`, holds for both errors and both estimators."""
    chosen = rows[(rows["choice"] == choice) & (rows["number"] == number)]
    reference = rows[rows["choice"] == "all"].set_index(["estimator", "error"])["failed"]
    failed = chosen.set_index(["estimator", "error"])["failed"]
    if choice != "all" and chosen[rule].all() and (failed <= reference).all():
        return "yes"
    return ""


def figure(rows: pd.DataFrame, times: pd.DataFrame | None = None) -> Figure:
    """Draw the ratios of both errors against the number of keypoints, and the time of a frame.

    Ratios near 1 are drawn once more, enlarged; arrows there mark intervals that are cut. rows: of
    `table`. times: of `time_steps`, drawn below the errors if given.
    """
    more = times is not None
    scales = [(error, near) for error in MARGINS for near in (False, True)]
    drawing, panels = style.new_figure(
        len(scales) + more, len(ESTIMATORS), sharex=True, height=9 + 1.6 * more
    )
    for panel_row, (error, near) in zip(panels, scales, strict=False):
        for panel, estimator in zip(panel_row, ESTIMATORS, strict=True):
            shown = rows[(rows["error"] == error) & (rows["estimator"] == estimator)]
            _draw_curves(panel, shown, near)
            title = f"{compare.METRICS[error]}, {ESTIMATORS[estimator]}"
            panel.set_title(f"the same, {NEAR[0]} to {NEAR[1]}" if near else title)
            if not near:
                style.ratio_axis(panel.yaxis, rows[["ratio", "low", "high"]].to_numpy())
        panel_row[0].set_ylabel("ratio to all keypoints")
    if times is not None:
        numbers = rows.drop_duplicates(["choice", "number"])[["choice", "number", "keypoints"]]
        timed = times.merge(numbers, on=["choice", "number"])
        _draw_times(panels[-1, 0], timed)
        panels[-1, 1].axis("off")
    for panel in (panels[-1, 0], panels[len(scales) - 1, -1]):
        panel.set_xlabel("keypoints a frame")
        panel.tick_params(labelbottom=True)
    style.legend_below(drawing, panels.ravel()[:1], 3)
    return drawing


def _draw_times(panel: plt.Axes, timed: pd.DataFrame) -> None:
    for index, choice in enumerate(LABELS):
        of_choice = timed[timed["choice"] == choice].sort_values("keypoints")
        look = style.line_style(index)
        panel.plot(of_choice["keypoints"], of_choice["milliseconds"], marker="o", **look)
        if choice == "all":
            (place,) = of_choice[["keypoints", "milliseconds"]].to_numpy()
            panel.annotate("all", place, (-8, 0), textcoords="offset points", ha="right")
    panel.set_ylabel("CPU time a frame (ms)")
    panel.set_ylim(0)


def _draw_curves(panel: plt.Axes, rows: pd.DataFrame, near: bool) -> None:
    panel.axhline(1, color=style.GRAY, linewidth=0.8)
    for index, (choice, label) in enumerate(LABELS.items()):
        of_choice = rows[rows["choice"] == choice].sort_values("keypoints")
        if choice == "all":
            continue
        look = style.line_style(index)
        position = of_choice["keypoints"] * 1.03 ** (index - 3)  # side by side
        panel.plot(position, of_choice["ratio"], marker="o", markersize=4, label=label, **look)
        panel.vlines(
            position, of_choice["low"], of_choice["high"], color=look["color"], linewidth=0.9
        )
        if near:
            inside = of_choice["ratio"].between(*NEAR)
            cut_low, cut_high = inside & (of_choice["low"] < NEAR[0]), of_choice["high"] > NEAR[1]
            for edge, marker, cut in zip(NEAR, "v^", (cut_low, inside & cut_high), strict=True):
                for place in position[cut]:
                    mark: dict[str, Any] = {"color": look["color"], "markersize": 4}
                    panel.plot(place, edge, marker, clip_on=False, **mark)
    if near:
        panel.set_ylim(*NEAR)
    panel.set_xscale("log")
    panel.set_xticks([50, 100, 200, 400, 800, 1900], ["50", "100", "200", "400", "800", "1900"])
    panel.minorticks_off()
