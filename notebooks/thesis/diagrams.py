"""Figures 2.1, 2.4 to 2.6 and A.1: diagrams, which do not depend on the data at hand."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import to_rgba_array
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from keypoint_study.report import style
from thesis.chapter2 import show_numbers


def figure_2_01() -> plt.Figure:
    """Figure 2.1: an image becomes maps; these are pooled, weighed and summed to class scores."""
    figure, axes = style.new_figure(height=2.3)
    axes.set(xlim=(0, 18.6), ylim=(0, 5.6))
    axes.set_axis_off()
    middle = 3.1
    inputs, outputs = (middle + 0.62 * (np.arange(count) - (count - 1) / 2) for count in (6, 4))
    for name, left, width, height, maps, color in (
        ("input\nimage", 0.1, 2.0, 3.0, 1, "#aaaaaa"),
        ("convolution\none map per kernel", 3.2, 1.6, 2.6, 5, style.BLUE),
        ("activation\nReLU", 6.5, 1.6, 2.6, 5, style.SKY),
        ("pooling\n2x2, largest", 9.8, 0.8, 1.3, 5, style.ORANGE),
        ("flatten\none vector", 12.4, 0.35, 4.6, 1, style.PINK),
    ):
        for offset in np.arange(maps) * 0.15:
            axes.add_patch(
                Rectangle(
                    (left + offset, middle - height / 2 - offset + 0.15 * (maps > 1)),
                    width,
                    height,
                    facecolor=color,
                    edgecolor="white",
                    linewidth=0.8,
                )
            )
        right = left + width + 0.15 * (maps - 1)
        axes.text((left + right) / 2, 0.45, name, ha="center", va="center", fontsize=8)
        axes.annotate(
            "",
            (right + 0.8, middle),
            (right + 0.1, middle),
            zorder=0,
            arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 0.9},
        )
    axes.plot(
        [[14.5], [17.2]],
        [np.repeat(inputs, 4), np.tile(outputs, 6)],
        color="#bbbbbb",
        linewidth=0.5,
        zorder=0,
    )
    for x, heights, color, name in (
        (14.5, inputs, style.GREEN, "dense\nall, weighted"),
        (17.2, outputs, style.RED, "softmax\nclass scores"),
    ):
        axes.scatter(np.full(len(heights), x), heights, s=110, color=color)
        axes.text(x, 0.45, name, ha="center", va="center", fontsize=8)
    return figure


def figure_2_04(values: np.ndarray, pooled: np.ndarray) -> plt.Figure:
    """Figure 2.4: a map (4, 4) and the largest value of each 2x2 block, (2, 2)."""
    figure, axes = style.new_figure(1, 2, height=1.9, width=3.6, width_ratios=[4, 2])
    colors = to_rgba_array([style.SKY, style.ORANGE, style.GREEN, style.PINK]).reshape(2, 2, 4)
    blocks = colors.repeat(2, axis=0).repeat(2, axis=1)
    # what is kept is darker
    blocks[..., 3] = np.where(values == pooled.repeat(2, axis=0).repeat(2, axis=1), 0.75, 0.25)
    show_numbers(axes[0], values, "feature map, 4x4", "d", blocks)
    show_numbers(axes[1], pooled, "2x2 max pooling,\nstride 2", "d", colors)
    axes[1].set_ylim(2.5, -1.5)  # four rows, as the other panel, so that all cells are of one size
    axes[0].annotate(
        "",
        (-0.05, 0.5),
        (1.03, 0.5),
        axes[1].transAxes,
        axes[0].transAxes,
        arrowprops={"arrowstyle": "-|>", "color": "black"},
    )
    return figure


def figure_2_05(
    features: np.ndarray, weights: np.ndarray, sums: np.ndarray, scores: np.ndarray
) -> plt.Figure:
    """Figure 2.5: features (5,) through a dense layer with weights (3, 5), and softmax.

    sums: the three weighted sums. scores: the probabilities of the three classes.
    """
    figure, axes = style.new_figure(1, 2, height=3.2, width_ratios=[3, 2])
    left, right = np.linspace(0, 1, 5), np.linspace(0.15, 0.85, 3)  # places of features and classes
    for (row, column), weight in np.ndenumerate(weights):
        axes[0].plot(
            (0, 1),
            (left[column], right[row]),
            color=style.BLUE if weight > 0 else style.RED,
            linewidth=1.5 * abs(weight),
        )
    for x, heights, numbers, form, color in (
        (0, left, features, ".1f", style.ORANGE),
        (1, right, sums, ".2f", style.GREEN),
    ):
        axes[0].scatter(np.full(len(heights), x), heights, s=600, color=color, zorder=2)
        for height, number in zip(heights, numbers):
            axes[0].text(x, height, format(number, form), ha="center", va="center", fontsize=8)
    axes[0].set(
        title="features x, weights W (lines), scores W x", xlim=(-0.15, 1.15), ylim=(1.15, -0.15)
    )
    axes[0].set_axis_off()
    axes[1].barh(right, scores, height=0.2, color=style.GREEN)
    axes[1].bar_label(axes[1].containers[0], fmt="%.3f", padding=3)
    axes[1].set(
        title="softmax: exp(score) / sum of all",
        xlim=(0, 1),
        ylim=(1.15, -0.15),
        xlabel="probability",
    )
    axes[1].set_yticks(right, ["class 1", "class 2", "class 3"])
    above = Line2D([], [], color=style.BLUE, label="weight above 0 (the wider, the larger)")
    below = Line2D([], [], color=style.RED, label="weight below 0")
    figure.legend(handles=[above, below], loc="outside lower center", ncols=2)
    return figure


def figure_2_06(x: np.ndarray, y: np.ndarray, loss: np.ndarray, path: np.ndarray) -> plt.Figure:
    """Figure 2.6: steps of gradient descent, path (n, 2), on the loss over two weights."""
    figure, axes = style.new_figure(height=3)
    levels = axes.contourf(x, y, loss, 20, cmap="cividis")
    axes.plot(*path.T, "o-", color="white", linewidth=1, markersize=3)
    axes.plot(*path[0], "s", color=style.RED, markersize=9, label="start")
    axes.plot(*path[-1], "*", color=style.RED, markersize=14, label=f"after {len(path) - 1} steps")
    axes.set(xlabel="first weight (no unit)", ylabel="second weight (no unit)")
    axes.legend(loc="upper left", labelcolor="white")
    figure.colorbar(levels, label="loss (no unit)")
    return figure


def summary_rows(model: Any) -> list[dict[str, Any]]:
    """Return a model's rows in the format of Figure A.1.

    A row is a dict of layer, output_shape, params and connected_to.
    """
    rows = []
    for layer in model.layers:
        tensors = layer._inbound_nodes[0].input_tensors
        shape = f"{tuple(layer.output.shape)}"
        if not tensors:
            shape = f"[{shape}]"
        kind = type(layer).__name__.replace("BatchNormalization", "BatchNormal")
        sources = [f"{tensor._keras_history.operation.name}[0][0]" for tensor in tensors]
        rows.append(
            {
                "layer": f"{layer.name} ({kind})",
                "output_shape": shape,
                "params": layer.count_params(),
                "connected_to": " ".join(sources),
            }
        )
    return rows


def figure_a_01(model: Any, rows: list[dict[str, Any]]) -> plt.Figure:
    """Figure A.1: the summary of a Keras model, as a table. rows: `summary_rows`."""
    trainable = sum(weights.numpy().size for weights in model.trainable_weights)
    total = model.count_params()
    lines = [("Layer (type)", "Output shape", "Parameters", "Connected to")]
    for row in rows:
        count = f"{row['params']:,}"
        lines.append((row["layer"], row["output_shape"], count, row["connected_to"]))
    lines += [
        ("", "", "", ""),
        ("Parameters, total", "", f"{total:,}", ""),
        ("trainable", "", f"{trainable:,}", ""),
        ("not trainable", "", f"{total - trainable:,}", ""),
    ]
    figure, axes = style.new_figure(height=0.155 * len(lines))
    axes.set(xlim=(0, 1), ylim=(len(lines), 0))
    axes.set_axis_off()
    for number, line in enumerate(lines):
        for cell, x, side in zip(line, (0.0, 0.36, 0.62, 0.66), ("left", "left", "right", "left")):
            axes.text(
                x,
                number + 0.5,
                cell,
                ha=side,
                va="center",
                fontsize=6.5,
                family="monospace",
                weight="bold" if number == 0 else "normal",
            )
    axes.axhline(1, color="black", linewidth=0.8)
    return figure
