"""Figures and tables of `compare.comparisons`: masks against all keypoints, controls and masks
from other sources.
"""

import textwrap
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from thesis_repro.report import style, texts
from thesis_repro.report.style import BASELINE, MASKED
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import ESTIMATORS

SHOWN = (*compare.JUDGING_METRICS, "rmse")
CHOICES = {"best": "best width", "left_out": "left-out width", "fixed": "one width for all"}


def figure_comparison(table: pd.DataFrame) -> Figure:
    """Draw each method's ratio to all keypoints: its sequences in grey, geometric mean and
    interval.

    The figure has one row of panels for each estimator. Its columns are the judging metrics and the
    thesis's RMSE. With several sources of masks it shows only their masks, not the controls.
    """
    rows = _tested(_over_all_keypoints(table))
    if rows["source"].nunique() > 1:  # controls of every source would be dozens of rows
        rows = rows[rows["method"] == "masked"]
    labels = _labels(rows)
    order = list(labels.unique())
    estimators = [name for name in ESTIMATORS if (rows["estimator"] == name).any()]
    metrics = [name for name in SHOWN if (rows["metric"] == name).any()]
    figure, axes = style.new_figure(
        len(estimators),
        len(metrics),
        squeeze=False,
        sharey=True,
        height=0.7 + (0.9 + 0.21 * len(order)) * len(estimators),
    )
    for panel, (estimator, metric) in zip(axes.flat, product(estimators, metrics), strict=True):
        for index, row in rows[
            (rows["estimator"] == estimator) & (rows["metric"] == metric)
        ].iterrows():
            y, color = order.index(labels[index]), MASKED if row["method"] == "masked" else BASELINE
            values = row[_sequences(table)].dropna().astype(float)
            panel.plot(
                values,
                [y - 0.22] * len(values),
                "o",
                color="#555555",
                alpha=0.45,
                markersize=3,
                markeredgewidth=0,
            )
            panel.plot([row["low"], row["high"]], [y + 0.1] * 2, color=color, linewidth=2.2)
            panel.plot(
                row["ratio"], y + 0.1, "D", color=color, markersize=5, markeredgecolor="white"
            )
        panel.axvline(1, color="black", linewidth=0.8)
        panel.grid(axis="y", visible=False)
        panel.set_yticks(range(len(order)), order)
        panel.set_ylim(len(order) - 0.5, -0.6)
        panel.tick_params(labelsize=7)
        style.ratio_axis(panel.xaxis, np.concatenate([line.get_xdata() for line in panel.lines]))
    for panel, metric in zip(axes[0], metrics):
        panel.set_title(textwrap.fill(compare.METRICS[metric], 18))
    for panel, estimator in zip(axes[:, 0], estimators):
        panel.set_ylabel(ESTIMATORS[estimator])
    for panel in axes[-1]:
        panel.set_xlabel("ratio to all keypoints\n(left of 1: lower)", fontsize=8)
    return figure


def _over_all_keypoints(table: pd.DataFrame) -> pd.DataFrame:
    return table[(table["reference"] == "baseline") & (table["method"] != "baseline")]


def _tested(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the tested width. A source without masks of that width keeps all its
    rows.
    """
    masked = rows[(rows["method"] == "masked") & rows["tested"]]
    return rows[rows["tested"] | ~rows["source"].isin(masked["source"])]


def _labels(rows: pd.DataFrame) -> pd.Series:
    """Label each row with its method, the width of its masks and, if there are several sources,
    its source.
    """
    source = rows["source"] + ": " if rows["source"].nunique() > 1 else ""
    width = rows["dilation_width"].where(rows["method"] == "masked")
    width = width.map(", width {:g}".format, na_action="ignore").fillna("")
    return source + rows["method"].map(compare.METHODS) + width


def _sequences(table: pd.DataFrame) -> list[str]:
    """Return the names of the columns with the ratio of each sequence."""
    return list(table.columns[table.columns.get_loc("verdict") + 1 :])


def table_summary(table: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each source: the answer of a study (`compare.primary_comparison`).

    The columns are the mean number of keypoints that the masks leave and that of all, the ratio of
    each judging metric, the verdict, and the control without segmentation that has the lowest
    ratio of the first judging metric.
    """
    judged = compare.primary_comparison(table)
    estimator = compare.judging_estimator(judged)
    total = compare.of_method(runs, "baseline", estimator)["mean_keypoints"].mean()
    controls = _tested(_over_all_keypoints(table))
    controls = controls[
        (controls["estimator"] == estimator)
        & (controls["metric"] == next(iter(compare.JUDGING_METRICS)))
        & controls["method"].isin(compare.SEGMENTATION_FREE_CONTROLS)
    ]
    rows = []
    for source, pair in judged.groupby("source", sort=False):
        row = {
            "masks": source,
            "keypoints": f"{pair['keypoints'].iloc[0]:.0f} of {total:.0f}",
            **{compare.METRICS[row["metric"]]: _short(row) for _, row in pair.iterrows()},
            "verdict": compare.overall(pair["verdict"]),
        }
        for _, best in controls[controls["source"] == source].nsmallest(1, "ratio").iterrows():
            row["best control"] = f"{compare.METHODS[best['method']]} {texts.number(best['ratio'])}"
        rows.append(row)
    return pd.DataFrame(rows)


def table_comparison(table: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios of each method to all keypoints, and of masks to each control, one column a
    metric.

    A ratio is a text, "1.09 (0.98-1.32)". The last columns are the verdict on all judging metrics
    (`compare.overall`) and each sequence's ratio of the first metric.
    """
    rows = pd.concat([_tested(_over_all_keypoints(table)), table[table["reference"] != "baseline"]])
    rows = rows.assign(label=_labels(rows))
    shown = []
    keys = ["estimator", "source", "method", "dilation_width", "reference_source", "reference"]
    for _, pair in rows.groupby(keys, dropna=False, sort=False):
        first, judging = pair.iloc[0], pair[pair["metric"].isin(compare.JUDGING_METRICS)]
        other_source = (
            ""
            if first["reference_source"] in ("", first["source"])
            else f"{first['reference_source']}: "
        )
        shown.append(
            {
                "estimator": ESTIMATORS[first["estimator"]],
                "keypoints": first["label"],
                "number": round(first["keypoints"]),
                "over": other_source + compare.METHODS[first["reference"]],
                "sequences": pair["n"].max(),
                **{compare.METRICS[row["metric"]]: _short(row) for _, row in pair.iterrows()},
                "verdict": compare.overall(judging["verdict"]) if len(judging) else pd.NA,
                **first[_sequences(table)].dropna().map(texts.number).add_prefix("sequence "),
            }
        )
    last = ["verdict", *(f"sequence {name}" for name in _sequences(table))]
    shown = pd.DataFrame(shown)
    return shown.reindex(columns=[*(name for name in shown if name not in last), *last])


def _short(row: dict[str, Any] | pd.Series) -> Any:
    return (
        pd.NA if pd.isna(row["ratio"]) else texts.ratio(row).replace(f"{compare.LEVEL} % CI ", "")
    )


def table_widths(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios of errors to all keypoints with the best, the left-out and the fixed width,
    by sequence.

    The last two rows of each source have the geometric mean with its interval, and the
    number of sequences with a lower error.
    """
    tables = {}
    for source in compare.sources(runs) or [""]:
        masked, baseline = (
            compare.of_method(compare.of_source(runs, source), name)
            for name in ("masked", "baseline")
        )
        if masked["dilation_width"].nunique() > 1:
            tables[source] = _widths(masked, baseline)
    if len(compare.sources(runs)) > 1 and tables:
        return pd.concat(tables, names=["masks"]).reset_index("masks")
    return next(iter(tables.values()), pd.DataFrame())


def _widths(masked: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    chosen, stability = (
        thesis_tables.chosen_widths(masked, baseline),
        thesis_tables.stability(masked, baseline),
    )
    ratios = {}
    for choice, label in CHOICES.items():
        rows = thesis_tables.of_chosen_width(masked, chosen[choice])
        for metric in ("rmse", "se3"):
            if metric in masked:
                ratios[f"{label}: {compare.METRICS[metric]}"] = compare.ratios(
                    rows, baseline, metric
                )
    ratios["best width of one repetition, in the others: RMSE"] = stability["elsewhere"]
    table = pd.DataFrame(ratios, index=chosen.index).dropna(axis=1, how="all")
    shown = table.map(texts.number, na_action="ignore").astype(object)
    shown.loc["geometric mean"] = {
        name: _short(compare.geometric_mean(table[name])) for name in table
    }
    shown.loc["lower in"] = {
        name: f"{(table[name] < 1).sum()} of {table[name].count()}" for name in table
    }
    numbers = (
        chosen[list(CHOICES)]
        .rename(columns=CHOICES)
        .assign(**{"same best width in two repetitions (%)": stability["same_best"].round()})
        .dropna(axis=1, how="all")
    )
    return numbers.convert_dtypes().join(shown, how="right").rename_axis("sequence").reset_index()
