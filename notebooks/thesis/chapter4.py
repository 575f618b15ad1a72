"""Figures 4.4 to 4.16: single frames, paths, and errors in metres.

`keypoint_study.report.comparison` shows ratios of errors.

Runs are rows of the table of `runner.run_all`. Lines and bars show the mean over repetitions, or
the only run. Bands and error bars go from the lowest to the highest repetition.
"""

from functools import partial
from itertools import compress
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.container import BarContainer
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from keypoint_study import ratios
from keypoint_study.report import style
from keypoint_study.report.style import (
    BASELINE,
    EDGE_COLOR,
    KEYPOINT,
    MASKED,
    PAGE_WIDTH,
    PINK,
    REDUCED,
    TRUTH,
)
from thesis import views
from thesis.views import View
from thesis_repro.odometry.loop import detect

DRAWN_METHODS = {
    "baseline": ("all keypoints", BASELINE),
    "masked": ("masked, best width", MASKED),
    "reduced": ("plainly reduced", REDUCED),
}
SQUEEZED = 3  # times as high: breaks the axis of bars, gives a panel of distances its own scale
LINES = ["-o", "--s", "-.^", ":D"] * 3  # of up to twelve sequences, beside their colours
BAND = "lowest to highest of the repetitions"
# cross on a failed run (see `ratios.has_failed`), and on a mean over runs of which one failed
FAILED: dict[str, Any] = {
    "linestyle": "none",
    "marker": "x",
    "color": "black",
    "markersize": 6,
    "markeredgewidth": 1.4,
    "zorder": 4,
    "clip_on": False,
    "label": "failed run",
}
# dashed, so that a path below it is seen
TRUE_PATH: dict[str, Any] = {
    "color": TRUTH,
    "linewidth": 0.8,
    "linestyle": (0, (4, 4)),
    "zorder": 3.5,
    "label": "true path",
}


def figure_4_04(
    frame: np.ndarray, edge_image: np.ndarray, keypoints: np.ndarray, title: str
) -> plt.Figure:
    """Figure 4.4: the keypoints, (n, 2) pixels, that the mask keeps along predicted boundaries."""
    figure, (axes,) = style.frame_panels(frame)
    bright = max(np.percentile(frame, 98), 1)
    brighter = np.clip(230 * (frame / bright) ** 0.6, 0, 255).astype(np.uint8)
    style.show_image(axes, views.with_edges(brighter, edge_image), title)
    axes.scatter(*keypoints.T, s=9, color=KEYPOINT["color"], edgecolors="black", linewidths=0.4)
    return figure


def figure_4_05(
    frame: np.ndarray, label_map: np.ndarray, mask: np.ndarray, title: str
) -> plt.Figure:
    """Figure 4.5: a frame, its label map and mask, and the keypoints on the mask and off it.

    The detector finds more keypoints on the mask than there lie of all keypoints, because it looks
    for as many.
    """
    every, kept = detect(frame), detect(frame, mask=mask)
    columns, rows = every.astype(int).T
    dropped = every[mask[rows, columns] == 0]
    pictures = {
        f"(a) {title}": frame,
        f"(b) {len(every)} keypoints, wherever they are": (frame, every),
        "(c) label map: a class for each pixel": style.label_colors(label_map, frame),
        "(d) mask: white where classes meet": mask,
        f"(e) {len(kept)} keypoints on the mask: enough?": (frame, kept),
        f"(f) {len(dropped)} of (b) off the mask: needed?": (frame, dropped),
    }
    figure = views.pictures(frame, pictures, columns=2, label_maps=[label_map])
    figure.axes[5].collections[0].set_color(style.ORANGE)
    return figure


# around a keypoint of the frame before
RING: dict[str, Any] = {"s": 34, "facecolors": "none", "edgecolors": PINK, "linewidths": 1.1}


def figure_4_08(windows: list[View], title: str) -> plt.Figure:
    """Figure 4.8: one place in consecutive frames, where keypoints jump.

    windows: from `views.follow_window`.
    """
    figure, axes = style.new_figure(1, len(windows), height=3.4)
    for panel, view in zip(axes, windows, strict=True):
        height, width = view.crop.shape
        text = f"frame {view.frame}: {len(view.keypoints)} keypoints"
        if view.expected is not None:
            text += f";\n{view.jumped} of {len(view.expected)} rings without a keypoint"
            panel.scatter(*view.expected.T, **RING)
        style.show_image(panel, views.with_edges(view.crop, view.edges), text)
        panel.scatter(*view.keypoints.T, **{**KEYPOINT, "s": 12})
        # a circle at the border would widen the panel
        panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    edge_color = tuple(np.array(EDGE_COLOR) / 255)
    dot = partial(Line2D, [], [], linestyle="none", marker="o")
    handles = [
        Patch(color=edge_color, label="edges of the predicted label map"),
        dot(markersize=4, color=KEYPOINT["color"], label="keypoints"),
        dot(
            markersize=6,
            markerfacecolor="none",
            color=PINK,
            label="where keypoints of the frame before are now",
        ),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    figure.suptitle(title, fontsize=9)
    return figure


# what is special in the runs of a method
SPECIAL = {"masked": ("dilation_width", ", width {:.0f}")}
SPECIAL["reduced"] = ("max_keypoints", ", {:.0f} keypoints")


def figure_paths(
    truths: dict[str, np.ndarray],
    rows: pd.DataFrame,
    paths: dict[tuple[str, str], np.ndarray],
) -> plt.Figure:
    """Figures 4.6, 4.11, 4.12: the paths from above, and below each its distance to the truth.

    truths: {sequence: ground-truth positions (n, 3)}. rows: the runs to draw, of one method;
    repetition 0 is bold, the other repetitions are faint. paths: {(sequence, run): estimated
    positions (n, 3)}. All paths of a sequence, also those of other methods, choose the limits of
    its panels, so that the figures can be compared. Where others would make the distances of these
    flat, the panel has its own scale and says so.
    """
    groups = dict(iter(rows.sort_values("repetition").groupby("sequence")))
    columns = min(4, len(groups))
    count = -(-len(groups) // columns)
    height = count * (PAGE_WIDTH / columns * 0.85 + 1.25) + 0.4
    figure, axes = style.new_figure(
        2 * count, columns, height=height, squeeze=False, height_ratios=[2, 1] * count
    )
    # panels of a path and of its error
    pairs = list(zip(axes[::2].flat, axes[1::2].flat, strict=True))
    for panel in np.ravel(pairs[len(groups) :]):
        panel.remove()
    errors = ratios.range_over_repetitions(rows, "rmse")
    for (above, below), (name, runs) in zip(pairs, groups.items(), strict=False):
        of_sequence = {run: path for (sequence, run), path in paths.items() if sequence == name}
        _draw_paths(above, below, truths[name], of_sequence, runs)
        # two digits that are not zero, such as 0.0078
        mean, *span = (f"{float(f'{value:.2g}'):g}" for value in errors.loc[name])
        repeated = f" ({'-'.join(span)})" if len(runs) > 1 else ""
        column, special = SPECIAL.get(runs["method"].iloc[0], ("frames", ""))
        title = f"{name}{special.format(runs[column].iloc[0])}\n{mean}{repeated} m"
        above.set_title(title, fontsize=8)
        below.set_xlabel("way (m)", fontsize=7.5, labelpad=1)
        for panel in (above, below):
            panel.tick_params(labelsize=6.5)
            panel.locator_params(nbins=4)
    for above, below in pairs[::columns]:
        above.set_ylabel("z (m) over x (m)", fontsize=7.5)
        below.set_ylabel("distance (m)", fontsize=7.5)
    style.legend_below(figure, [above for above, _ in pairs[: len(groups)]], 4)
    repeated = ", mean (lowest-highest of the repetitions)" if rows["repetition"].any() else ""
    figure.suptitle(f"RMSE of each sequence{repeated}", fontsize=9)
    return figure


def _draw_paths(
    above: plt.Axes,
    below: plt.Axes,
    true: np.ndarray,
    paths: dict[str, np.ndarray],
    runs: pd.DataFrame,
) -> None:
    """Draw the paths of runs over one sequence from above, and below their distances to the truth.

    true: positions (n, 3). paths: {run: (n, 3)}, also those of other runs.
    """
    above.plot(true[:, 0], true[:, 2], **TRUE_PATH)
    # paths meet at frame 1, as for the RMSE
    errors = {run: path - path[1] - (true - true[1]) for run, path in paths.items()}
    distances = {run: np.linalg.norm(error, axis=1) for run, error in errors.items()}
    for error in errors.values():
        above.update_datalim((true + error)[:, [0, 2]])
    along = np.insert(np.linalg.norm(np.diff(true, axis=0), axis=1).cumsum(), 0, 0)
    for run in runs.itertuples():
        line: dict[str, Any] = {"linewidth": 0.6, "alpha": 0.45, "label": "tracks shuffled"}
        if run.repetition == 0:
            line = {"linewidth": 2, "alpha": 1, "label": "estimated path", "zorder": 3}
        drawn = true + errors[run.run]
        for panel, across, up in (
            (above, drawn[:, 0], drawn[:, 2]),
            (below, along, distances[run.run]),
        ):
            panel.plot(across, up, color=DRAWN_METHODS[run.method][1], **line)
            if run.failed > 0 or run.lost > 0:
                panel.plot(across[-1], up[-1], **FAILED)
    above.set_aspect("equal", adjustable="datalim")
    highest = max(distance.max() for distance in distances.values())
    highest_drawn = max(distances[run].max() for run in runs["run"])
    if highest > SQUEEZED * highest_drawn:
        highest = highest_drawn
        below.set_title("own scale", fontsize=6.5, loc="right", pad=2)
    below.set_ylim(0, 1.05 * highest or None)


def figure_against_width(masked: pd.DataFrame, baseline: pd.DataFrame, metric: str) -> plt.Figure:
    """Figures 4.9, 4.10: the metric against dilation width, one line a sequence.

    Below, one panel a sequence has a bar at each width that was repeated, and the band of the
    repetitions with all keypoints. masked, baseline: the runs with masks of each width, and with
    all keypoints.
    """
    names = sorted(masked["sequence"].unique())
    label = f"{metric.upper()} (m)"
    rows = -(-len(names) // 4)
    # Any, because subfigures may also return a single one
    figure: Any = plt.figure(figsize=(PAGE_WIDTH, 4.8 + 1.35 * rows), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[4.2, 1.35 * rows + 0.6])
    errors = ratios.range_over_repetitions(masked, metric, by=["sequence", "dilation_width"])
    failed = ratios.has_failed(masked).groupby([masked["sequence"], masked["dilation_width"]])
    crosses = errors["mean"][failed.any()]
    lines = errors["mean"].unstack("sequence")
    _draw_lines(above, lines, crosses)
    above.suptitle(f"{metric.upper()} against dilation width, by sequence", fontsize=9)
    above.supylabel(label, fontsize=9)
    of_all = ratios.range_over_repetitions(baseline, metric)
    _, panels = views.small_panels(names, "width (pixels)", below)
    for panel, name in zip(panels, names, strict=True):
        bars, band = errors.loc[name], of_all.loc[name]
        panel.vlines(
            bars.index,
            bars["lowest"],
            bars["highest"],
            color=MASKED,
            alpha=0.35,
            linewidth=4,
            label=f"masked, {BAND}",
        )
        panel.plot(
            bars["mean"], "o-", color=MASKED, markersize=2, linewidth=1.1, label="masked, mean"
        )
        if name in crosses:
            panel.plot(crosses[name], **FAILED)
        panel.axhspan(
            band["lowest"],
            band["highest"],
            color=BASELINE,
            alpha=0.2,
            linewidth=0,
            label=f"all keypoints, {BAND}",
        )
        panel.axhline(
            band["mean"], color=BASELINE, linestyle="--", linewidth=1.1, label="all keypoints, mean"
        )
        panel.set_ylim(0, None)
    below.supylabel(label, fontsize=8)
    style.legend_below(below, panels, 2)
    return figure


def _draw_lines(figure: Any, lines: pd.DataFrame, crosses: pd.Series) -> None:
    """Draw errors against the width. On one axis, more than four lines would meet.

    lines: one column a sequence; the half with lower errors has the lower one of two panels.
    crosses: the means with a failed run in them, by sequence and width.
    """
    names = list(lines.median().sort_values(ascending=False).index)
    count = 2 if len(names) > 4 else 1
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    for panel, half in zip(panels, np.array_split(names, count), strict=True):
        for name in sorted(half):
            place = lines.columns.get_loc(name)
            look = {"marker": "os^D"[place % 4], "markersize": 3.5, **style.line_style(place)}
            panel.plot(lines[name], label=name, **look)
            if name in crosses:
                panel.plot(crosses[name], **FAILED | {"label": None})
        style.ratio_axis(panel.yaxis, lines[half].to_numpy())
        panel.legend(loc="upper left", bbox_to_anchor=(1, 1))
        panel.set_xticks(lines.index)
    panels[-1].set_xlabel("dilation width (pixels)")


def mark_failed(axes: plt.Axes, failed: pd.DataFrame) -> None:
    """Mark bars that stand for a failed run by a cross. failed: the shape of the table drawn."""
    methods = [bars for bars in axes.containers if isinstance(bars, BarContainer)]
    for bars, name in zip(methods, failed, strict=True):
        for bar in compress(bars, failed[name].eq(True)):
            axes.plot(bar.get_x() + bar.get_width() / 2, bar.get_height(), **FAILED)


def bars(axes: plt.Axes, runs: pd.DataFrame, metric: str) -> None:
    """Draw a bar for each method of DRAWN_METHODS and each sequence at the mean of a metric.

    Error bars go from the lowest to the highest repetition. runs: those of all methods.
    """
    names = runs["method"].map({method: title for method, (title, _) in DRAWN_METHODS.items()})
    by_method = runs.assign(any_failed=ratios.has_failed(runs)).groupby(["sequence", names])
    table = by_method[metric].agg(["mean", "min", "max"]).unstack("method")
    mean, failed = table["mean"], by_method["any_failed"].any().unstack("method")
    whiskers = np.stack([mean - table["min"], table["max"] - mean]).transpose(2, 0, 1)
    colors = dict(DRAWN_METHODS.values())
    mean.plot.bar(
        ax=axes,
        yerr=np.where(whiskers > 0, whiskers, np.nan),
        color=[colors[name] for name in mean],
        legend=False,
        rot=0,
        width=0.8,
    )
    mark_failed(axes, failed)


def figure_of_bars(runs: pd.DataFrame, metric: str) -> plt.Figure:
    """Figures 4.13, 4.15: the bars of all sequences on one axis.

    The axis is broken where a sequence would squeeze all others. runs, metric: as for `bars`.
    """
    highest = runs.groupby("sequence")[metric].max().sort_values()
    broken = len(highest) > 1 and highest.iloc[-1] > SQUEEZED * highest.iloc[-2]
    parts: dict[str, Any] = {"height": 4, "height_ratios": [1, 2]} if broken else {"height": 3.4}
    figure, panels = style.new_figure(1 + broken, squeeze=False, sharex=True, **parts)
    for panel in panels.flat:
        bars(panel, runs, metric)
        panel.set(xlabel="", ylabel=f"{metric.upper()} (m)")
    names = sorted(highest.index)
    if max(map(len, names)) > 4:  # would run together
        panels[-1, 0].set_xticklabels(names, rotation=30, ha="right", rotation_mode="anchor")
    panels[-1, 0].set_xlabel("sequence")
    if broken:
        _break(panels[0, 0], panels[1, 0], highest)
    style.legend_below(figure, panels[-1], 4)
    return figure


def _break(above: plt.Axes, below: plt.Axes, highest: pd.Series) -> None:
    """Show in the lower panel all sequences but the highest, whose bars go on in the upper one."""
    for cross in (*above.lines, *below.lines):
        cross.set_clip_on(True)
    below.set_ylim(0, 1.1 * highest.iloc[-2])
    above.set_ylim(below.get_ylim()[1], 1.08 * highest.iloc[-1])
    above.spines["bottom"].set_visible(False)
    above.tick_params(bottom=False)
    slash: dict[str, Any] = {"marker": [(-1, -0.6), (1, 0.6)], "markersize": 8, "color": "black"}
    for panel, height in ((above, 0), (below, 1)):
        axis = panel.transAxes
        panel.plot(0, height, linestyle="none", transform=axis, clip_on=False, **slash)
    above.set_title(f"The axis is broken: {highest.index[-1]} is far above the others.", fontsize=8)


def panels_of_bars(runs: pd.DataFrame, metric: str) -> plt.Figure:
    """Figures 4.14, 4.16: a panel with its own scale for each sequence.

    runs, metric: as for `bars`.
    """
    names = sorted(runs["sequence"].unique())
    figure, panels = views.small_panels(names)
    for panel, name in zip(panels, names, strict=True):
        bars(panel, runs[runs["sequence"] == name], metric)
        panel.set(xticks=[], xlabel="")
    figure.supylabel(f"{metric.upper()} (m)", fontsize=8)
    style.legend_below(figure, panels, 4)
    return figure


def figures_beside(
    masked: pd.DataFrame, baseline: pd.DataFrame, of_methods: pd.DataFrame
) -> dict[str, plt.Figure]:
    """Return Figures 4.10 and 4.14 to 4.16, which repeat others for the MAE or by sequence.

    masked, baseline: as for `figure_against_width`. of_methods: as for `bars`.
    """
    return {
        "figure_4_10": figure_against_width(masked, baseline, "mae"),
        "figure_4_14": panels_of_bars(of_methods, "rmse"),
        "figure_4_15": figure_of_bars(of_methods, "mae"),
        "figure_4_16": panels_of_bars(of_methods, "mae"),
    }
