"""Figures 4.6, 4.7, 4.9 to 4.17, and those of the controls and the budget.

`summary` is the table that `runner.run` returns; what is computed from it is in results.py. Lines and bars stand
at the mean over repetitions; bands and error bars go from the lowest to the highest of them.
"""

import numpy as np
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from thesis_repro.report.style import (
    BASELINE,
    BLUE,
    GREEN,
    MASKED,
    ORANGE,
    PAGE_WIDTH,
    PINK,
    RED,
    REDUCED,
    SKY,
    TRUTH,
    line_style,
    new_figure,
)
from thesis_repro.study import results

VARIANTS = {"baseline": ("all keypoints", BASELINE, "//"), "masked": ("masked, best width", MASKED, ""),
            "reduced": ("plainly reduced", REDUCED, "\\\\")}
FRAME_MS = 100  # KITTI's cameras take ten frames a second
STAGES = {"read": (SKY, ""), "segmentation": (RED, ""), "mask": (ORANGE, "//"), "detection": (BLUE, ""),
          "tracking": (GREEN, "\\\\"), "pose": (PINK, "")}


def figure_paths(truths, rows, paths, method, title):
    """Figures 4.6, 4.11, 4.12: estimated against true path of each sequence, seen from above.

    truths: {sequence: true positions (n, 3)}. rows: the runs to draw, of one method; repetition 0 is drawn bold, the
    others faint. paths: {(sequence, run): estimated positions (n, 3)}.
    """
    groups = {name: runs.sort_values("repetition") for name, runs in rows.groupby("sequence")}
    figure, panels, columns = _panels(len(groups), PAGE_WIDTH / min(4, len(groups)))
    color = VARIANTS[method][1]
    errors = results.over_orders(rows, "rmse")
    for panel, (name, runs) in zip(panels, groups.items()):
        panel.plot(truths[name][:, 0], truths[name][:, 2], color=TRUTH, linewidth=2.2, alpha=0.45, label="true path")
        for order, run in enumerate(runs["run"]):
            positions = paths[name, run]
            faint = {"linewidth": 0.6, "alpha": 0.45, "label": "other orders of the correspondences"}
            bold = {"linewidth": 1.2, "label": "estimated path", "zorder": 3}
            panel.plot(positions[:, 0], positions[:, 2], color=color, **(faint if order else bold))
        row = errors.loc[name]
        span = f"\n{row['lowest']:.2f} to {row['highest']:.2f} m" if len(runs) > 1 else ""
        panel.set_title(f"{name}: {row['mean']:.2f} m{span}", fontsize=7.5)
        panel.set_aspect("equal", adjustable="datalim")
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(MaxNLocator(4))
    for panel in panels[-columns:]:
        panel.set_xlabel("x (m)")
    for panel in panels[::columns]:
        panel.set_ylabel("z (m)")
    handles, labels = panels[0].get_legend_handles_labels()
    named = dict(zip(labels, handles))
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3)
    figure.suptitle(f"{title}; RMSE: mean (lowest to highest of the repetitions)", fontsize=9)
    return figure


def _panels(count, height):
    """(figure, axes in use, columns) of a grid with one panel a sequence, each `height` inches high."""
    columns = min(4, count)
    rows = -(-count // columns)
    figure, axes = new_figure(rows, columns, height=height * rows + 0.5, squeeze=False)
    for panel in axes.flat[count:]:
        panel.set_axis_off()
    return figure, list(axes.flat[:count]), columns


def figure_4_07(summary):
    """Fraction of keypoints kept, relative to the baseline's mean number, against dilation width."""
    masked = results.of_method(summary, "masked")
    kept = masked.groupby(["sequence", "dilation_width"])["mean_keypoints"].mean().unstack()
    kept = kept.div(results.over_orders(results.of_method(summary, "baseline"), "mean_keypoints")["mean"], axis=0)
    figure, axes = new_figure(height=4.0)
    _lines(axes, kept)
    axes.set(xlabel="dilation width (pixels)", ylabel="fraction of keypoints kept", ylim=(0, None),
             title="Keypoints kept by masks of increasing dilation width")
    axes.axhline(1, color="#999999", linewidth=0.8, linestyle=":")
    return figure


def _lines(axes, table):
    """One line a row of a table with one column a dilation width."""
    for index, (name, row) in enumerate(table.iterrows()):
        axes.plot(row.index, row, marker="o", markersize=2.5, label=name, **line_style(index))
    axes.set_xticks(table.columns.astype(int))
    axes.legend(title="sequence", loc="center left", bbox_to_anchor=(1, 0.5))


def figure_against_width(summary, metric):
    """Figures 4.9, 4.10: the metric against dilation width, one line a sequence, and one panel a sequence below with
    the band of its repetitions and that of all keypoints."""
    masked = results.of_method(summary, "masked")
    baseline = results.over_orders(results.of_method(summary, "baseline"), metric)
    names = sorted(masked["sequence"].unique())
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    label = f"{metric.upper()} (m)"
    figure, _ = new_figure(height=3.8 + 1.35 * rows)
    figure.clear()
    above, below = figure.subfigures(2, 1, height_ratios=[3.2, 1.35 * rows + 0.6])
    axes = above.subplots()
    _lines(axes, masked.groupby(["sequence", "dilation_width"])[metric].mean().unstack())
    axes.set(xlabel="dilation width (pixels)", ylabel=label, ylim=(0, None),
             title=f"{metric.upper()} against dilation width, means over repetitions")
    panels = below.subplots(rows, columns, squeeze=False, sharex=True)
    for panel, name in zip(panels.flat, names):
        errors = results.over_orders(masked[masked["sequence"] == name], metric, by="dilation_width")
        panel.fill_between(errors.index, errors["lowest"], errors["highest"], color=MASKED, alpha=0.25, linewidth=0,
                           label="lowest to highest, masked")
        panel.plot(errors.index, errors["mean"], color=MASKED, marker="o", markersize=2, linewidth=1.1,
                   label="mean, masked")
        if name in baseline.index:
            row = baseline.loc[name]
            panel.axhspan(row["lowest"], row["highest"], color=BASELINE, alpha=0.2, linewidth=0,
                          label="lowest to highest, all keypoints")
            panel.axhline(row["mean"], color=BASELINE, linestyle="--", linewidth=1.1, label="mean, all keypoints")
        panel.set_title(name, fontsize=8, pad=3)
        panel.set_ylim(0, None)
        panel.xaxis.set_major_locator(MaxNLocator(4, integer=True))
        panel.tick_params(labelsize=7)
    for panel in panels.flat[len(names):]:
        panel.set_axis_off()
    for panel in panels.flat[max(0, len(names) - columns):len(names)]:
        panel.tick_params(labelbottom=True)
        panel.set_xlabel("width (pixels)", fontsize=8)
    for panel in panels[:, 0]:
        panel.set_ylabel(label, fontsize=8)
    named = {text: handle for handle, text in zip(*panels[0, 0].get_legend_handles_labels())}
    below.legend([named[text] for text in sorted(named, reverse=True)], sorted(named, reverse=True),
                 loc="outside lower center", ncols=2)
    return figure


def _compared(summary, metric):
    """Mean, lowest and highest of the three methods of the thesis, {method: table with one row a sequence}."""
    rows = {"baseline": results.of_method(summary, "baseline"), "masked": results.of_best_width(summary),
            "reduced": results.of_method(summary, "reduced")}
    names = sorted(rows["baseline"]["sequence"].unique())
    return names, {method: results.over_orders(runs, metric).reindex(names) for method, runs in rows.items()}


def _bar(axes, position, table, width, method):
    text, color, hatch = VARIANTS[method]
    axes.set_axisbelow(True)
    axes.bar(position, table["mean"], width, label=text, color=color, hatch=hatch, edgecolor="white", linewidth=0)
    errors = np.array([table["mean"] - table["lowest"], table["highest"] - table["mean"]])
    axes.errorbar(position, table["mean"], yerr=errors.reshape(2, -1), fmt="none", ecolor="black", elinewidth=0.9,
                  capsize=2)


def figure_comparison(summary, metric):
    """Figures 4.13, 4.15: the metric of baseline, best mask and plainly reduced, all sequences."""
    names, tables = _compared(summary, metric)
    figure, axes = new_figure(height=3.2)
    positions = np.arange(len(names))
    for offset, (method, table) in enumerate(tables.items()):
        _bar(axes, positions + (offset - 1) * 0.27, table, 0.25, method)
    axes.set_xticks(positions, names)
    axes.set(xlabel="sequence", ylabel=f"{metric.upper()} (m)")
    axes.grid(axis="x", visible=False)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def figure_breakdown(summary, metric):
    """Figures 4.14, 4.16: the same, one panel a sequence with its own scale."""
    names, tables = _compared(summary, metric)
    figure, panels, columns = _panels(len(names), 1.7)
    for panel, name in zip(panels, names):
        for offset, (method, table) in enumerate(tables.items()):
            _bar(panel, offset, table.loc[name], 0.8, method)
        panel.set_title(name)
        panel.set_xticks([])
        panel.grid(axis="x", visible=False)
    for panel in panels[::columns]:
        panel.set_ylabel(f"{metric.upper()} (m)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def figure_controls(summary):
    """Mean change of RMSE and MAE with masks of one width and with each control; one column of panels an estimator."""
    table = results.controls(summary)
    table = table[table["method"] != "baseline"]
    methods = [method for method in results.CONTROLS if method in set(table["method"])]
    poses = [estimator for estimator in results.ESTIMATORS if (table["estimator"] == estimator).any()]
    figure, axes = new_figure(2, len(poses), height=1.6 + 0.5 * len(methods), sharex="col", sharey=True, squeeze=False)
    for column, estimator in enumerate(poses):
        extreme = [0.0]
        for panel, metric in zip(axes[:, column], ("rmse", "mae")):
            changes = results.control_changes(summary, metric, estimator)
            panel.axvline(0, color="black", linewidth=0.8)
            for row in table[table["estimator"] == estimator].to_dict("records"):
                y, masked = methods.index(row["method"]), row["method"] == "masked"
                color = MASKED if masked else BASELINE
                values = changes[row["method"]].dropna()
                panel.plot(values, np.full(len(values), y - 0.24), "o", color="#555555", alpha=0.45, markersize=3.5,
                           markeredgewidth=0)
                panel.plot([row[f"{metric}_low"], row[f"{metric}_high"]], [y + 0.1] * 2, color=color, linewidth=2.4)
                panel.plot(row[metric], y + 0.1, "D" if masked else "o", color=color, markersize=5.5,
                           markeredgecolor="white")
                extreme += list(values)
            panel.set_title(f"{metric.upper()}, {results.ESTIMATORS[estimator]}")
            panel.grid(axis="y", visible=False)
        scaled = _percent_scale(axes[:, column], min(extreme), max(extreme))
        axes[1, column].set_xlabel("change from all keypoints (%)" + scaled * ",\non the scale of the errors' ratio")
    names = results.control_names(summary)
    axes[0, 0].set_yticks(range(len(methods)), [names[method] for method in methods])
    axes[0, 0].set_ylim(len(methods) - 0.5, -0.6)
    figure.suptitle("Grey: sequences. Marker and bar: their mean and its "
                    f"{results.LEVEL} % interval. Left of 0 is better than all keypoints.", fontsize=8)
    return figure


def _percent_scale(panels, lowest, highest):
    """A scale of percent changes on which half and double are equally far from 0, where changes are that large.

    Returns whether they are.
    """
    if highest <= 100:
        return False
    low, high = (100 + max(lowest, -99)) / 115 - 1, (100 + highest) / 100 * 1.15 - 1
    step = 2.0 if (1 + high) / (1 + low) < 16 else 4.0  # as many times the error from tick to tick
    for panel in panels:
        panel.set_xscale("function", functions=(lambda x: np.log1p(np.maximum(x, -99.9) / 100),
                                                lambda x: 100 * np.expm1(x)))
        panel.set_xlim(100 * low, 100 * high)
        panel.xaxis.set_major_locator(FixedLocator(100 * (step ** np.arange(-2, 9) - 1)))
        panel.xaxis.set_minor_locator(NullLocator())
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:+.0f}" if value else "0"))
    return True


def figure_keypoints(summary, estimator):
    """Error against number of keypoints, one line a source of masks: over all sequences, then each by itself.

    estimator: estimator. A line joins the widths of a source; bars go from the lowest to the highest repetition, above over
    the interval of the mean.
    """
    table, means = (rows[rows["estimator"] == estimator] for rows in (results.errors(summary), results.side_by_side(summary)))
    names, sources = sorted(table["sequence"].unique()), results.sources(summary)
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure, _ = new_figure(height=3.4 + 1.6 * rows)
    figure.clear()
    above, below = figure.subfigures(2, 1, height_ratios=[2.9, 1.6 * rows + 0.5])
    axes = above.subplots()
    for index, source in enumerate(sources):
        own = means[means["source"] == source].sort_values("kept")
        change, line = own["rmse_change"], line_style(index)
        spread = np.array([change - own["rmse_low"], own["rmse_high"] - change])
        axes.errorbar(own["kept"], change, yerr=None if np.isnan(spread).all() else spread, marker="o", markersize=3,
                      elinewidth=0.7, label=source, **line)
    axes.plot(100, 0, "D", color="black", markersize=5, label="all keypoints")
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(xlabel="keypoints kept (%)", ylabel="change of RMSE (%)",
             title=f"Error against keypoints, mean over sequences, {results.ESTIMATORS[estimator]}")
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    panels = below.subplots(rows, columns, squeeze=False)
    for panel, name in zip(panels.flat, names):
        of_name = table[table["sequence"] == name]
        for index, source in enumerate(["", *sources]):
            own = of_name[of_name["source"] == source].sort_values("mean_keypoints")
            line = line_style(index - 1) if source else {"color": "black", "linestyle": "none"}
            panel.errorbar(own["mean_keypoints"], own["rmse"],
                           yerr=[own["rmse"] - own["rmse_lowest"], own["rmse_highest"] - own["rmse"]],
                           marker="o" if source else "D", markersize=2.5, linewidth=1, elinewidth=0.6, **line)
        panel.set_title(name, fontsize=8, pad=3)
        panel.set_ylim(0, None)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(MaxNLocator(4))
    for panel in panels.flat[len(names):]:
        panel.set_axis_off()
    for panel in panels.flat[max(0, len(names) - columns):len(names)]:
        panel.set_xlabel("keypoints", fontsize=8)
    for panel in panels[:, 0]:
        panel.set_ylabel("RMSE (m)", fontsize=8)
    return figure


def figure_4_17(seconds):
    """Percent time savings of each dilation width (Equation 4.2), from the table of `budget.time_runs`; dots:
    of single sequences."""
    savings = results.time_savings(seconds)
    figure, axes = new_figure(height=3.0)
    axes.bar(savings.index.astype(int), savings, color=MASKED, label="all sequences together")
    single = [results.time_savings(rows) for _, rows in seconds.groupby("sequence")]
    for number, of_one in enumerate(single):
        axes.plot(of_one.index.astype(int), of_one, "o", color="#333333", alpha=0.5, markersize=3, markeredgewidth=0,
                  label="one sequence" if number == 0 else None)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xticks(savings.index.astype(int))
    axes.set(xlabel="dilation width (pixels)", ylabel="change of time (%)",
             title="Time of the timed frames against all keypoints (negative: time saved)")
    axes.grid(axis="x", visible=False)
    return figure


def figure_budget(measured, overlapped):
    """Milliseconds a frame of every stage, from reading the frame to its estimator, against KITTI's ten frames a second.

    measured: method, stage and milliseconds (`budget.measure`). overlapped: method and milliseconds between frames
    where the next frame is read and segmented beside the odometry of this one (`budget.measure_overlapped`).
    """
    methods = list(measured["method"].unique())
    figure, axes = new_figure(height=1.4 + 0.5 * len(methods))
    axes.set_axisbelow(True)
    left = dict.fromkeys(methods, 0.0)
    for stage, (color, hatch) in STAGES.items():
        rows = measured[measured["stage"] == stage].set_index("method")["milliseconds"].reindex(methods).fillna(0)
        axes.barh(methods, rows, 0.6, left=list(left.values()), label=stage, color=color, hatch=hatch,
                  edgecolor="white", linewidth=0.5)
        for method in methods:
            left[method] += rows[method]
    between = overlapped.set_index("method")["milliseconds"].reindex(methods)
    axes.plot(between, range(len(methods)), "D", color="black", markeredgecolor="white", markersize=6,
              linestyle="none", label="between frames, overlapped")
    for place, method in enumerate(methods):
        end = np.nanmax([left[method], between[method] + 1])
        axes.text(end, place, f"  {left[method]:.0f} ms", va="center", ha="left", fontsize=8)
    axes.axvline(FRAME_MS, color="black", linewidth=1, linestyle="--")
    axes.text(FRAME_MS, -0.4, "10 frames a second ", ha="right", va="bottom", fontsize=8)
    axes.set(xlim=(0, max(FRAME_MS, *left.values(), between.max()) * 1.12), xlabel="time a frame (ms)",
             ylim=(len(methods) - 0.6, -0.65))
    axes.grid(axis="y", visible=False)
    handles = dict(zip(*reversed(axes.get_legend_handles_labels())))
    labels = [*STAGES, "between frames, overlapped"]
    figure.legend([handles[label] for label in labels], labels, loc="outside lower center", ncols=4)
    return figure
