"""Figures 4.6, 4.7, 4.9 to 4.17 and Tables 4.1 to 4.3, from the tables that experiments.py leaves on disk.

`summary` has one row a run: sequence, run, variant (baseline, masked, reduced), dilation_width, frames, rmse, mae
(metres), mean_keypoints, flagged (frames whose pose was not estimated).
"""

import numpy as np
import pandas as pd

from thesis_repro.experiments import best_widths
from thesis_repro.figures import (BASELINE, MASKED, PAGE_WIDTH, REDUCED, REPORTED, TRUTH, line_style, new_figure)
from thesis_repro.metrics import percent_change

VARIANTS = {"baseline": ("all keypoints", BASELINE, "//"), "masked": ("masked, best width", MASKED, ""),
            "reduced": ("plainly reduced", REDUCED, "..")}


def table_4_1(summary, reported_as):
    """Best dilation width and mean number of keypoints of each sequence, the thesis's numbers beside them."""
    best = best_widths(summary)
    reported = {row["sequence"]: row for row in REPORTED["table_4_1"]}
    return pd.DataFrame({
        "sequence": best.index,
        "frames": best["frames"].to_numpy(),
        "dilation width (pixels)": best["dilation_width"].astype(int).to_numpy(),
        "mean keypoints": best["mean_keypoints"].round().astype(int).to_numpy(),
        f"width, {reported_as}": [_reported(reported, name, "dilation_width") for name in best.index],
        f"mean keypoints, {reported_as}": [_reported(reported, name, "mean_keypoints") for name in best.index],
    })


def _reported(reported, name, key):
    return pd.NA if name not in reported else reported[name][key]


def table_of_change(summary, metric, reported_as):
    """Tables 4.2 and 4.3: percent change (Equation 4.1) of the metric from all keypoints to the best mask.

    The thesis's "aggregate" is the sum of the sequences' percentages; mean and median stand beside it.
    """
    baseline = summary[summary["variant"] == "baseline"].set_index("sequence")[metric].sort_index()
    masked = best_widths(summary)[metric]
    change = percent_change(masked, baseline).reindex(baseline.index)
    number, key = {"rmse": ("4_2", "rmse"), "mae": ("4_3", "mae")}[metric]
    reported = REPORTED[f"table_{number}_{key}_percent_change"]
    theirs = pd.Series([reported.get(name, np.nan) for name in baseline.index], baseline.index)
    rows = [(name, baseline[name], masked.get(name, np.nan), change[name], theirs[name]) for name in baseline.index]
    everything = pd.Series(reported)
    rows += [("sum (the thesis's aggregate)", np.nan, np.nan, change.sum(), everything.sum()),
             ("mean", np.nan, np.nan, change.mean(), everything.mean()),
             ("median", np.nan, np.nan, change.median(), everything.median()),
             ("sequences improved", np.nan, np.nan, (change < 0).sum(), (everything < 0).sum())]
    label = metric.upper()
    table = pd.DataFrame(rows, columns=["sequence", f"{label}, all keypoints (m)", f"{label}, best mask (m)",
                                        "change (%)", f"change (%), {reported_as}"])
    return table.round({table.columns[1]: 4, table.columns[2]: 4, table.columns[3]: 2, table.columns[4]: 2})


def figure_paths(truths, paths, variant, title):
    """Figures 4.6, 4.11, 4.12: estimated against true path of each sequence, seen from above.

    paths: {sequence: (positions (n, 3), text for the panel)}.
    """
    columns = min(4, len(paths))
    rows = -(-len(paths) // columns)
    figure, axes = new_figure(rows, columns, height=PAGE_WIDTH / columns * rows + 0.5, squeeze=False)
    color = VARIANTS[variant][1]
    for panel, (name, (positions, text)) in zip(axes.flat, sorted(paths.items())):
        panel.plot(truths[name][:, 0], truths[name][:, 2], color=TRUTH, linewidth=2.2, alpha=0.45, label="true path")
        panel.plot(positions[:, 0], positions[:, 2], color=color, linewidth=1.1, label="estimated path")
        panel.set_title(f"{name}: {text}", fontsize=8)
        panel.set_aspect("equal", adjustable="datalim")
        panel.tick_params(labelsize=7)
    for panel in axes.flat[len(paths):]:
        panel.set_axis_off()
    for panel in axes[-1]:
        panel.set_xlabel("x (m)")
    for panel in axes[:, 0]:
        panel.set_ylabel("z (m)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.suptitle(title, fontsize=9)
    return figure


def figure_against_width(summary, column, label, title):
    """Figures 4.7, 4.9, 4.10: one line a sequence against the dilation width."""
    figure, axes = new_figure(height=4.0)
    masked = summary[summary["variant"] == "masked"].sort_values("dilation_width")
    for index, (name, rows) in enumerate(masked.groupby("sequence")):
        axes.plot(rows["dilation_width"], rows[column], marker="o", markersize=2.5, label=name, **line_style(index))
    axes.set(xlabel="dilation width (pixels)", ylabel=label, title=title, ylim=(0, None))
    axes.set_xticks(sorted(masked["dilation_width"].astype(int).unique()))
    axes.legend(title="sequence", loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def figure_4_07(summary):
    """Fraction of keypoints kept, relative to the baseline's mean number, against dilation width."""
    baseline = summary[summary["variant"] == "baseline"].set_index("sequence")["mean_keypoints"]
    kept = summary.assign(fraction=summary["mean_keypoints"] / summary["sequence"].map(baseline))
    figure = figure_against_width(kept, "fraction", "fraction of keypoints kept",
                                  "Keypoints kept by masks of increasing dilation width")
    figure.axes[0].axhline(1, color="#999999", linewidth=0.8, linestyle=":")
    return figure


def _compared(summary, metric):
    best = best_widths(summary)
    table = {"masked": best[metric]}
    for variant in ("baseline", "reduced"):
        table[variant] = summary[summary["variant"] == variant].set_index("sequence")[metric]
    return pd.DataFrame(table)[["baseline", "masked", "reduced"]].sort_index()


def figure_comparison(summary, metric):
    """Figures 4.13, 4.15: the metric of baseline, best mask and plainly reduced, all sequences."""
    table = _compared(summary, metric)
    figure, axes = new_figure(height=3.2)
    positions = np.arange(len(table))
    for offset, variant in enumerate(table):
        text, color, hatch = VARIANTS[variant]
        axes.bar(positions + (offset - 1) * 0.27, table[variant], 0.25, label=text, color=color, hatch=hatch,
                 edgecolor="white", linewidth=0)
    axes.set_xticks(positions, table.index)
    axes.set(xlabel="sequence", ylabel=f"{metric.upper()} (m)")
    axes.grid(axis="x", visible=False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def figure_breakdown(summary, metric):
    """Figures 4.14, 4.16: the same, one panel a sequence with its own scale."""
    table = _compared(summary, metric)
    columns = min(4, len(table))
    rows = -(-len(table) // columns)
    figure, axes = new_figure(rows, columns, height=1.7 * rows + 0.5, squeeze=False)
    for panel, (name, row) in zip(axes.flat, table.iterrows()):
        for offset, variant in enumerate(table):
            text, color, hatch = VARIANTS[variant]
            panel.bar(offset, row[variant], 0.8, color=color, hatch=hatch, edgecolor="white", linewidth=0, label=text)
        panel.set_title(name)
        panel.set_xticks([])
        panel.grid(axis="x", visible=False)
    for panel in axes.flat[len(table):]:
        panel.set_axis_off()
    for panel in axes[:, 0]:
        panel.set_ylabel(f"{metric.upper()} (m)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def time_savings(seconds):
    """Equation 4.2 for each dilation width, from the table of `experiments.time_runs`: percent by which the total
    time of all sequences changes.

    Negative where time is saved, as the thesis defines it. Mask making is included, prediction is not.
    """
    baseline = seconds[seconds["variant"] == "baseline"]["seconds"].sum()
    masked = seconds[seconds["variant"] == "masked"].groupby("dilation_width")["seconds"].sum()
    return percent_change(masked, baseline)


def figure_4_17(seconds):
    """Percent time savings of each dilation width (Equation 4.2)."""
    savings = time_savings(seconds)
    figure, axes = new_figure(height=3.0)
    axes.bar(savings.index.astype(int), savings, color=MASKED)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xticks(savings.index.astype(int))
    axes.set(xlabel="dilation width (pixels)", ylabel="change of total time (%)",
             title="Time against all keypoints (negative: time saved)")
    axes.grid(axis="x", visible=False)
    return figure
