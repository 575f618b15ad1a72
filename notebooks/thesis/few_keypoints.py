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

from keypoint_study import compare, jobs
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.report import style, texts
from keypoint_study.worth import FILL
from thesis.ablations import FunctionMasks, random_keypoints, run_choices
from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.masks.folders import LabelMasks
from thesis_repro.odometry import THESIS
from thesis_repro.odometry.keypoints import filled, spread
from thesis_repro.running import provenance

ESTIMATORS = {name: jobs.ESTIMATORS[name] for name in ("thesis", "refined")}  # of rule 4
NUMBERS = (50, 100, 200, 400, 800)
REPETITIONS = 4  # three of them with the matched points shuffled
TIMED_RUNS = 5
LABELS = {
    "all": "all keypoints",
    "strongest": "the strongest",
    "random": "random ones",
    "spread": "spread over the frame",
    "mask": "the strongest on the mask",
    "filled": f"mask, filled to {FILL} a field",
}
ERRORS = compare.JUDGING_METRICS
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


def choices(
    sequence: Sequence, labels: Path, numbers: Iterable[int] = ()
) -> dict[tuple[str, int], tuple]:
    """Return {(choice, number of keypoints asked for, 0 for no limit): (settings, masks)}.

    numbers: NUMBERS if there are none.
    """
    masks = LabelMasks(labels, sequence, CONTROL_WIDTH)
    chosen: dict[tuple[str, int], tuple] = {
        ("all", 0): (THESIS, None),
        ("mask", 0): (THESIS, masks),
        ("filled", 0): (replace(THESIS, detector=filled(FILL)), masks),
    }
    for number in numbers or NUMBERS:
        few = replace(THESIS, max_keypoints=number)
        drawn = FunctionMasks(partial(random_keypoints, sequence, number))
        chosen |= {
            ("strongest", number): (few, None),
            ("random", number): (THESIS, drawn),
            ("spread", number): (replace(THESIS, detector=spread(number)), None),
            ("mask", number): (few, masks),
        }
    return chosen


def run_few(
    sequences: Iterable[Sequence],
    labels: Path,
    folder: Path,
    processes: int = 1,
    repetitions: int = REPETITIONS,
    numbers: Iterable[int] = (),
) -> pd.DataFrame:
    """Run all choices on sequences. Returns one row a run; finished sequences are not repeated.

    labels: a folder with one folder of label maps a sequence. folder: of the results. numbers: of
    keypoints, NUMBERS if there are none.
    """

    def named(sequence: Sequence) -> dict[str, tuple]:
        of_sequence = choices(sequence, labels, numbers).items()
        return {f"{choice}-{number}": run for (choice, number), run in of_sequence}

    table = run_choices(
        named, sequences, labels, folder, __file__, ESTIMATORS, repetitions, processes
    )
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
    folder: that of `run_few`, which is called before. Times in it are not measured again.
    """
    file = folder / sequence.name / "milliseconds.csv"
    if file.is_file():
        return pd.read_csv(file)
    cv2.setNumThreads(1)
    excerpt = sequence.subset(frames)
    timed = {key: run for key, run in choices(excerpt, labels).items() if key[0] != "random"}
    least = dict.fromkeys(timed, np.inf)
    for _, (key, (settings, masks)) in product(range(TIMED_RUNS), timed.items()):
        start = process_time()
        odometry.run(excerpt, settings, masks)
        least[key] = min(least[key], process_time() - start)
    # whole milliseconds: repeated measurements differ by more than one
    times = (1000 * pd.Series(least) / len(excerpt)).round().astype(int)
    times = times.rename_axis(["choice", "number"]).rename("milliseconds").reset_index()
    provenance.write_table(file, times)
    return times


def ratios_to_all(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row a choice, number, estimator and error: its ratio to all keypoints.

    runs: of `run_few`. low, high: 95 %. as_good: whether the 90 % interval is within MARGINS, and
    no more runs failed than with all keypoints (rule 4). no_worse: the same of its upper end
    (rule 5).
    """
    rows = []
    keys = ["choice", "number", "estimator"]
    for (choice, number, estimator), chosen in runs.groupby(keys, sort=False):
        reference = runs[(runs["choice"] == "all") & (runs["estimator"] == estimator)]
        no_more_failed = chosen["failed"].sum() <= reference["failed"].sum()
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
                "failed": f"{chosen['failed'].sum()} of {len(chosen)}",
                **{rule: no_more_failed and good for rule, good in within(ratios, margin).items()},
            }
            rows.append(row)
    return pd.DataFrame(rows)


def within(ratios: pd.Series, margin: float) -> dict[str, bool]:
    """Say whether one-sided tests at 5 % place the ratio within the margin (rules 4, 5)."""
    _, low, high = compare.typical_interval(np.log(ratios), level=90)  # NaN for few sequences
    is_below = bool(high < np.log(margin))
    return {"as_good": is_below and bool(low > -np.log(margin)), "no_worse": is_below}


def table_of_few(rows: pd.DataFrame, times: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return one row a choice and number, for readers.

    rows: of `ratios_to_all`. times: of `time_steps`.
    "as good" and "no worse" are "yes" if a rule holds for both errors and both estimators.
    """
    keys = ["choice", "number"]
    milliseconds = {} if times is None else times.set_index(keys)["milliseconds"]
    lines = []
    for (choice, number), chosen in rows.groupby(keys, sort=False):
        mean = chosen["keypoints"].iloc[0]
        line: dict[str, Any] = {"keypoints": f"{mean:.0f}", "how chosen": LABELS[choice]}
        for row in chosen.itertuples():
            ratio, low, high = map(texts.number, (row.ratio, row.low, row.high))
            name = f"{ERRORS[row.error]}, {ESTIMATORS[row.estimator]}"
            line[name] = f"{ratio} ({low}-{high}), {row.above} of {row.n}"
        for row in chosen.drop_duplicates("estimator").itertuples():
            line[f"failed, {ESTIMATORS[row.estimator]}"] = row.failed
        if times is not None:
            line["CPU time a frame (ms)"] = milliseconds.get((choice, number))
        for rule in ("as_good", "no_worse"):
            is_so = choice != "all" and chosen[rule].all()
            line[rule.replace("_", " ")] = "yes" if is_so else ""
        lines.append(line)
    return pd.DataFrame(lines)


def figure_of_few(rows: pd.DataFrame) -> Figure:
    """Draw the ratios of both errors against the number of keypoints. rows: of `ratios_to_all`.

    Ratios near 1 are drawn once more, enlarged; arrows there mark intervals that are cut.
    """
    scales = list(product(ERRORS, (False, True)))
    drawing, panels = style.new_figure(len(scales), len(ESTIMATORS), sharex=True, height=9)
    for (error, near), panel_row in zip(scales, panels, strict=True):
        for panel, estimator in zip(panel_row, ESTIMATORS, strict=True):
            shown = rows[(rows["error"] == error) & (rows["estimator"] == estimator)]
            _draw_curves(panel, shown, near)
            title = f"{compare.METRICS[error]}, {ESTIMATORS[estimator]}"
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
