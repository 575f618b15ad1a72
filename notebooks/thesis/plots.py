"""Figures 3.2, 3.4, 3.5, 4.1 and 4.17: plots of one table or formula, for the notebooks' cells."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.patches import Patch

from thesis import thesis_tables
from thesis.captions import REPORTED
from thesis_repro.data import cityscapes
from thesis_repro.report import style


def figure_3_02(
    as_image: dict[str, np.ndarray], as_map: dict[str, np.ndarray], ids: np.ndarray, outside: int
) -> plt.Figure:
    """Figure 3.2: a label map transformed as an image (above) and as a label map (below).

    as_image, as_map: {title: (h, w) ids}. ids: those of the label map. outside: the id of pixels
    from outside the image in `as_map`; in `as_image` it is 0. Ids that are not there are white.
    """
    figure, axes = style.new_figure(2, 4, height=3.8)
    label_maps = []
    for column, title in enumerate(as_image):
        invented = ~np.isin(as_image[title], [*ids, 0])
        colors = cityscapes.colorize(as_image[title])
        colors[invented] = 255
        style.show_image(
            axes[0, column], colors, f"{title}\n{100 * invented.mean():.1f} % of no class here"
        )
        style.show_image(axes[1, column], cityscapes.colorize(as_map[title]), "")
        label_maps.append(as_map[title][as_map[title] != outside])
    texts = "transformed as an image\n(the appendix)", "as a label map\n(for training)"
    for panel, text in zip(axes[:, 0], texts, strict=True):
        panel.text(
            -0.12, 0.5, text, transform=panel.transAxes, rotation=90, ha="center", va="center"
        )
    white = Patch(facecolor="white", edgecolor="black", label="id of no class here")
    black = Patch(color="black", label="outside the image")
    style.class_legend(figure, *label_maps, also=[white, black])
    return figure


def figure_3_04() -> plt.Figure:
    """Figure 3.4: the focal loss (Equation 3.7, α = 1) for several γ."""
    probability = np.linspace(0.005, 1, 400)  # that the network gives to the true class
    figure, axes = style.new_figure(height=2.8)
    for index, gamma in enumerate((0, 0.5, 1, 2, 5)):
        axes.plot(
            probability,
            -((1 - probability) ** gamma) * np.log(probability),
            label=f"γ = {gamma:g}" + (" (cross-entropy)" if gamma == 0 else ""),
            **style.line_style(index),
        )
    axes.set(
        xlabel="probability p of the true class (no unit)",
        ylabel="focal loss, α = 1 (no unit)",
        xlim=(0, 1),
        ylim=(0, 5),
    )
    axes.legend()
    return figure


def focal_loss_and_two_values(gamma: float) -> plt.Figure:
    """Draw the focal loss (α = 1) for one γ beside the cross-entropy, with its values at two p."""
    probability = np.linspace(0.005, 1, 400)
    loss = -((1 - probability) ** gamma) * np.log(probability)
    figure, axes = style.new_figure(height=2.8)
    axes.plot(probability, -np.log(probability), **style.line_style(1), label="cross-entropy")
    axes.plot(probability, loss, label=f"focal loss, γ = {gamma:g}")
    for p in (0.3, 0.9):
        value = -((1 - p) ** gamma) * np.log(p)
        axes.plot(p, value, "ko", markersize=4)
        axes.annotate(f"{value:.4f}", (p, value), (0, 5), textcoords="offset points", fontsize=8)
    axes.set(xlabel="probability p of the true class", ylabel="loss", xlim=(0, 1), ylim=(0, 5))
    axes.legend()
    return figure


def figure_3_05(counts: np.ndarray, title: str) -> plt.Figure:
    """Figure 3.5: the pixels of each label id, counts (ids,), on a logarithmic scale."""
    present = sorted(
        (label for label in cityscapes.LABELS[: len(counts)] if counts[label.id]),
        key=lambda label: -counts[label.id],
    )
    pixels = [counts[label.id] for label in present]
    figure, axes = style.new_figure(height=3.4)
    # points, because the height of a bar means nothing on a logarithmic axis
    axes.scatter(
        [label.name for label in present],
        pixels,
        s=60,
        color=[np.array(label.color) / 255 for label in present],
        edgecolors="#555555",
        linewidths=0.5,
    )
    for position, count in enumerate(pixels):
        axes.annotate(
            f"{100 * count / sum(pixels):.2f} %",
            (position, count),
            (0, 6),
            textcoords="offset points",
            ha="center",
            fontsize=6.5,
        )
    style.ratio_axis(axes.yaxis, [min(pixels) / 2, 2 * max(pixels)])
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.set(ylabel="pixels", xlabel="category", title=title)
    axes.tick_params(axis="x", labelrotation=45, labelsize=8)
    for name in axes.get_xticklabels():
        name.set(ha="right", rotation_mode="anchor")
    axes.margins(x=0.05)
    axes.grid(axis="x", visible=False)
    return figure


def figure_4_01(history: pd.DataFrame) -> plt.Figure:
    """Figure 4.1: scores and loss of each epoch, with the best epoch marked.

    history: one row an epoch, with loss, metrics, and both on the validation set (val_).
    """
    best_epoch = history.loc[history["val_loss"].idxmin()]
    figure, axes = style.new_figure(1, 3, height=2.6)
    titles = {"f1-score": "(a) F1 score", "iou_score": "(b) IoU score", "loss": "(c) loss"}
    for panel, (column, title) in zip(axes, titles.items(), strict=True):
        panel.plot(history["epoch"], history[column], color=style.BLUE, label="training")
        panel.plot(
            history["epoch"],
            history[f"val_{column}"],
            color=style.ORANGE,
            linestyle="--",
            label="validation",
        )
        panel.plot(
            best_epoch["epoch"],
            best_epoch[f"val_{column}"],
            "o",
            color=style.ORANGE,
            markeredgecolor="black",
            markersize=6,
            label=f"lowest validation loss (epoch {best_epoch['epoch']:.0f})",
        )
        panel.set(title=title, xlabel="epoch", ylabel=f"{title[4:]} (no unit)")
        panel.xaxis.get_major_locator().set_params(integer=True)
    if history[["loss", "val_loss"]].min(axis=None) < 0:
        axes[2].axhline(0, color="black", linewidth=0.8)
    style.legend_below(figure, axes, 3)
    return figure


def figure_4_17(seconds: pd.DataFrame) -> plt.Figure:
    """Figure 4.17: the change of time by dilation width, of all timed sequences and of each.

    seconds: the table of `timing.time_runs`.
    """
    savings = thesis_tables.time_savings(seconds)
    figure, axes = style.new_figure(height=3.0)
    together = f"all {seconds['sequence'].nunique()} timed sequences together"
    axes.bar(savings.index.astype(int), savings, color=style.MASKED, label=together)
    dots = {"color": "#333333", "alpha": 0.5, "markersize": 3, "markeredgewidth": 0}
    for _, rows in seconds.groupby("sequence"):
        own = thesis_tables.time_savings(rows)
        axes.plot(own.index.astype(int), own, "o", label="a single timed sequence", **dots)
    least, most = REPORTED["headline_claims"]["time_savings_percent"]
    of_thesis = f"the thesis, on KITTI: {least} to {most} % saved with its best widths"
    axes.axhspan(-most, -least, color=style.GRAY, alpha=0.5, linewidth=0, zorder=3, label=of_thesis)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set_xticks(savings.index.astype(int))
    title = "Time of the timed frames against all keypoints (negative: time saved)"
    axes.set(xlabel="dilation width (pixels)", ylabel="change of time (%)", title=title)
    style.legend_below(figure, [axes], 2)
    axes.grid(axis="x", visible=False)
    return figure
