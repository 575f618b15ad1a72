"""Figures 4.6, 4.7 and 4.9 to 4.16: errors in metres, and keypoints.

`runs` is the table of `runner.run`. Lines and bars stand at the mean over repetitions; bands and error bars go from the
lowest to the highest of them. What compares methods by ratios is in comparison.py.
"""

import matplotlib.pyplot as plt
import numpy as np

from thesis_repro.odometry import THESIS
from thesis_repro.report import style
from thesis_repro.report.style import BASELINE, MASKED, PAGE_WIDTH, REDUCED, TRUTH
from thesis_repro.study import compare, thesis_tables

METHODS = {"baseline": ("all keypoints", BASELINE, "//"), "masked": ("masked, best width", MASKED, ""),
           "reduced": ("plainly reduced", REDUCED, "\\\\")}
BAND = "lowest to highest of the repetitions"


def figure_paths(truths, rows, paths, method):
    """Figures 4.6, 4.11, 4.12: paths from above, and below each the distance to the true path along the way.

    truths: {sequence: true positions (n, 3)}. rows: the runs to draw, of one method; repetition 0 is drawn bold, the
    others faint. paths: {(sequence, run): estimated positions (n, 3)}.
    """
    groups = {name: runs.sort_values("repetition") for name, runs in rows.groupby("sequence")}
    columns = min(4, len(groups))
    count = -(-len(groups) // columns)
    figure, axes = style.new_figure(2 * count, columns, height=count * (PAGE_WIDTH / columns * 0.85 + 1.1) + 0.4,
                                    squeeze=False, height_ratios=[2, 1] * count)
    pairs = list(zip(axes[::2].flat, axes[1::2].flat, strict=True))  # the path, and its error below
    for panel in np.ravel(pairs[len(groups):]):
        panel.remove()
    errors = compare.spread(rows, "rmse")
    for (above, below), (name, runs) in zip(pairs, groups.items(), strict=False):
        true = truths[name]
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
        above.plot(true[:, 0], true[:, 2], color=TRUTH, linewidth=3, alpha=0.3, label="true path")
        for order, run in enumerate(runs["run"]):
            line = {"color": METHODS[method][1], "linewidth": 0.6, "alpha": 0.45, "label": "matched points shuffled"}
            if order == 0:
                line |= {"linewidth": 1.2, "alpha": 1, "label": "estimated path", "zorder": 3}
            estimated = paths[name, run] + (true[1] - paths[name, run][1])  # agree at frame 1, as for the RMSE
            above.plot(estimated[:, 0], estimated[:, 2], **line)
            below.plot(along, np.linalg.norm(estimated - true, axis=1), **line)
        row = errors.loc[name]
        span = f" ({row['lowest']:.2g}-{row['highest']:.2g})" if len(runs) > 1 else ""
        above.set_title(f"{name}: {row['mean']:.2g}{span} m", fontsize=8)
        above.set_aspect("equal", adjustable="datalim")
        below.set_ylim(0, None)
        below.set_xlabel("way (m)", fontsize=7.5, labelpad=1)
        for panel in (above, below):
            panel.tick_params(labelsize=6.5)
            panel.locator_params(nbins=4)
    for above, below in pairs[::columns]:
        above.set_ylabel("z (m) over x (m)", fontsize=7.5)
        below.set_ylabel("distance (m)", fontsize=7.5)
    style.legend_below(figure, axes[0, :1], 3)
    figure.suptitle("sequence: RMSE, mean (lowest-highest of the repetitions)", fontsize=9)
    return figure


def figure_4_07(runs):
    """Keypoints that masks leave, as a part of the thesis's 2000, against dilation width."""
    masked = compare.of_method(runs, "masked")
    kept = masked.groupby(["sequence", "dilation_width"])["mean_keypoints"].mean().unstack() / THESIS.max_keypoints
    figure, axes = style.new_figure(height=4.0)
    _lines(axes, kept)
    axes.set(xlabel="dilation width (pixels)", ylabel=f"keypoints, part of {THESIS.max_keypoints}", ylim=(0, None),
             title="Keypoints kept by masks of increasing dilation width")
    return figure


def figure_against_width(runs, metric):
    """Figures 4.9, 4.10: the metric against dilation width, one line a sequence; below, one panel a sequence with the
    band of its repetitions and that of all keypoints."""
    masked = compare.of_method(runs, "masked")
    baseline = compare.spread(compare.of_method(runs, "baseline"), metric)
    names = sorted(masked["sequence"].unique())
    label = f"{metric.upper()} (m)"
    rows = -(-len(names) // 4)
    figure = plt.figure(figsize=(PAGE_WIDTH, 3.8 + 1.35 * rows), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[3.2, 1.35 * rows + 0.6])
    axes = above.subplots()
    _lines(axes, masked.groupby(["sequence", "dilation_width"])[metric].mean().unstack())
    axes.set(xlabel="dilation width (pixels)", ylabel=label, ylim=(0, None),
             title=f"{metric.upper()} against dilation width, means over repetitions")
    _, panels = style.small_panels(names, "width (pixels)", below)
    for panel, name in zip(panels, names, strict=True):
        errors = compare.spread(masked[masked["sequence"] == name], metric, by="dilation_width")
        panel.fill_between(errors.index, errors["lowest"], errors["highest"], color=MASKED, alpha=0.25, linewidth=0,
                           label=f"masked, {BAND}")
        panel.plot(errors.index, errors["mean"], color=MASKED, marker="o", markersize=2, linewidth=1.1,
                   label="masked, mean")
        row = baseline.loc[name]
        panel.axhspan(row["lowest"], row["highest"], color=BASELINE, alpha=0.2, linewidth=0,
                      label=f"all keypoints, {BAND}")
        panel.axhline(row["mean"], color=BASELINE, linestyle="--", linewidth=1.1, label="all keypoints, mean")
        panel.set_ylim(0, None)
    below.supylabel(label, fontsize=8)
    style.legend_below(below, panels, 2)
    return figure


def figure_of_methods(runs, metric):
    """Figures 4.13, 4.15: the metric of baseline, best mask and plainly reduced, all sequences."""
    names, tables = _of_methods(runs, metric)
    figure, axes = style.new_figure(height=3.2)
    for offset, (method, table) in enumerate(tables.items()):
        _bar(axes, np.arange(len(names)) + (offset - 1) * 0.27, table, 0.25, method)
    axes.set_xticks(range(len(names)), names)
    axes.set(xlabel="sequence", ylabel=f"{metric.upper()} (m)")
    axes.grid(axis="x", visible=False)
    style.legend_below(figure, [axes], 3)
    return figure


def figure_of_sequences(runs, metric):
    """Figures 4.14, 4.16: the same, one panel a sequence with its own scale."""
    names, tables = _of_methods(runs, metric)
    figure, panels = style.small_panels(names)
    for panel, name in zip(panels, names, strict=True):
        for offset, (method, table) in enumerate(tables.items()):
            _bar(panel, [offset], table.loc[[name]], 0.8, method)
        panel.set_xticks([])
        panel.grid(axis="x", visible=False)
    figure.supylabel(f"{metric.upper()} (m)", fontsize=8)
    style.legend_below(figure, panels, 3)
    return figure


def _lines(axes, table):
    """One line a row of a table with one column a dilation width."""
    for index, (name, row) in enumerate(table.iterrows()):
        axes.plot(row.index, row, marker="o", markersize=2.5, label=name, **style.line_style(index))
    axes.set_xticks(table.columns.astype(int))
    axes.legend(title="sequence", loc="center left", bbox_to_anchor=(1, 0.5))


def _of_methods(runs, metric):
    """(sequences, {method: mean, lowest, highest, one row a sequence}) of the three methods of the thesis."""
    rows = {method: compare.of_method(runs, method) for method in ("baseline", "masked", "reduced")}
    rows["masked"] = thesis_tables.of_chosen_width(rows["masked"])
    names = sorted(rows["baseline"]["sequence"].unique())
    return names, {method: compare.spread(own, metric).reindex(names) for method, own in rows.items()}


def _bar(axes, positions, table, width, method):
    """Bars at the means of some rows of a table, with error bars that end at lowest and highest."""
    text, color, hatch = METHODS[method]
    axes.bar(positions, table["mean"], width, label=text, color=color, hatch=hatch, edgecolor="white", linewidth=0)
    errors = [table["mean"] - table["lowest"], table["highest"] - table["mean"]]
    axes.errorbar(positions, table["mean"], yerr=errors, fmt="none", ecolor="black", elinewidth=0.9, capsize=2)
