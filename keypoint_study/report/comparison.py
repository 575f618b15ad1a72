"""Figures and tables of `comparisons.comparisons_of` and of the errors beside them.

They compare masks with all keypoints, with controls and with masks from other sources.
"""

from itertools import product
from math import floor, log10
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from keypoint_study import best_width, comparisons, ratios
from keypoint_study.comparisons import BROUGHT
from keypoint_study.jobs import ESTIMATOR_TITLES
from keypoint_study.path_errors import ERRORS
from keypoint_study.report import style, texts
from keypoint_study.report.style import BASELINE, COLUMN_WIDTH, MASKED, PAGE_WIDTH, Artefact
from keypoint_study.verdicts import LEVEL, MIN_SEQUENCES, TOO_FEW

REACHES = (2, 4, 8, 16, 64)  # of the figure's axis, which goes from 1 / reach to reach
SHOWN = (*comparisons.JUDGING_METRICS, "rmse")  # the last one as the thesis measures it
FAIL = "sequences that fail"  # a column: on which half of the runs or more fail
CHOICES = {"best": "best width", "left_out": "left-out width", "fixed": "one width for all"}
_INTERVAL = (
    "typical ratio of the sequences (the median of the means of all pairs, on logarithms), from "
    f"{MIN_SEQUENCES} sequences on with its {LEVEL} % interval (Wilcoxon's signed-rank test)"
)
# {name: (title, caption)}
CAPTIONS = {
    "ratios_drawn": (
        "Masks and controls",
        "A ratio is an error divided by that of all keypoints under the same estimator: below 1 is "
        f"better. Grey dots are sequences, the diamond is the {_INTERVAL}, the bar with end caps. "
        "Columns: the two errors that decide. One row of panels for each estimator, all with one "
        "scale; a sequence beyond it is named at the edge, and an arrow marks an interval that is "
        "cut. The mask of another frame and the rows below it do not use the classes in the frame. "
        "If they do as well as masks, it is not the segmentation that helps. With several sources "
        "of masks, the controls of each are in a figure of its own.",
    ),
    "ratios": (
        "Masks and controls, in numbers",
        f"Ratios of errors: {_INTERVAL}. An arrow behind an interval says that all of it lies below "
        "or above 1. The verdict is that of both errors that decide: aligned ATE and rotational RPE "
        "over one frame. In a failed run, a step turns wrongly or goes backwards. A sequence "
        "fails if half of its runs do; “failures” compares on how many sequences more runs fail.",
    ),
    "errors": (
        "Every sequence",
        "The two errors that decide, for each estimator: mean and standard deviation over the "
        "shuffles (none if it is 0 in these digits). The lowest mean of a sequence is bold; a "
        "smaller difference than the deviations may be chance. With several sources of masks, the "
        "controls stand in the table of ratios only.",
    ),
    "widths": (
        "A fair choice of width",
        "Ratios of errors to all keypoints with the best width of each sequence (chosen by its error "
        "there), with the width chosen on the other sequences, and with one width for all. The row "
        "“all sequences” has the typical ratio with its interval. If all widths are repeated, two "
        "columns show how much is chance: the best width of one shuffle evaluated in the other "
        "shuffles, and how often two shuffles agree on the best width. The choices share data, "
        "so the intervals of the chosen widths are too narrow.",
    ),
}


def figure_of_ratios(table: pd.DataFrame, source: str = "", width: float = PAGE_WIDTH) -> Artefact:
    """Draw the ratios of masks, other masks and controls to all keypoints.

    Grey dots are the sequences, the coloured mark is their typical ratio with its interval. The
    figure has one row of panels for each estimator and one column for each judging metric, all with
    one scale, which shows nine of ten sequences, and three of four with masks. A sequence beyond it
    is named at the edge, and an arrow marks an interval that is cut. With several sources of masks
    it shows no controls.
    source: show only this one, with its controls. width: inches; one column has the estimator that
    decides alone, and its panels below each other.
    """
    name, (title, caption) = "comparison", CAPTIONS["ratios_drawn"]
    if source:
        name, title = f"comparison-{source}", f"{title} of {source}"
    rows = judged(table, source)
    is_wide = width > COLUMN_WIDTH
    if not is_wide:
        rows = rows[rows["estimator"] == comparisons.judging_estimator(rows)]
    orders = {name: list(part["label"].unique()) for name, part in rows.groupby("estimator")}
    estimators = [name for name in ESTIMATOR_TITLES if name in orders]
    metrics = [name for name in comparisons.JUDGING_METRICS if (rows["metric"] == name).any()]
    shown = list(product(estimators, metrics))
    columns, step = 1, 0.22  # inches from row to row
    if is_wide:
        columns, step = len(metrics), 0.33
    heights = [0.8 + step * len(orders[estimator]) for estimator, _ in shown[::columns]]
    figure, axes = style.new_figure(
        len(heights),
        columns,
        squeeze=False,
        sharex=True,
        sharey="row",
        height=0.7 + sum(heights),
        width=width,
        height_ratios=heights,
    )
    reach = _reach(rows)
    for panel, (estimator, metric) in zip(axes.flat, shown, strict=True):
        of_panel = rows[(rows["estimator"] == estimator) & (rows["metric"] == metric)]
        _draw_ratios(panel, of_panel, orders[estimator], reach)
        panel.set_title(comparisons.METRIC_TITLES[metric])
    for panel, (estimator, _) in zip(axes[:, 0], shown[::columns], strict=True):
        panel.set_ylabel(ESTIMATOR_TITLES[estimator])
    for panel in axes[-1]:
        panel.set_xlabel(f"ratio to all keypoints{' (left of 1: lower)' * is_wide}", fontsize=8)
    return Artefact(name, title, caption, figure)


def _reach(rows: pd.DataFrame) -> float:
    """Return the largest ratio of the figure's axis."""
    every = _distances_from_one(rows)
    brought = _distances_from_one(rows[rows["method"].isin(BROUGHT)])
    for reach in REACHES:
        limit = np.log(reach)
        if (every < limit).mean() >= 0.9 and (brought < limit).mean() >= 0.75:
            return reach
    return REACHES[-1]


def _distances_from_one(rows: pd.DataFrame) -> pd.Series:
    """Return how far the ratios of all sequences are from 1, on logarithms."""
    each = [ratio for of_row in rows["ratios"] for ratio in of_row.values()]
    return np.log(pd.Series(each, dtype=float)).abs()


def _draw_ratios(panel: Axes, rows: pd.DataFrame, order: list[str], reach: float) -> None:
    """Draw the ratios of one estimator and metric, each at the place of its label in `order`."""
    dot: dict[str, Any] = {"color": "#555555", "markersize": 4, "markeredgewidth": 0}
    edges = {1 / reach: ("<", "left"), reach: (">", "right")}
    for _, row in rows.iterrows():
        y = order.index(row["label"])
        color = MASKED if row["method"] == "masked" else BASELINE
        values = pd.Series(row["ratios"])
        shown = values.clip(1 / reach, reach)
        inside = values[values == shown]
        ends = row[["low", "high"]].astype(float)
        panel.plot(inside, [y - 0.1] * len(inside), "o", alpha=0.45, **dot)
        panel.plot(ends.clip(1 / reach, reach), [y + 0.2] * 2, **style.interval_style(color))
        panel.plot(row["ratio"], y + 0.2, "D", color=color, markersize=4, markeredgewidth=0)
        for edge, (marker, side) in edges.items():
            beyond = values[(shown == edge) & (values != shown)]
            if len(beyond):
                named = ", ".join(f"{name}: {value:.3g}" for name, value in beyond.items())
                panel.plot(edge, y - 0.1, marker, clip_on=False, **dot)
                panel.text(edge, y - 0.22, f" {named} ", va="bottom", ha=side, fontsize=7)
            if ((ends - edge) * (edge - 1) > 0).any():  # farther from 1 than the edge
                panel.plot(edge, y + 0.2, marker, color=color, markersize=5, clip_on=False)
    style.ratio_rows(panel, order, reach)
    panel.tick_params(labelsize=7)


def judged(table: pd.DataFrame, source: str = "") -> pd.DataFrame:
    """Return the rows of `figure_of_ratios`: none if no error that decides has a ratio."""
    if source:
        table = table[table["source"].isin([source, ""])]
    rows = _drawn(table)
    return rows[rows["metric"].isin(comparisons.JUDGING_METRICS)]


def _drawn(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `comparisons_of` for figures and tables of errors."""
    rows = table[table["shown"] & (table["reference"] == "baseline")]
    rows = rows[rows["method"] != "baseline"]
    sources_of_masks = rows.loc[rows["method"] == "masked", "source"]
    if sources_of_masks.nunique() > 1:  # controls of every source would be dozens of rows
        rows = rows[rows["method"].isin(BROUGHT)]
    return rows


def table_of_ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """Return rows of `comparisons_of` for readers: one row for each pair of methods and estimator.

    A ratio is a text, "1.09 (0.98-1.32)", see `texts.short`. The verdict is that of all judging
    metrics. "failures" is the verdict on the failed runs. With too few sequences to tell, neither
    is there.
    """
    rows = rows[(rows["method"] != "baseline") & rows["metric"].isin(SHOWN)]
    keys = ["estimator", "source", "method", "dilation_width", "reference_source", "reference"]
    lines = []
    for _, pair in rows.groupby(keys, dropna=False, sort=False):
        first = pair.iloc[0]
        over = comparisons.METHOD_TITLES[first["reference"]]
        if first["reference_source"] not in ("", first["source"]):
            over = f"{first['reference_source']}: {over}"
        line = {
            "estimator": ESTIMATOR_TITLES[first["estimator"]],
            "keypoints": first["label"],
            "number": round(first["keypoints"]),
            "over": over,
            "sequences": pair["n"].max(),
        }
        for _, row in pair.iterrows():
            line[comparisons.METRIC_TITLES[row["metric"]]] = texts.short(row)
        judging = pair[pair["metric"].isin(comparisons.JUDGING_METRICS)]
        line |= {
            "verdict": comparisons.verdict_of(judging),
            FAIL: first["failed"],
            f"{FAIL}, of the reference": first["reference_failed"],
            "failures": first["failures_verdict"],
        }
        lines.append(line)
    table = pd.DataFrame(lines)
    untold = [name for name in ("verdict", "failures") if set(table.get(name, [])) == {TOO_FEW}]
    return table.drop(columns=untold)


def long_table_of_ratios(table: pd.DataFrame) -> Artefact:
    """Return `comparisons_of` for programs, with a column for each sequence."""
    title, caption = CAPTIONS["ratios"]
    rows = table.drop(columns="ratios").assign(far_off=table["far_off"].map(" ".join))
    of_sequences = pd.DataFrame(list(table["ratios"]), index=table.index).sort_index(axis=1)
    rows = pd.concat([rows, of_sequences], axis=1)
    return Artefact("ratios", title, caption, rows, for_programs=True)


def all_of(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `comparisons_of` of the tested width, those to all keypoints first."""
    rows = table[table["shown"]]
    return rows.sort_values("reference", key=lambda name: name != "baseline", kind="stable")


def table_of_errors(table: pd.DataFrame, runs: pd.DataFrame) -> Artefact:
    """Return the errors of the methods of the figure and of all keypoints, one column a sequence.

    There is a row for each judging metric, estimator and method. A cell has the mean and the
    standard deviation over the repetitions, "0.0103 ± 0.0021", if it is not 0. The lowest mean of a
    sequence is bold, as Markdown has it: "**0.0103 ± 0.0021**".
    """
    labels = [comparisons.METHOD_TITLES["baseline"], *_drawn(table)["label"].unique()]
    runs = runs.assign(label=comparisons.labels(runs))
    parts = {}
    for metric, estimator in product(comparisons.JUDGING_METRICS, ESTIMATOR_TITLES):
        rows = runs[runs["estimator"] == estimator].dropna(subset=[metric])
        errors = rows.groupby(["label", "sequence"])[metric]
        means = errors.mean().unstack().reindex(labels)
        cells = errors.agg(_mean_and_spread).unstack().reindex(labels)
        cells = cells.mask(means == means.min(), "**" + cells + "**")
        error = f"{ERRORS[metric].title} ({ERRORS[metric].unit})"
        parts[error, ESTIMATOR_TITLES[estimator]] = cells.dropna(how="all")
    shown = pd.concat(parts, names=["error", "estimator", "method"]).reset_index()
    return Artefact("errors", *CAPTIONS["errors"], shown)


def _mean_and_spread(errors: pd.Series) -> str:
    """Return "0.0103 ± 0.0021", or only the mean if the deviation is 0 in these digits."""
    mean = errors.mean()
    magnitude = max(mean, 1e-4)  # an error of 0 gets no more digits than a tenth of a millimetre
    digits = max(0, 2 - floor(log10(magnitude)))  # after the point, for three that are not 0
    deviation = f"{errors.std():.{digits}f}"
    if len(errors) == 1 or float(deviation) == 0:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ± {deviation}"


def table_of_widths(runs: pd.DataFrame) -> Artefact:
    """Return the ratios of errors to all keypoints with three choices of the width, by sequence.

    The choices are the best, the left-out and the fixed width. The last rows of each source have
    the ratio over all sequences with its interval, the number of sequences with a lower error, and
    that of FAIL.
    """
    tables = {}
    for source in comparisons.sources(runs) or [""]:
        of_source = comparisons.of_source(runs, source)
        masked = comparisons.of_method(of_source, "masked")
        if masked["dilation_width"].nunique() > 1:
            tables[source] = _widths(masked, comparisons.of_method(of_source, "baseline"))
    table = next(iter(tables.values()), pd.DataFrame())
    if len(comparisons.sources(runs)) > 1 and tables:
        table = pd.concat(tables, names=["masks"]).reset_index("masks")
    return Artefact("widths", *CAPTIONS["widths"], table)


def _widths(masked: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Return `table_of_widths` of one source."""
    chosen = best_width.chosen_widths(masked, baseline)
    stability = best_width.stability(masked, baseline)
    columns, failed = {}, {}
    for choice, label in CHOICES.items():
        rows = best_width.of_chosen_width(masked, chosen[choice])
        for metric in ("rmse", "se3"):
            name = f"{label}: {comparisons.METRIC_TITLES[metric]}"
            columns[name] = ratios.ratios_of(rows, baseline, metric)
            failed[name] = ratios.count_failing(ratios.has_failed(rows.set_index("sequence")))
    columns["best width of one repetition, in the others: RMSE"] = stability["elsewhere"]
    table = pd.DataFrame(columns, index=chosen.index).dropna(axis=1, how="all")
    shown = table.map(texts.number, na_action="ignore").astype(object)
    for name, of_choice in table.items():
        shown.loc["all sequences", name] = texts.short(ratios.typical_ratio(of_choice))
        shown.loc["lower in", name] = f"{(of_choice < 1).sum()} of {of_choice.count()}"
    shown.loc[FAIL] = failed
    widths = chosen[list(CHOICES)].rename(columns=CHOICES)
    widths["same best width in two repetitions (%)"] = stability["same_best"].round()
    widths = widths.dropna(axis=1, how="all").convert_dtypes()
    return widths.join(shown, how="right").rename_axis("sequence").reset_index()
