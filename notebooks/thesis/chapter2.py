"""Figures 2.2, 2.7 to 2.12, drawn from the project's network and data.

Diagrams are in `diagrams`; cells of the notebooks draw lines and bars of one formula or table.
"""

from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from keypoint_study.report import style
from keypoint_study.report.style import BLUE, GREEN, KEYPOINT, ORANGE, RED, SKY
from thesis_repro.odometry import metrics


def figure_2_02(
    patch: np.ndarray,
    kernel: np.ndarray,
    bias: float,
    feature_map: np.ndarray,
    activated: np.ndarray,
    pixel: tuple[int, int],
) -> plt.Figure:
    """Figure 2.2: a kernel of the trained network's first layer on a patch of its input.

    It shows Equation 2.1. The upper panels show the patch (h, w, channels), its feature map (h, w)
    and the activation after normalisation and ReLU (h, w). The lower panels show the sum at one
    pixel (row, column): the kernel (k, k, channels) times the pixel's receptive field, plus the
    bias.
    """
    figure, axes = style.new_figure(2, 3, height=4.7, height_ratios=[1.35, 1])
    row, column = pixel
    height, width = patch.shape[:2]
    reach = kernel.shape[0] // 2
    limit = np.abs(feature_map).max()
    activation = f"normalised, ReLU: {activated[row, column]:.2f}"
    gray, signed = {"vmin": 0, "vmax": 255}, {"cmap": "PuOr", "vmin": -limit, "vmax": limit}
    for panel, image, title, look, unit, side in (
        (
            axes[0, 0],
            patch[..., 0],
            f"input x, {height}x{width}",
            gray,
            "gray value",
            2 * reach + 1,
        ),
        (axes[0, 1], feature_map, "feature map y", signed, "response", 1),
        (axes[0, 2], activated, activation, {"vmin": 0}, "activation", 1),
    ):
        style.show_image(panel, image, title, **look)
        figure.colorbar(panel.images[0], ax=panel, shrink=0.85, pad=0.03, label=unit)
        corner = (column - side / 2, row - side / 2)  # of a square around the pixel
        panel.add_patch(Rectangle(corner, side, side, fill=False, edgecolor=RED))
    field = patch[row - reach : row + reach + 1, column - reach : column + reach + 1]
    # every number is rounded before it is used, so that a reader can check the sum
    weights = kernel.astype(float).round(4)
    products = (field * weights).round(2) + 0.0  # no -0.00
    terms = np.array([bias, *products.sum(axis=(0, 1))]).round(2) + 0.0
    show_numbers(axes[1, 0], field[..., 0], "its receptive field x (marked)", ".0f")
    show_numbers(axes[1, 1], weights[..., 0], "times the kernel's weights w", ".4f")
    show_numbers(axes[1, 2], products[..., 0], "is w x", ".2f")
    shown = " + ".join(f"{term:.2f}" if term >= 0 else f"({term:.2f})" for term in terms)
    total, unrounded = f"{terms.sum():.2f}", f"{feature_map[row, column]:.2f}"
    remark = " (above: the first channel)" if len(terms) > 2 else ""
    remark += f"; {unrounded} before rounding" if unrounded != total else ""
    figure.supxlabel(f"y = b + Σ w x = {shown} = {total}{remark}", fontsize=9)
    return figure


def window_of_most_contrast(image: np.ndarray, side: int) -> tuple[slice, slice]:
    """Return the square window of an image (size, size) in which its values vary most.

    It is not at the edge of the image, where a convolution adds zeros to it.
    """
    places = range(1, len(image) - side, side // 4)
    windows = [np.s_[row : row + side, left : left + side] for row in places for left in places]
    return max(windows, key=lambda window: image[window].std())


UNET_PARTS = {
    "InputLayer": ("input", "#999999"),
    "Activation": ("convolution, normalisation, ReLU", BLUE),
    "MaxPooling2D": ("max pooling", ORANGE),
    "Conv2DTranspose": ("transposed convolution", GREEN),
    "Concatenate": ("concatenation", SKY),
    "output": ("1x1 convolution, softmax", RED),
}


def figure_2_07(model: Any) -> plt.Figure:
    """Figure 2.7: the U-Net, one box a stage.

    The height of a box shows the image size, its width the number of channels. Shapes and skip
    connections are read from the layers of the Keras model.
    """
    figure, axes = style.new_figure(height=4.0)
    axes.set_axis_off()
    ends: dict[str, tuple[float, float]] = {}  # of each box: its right edge and its middle
    left, previous = 0.0, None
    for layer in model.layers:
        kind = "output" if layer is model.layers[-1] else type(layer).__name__
        if kind not in UNET_PARTS:
            continue
        side, channels = layer.output.shape[2:]
        scale = side / model.input_shape[2]
        width, half, middle = (
            0.09 + 0.045 * np.log2(channels),
            0.175 + 0.525 * scale,
            1.5 * np.log2(scale),
        )
        center, color = left + width / 2, UNET_PARTS[kind][1]
        axes.add_patch(Rectangle((left, middle - half), width, 2 * half, color=color, linewidth=0))
        axes.text(center, middle + half + 0.06, channels, ha="center", va="bottom", fontsize=6)
        if kind in ("InputLayer", "MaxPooling2D", "Concatenate"):
            below = center, middle - half - 0.08
            axes.text(*below, f"{side}x{side}", ha="center", va="top", fontsize=7)
        if previous:
            axes.plot(*zip(previous, (left, middle)), color="#bbbbbb", linewidth=0.8, zorder=0)
        if kind == "Concatenate":  # of the box before it, and one further to the left
            skipped = min(ends[tensor._keras_history.operation.name] for tensor in layer.input)
            _arrow(axes, skipped, (left, middle), "#777777")
        ends[layer.name] = previous = (left + width, middle)
        left += width + 0.32
    axes.autoscale_view()
    handles: list[Any] = [Patch(color=color, label=text) for text, color in UNET_PARTS.values()]
    handles.append(
        Line2D([], [], color="#777777", marker=">", markersize=5, label="skip connection")
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def figure_2_08(poses: np.ndarray, title: str) -> plt.Figure:
    """Figure 2.8: camera poses C of a sequence from above, and the motions T between them.

    Equations 2.2, 2.3. poses: a few (n, 4, 4) camera-to-world poses, metres. Short arrows show the
    viewing direction.
    """
    # the first camera is at the origin and looks up the page
    poses = np.linalg.inv(poses[0]) @ poses
    positions, right, ahead = (poses[:, [0, 2], column] for column in (3, 0, 2))
    figure, axes = style.new_figure(height=3.8)
    axes.plot(*positions.T, "o", markersize=4, color="black")
    axes.quiver(
        *positions.T,
        *ahead.T,
        color=BLUE,
        zorder=3,
        angles="xy",
        units="height",
        scale=11,
        width=0.01,
    )
    for index, position in enumerate(positions):
        axes.annotate(f"$C_{{{index}}}$", position, 16 * right[index], **FORMULA)
    motions = np.linalg.inv(poses[:-1]) @ poses[1:]  # Equation 2.3, for T
    for index, (motion, start, end) in enumerate(zip(motions, positions, positions[1:]), start=1):
        formula = f"$T_{{{index},{index - 1}}}$"
        length = np.linalg.norm(motion[:3, 3])
        _arrow(axes, start, end, RED, shrinkA=3, shrinkB=3, connectionstyle="arc3,rad=-0.3")
        left = (end - start)[::-1] * (-1, 1)
        beside, offset = (start + end) / 2 + 0.15 * left, 11 * left / max(length, 1e-9)
        axes.annotate(formula, beside, offset, color=RED, **FORMULA)
        axes.plot([], [], " ", label=f"{formula}: {length:.1f} m, {metrics.angles(motion):.1f}°")
    # a square around the path, with room for the formulas
    x, z = (positions.max(axis=0) + positions.min(axis=0)) / 2
    room = 0.65 * max(np.ptp(positions, axis=0).max(), 1)
    axes.set(xlim=(x - room, x + room), ylim=(z - room, z + room), aspect="equal", title=title)
    axes.set(
        xlabel="x, to the right of the first camera (m)", ylabel="z, ahead of the first camera (m)"
    )
    legend = axes.legend(
        title="motion: length, turn",
        loc="center left",
        bbox_to_anchor=(1, 0.5),
        handlelength=0,
        handletextpad=0,
    )
    legend.get_title().set_fontsize(8)
    # rc_context would also reset whether notebooks show figures
    plt.setp(legend.get_texts(), parse_math=True)
    return figure


FORMULA: dict[str, Any] = {
    "textcoords": "offset points",
    "ha": "center",
    "va": "center",
    "fontsize": 10,
    "parse_math": True,
}


def two_cameras() -> plt.Figure:
    """Sketch of Equation 2.5: rays to one point from two places, and the way between these."""
    previous, current, point = np.array([[0.0, 0.0], [3.0, 0.5], [2.4, 2.6]])
    figure, axes = style.new_figure(height=2, width=4.6)
    axes.set(xlim=(-1.6, 4.8), ylim=(-0.4, 2.9), aspect="equal")
    axes.set_axis_off()
    axes.fill(*np.transpose([previous, current, point]), color=SKY, alpha=0.25)
    for start, end, color, formula, offset in (
        (previous, point, GREEN, "$x_{previous}$", (-26, 6)),
        (current, point, GREEN, "$R\\,x_{current}$", (28, 0)),
        (previous, current, RED, "$t$", (0, -9)),
    ):
        _arrow(axes, start, end, color, shrinkA=3, shrinkB=3)
        axes.annotate(formula, (start + end) / 2, offset, color=color, **FORMULA)
    for place, text, side in (
        (previous, "previous place ", "right"),
        (current, " place now", "left"),
    ):
        axes.text(*place, text, ha=side, va="center", fontsize=8)
    axes.text(*point, " point", va="bottom", fontsize=8)
    axes.plot(*np.transpose([previous, current, point]), "o", color="black", markersize=4)
    return figure


def figure_2_09(first: np.ndarray, second: np.ndarray, title: str) -> plt.Figure:
    """Figure 2.9: the 60 ORB matches of smallest descriptor distance between two frames.

    first, second: (height, width).
    """
    orb = cv2.ORB_create(1000)
    (points, descriptors), (second_points, second_descriptors) = (
        orb.detectAndCompute(image, None) for image in (first, second)
    )
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(descriptors, second_descriptors)
    best = sorted(matches, key=lambda match: match.distance)[:60]
    gap = np.full((first.shape[0] // 25, first.shape[1]), 255, np.uint8)
    both = np.vstack([first, gap, second])
    down = (0, first.shape[0] + gap.shape[0])
    figure, (axes,) = style.frame_panels(both)
    figure.set_figheight(figure.get_figheight() + 0.55)  # of the colour scale
    title = f"{title}: the {len(best)} most similar of {len(matches)} ORB matches"
    style.show_image(axes, both, title)
    ends = [
        (points[match.queryIdx].pt, np.add(second_points[match.trainIdx].pt, down))
        for match in best
    ]
    distances = [match.distance for match in best]
    lines = axes.add_collection(LineCollection(ends, array=distances, cmap="plasma", linewidth=0.8))
    figure.colorbar(
        lines,
        ax=axes,
        location="bottom",
        shrink=0.5,
        aspect=40,
        pad=0.02,
        label="descriptor bits that differ, of 256",
    )
    return figure


def figure_2_11(
    first: np.ndarray,
    second: np.ndarray,
    in_both: tuple[np.ndarray, np.ndarray],
    lost: np.ndarray,
    new: np.ndarray,
    titles: list[str],
) -> plt.Figure:
    """Figure 2.11: one scene from two viewpoints, with the keypoints of both and of one frame.

    in_both: the same keypoints in the first and in the second frame, a pair of arrays. lost, new:
    those of the first and of the second frame only (see `views.found_again`). All arrays are
    (n, 2) pixels.
    """
    figure, axes = style.frame_panels(first, 2)
    for panel, image, title, points in zip(axes, (first, second), titles, in_both, strict=True):
        style.show_image(panel, image, title)
        label = f"{len(points)} in both frames"
        panel.scatter(*points.T, s=5, color=GREEN, linewidths=0, label=label)
    only = f"{len(lost)} in the first frame only"
    axes[0].scatter(*lost.T, s=9, color=RED, marker="x", linewidths=0.8, label=only)
    only = f"{len(new)} in the second frame only"
    axes[1].scatter(*new.T, s=9, color=ORANGE, marker="^", linewidths=0, label=only)
    style.legend_below(figure, axes, 3)
    return figure


def figure_2_12(
    frame: np.ndarray,
    frame_keypoints: np.ndarray,
    label_map: np.ndarray,
    label_keypoints: np.ndarray,
    titles: tuple[str, str],
) -> plt.Figure:
    """Figure 2.12: a frame, its Shi-Tomasi keypoints, and those of its label map, with counts."""
    figure, axes = style.frame_panels(frame, 3)
    style.show_image(axes[0], frame, f"(a) {titles[0]}")
    style.show_image(axes[1], frame, f"(b) {len(frame_keypoints)} keypoints on the frame")
    axes[1].scatter(*frame_keypoints.T, **KEYPOINT)
    colors = style.label_colors(label_map, frame)
    style.show_image(axes[2], colors, f"(c) {len(label_keypoints)} keypoints on {titles[1]}")
    dots = axes[2].scatter(
        *label_keypoints.T,
        s=7,
        color="white",
        edgecolors="black",
        linewidths=0.4,
        label="keypoint",
    )
    style.class_legend(figure, label_map, also=[dots])
    return figure


def _arrow(axes: plt.Axes, start: Any, end: Any, color: str, **options: Any) -> None:
    properties = {"arrowstyle": "-|>", "color": color, "linewidth": 0.9} | options
    axes.annotate("", end, start, zorder=0, arrowprops=properties)


def show_numbers(
    axes: plt.Axes, values: np.ndarray, title: str, form: str, colors: np.ndarray | None = None
) -> None:
    """Show an array as a table of numbers.

    Its background is given colors (h, w, 4) or a color scale whose middle is zero.
    """
    image = values if colors is None else colors
    limit = 2.0 * np.abs(values).max()
    style.show_image(axes, image, title, cmap="PuOr", vmin=-limit, vmax=limit)
    for (row, column), value in np.ndenumerate(values):
        axes.text(column, row, format(value, form), ha="center", va="center", fontsize=8)


def enlarge_end(figure: plt.Figure, poses: np.ndarray, true: np.ndarray) -> None:
    """Figure 2.10: show beside a path from above where its end is, and where the true end is.

    figure: of `paths.figure_of_paths`. poses, true: (n, 4, 4).
    """
    above = figure.axes[0]
    ends = np.array([poses[-1, [0, 2], 3], true[-1, [0, 2], 3]])
    distance = float(np.linalg.norm(ends[0] - ends[1]))
    middle, half = ends.mean(axis=0), 2 * distance
    inset = above.inset_axes((0.03, 0.2, 0.42, 0.42))
    for line in above.lines:
        width = 1.5 * line.get_linewidth()
        inset.plot(*line.get_data(), color=line.get_color(), linewidth=width, alpha=0.7)
    arrow = {"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0}
    inset.annotate("", ends[0], ends[1], arrowprops=arrow)
    text = f"the end, enlarged:\n{100 * distance:.1f} cm apart"
    inset.text(0.5, 0.95, text, transform=inset.transAxes, fontsize=7, ha="center", va="top")
    limits = [(centre - half, centre + half) for centre in middle]
    inset.set(xlim=limits[0], ylim=limits[1], xticks=[], yticks=[], aspect="equal")
    inset.spines[:].set_visible(True)
    indicator = above.indicate_inset_zoom(inset, edgecolor="black")
    for place, connector in enumerate(indicator.connectors or ()):
        connector.set_visible(place == 1)  # upper left: the others cross the path
