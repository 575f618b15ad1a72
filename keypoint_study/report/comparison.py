"""Figures and tables of `compare.comparisons`.

They compare masks with all keypoints, with controls and with masks from other sources.
"""

from itertools import product
from math import floor, log10
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keypoint_study import best_width, compare
from keypoint_study.errors import ERRORS
from keypoint_study.jobs import ESTIMATORS
from keypoint_study.report import style, texts
from keypoint_study.report.style import BASELINE, MASKED
from keypoint_study.sources import UNMASKED

BROUGHT = ("masked", *UNMASKED)  # methods of what a user brings; the others are controls
REACHES = (2, 4, 8, 16, 64)  # of the figure's axis, which goes from 1 / reach to reach
# columns of the failed runs of a method and of its reference, "2 of 40"
FAILED = {"failed runs": "failed", "failed runs of the reference": "reference_failed"}
NEUTRAL_ESTIMATORS = ESTIMATORS | {"thesis": "vote of all points"}  # for a table in another paper
CHOICES = {"best": "best width", "left_out": "left-out width", "fixed": "one width for all"}


def figure_comparison(table: pd.DataFrame) -> Figure:
    """Draw the ratios of masks, other masks and controls to all keypoints.

    Grey dots are the sequences, the coloured mark is their typical ratio with its interval. The
    figure has one row of panels for each estimator and one column for each judging metric, all with
    one scale, which shows nine of ten sequences, and three of four with masks. A sequence beyond it
    is named at the edge, and an arrow marks an interval that is cut. With several sources of masks
    it shows no controls.
    """
    rows = _drawn(table)
    rows = rows[rows["metric"].isin(compare.JUDGING_METRICS)]
    sequences = compare.sequences_of(table)
    orders = {name: list(part["label"].unique()) for name, part in rows.groupby("estimator")}
    estimators = [name for name in ESTIMATORS if name in orders]
    metrics = [name for name in compare.JUDGING_METRICS if (rows["metric"] == name).any()]
    heights = [0.8 + 0.33 * len(orders[name]) for name in estimators]  # of the panels, inches
    figure, axes = style.new_figure(
        len(estimators),
        len(metrics),
        squeeze=False,
        sharex=True,
        sharey="row",
        height=0.7 + sum(heights),
        height_ratios=heights,
    )
    distances = rows[sequences].astype(float).map(np.log).abs()
    brought = distances[rows["method"].isin(BROUGHT)].stack()
    wide_enough = [
        reach
        for reach in REACHES
        if (distances.stack() < np.log(reach)).mean() >= 0.9
        and (brought < np.log(reach)).mean() >= 0.75
    ]
    reach = min(wide_enough, default=REACHES[-1])
    for panels, estimator in zip(axes, estimators, strict=True):
        panels[0].set_ylabel(ESTIMATORS[estimator])
        for panel, metric in zip(panels, metrics, strict=True):
            of_panel = rows[(rows["estimator"] == estimator) & (rows["metric"] == metric)]
            _draw_ratios(panel, of_panel, orders[estimator], sequences, reach)
    for panel, metric in zip(axes[0], metrics):
        panel.set_title(compare.METRICS[metric])
    for panel in axes[-1]:
        panel.set_xlabel("ratio to all keypoints (left of 1: lower)", fontsize=8)
    return figure


def _draw_ratios(
    panel: Axes, rows: pd.DataFrame, order: list[str], sequences: list[str], reach: float
) -> None:
    """Draw the ratios of one estimator and metric, each at the place of its label in `order`."""
    style.ratio_axis(panel.xaxis, [1 / reach, reach])
    dot: dict[str, Any] = {"color": "#555555", "markersize": 4, "markeredgewidth": 0}
    for _, row in rows.iterrows():
        y = order.index(row["label"])
        color = BASELINE
        if row["method"] == "masked":
            color = MASKED
        values = row[sequences].dropna().astype(float)
        inside = values[(values < reach) & (values > 1 / reach)]
        panel.plot(inside, [y - 0.1] * len(inside), "o", alpha=0.45, **dot)
        for edge, marker, beyond in (
            (1 / reach, "<", values[values <= 1 / reach]),
            (reach, ">", values[values >= reach]),
        ):
            if len(beyond):
                named = [f"{name}: {value:.3g}" for name, value in beyond.items()]
                place: dict[str, Any] = {"ha": "right" if edge > 1 else "left", "fontsize": 7}
                panel.plot(edge, y - 0.1, marker, clip_on=False, **dot)
                panel.text(edge, y - 0.22, f" {', '.join(named)} ", va="bottom", **place)
        interval = np.clip([row["low"], row["high"]], 1 / reach, reach)
        panel.plot(interval, [y + 0.2] * 2, **style.interval_style(color, "|"))
        for edge, marker, is_cut in (
            (1 / reach, "<", row["low"] < 1 / reach),
            (reach, ">", row["high"] > reach),
        ):
            if is_cut:
                panel.plot(edge, y + 0.2, marker, color=color, markersize=5, clip_on=False)
        panel.plot(row["ratio"], y + 0.2, "D", color=color, markersize=4, markeredgewidth=0)
    panel.axvline(1, color="black", linewidth=0.8)
    panel.grid(axis="y", visible=False)
    panel.set_yticks(range(len(order)), order)
    panel.set_ylim(len(order) - 0.5, -0.7)
    panel.tick_params(labelsize=7)


def _drawn(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of `compare.comparisons` for figures and tables of errors."""
    rows = table[table["shown"] & (table["reference"] == "baseline")]
    rows = rows[rows["method"] != "baseline"]
    sources_of_masks = rows.loc[rows["method"] == "masked", "source"]
    if sources_of_masks.nunique() > 1:  # controls of every source would be dozens of rows
        rows = rows[rows["method"].isin(BROUGHT)]
    return rows


def table_summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each source: the answer of a study, from `compare.comparisons`.

    The columns are the mean number of keypoints that the source leaves and that of all, the ratio
    of each judging metric, the verdict, the estimator that these are of, failed runs (those of
    another estimator stand behind its name), and the control that does not use the classes in the
    frame and has the lowest ratio of the first judging metric.
    """
    table = table[table["tested"] & (table["reference"] == "baseline")]
    total = table.loc[table["decides"] & (table["method"] == "baseline"), "keypoints"].mean()
    brought = table[table["method"].isin(BROUGHT)]
    others = brought[brought["metric"].isin(compare.JUDGING_METRICS)]
    controls = table[table["decides"] & table["method"].isin(compare.SEGMENTATION_FREE_CONTROLS)]
    rows = []
    for source, pair in brought[brought["decides"]].groupby("source", sort=False):
        first = pair.iloc[0]
        row = {
            "source": source,
            "keypoints": f"{first['keypoints']:.0f} instead of {total:.0f}",
            **{compare.METRICS[line["metric"]]: texts.short(line) for _, line in pair.iterrows()},
            "verdict": compare.overall(pair["verdict"]),
            "estimator": ESTIMATORS[first["estimator"]],
        }
        of_source = others[
            (others["source"] == source) & (others["estimator"] != first["estimator"])
        ]
        of_others = of_source.drop_duplicates("estimator")
        for name, column in FAILED.items():
            counts = zip(of_others["estimator"], of_others[column], strict=True)
            named = [f"{ESTIMATORS[other]} {count}" for other, count in counts]
            row[name] = "; ".join([first[column], *named])
        if first["method"] == "paths":
            row["keypoints"] = ""
        of_metric = controls[controls["metric"] == first["metric"]]
        of_source = of_metric[of_metric["source"] == source]
        for _, best in of_source.nsmallest(1, "ratio").iterrows():
            row["best control"] = f"{compare.METHODS[best['method']]} {texts.number(best['ratio'])}"
        rows.append(row)
    return pd.DataFrame(rows)


def table_comparison(table: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios of each method to all keypoints, and of masks to each control.

    It has one column a metric. A ratio is a text, "1.09 (0.98-1.32)". Beside each judging metric
    stand the number of sequences with a ratio above 1, the geometric mean with its interval, and
    the ratio that these sequences could show. The last columns are the verdict on all judging
    metrics (`compare.overall`), the failed runs of the method and of its reference, and each
    sequence's ratio of the first metric.
    """
    rows = table[table["shown"] & (table["method"] != "baseline")]
    numbers = rows["keypoints"].round().astype("Int64")  # missing for paths of another system
    rows = rows.assign(keypoints=numbers, last=rows["reference"] != "baseline")
    rows = rows.sort_values("last", kind="stable")
    sequences = compare.sequences_of(table)
    keys = ["estimator", "source", "method", "dilation_width", "reference_source", "reference"]
    lines = []
    for _, pair in rows.groupby(keys, dropna=False, sort=False):
        first = pair.iloc[0]
        over = compare.METHODS[first["reference"]]
        if first["reference_source"] not in ("", first["source"]):
            over = f"{first['reference_source']}: {over}"
        judging = pair[pair["metric"].isin(compare.JUDGING_METRICS)]
        by_sequence = first[sequences].dropna().map(texts.number)
        lines.append(
            {
                "estimator": ESTIMATORS[first["estimator"]],
                "keypoints": first["label"],
                "number": first["keypoints"],
                "over": over,
                "sequences": pair["n"].max(),
                **_ratios_and_counts(pair),
                "verdict": compare.overall(judging["verdict"]),
                **{name: first[column] for name, column in FAILED.items()},
                **by_sequence.add_prefix("sequence "),
            }
        )
    shown = pd.DataFrame(lines)
    last = ["verdict", *FAILED, *(f"sequence {name}" for name in sequences)]
    others = [name for name in shown if name not in last]
    return shown.reindex(columns=[*others, *last])


def _ratios_and_counts(pair: pd.DataFrame) -> dict[str, Any]:
    """Return {name of the metric: ratio as a text} for two methods, which have one row a metric.

    Behind a judging metric stand "6 of 8" above 1, the geometric mean and the detectable ratio.
    """
    cells: dict[str, Any] = {}
    for _, row in pair.iterrows():
        name = compare.METRICS[row["metric"]]
        cells[name] = texts.short(row)
        if row["metric"] in compare.JUDGING_METRICS:
            cells[f"{name}: above 1"] = f"{row['above']} of {row['n']}"
            mean = {end: row[f"mean_{end}"] for end in ("low", "high")}
            cells[f"{name}: geometric mean"] = texts.short({"ratio": row["mean"], **mean})
            cells[f"{name}: detectable"] = f"{row['detectable']:.2f}"
    return cells


def table_errors(table: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Return the errors of the methods of the figure and of all keypoints, one column a sequence.

    There is a row for each judging metric, estimator and method. A cell has the mean and the
    standard deviation over the repetitions, "0.0103 ± 0.0021", if it is not 0. The lowest mean of a
    sequence is bold, as Markdown has it: "**0.0103 ± 0.0021**".
    """
    labels = [compare.METHODS["baseline"], *_drawn(table)["label"].unique()]
    runs = runs.assign(label=compare.labels(runs))
    parts = {}
    for metric, estimator in product(compare.JUDGING_METRICS, NEUTRAL_ESTIMATORS):
        rows = runs[runs["estimator"] == estimator].dropna(subset=[metric])
        errors = rows.groupby(["label", "sequence"])[metric]
        means = errors.mean().unstack().reindex(labels)
        cells = errors.agg(_mean_and_spread).unstack().reindex(labels)
        cells = cells.mask(means == means.min(), "**" + cells + "**")
        error = ERRORS[metric]
        parts[f"{error.title} ({error.unit})", NEUTRAL_ESTIMATORS[estimator]] = cells.dropna(
            how="all"
        )
    return pd.concat(parts, names=["error", "estimator", "method"]).reset_index()


def _mean_and_spread(errors: pd.Series) -> str:
    """Return "0.0103 ± 0.0021", or only the mean if the deviation is 0 in these digits."""
    mean = errors.mean()
    magnitude = max(mean, 1e-4)  # an error of 0 gets no more digits than a tenth of a millimetre
    digits = max(0, 2 - floor(log10(magnitude)))  # after the point, for three that are not 0
    deviation = f"{errors.std():.{digits}f}"
    if len(errors) == 1 or float(deviation) == 0:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ± {deviation}"


def table_widths(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios of errors to all keypoints with three choices of the width, by sequence.

    The choices are the best, the left-out and the fixed width. The last rows of each source have
    the ratio over all sequences with its interval, the number of sequences with a lower error, and
    that of failed runs.
    """
    tables = {}
    for source in compare.sources(runs) or [""]:
        of_source = compare.of_source(runs, source)
        masked = compare.of_method(of_source, "masked")
        if masked["dilation_width"].nunique() > 1:
            tables[source] = _widths(masked, compare.of_method(of_source, "baseline"))
    if len(compare.sources(runs)) > 1 and tables:
        return pd.concat(tables, names=["masks"]).reset_index("masks")
    return next(iter(tables.values()), pd.DataFrame())


def _widths(masked: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Return `table_widths` of one source."""
    chosen = best_width.chosen_widths(masked, baseline)
    stability = best_width.stability(masked, baseline)
    metrics = [name for name in ("rmse", "se3") if name in masked]
    columns, failed = {}, {}
    for choice, label in CHOICES.items():
        rows = best_width.of_chosen_width(masked, chosen[choice])
        for metric in metrics:
            ratios = compare.ratios(rows, baseline, metric)
            name = f"{label}: {compare.METRICS[metric]}"
            columns[name] = ratios
            failed[name] = compare.count_failed(rows)
    columns["best width of one repetition, in the others: RMSE"] = stability["elsewhere"]
    table = pd.DataFrame(columns, index=chosen.index).dropna(axis=1, how="all")
    shown = table.map(texts.number, na_action="ignore").astype(object)
    means, lower = {}, {}
    for name, ratios in table.items():
        means[name] = texts.short(compare.typical_ratio(ratios))
        lower[name] = f"{(ratios < 1).sum()} of {ratios.count()}"
    shown.loc["all sequences"] = means
    shown.loc["lower in"] = lower
    shown.loc["failed runs"] = failed
    widths = chosen[list(CHOICES)].rename(columns=CHOICES)
    widths["same best width in two repetitions (%)"] = stability["same_best"].round()
    widths = widths.dropna(axis=1, how="all").convert_dtypes()
    return widths.join(shown, how="right").rename_axis("sequence").reset_index()
