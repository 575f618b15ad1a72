"""Masks against all keypoints, controls and other sources, in figures and tables: `compare.comparisons`, for reading.

A figure has one row of panels an estimator and one column an error: those that judge, and the RMSE as the thesis
measures it. Several sources of masks are further rows.
"""

import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from thesis_repro.report import texts
from thesis_repro.report.style import (
    BASELINE,
    BLACK,
    GREEN,
    MASKED,
    ORANGE,
    PAGE_WIDTH,
    PINK,
    SKY,
    new_figure,
    ratio_axis,
)
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import ESTIMATORS

SHOWN = (*compare.JUDGING_METRICS, "rmse")
MARKERS = "oDsh^v<>PpX"
COLORS = (BASELINE, MASKED, GREEN, "#7fb800", ORANGE, PINK, SKY, BLACK, "#777777", "#8b5a2b", "#5d3a9b")
CHOICES = {"best": "best width", "left_out": "left-out width", "fixed": "one width for all"}
KEYS = ["source", "method", "dilation_width", "estimator"]


def figure_comparison(table):
    """Every method's ratio to all keypoints, a row each: sequences in grey, geometric mean, bootstrap interval."""
    rows = _against_all_keypoints(table)
    labels = _labels(rows)
    order = list(dict.fromkeys(labels))
    figure, panels = _panels(rows, height=0.9 + 0.21 * len(order), sharey=True)
    for panel, of_panel in panels:
        for index, row in of_panel.iterrows():
            y, color = order.index(labels[index]), MASKED if row["method"] == "masked" else BASELINE
            values = row[_sequences(table)].dropna().astype(float)
            panel.plot(values, [y - 0.22] * len(values), "o", color="#555555", alpha=0.45, markersize=3,
                       markeredgewidth=0)
            panel.plot([row["low"], row["high"]], [y + 0.1] * 2, color=color, linewidth=2.2)
            panel.plot(row["ratio"], y + 0.1, "D" if row["method"] == "masked" else "o", color=color, markersize=5,
                       markeredgecolor="white")
        panel.axvline(1, color="black", linewidth=0.8)
        panel.grid(axis="y", visible=False)
        panel.set_yticks(range(len(order)), order, fontsize=7)
        panel.set_ylim(len(order) - 0.5, -0.6)
        _ratio_axis(panel.xaxis)
    for panel in figure.axes[-len(panels) // len(set(rows["estimator"])):]:
        panel.set_xlabel("ratio to all keypoints\n(left of 1: lower)", fontsize=8)
    return figure


def figure_keypoints(table):
    """Ratio to all keypoints against the mean number of keypoints; lines lead through the other widths."""
    rows = table[(table["reference"] == "baseline") & (table["method"] != "baseline")]
    several = rows["source"].nunique() > 1
    rows = rows[rows["method"] == "masked"] if several else rows
    series = rows["source"] if several else rows["method"]
    tested = set(_against_all_keypoints(table).index)
    figure, panels = _panels(rows, height=2.3)
    for panel, of_panel in panels:
        for place, (name, line) in enumerate(of_panel.sort_values("keypoints").groupby(series, sort=False)):
            style = {"color": COLORS[place % len(COLORS)], "marker": MARKERS[place % len(MARKERS)]} if several else \
                _style(name)
            at_width = line[line.index.isin(tested)]
            panel.plot(line["keypoints"], line["ratio"], color=style["color"], linewidth=0.9, alpha=0.6)
            for row in at_width.itertuples():
                panel.plot([row.keypoints] * 2, [row.low, row.high], color=style["color"], linewidth=1.6)
            panel.plot(at_width["keypoints"], at_width["ratio"], linestyle="none", markersize=6,
                       markeredgecolor="white", markeredgewidth=0.5,
                       label=name if several else compare.METHODS[name], **style)
        panel.plot(of_panel["reference_keypoints"].iloc[0], 1, "k*", markersize=8, label=compare.METHODS["baseline"])
        panel.axhline(1, color="black", linewidth=0.8)
        panel.xaxis.set_major_locator(MaxNLocator(4))
        _ratio_axis(panel.yaxis)
    _legend(figure, figure.axes)
    for panel in figure.axes[-len(panels) // len(set(rows["estimator"])):]:
        panel.set_xlabel("mean number of keypoints", fontsize=8)
    return figure


def figure_sequences(table, runs, metric="rmse_boresight_corrected"):
    """Ratio to all keypoints against keypoints, one panel a sequence, under the estimator that judges.

    runs: those of the table, for the number of keypoints of each sequence.
    """
    metric = metric if (table["metric"] == metric).any() else "rmse"
    estimator = compare.judging_estimator(table)
    rows = table[(table["reference"] == "baseline") & (table["metric"] == metric) & (table["method"] != "baseline")
                 & (table["estimator"] == estimator)]
    several = rows["source"].nunique() > 1
    rows = rows[rows["method"] == "masked"] if several else rows
    keypoints = runs.groupby([*KEYS, "sequence"], dropna=False)["mean_keypoints"].mean().rename("own").reset_index()
    points = rows.melt(KEYS, _sequences(table), "sequence", "its_ratio").merge(keypoints).dropna(subset=["its_ratio"])
    names = sorted(points["sequence"].unique())
    columns = min(4, len(names))
    count = -(-len(names) // columns)
    figure, axes = new_figure(count, columns, height=PAGE_WIDTH / columns * count * 0.85 + 0.9, squeeze=False)
    for panel in axes.flat[len(names):]:
        panel.set_axis_off()
    for panel, name in zip(axes.flat, names):
        own = points[points["sequence"] == name].sort_values("own")
        for place, (key, line) in enumerate(own.groupby("source" if several else "method", sort=False)):
            style = {"color": COLORS[place % len(COLORS)], "marker": MARKERS[place % len(MARKERS)]} if several else \
                _style(key)
            panel.plot(line["own"], line["its_ratio"], linewidth=0.9, markersize=4.5, markeredgewidth=0,
                       label=key if several else compare.METHODS[key], **style)
        panel.axhline(1, color="black", linewidth=0.8)
        panel.set_title(name)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(MaxNLocator(3))
        _ratio_axis(panel.yaxis)
    _legend(figure, axes.flat[:len(names)])
    figure.suptitle(f"{compare.METRICS[metric]}, {ESTIMATORS[estimator]}: ratio to all keypoints", fontsize=9)
    for panel in axes.flat[max(0, len(names) - columns):len(names)]:
        panel.set_xlabel("number of keypoints", fontsize=8)
    return figure


def _ratio_axis(axis):
    """Make an axis logarithmic, with 1 in it, around what its panel's lines show."""
    values = np.concatenate([line.get_data()[axis.axis_name == "y"] for line in axis.axes.lines]).astype(float)
    values = [*values[np.isfinite(values) & (values > 0)], 1]
    ratio_axis(axis, min(values), max(values))


def _style(method):
    place = list(compare.METHODS).index(method)
    return {"color": COLORS[place], "marker": MARKERS[place]}


def _panels(rows, height, **options):
    """(figure, (panel, its rows)), one row of panels an estimator and one column an error; height: inches a row."""
    estimators = [name for name in ESTIMATORS if (rows["estimator"] == name).any()]
    metrics = [name for name in SHOWN if (rows["metric"] == name).any()]
    figure, axes = new_figure(len(estimators), len(metrics), height=0.7 + height * len(estimators), squeeze=False,
                              **options)
    panels = []
    for row, estimator in zip(axes, estimators):
        row[0].set_ylabel(ESTIMATORS[estimator])
        for panel, metric in zip(row, metrics):
            panel.tick_params(labelsize=7)
            panels.append((panel, rows[(rows["estimator"] == estimator) & (rows["metric"] == metric)]))
    for panel, metric in zip(axes[0], metrics):
        panel.set_title(compare.METRICS[metric].replace(", ", ",\n"))
    return figure, panels


def _legend(figure, axes):
    handles = {label: handle for panel in axes for handle, label in zip(*panel.get_legend_handles_labels())}
    order = [name for name in compare.METHODS.values() if name in handles]
    order += [name for name in handles if name not in order]  # sources
    figure.legend([handles[name] for name in order], order, loc="outside lower center", ncols=4)


def _against_all_keypoints(table):
    """Every method over all keypoints: at the tested width, or at every one where none of its source is tested."""
    rows = table[(table["reference"] == "baseline") & (table["method"] != "baseline")]
    masked = rows[(rows["method"] == "masked") & rows["tested"]]
    return rows[rows["tested"] | ~rows["source"].isin(masked["source"])]


def _labels(rows):
    """What each row is called: source where there are several, method, width of masks."""
    several = rows["source"].nunique() > 1
    source = rows["source"] + ": " if several else ""
    width = rows["dilation_width"].where(rows["method"] == "masked")
    width = width.map(", width {:g}".format, na_action="ignore").fillna("")
    return source + rows["method"].map(compare.METHODS) + width


def _sequences(table):
    """The columns with the ratio of each sequence."""
    return list(table.columns[table.columns.get_loc("verdict") + 1:])


def table_comparison(table):
    """Every method over all keypoints and masks over every control, a column an error: "1.09 (0.98-1.32)".

    The last column is the verdict of the errors that judge together (`compare.overall`).
    """
    rows = pd.concat([_against_all_keypoints(table), table[table["reference"] != "baseline"]])
    rows = rows.assign(what=_labels(rows), place=range(len(rows)))
    shown = []
    for _, of_pair in rows.groupby(["estimator", *KEYS[:3], "reference_source", "reference"], dropna=False, sort=False):
        first, judging = of_pair.iloc[0], of_pair[of_pair["metric"].isin(compare.JUDGING_METRICS)]
        reference = compare.METHODS[first["reference"]]
        if first["reference_source"] not in ("", first["source"]):
            reference = f"{first['reference_source']}: {reference}"
        shown.append({
            "estimator": ESTIMATORS[first["estimator"]], "keypoints": first["what"],
            "number": round(first["keypoints"]), "over": reference, "sequences": of_pair["n"].max(),
            **{compare.METRICS[row["metric"]]: _short(row) for _, row in of_pair.iterrows()},
            "verdict": compare.overall(judging["verdict"]) if len(judging) else pd.NA})
    columns = ["estimator", "keypoints", "number", "over", "sequences",
               *(name for name in compare.METRICS.values() if any(name in row for row in shown)), "verdict"]
    return pd.DataFrame(shown, columns=columns)


def _short(row):
    return pd.NA if pd.isna(row["ratio"]) else texts.ratio(row).replace(f"{compare.LEVEL} % CI ", "")


def table_widths(runs):
    """What the best, the left-out and the fixed width give: ratios of errors to all keypoints, one row a sequence.

    Below each source's sequences their geometric mean with its bootstrap interval, and in how many the error is lower.
    """
    tables = []
    for source in compare.sources(runs) or [""]:
        own = compare.of_source(runs, source)
        if compare.of_method(own, "masked")["dilation_width"].nunique() > 1:
            part = _widths(own)
            tables.append(part.assign(masks=source)[["masks", *part]] if len(compare.sources(runs)) > 1 else part)
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def _widths(runs):
    chosen, baseline = thesis_tables.chosen_widths(runs), compare.of_method(runs, "baseline")
    metrics = [name for name in ("rmse", "rmse_boresight_corrected") if name in runs and runs[name].notna().any()]
    shown, ratios = pd.DataFrame(index=chosen.index), {}
    for choice, words in CHOICES.items():
        shown[words] = chosen[choice]
        for metric in metrics:
            rows = thesis_tables.of_chosen_width(runs, chosen[choice])
            ratios[f"{words}: {compare.METRICS[metric]}"] = compare.ratios(rows, baseline, metric)
            shown[f"{words}: {compare.METRICS[metric]}"] = np.nan
    again = thesis_tables.stability(runs)
    ratios["best width of one repetition, in the others: RMSE"] = again["elsewhere"]
    shown = shown.assign(**{name: values.map(texts.number, na_action="ignore") for name, values in ratios.items()},
                         **{"same best width in two repetitions (%)": again["same_best"].round()})
    below = {"geometric mean": {name: _short(compare.geometric_mean(values)) for name, values in ratios.items()},
             "lower in": {name: f"{(values < 1).sum()} of {values.notna().sum()}" for name, values in ratios.items()}}
    table = pd.concat([shown, pd.DataFrame(below).T]).reindex(columns=shown.columns)
    return table.rename_axis("sequence").reset_index()
