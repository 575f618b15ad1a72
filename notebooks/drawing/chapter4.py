"""Figures 4.2 to 4.16: single frames, errors in metres, and keypoints. comparison.py shows ratios
of errors.

`runs` is the table of `runner.run_jobs`. Lines and bars show the mean over repetitions, or the
only run.
Bands and error bars go from the lowest to the highest repetition.
"""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from drawing.flicker import View
from thesis_repro.data.cityscapes import colorize
from thesis_repro.odometry import THESIS
from thesis_repro.report import style
from thesis_repro.report.style import (
    BASELINE,
    EDGE_COLOR,
    KEYPOINT,
    MASKED,
    PAGE_WIDTH,
    PINK,
    REDUCED,
    TRUTH,
)
from thesis_repro.study import compare, thesis_tables

METHODS = {
    "baseline": ("all keypoints", BASELINE, "//"),
    "masked": ("masked, best width", MASKED, ""),
    "reduced": ("plainly reduced", REDUCED, "\\\\"),
}
BAND = "lowest to highest of the repetitions"


def figure_4_02(
    image: np.ndarray, label_map: np.ndarray, prediction: np.ndarray, model_name: str
) -> plt.Figure:
    """Figure 4.2: an image of the Cityscapes validation split, its label map and its prediction
    (Section 4.1).
    """
    figure, axes = style.new_figure(1, 3, height=2.5)
    style.show_image(axes[0], image, "image")
    style.show_image(axes[1], colorize(label_map), "label map")
    style.show_image(axes[2], colorize(prediction), f"prediction of\n{model_name}")
    style.class_legend(figure, label_map, prediction)
    return figure


def figure_4_03(
    frame: np.ndarray, prediction: np.ndarray, title: str, label_map: np.ndarray | None = None
) -> plt.Figure:
    """Figure 4.3: a KITTI frame, its predicted label map at the network's size, and its true
    label map if known.
    """
    label_maps = {"prediction": prediction} | (
        {} if label_map is None else {"true label map": label_map}
    )
    pictures = {
        text: style.label_colors(label_map, frame) for text, label_map in label_maps.items()
    }
    return style.pictures(frame, {title: frame} | pictures, label_maps=label_maps.values())


def figure_4_04(
    frame: np.ndarray, edge_image: np.ndarray, keypoints: np.ndarray, title: str
) -> plt.Figure:
    """Figure 4.4: the keypoints, (n, 2) pixels, that the mask keeps along the predicted
    boundaries.
    """
    figure, (axes,) = style.frame_panels(frame)
    brighter = np.clip(230 * (frame / max(np.percentile(frame, 98), 1)) ** 0.6, 0, 255).astype(
        np.uint8
    )
    style.show_image(axes, style.with_edges(brighter, edge_image), title)
    axes.scatter(*keypoints.T, s=9, color=KEYPOINT["color"], edgecolors="black", linewidths=0.4)
    return figure


def figure_4_05(
    frame: np.ndarray,
    all_keypoints: np.ndarray,
    prediction: np.ndarray,
    mask: np.ndarray,
    kept_keypoints: np.ndarray,
    dilation_width: int,
    title: str,
) -> plt.Figure:
    """Figure 4.5: the procedure in five panels: frame, all keypoints, prediction, dilated
    edges, kept keypoints.
    """
    all_title = f"(b) all {len(all_keypoints)} Shi-Tomasi keypoints"
    kept_title = f"(e) the {len(kept_keypoints)} keypoints that the mask keeps"
    return style.pictures(
        frame,
        {
            f"(a) {title}": frame,
            all_title: frame,
            "(c) prediction": style.label_colors(prediction, frame),
            f"(d) Canny edges dilated by {dilation_width}x{dilation_width}": mask,
            kept_title: frame,
        },
        {all_title: all_keypoints, kept_title: kept_keypoints},
        label_maps=[prediction],
    )


def figure_4_08(views: list[View], title: str) -> plt.Figure:
    """Figure 4.8: one place in consecutive frames, where keypoints jump. views: from
    `flicker.follow`.
    """
    figure, axes = style.new_figure(1, len(views), height=3.4)
    for panel, view in zip(axes, views, strict=True):
        height, width = view.crop.shape
        text = f"frame {view.frame}: {len(view.keypoints)} keypoints"
        if view.expected is not None:
            text += f";\n{view.jumped} of {len(view.expected)} rings without a keypoint"
            panel.scatter(
                *view.expected.T, s=34, facecolors="none", edgecolors=PINK, linewidths=1.1
            )
        style.show_image(panel, style.with_edges(view.crop, view.edges), text)
        panel.scatter(*view.keypoints.T, **{**KEYPOINT, "s": 12})
        # a circle at the border would widen the panel
        panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    marker: dict[str, Any] = {"linestyle": "none", "marker": "o"}
    figure.legend(
        handles=[
            Patch(
                color=tuple(np.array(EDGE_COLOR) / 255), label="edges of the predicted label map"
            ),
            Line2D([], [], **marker, markersize=4, color=KEYPOINT["color"], label="keypoints"),
            Line2D(
                [],
                [],
                **marker,
                markersize=6,
                markerfacecolor="none",
                color=PINK,
                label="where keypoints of the frame before are now",
            ),
        ],
        loc="outside lower center",
        ncols=3,
    )
    figure.suptitle(title, fontsize=9)
    return figure


def figure_paths(
    truths: dict[str, np.ndarray],
    rows: pd.DataFrame,
    paths: dict[tuple[str, str], np.ndarray],
    method: str,
) -> plt.Figure:
    """Figures 4.6, 4.11, 4.12: the paths from above, and below each path its distance to the ground
    truth.

    Small errors are enlarged in the paths, by a factor that is in the panel's title.
    truths: {sequence: ground-truth positions (n, 3)}. rows: the runs to draw, of one method;
    repetition 0 is bold, the other repetitions are faint. paths: {(sequence, run): estimated
    positions (n, 3)}.
    """
    groups = {name: runs.sort_values("repetition") for name, runs in rows.groupby("sequence")}
    columns = min(4, len(groups))
    count = -(-len(groups) // columns)
    figure, axes = style.new_figure(
        2 * count,
        columns,
        height=count * (PAGE_WIDTH / columns * 0.85 + 1.1) + 0.4,
        squeeze=False,
        height_ratios=[2, 1] * count,
    )
    # panels of a path and of its error
    pairs = list(zip(axes[::2].flat, axes[1::2].flat, strict=True))
    for panel in np.ravel(pairs[len(groups) :]):
        panel.remove()
    errors = compare.spread(rows, "rmse")
    for (above, below), (name, runs) in zip(pairs, groups.items(), strict=False):
        true = truths[name]
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
        above.plot(true[:, 0], true[:, 2], color=TRUTH, linewidth=3, alpha=0.3, label="true path")
        # paths meet at frame 1, as for the RMSE
        distances = [
            paths[name, run] - paths[name, run][1] - (true - true[1]) for run in runs["run"]
        ]
        room = 0.15 * np.ptp(true[:, [0, 2]], axis=0).max() / max(np.abs(distances).max(), 1e-9)
        factor = max(scale for scale in (1, 2, 5, 10, 20, 50, 100) if scale <= max(room, 1))
        for repetition, distance in enumerate(distances):
            line = {
                "color": METHODS[method][1],
                "linewidth": 0.6,
                "alpha": 0.45,
                "label": "matched points shuffled",
            }
            if repetition == 0:
                line |= {"linewidth": 1.2, "alpha": 1, "label": "estimated path", "zorder": 3}
            drawn = true + factor * distance
            above.plot(drawn[:, 0], drawn[:, 2], **line)
            below.plot(along, np.linalg.norm(distance, axis=1), **line)
        row = errors.loc[name]
        span = f" ({row['lowest']:.2g}-{row['highest']:.2g})" if len(runs) > 1 else ""
        enlarged = f"errors x{factor} in the path" if factor > 1 else "errors not enlarged"
        above.set_title(f"{name}: {row['mean']:.2g}{span} m\n{enlarged}", fontsize=8)
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
    repeated = ", mean (lowest-highest of the repetitions)" if rows["repetition"].any() else ""
    figure.suptitle(f"sequence: RMSE{repeated}", fontsize=9)
    return figure


def figure_4_07(runs: pd.DataFrame) -> plt.Figure:
    """Figure 4.7: the keypoints that masks keep, as a part of the thesis's 2000, against
    dilation width.
    """
    masked = compare.of_method(runs, "masked")
    kept = (
        masked.groupby(["sequence", "dilation_width"])["mean_keypoints"].mean().unstack()
        / THESIS.max_keypoints
    )
    figure, axes = style.new_figure(height=4.0)
    _lines(axes, kept)
    axes.set(
        xlabel="dilation width (pixels)",
        ylabel=f"keypoints, part of {THESIS.max_keypoints}",
        ylim=(0, None),
        title="Keypoints kept by masks of increasing dilation width",
    )
    return figure


def figure_against_width(runs: pd.DataFrame, metric: str) -> plt.Figure:
    """Figures 4.9, 4.10: the metric against dilation width, one line a sequence.

    Below, one panel a sequence has a bar at each width that was repeated, and the band of the
    repetitions with all keypoints.
    """
    masked = compare.of_method(runs, "masked")
    baseline = compare.spread(compare.of_method(runs, "baseline"), metric)
    names = sorted(masked["sequence"].unique())
    label = f"{metric.upper()} (m)"
    rows = -(-len(names) // 4)
    # Any, because subfigures may also return a single one
    figure: Any = plt.figure(figsize=(PAGE_WIDTH, 3.8 + 1.35 * rows), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[3.2, 1.35 * rows + 0.6])
    axes = above.subplots()
    _lines(axes, masked.groupby(["sequence", "dilation_width"])[metric].mean().unstack())
    axes.set(
        xlabel="dilation width (pixels)",
        ylabel=label,
        ylim=(0, None),
        title=f"{metric.upper()} against dilation width",
    )
    _, panels = style.small_panels(names, "width (pixels)", below)
    for panel, name in zip(panels, names, strict=True):
        errors = compare.spread(masked[masked["sequence"] == name], metric, by="dilation_width")
        panel.vlines(
            errors.index,
            errors["lowest"],
            errors["highest"],
            color=MASKED,
            alpha=0.35,
            linewidth=4,
            label=f"masked, {BAND}",
        )
        panel.plot(
            errors.index,
            errors["mean"],
            color=MASKED,
            marker="o",
            markersize=2,
            linewidth=1.1,
            label="masked, mean",
        )
        row = baseline.loc[name]
        panel.axhspan(
            row["lowest"],
            row["highest"],
            color=BASELINE,
            alpha=0.2,
            linewidth=0,
            label=f"all keypoints, {BAND}",
        )
        panel.axhline(
            row["mean"], color=BASELINE, linestyle="--", linewidth=1.1, label="all keypoints, mean"
        )
        panel.set_ylim(0, None)
    below.supylabel(label, fontsize=8)
    style.legend_below(below, panels, 2)
    return figure


def figure_of_methods(runs: pd.DataFrame, metric: str) -> plt.Figure:
    """Figures 4.13, 4.15: the metric with all keypoints, the best mask and plainly reduced
    keypoints, all sequences.
    """
    names, tables = _spread_by_method(runs, metric)
    figure, axes = style.new_figure(height=3.2)
    for offset, (method, table) in enumerate(tables.items()):
        _bar(axes, np.arange(len(names)) + (offset - 1) * 0.27, table, 0.25, method)
    axes.set_xticks(range(len(names)), names)
    axes.set(xlabel="sequence", ylabel=f"{metric.upper()} (m)")
    axes.grid(axis="x", visible=False)
    style.legend_below(figure, [axes], 3)
    return figure


def figure_of_sequences(runs: pd.DataFrame, metric: str) -> plt.Figure:
    """Figures 4.14, 4.16: the bars of `figure_of_methods`, one panel with a scale of its own
    for each sequence.
    """
    names, tables = _spread_by_method(runs, metric)
    figure, panels = style.small_panels(names)
    for panel, name in zip(panels, names, strict=True):
        for offset, (method, table) in enumerate(tables.items()):
            _bar(panel, [offset], table.loc[[name]], 0.8, method)
        panel.set_xticks([])
        panel.grid(axis="x", visible=False)
    figure.supylabel(f"{metric.upper()} (m)", fontsize=8)
    style.legend_below(figure, panels, 3)
    return figure


def _lines(axes: plt.Axes, table: pd.DataFrame) -> None:
    """Draw one line for each row of a table with one column for each dilation width."""
    for index, (name, row) in enumerate(table.iterrows()):
        axes.plot(row.index, row, marker="o", markersize=2.5, label=name, **style.line_style(index))
    axes.set_xticks(table.columns.astype(int))
    axes.legend(title="sequence", loc="center left", bbox_to_anchor=(1, 0.5))


def _spread_by_method(runs: pd.DataFrame, metric: str) -> tuple[list[str], dict[str, pd.DataFrame]]:
    """Return the sequences and, for each method of the thesis, a table (mean, lowest, highest)
    with one row each.
    """
    tables = {}
    for method in METHODS:
        rows = compare.of_method(runs, method)
        rows = thesis_tables.of_chosen_width(rows) if method == "masked" else rows
        tables[method] = compare.spread(rows, metric)
    names = sorted(tables["baseline"].index)
    return names, {method: table.reindex(names) for method, table in tables.items()}


def _bar(
    axes: plt.Axes,
    positions: np.ndarray | list[int],
    table: pd.DataFrame,
    width: float,
    method: str,
) -> None:
    """Draw bars at the means of a table, with error bars from lowest to highest of the
    repetitions.
    """
    label, color, hatch = METHODS[method]
    axes.bar(
        positions,
        table["mean"],
        width,
        label=label,
        color=color,
        hatch=hatch,
        edgecolor="white",
        linewidth=0,
    )
    table = table.where(table["highest"] > table["lowest"])  # a single run has no error bar
    errors = [table["mean"] - table["lowest"], table["highest"] - table["mean"]]
    axes.errorbar(
        positions, table["mean"], yerr=errors, fmt="none", ecolor="black", elinewidth=0.9, capsize=2
    )
