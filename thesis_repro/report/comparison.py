"""Masks against all keypoints, controls and other sources, in figures and tables: `compare.comparisons`, for reading.

A figure has one row of panels an estimator and one column an error: those that judge, and the RMSE as the thesis
measures it. Several sources of masks are further rows.
"""

import textwrap
from itertools import product

import numpy as np
import pandas as pd

from thesis_repro.report import style, texts
from thesis_repro.report.style import BASELINE, MASKED
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import ESTIMATORS

SHOWN = (*compare.JUDGING_METRICS, "rmse")
CHOICES = {"best": "best width", "left_out": "left-out width", "fixed": "one width for all"}
KEYS = ["source", "method", "dilation_width", "estimator"]


def figure_comparison(table):
    """Every method's ratio to all keypoints, a row each: sequences in grey, geometric mean, bootstrap interval."""
    rows = _tested(_over_all_keypoints(table))
    labels = _labels(rows)
    order = list(labels.unique())
    estimators = [name for name in ESTIMATORS if (rows["estimator"] == name).any()]
    metrics = [name for name in SHOWN if (rows["metric"] == name).any()]
    figure, axes = style.new_figure(len(estimators), len(metrics), squeeze=False, sharey=True,
                                    height=0.7 + (0.9 + 0.21 * len(order)) * len(estimators))
    for panel, (estimator, metric) in zip(axes.flat, product(estimators, metrics), strict=True):
        for index, row in rows[(rows["estimator"] == estimator) & (rows["metric"] == metric)].iterrows():
            y, color = order.index(labels[index]), MASKED if row["method"] == "masked" else BASELINE
            values = row[_sequences(table)].dropna().astype(float)
            panel.plot(values, [y - 0.22] * len(values), "o", color="#555555", alpha=0.45, markersize=3,
                       markeredgewidth=0)
            panel.plot([row["low"], row["high"]], [y + 0.1] * 2, color=color, linewidth=2.2)
            panel.plot(row["ratio"], y + 0.1, "D", color=color, markersize=5, markeredgecolor="white")
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


def _over_all_keypoints(table):
    return table[(table["reference"] == "baseline") & (table["method"] != "baseline")]


def _tested(rows):
    """Rows at the tested width, or at every one where masks of their source have none of that width."""
    masked = rows[(rows["method"] == "masked") & rows["tested"]]
    return rows[rows["tested"] | ~rows["source"].isin(masked["source"])]


def _labels(rows):
    """What each row is called: source where there are several, method, width of masks."""
    source = rows["source"] + ": " if rows["source"].nunique() > 1 else ""
    width = rows["dilation_width"].where(rows["method"] == "masked")
    width = width.map(", width {:g}".format, na_action="ignore").fillna("")
    return source + rows["method"].map(compare.METHODS) + width


def _sequences(table):
    """The columns with the ratio of each sequence."""
    return list(table.columns[table.columns.get_loc("verdict") + 1:])


def table_comparison(table):
    """Every method over all keypoints and masks over every control, a column an error: "1.09 (0.98-1.32)".

    The last columns are the verdict of the errors that judge together (`compare.overall`), and each sequence's ratio of
    the first error.
    """
    rows = pd.concat([_tested(_over_all_keypoints(table)), table[table["reference"] != "baseline"]])
    rows = rows.assign(what=_labels(rows))
    shown = []
    for _, pair in rows.groupby(["estimator", *KEYS[:3], "reference_source", "reference"], dropna=False, sort=False):
        first, judging = pair.iloc[0], pair[pair["metric"].isin(compare.JUDGING_METRICS)]
        other_source = "" if first["reference_source"] in ("", first["source"]) else f"{first['reference_source']}: "
        shown.append({
            "estimator": ESTIMATORS[first["estimator"]], "keypoints": first["what"],
            "number": round(first["keypoints"]), "over": other_source + compare.METHODS[first["reference"]],
            "sequences": pair["n"].max(), **{compare.METRICS[row["metric"]]: _short(row) for _, row in pair.iterrows()},
            "verdict": compare.overall(judging["verdict"]) if len(judging) else pd.NA,
            **first[_sequences(table)].dropna().map(texts.number).add_prefix("sequence ")})
    last = ["verdict", *(f"sequence {name}" for name in _sequences(table))]
    shown = pd.DataFrame(shown)
    return shown.reindex(columns=[*(name for name in shown if name not in last), *last])


def _short(row):
    return pd.NA if pd.isna(row["ratio"]) else texts.ratio(row).replace(f"{compare.LEVEL} % CI ", "")


def table_widths(runs):
    """What the best, the left-out and the fixed width give: ratios of errors to all keypoints, one row a sequence.

    Below each source's sequences their geometric mean with its bootstrap interval, and in how many the error is lower.
    """
    tables = {}
    for source in compare.sources(runs) or [""]:
        own = compare.of_source(runs, source)
        if own["dilation_width"][own["method"] == "masked"].nunique() > 1:
            tables[source] = _widths(own)
    if len(compare.sources(runs)) > 1 and tables:
        return pd.concat(tables, names=["masks"]).reset_index("masks")
    return next(iter(tables.values()), pd.DataFrame())


def _widths(runs):
    masked, baseline = compare.of_method(runs, "masked"), compare.of_method(runs, "baseline")
    chosen, again = thesis_tables.chosen_widths(masked, baseline), thesis_tables.stability(masked, baseline)
    ratios = {f"{words}: {compare.METRICS[metric]}": compare.ratios(
        thesis_tables.of_chosen_width(masked, chosen[choice]), baseline, metric)
        for choice, words in CHOICES.items() for metric in ("rmse", "rmse_boresight_corrected") if metric in masked}
    ratios["best width of one repetition, in the others: RMSE"] = again["elsewhere"]
    table = pd.DataFrame(ratios, index=chosen.index).dropna(axis=1, how="all")
    shown = table.map(texts.number, na_action="ignore").astype(object)
    shown.loc["geometric mean"] = {name: _short(compare.geometric_mean(table[name])) for name in table}
    shown.loc["lower in"] = {name: f"{(table[name] < 1).sum()} of {table[name].count()}" for name in table}
    numbers = chosen[list(CHOICES)].rename(columns=CHOICES).assign(
        **{"same best width in two repetitions (%)": again["same_best"].round()}).dropna(axis=1, how="all")
    return numbers.convert_dtypes().join(shown, how="right").rename_axis("sequence").reset_index()
