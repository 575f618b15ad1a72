"""The figures of chapter 2, drawn anew from the project's own network and data: networks, odometry, keypoints."""

import cv2
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba_array
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from thesis_repro.odometry import metrics
from thesis_repro.report import style
from thesis_repro.report.style import BASELINE, BLUE, GREEN, KEYPOINT, ORANGE, PINK, RED, SKY, TRUTH

GRAY, LIGHT_GRAY = "#777777", "#bbbbbb"


def figure_2_01():
    """Figure 2.1: a basic convolutional network as a diagram."""
    figure, axes = _diagram((0, 18.6), (0, 5.6), height=2.3)
    middle = 3.1
    for name, left, side, maps, color in (
            ("input\nimage", 0.2, 3.2, 1, "#aaaaaa"), ("convolution\none map per kernel", 3.5, 2.8, 5, BLUE),
            ("activation\nReLU", 6.9, 2.8, 5, SKY), ("pooling\n2x2, largest", 10.3, 1.4, 5, ORANGE)):
        for offset in np.arange(maps) * 0.15:
            axes.add_patch(Rectangle((left + offset, middle - side / 2 - offset + 0.3), 0.65 * side, side,
                                     facecolor=color, edgecolor="white", linewidth=0.8))
        axes.text(left + 0.325 * side + 0.075 * (maps - 1), 0.45, name, ha="center", va="center", fontsize=8)
    for start, end in ((2.4, 3.5), (5.95, 6.9), (9.35, 10.3), (11.85, 13.3)):
        _arrow(axes, (start, middle), (end, middle))
    inputs, outputs = (middle + 0.62 * (np.arange(count) - (count - 1) / 2) for count in (6, 4))
    axes.plot([[13.6], [16.3]], [np.repeat(inputs, 4), np.tile(outputs, 6)], color=LIGHT_GRAY, linewidth=0.5, zorder=0)
    for x, heights, color, name in ((13.6, inputs, GREEN, "dense\nall, weighted"),
                                    (16.3, outputs, RED, "softmax\nclass scores")):
        axes.scatter(np.full(len(heights), x), heights, s=110, color=color)
        axes.text(x, 0.45, name, ha="center", va="center", fontsize=8)
    return figure


def figure_2_02(patch, kernel, bias, feature_map, activated, where):
    """Figure 2.2 and Equation 2.1: a kernel of the trained network's first layer on a patch of its input.

    Above the patch (h, w, channels), its feature map (h, w) and what normalisation and ReLU leave (h, w). Below, for
    the pixel `where` (row, column), every number of the sum: kernel (k, k, channels) times its receptive field, + bias.
    """
    figure, axes = style.new_figure(2, 3, height=4.7, height_ratios=[1.35, 1])
    row, column = where
    reach, limit = kernel.shape[0] // 2, np.abs(feature_map).max()
    style.show_image(axes[0, 0], patch[..., 0], f"input x, {patch.shape[0]}x{patch.shape[1]}", vmin=0, vmax=255)
    style.show_image(axes[0, 1], feature_map, "feature map y", cmap="PuOr", vmin=-limit, vmax=limit)
    style.show_image(axes[0, 2], activated, f"normalised, ReLU: {activated[row, column]:.2f}", vmin=0)
    for panel, radius, text in zip(axes[0], (reach + 0.5, 0.5, 0.5), ("gray value", "response", "activation"),
                                   strict=True):
        figure.colorbar(panel.images[0], ax=panel, shrink=0.85, pad=0.03, label=text)
        panel.add_patch(Rectangle((column - radius, row - radius), 2 * radius, 2 * radius, fill=False, edgecolor=RED,
                                  linewidth=1.4))
    field = patch[row - reach:row + reach + 1, column - reach:column + reach + 1]
    _numbers(axes[1, 0], field[..., 0], "its receptive field x (marked)", ".0f")
    _numbers(axes[1, 1], kernel[..., 0], "times the kernel's weights w", ".4f")
    _numbers(axes[1, 2], (field * kernel)[..., 0], "is w x", ".2f")
    sums = (field * kernel).sum(axis=(0, 1))
    first = "" if len(sums) == 1 else " (above: the first channel)"
    figure.supxlabel(f"y = b + Σ w x = {bias:.2f} + {' + '.join(f'{term:.2f}' for term in sums)} = "
                     f"{bias + sums.sum():.2f}{first}", fontsize=9)
    return figure


def figure_2_03():
    """Figure 2.3: sigmoid against ReLU, with their derivatives."""
    x = np.linspace(-4, 4, 161)
    sigmoid = 1 / (1 + np.exp(-x))
    figure, axes = style.new_figure(1, 2, height=2.2)
    axes[0].plot(x, sigmoid, color=BLUE)
    axes[0].plot(x, sigmoid * (1 - sigmoid), color=RED, linestyle="--")
    axes[1].plot(x, np.maximum(x, 0), color=BLUE, label="activation")
    axes[1].plot([-4, 0, np.nan, 0, 4], [0, 0, np.nan, 1, 1], color=RED, linestyle="--", label="its derivative")
    axes[1].plot([0, 0], [0, 1], "o", color=RED, markersize=4, markerfacecolor="white")  # at 0 there is none
    for panel, title in zip(axes, ("sigmoid, 1 / (1 + exp(-x))", "ReLU, max(0, x)"), strict=True):
        panel.set(title=title, xlabel="x (no unit)", ylabel="value (no unit)")
    axes[1].legend()
    return figure


def figure_2_04():
    """Figure 2.4: a 4x4 array under 2x2 max pooling with stride 2."""
    values = np.random.default_rng(0).permutation(np.arange(1, 17)).reshape(4, 4)
    pooled = values.reshape(2, 2, 2, 2).max(axis=(1, 3))
    figure, axes = style.new_figure(1, 2, height=1.9, width=3.6, width_ratios=[4, 2])
    colors = to_rgba_array([SKY, ORANGE, GREEN, PINK]).reshape(2, 2, 4)
    blocks = colors.repeat(2, axis=0).repeat(2, axis=1)
    blocks[..., 3] = np.where(values == pooled.repeat(2, axis=0).repeat(2, axis=1), 0.75, 0.25)
    _numbers(axes[0], values, "feature map, 4x4", "d", blocks)
    _numbers(axes[1], pooled, "2x2 max pooling,\nstride 2", "d", colors)
    axes[1].set_ylim(2.5, -1.5)  # four rows, as the other panel, so that all cells are of one size
    axes[0].annotate("", (-0.05, 0.5), (1.03, 0.5), axes[1].transAxes, axes[0].transAxes,
                     arrowprops={"arrowstyle": "-|>", "color": "black"})
    return figure


def figure_2_05():
    """Figure 2.5: a feature vector through a dense layer and softmax to class scores."""
    rng = np.random.default_rng(0)
    features, weights = rng.normal(size=5).round(1), rng.normal(size=(5, 3)).round(1)
    logits = features @ weights
    scores = np.exp(logits) / np.exp(logits).sum()
    figure, axes = _diagram((0.4, 10.3), (-0.5, 5.0), height=2.4, width=5.4)
    heights = np.array([3.0, 2.0, 1.0])
    for (row, column), weight in np.ndenumerate(weights):
        axes.plot((1.0, 4.4), (row, heights[column]), color=RED if weight < 0 else BLUE,
                  linestyle="--" if weight < 0 else "-", linewidth=0.3 + 1.2 * abs(weight), alpha=0.7)
    for x, ys, numbers, digits in ((1.0, range(5), features, 1), (4.4, heights, logits, 2)):
        axes.scatter([x] * len(numbers), ys, s=560, facecolor="white", edgecolor="black", zorder=3)
        for y, number in zip(ys, numbers, strict=True):
            axes.text(x, y, f"{number:.{digits}f}", ha="center", va="center", fontsize=7.5, zorder=4)
    axes.barh(heights, 2.6 * scores, height=0.56, left=6.4, color=GREEN)
    for number, (y, score) in enumerate(zip(heights, scores, strict=True), 1):
        _arrow(axes, (4.9, y), (6.3, y))
        axes.text(6.55 + 2.6 * score, y, f"class {number}: {score:.2f}", va="center", fontsize=8)
    for x, text in ((1.0, "features"), (4.4, "dense layer"), (7.4, "softmax")):
        axes.text(x, 4.7, text, ha="center")
    axes.legend(handles=[Line2D([], [], color=BLUE, label="positive weight"),
                         Line2D([], [], color=RED, linestyle="--", label="negative weight")], loc="lower right")
    return figure


def figure_2_06():
    """Figure 2.6: steps of stochastic gradient descent on a loss surface with two valleys."""
    rng = np.random.default_rng(0)
    steps, rate, noise = 40, 0.1, 1.2

    def loss(x, y):
        return 0.5 * (x**2 - 1.5) ** 2 + 0.6 * y**2 + 0.35 * x

    def gradient(x, y):
        return np.array([2 * x * (x**2 - 1.5) + 0.35, 1.2 * y])

    path = [np.array([0.35, 1.5])]
    for _ in range(steps):
        path.append(path[-1] - rate * (gradient(*path[-1]) + noise * rng.normal(size=2)))
    x, y = np.meshgrid(np.linspace(-1.8, 1.8, 200), np.linspace(-1.2, 1.7, 160))
    figure, axes = style.new_figure(height=2.7, width=5.4)
    levels = axes.contourf(x, y, loss(x, y), 20, cmap="cividis")
    axes.plot(*np.transpose(path), color="white", linewidth=1, marker="o", markersize=3)
    for point, marker, size, label in ((path[0], "s", 9, "start"), (path[-1], "*", 14, f"after {steps} steps")):
        axes.plot(*point, marker, color=RED, markersize=size, markeredgecolor="white", label=label)
    for valley in (-1.28, 1.16):  # along y = 0, where the slope vanishes
        axes.text(valley, -0.7, f"loss {loss(valley, 0):.2f}", color="white", fontsize=8, ha="center")
    axes.set(xlabel="first weight (no unit)", ylabel="second weight (no unit)")
    axes.grid(visible=False)
    axes.legend(loc="upper left", labelcolor="white")
    figure.colorbar(levels, label="loss (no unit)")
    return figure


UNET_PARTS = {"InputLayer": ("input", "#999999"), "Activation": ("convolution, normalisation, ReLU", BLUE),
              "MaxPooling2D": ("max pooling", ORANGE), "Conv2DTranspose": ("transposed convolution", GREEN),
              "Concatenate": ("concatenation", SKY), "output": ("1x1 convolution, softmax", RED)}


def figure_2_07(model):
    """Figure 2.7: the U-Net drawn from the Keras model itself, a box per stage, as high as its image, as wide as deep.

    Shapes and skip connections are read from the model's layers, so another depth or width draws itself.
    """
    figure, axes = style.new_figure(height=4.0)
    axes.set_axis_off()
    largest = model.input_shape[2]
    x, boxes, before = 0.0, {}, None  # layer's name: left, right and middle height of its box
    for layer in model.layers:
        kind = "output" if layer is model.layers[-1] else type(layer).__name__
        if kind not in UNET_PARTS:
            continue
        side, channels = layer.output.shape[2:]
        width, half = 0.09 + 0.045 * np.log2(channels), 0.175 + 0.525 * side / largest
        y = -1.5 * np.log2(largest / side)
        axes.add_patch(Rectangle((x, y - half), width, 2 * half, color=UNET_PARTS[kind][1], linewidth=0))
        axes.text(x + width / 2, y + half + 0.06, channels, ha="center", va="bottom", fontsize=6)
        if kind in ("InputLayer", "MaxPooling2D", "Concatenate"):
            axes.text(x + width / 2, y - half - 0.08, f"{side}x{side}", ha="center", va="top", fontsize=7)
        if before:
            axes.plot((before[1], x), (before[2], y), color=LIGHT_GRAY, linewidth=0.8, zorder=0)
        if kind == "Concatenate":
            _, right, level = min(boxes[tensor._keras_history.operation.name] for tensor in layer.input)
            _arrow(axes, (right, level), (x, y), GRAY, zorder=0)
        before = boxes[layer.name] = x, x + width, y
        x += width + 0.32
    axes.autoscale_view()
    handles = [Patch(color=color, label=text) for text, color in UNET_PARTS.values()]
    handles.append(Line2D([], [], color=GRAY, marker=">", markersize=5, label="skip connection"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def figure_2_08(poses, title):
    """Figure 2.8: camera poses C of a sequence from above, and the motions T between them (Equations 2.2, 2.3).

    poses: a few (n, 4, 4) camera-to-world poses, metres. A short arrow points to where the camera looks.
    """
    poses = np.linalg.inv(poses[0]) @ poses  # the first camera is where the path starts, and looks up the page
    positions, right, ahead = (poses[:, [0, 2], column] for column in (3, 0, 2))
    figure, axes = style.new_figure(height=3.8)
    axes.plot(*positions.T, "o", markersize=4, color="black")
    axes.quiver(*positions.T, *ahead.T, color=BLUE, angles="xy", scale=18, width=0.006, zorder=3)
    for index, (position, sideways) in enumerate(zip(positions, right)):
        _formula(axes, position, f"$C_{{{index}}}$", 16 * sideways, "black")
    for index, (start, end) in enumerate(zip(positions, positions[1:]), 1):
        motion = np.linalg.inv(poses[index - 1]) @ poses[index]  # Equation 2.3, for T
        name, length = f"$T_{{{index},{index - 1}}}$", np.linalg.norm(motion[:3, 3])
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": RED, "shrinkA": 3, "shrinkB": 3,
                                                  "connectionstyle": "arc3,rad=-0.3"})
        to_the_left = (end - start)[::-1] * (-1, 1)
        _formula(axes, (start + end) / 2 + 0.15 * to_the_left, name, 11 * to_the_left / max(length, 1e-9), RED)
        axes.plot([], [], color=RED, label=f"{name}: {length:.1f} m, {metrics.angles(motion):.1f}°")
    axes.set(xlabel="x, to the right of the first camera (m)", ylabel="z, ahead of the first camera (m)", title=title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.2)
    for text in axes.legend(loc="center left", bbox_to_anchor=(1, 0.5), handlelength=0.8).get_texts():
        text.set_parse_math(True)
    return figure


def figure_2_09(first, second, title):
    """Figure 2.9: ORB matches between two frames, (height, width) each, the 60 of smallest descriptor distance."""
    orb = cv2.ORB_create(1000)
    points, descriptors = orb.detectAndCompute(first, None)
    others, other_descriptors = orb.detectAndCompute(second, None)
    matches = []
    if points and others:
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, other_descriptors)
    best = sorted(matches, key=lambda match: match.distance)[:60]
    gap = np.full((first.shape[0] // 25, first.shape[1]), 255, np.uint8)
    both = np.vstack([first, gap, second])
    figure, (axes,) = style.frame_panels(both)
    style.show_image(axes, both, f"{title}: the {len(best)} best of {len(matches)} ORB matches")
    distances = [match.distance for match in best] or [0, 1]
    scale = ScalarMappable(Normalize(min(distances), max(distances)), "plasma")
    for match in reversed(best):  # the best on top
        (u, v), (x, y) = points[match.queryIdx].pt, others[match.trainIdx].pt
        axes.plot((u, x), (v, y + first.shape[0] + gap.shape[0]), linewidth=0.8, color=scale.to_rgba(match.distance),
                  marker="o", markersize=2)
    figure.colorbar(scale, ax=axes, shrink=0.7, pad=0.01, label="bits of 256 that differ")
    return figure


def figure_2_10(estimated, true, title):
    """Figure 2.10: drift of an estimated path (n, 3), metres, from the true one, and the distance between them."""
    figure, axes = style.new_figure(1, 2, height=3.2)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
    axes[0].plot(true[:, 0], true[:, 2], color=TRUTH, label="true path")
    axes[0].plot(estimated[:, 0], estimated[:, 2], color=BASELINE, linestyle="--", label="estimated path")
    pairs = np.stack([true, estimated])[:, np.linspace(0, len(true) - 1, 12).astype(int)]
    axes[0].plot(pairs[..., 0], pairs[..., 2], color="#aaaaaa", linewidth=0.8, zorder=0)
    axes[0].set(xlabel="x (m)", ylabel="z (m)", title=title)
    axes[0].set_aspect("equal", adjustable="datalim")
    axes[1].plot(travelled, np.linalg.norm(estimated - true, axis=1), color=RED)
    axes[1].set(xlabel="distance travelled (m)", ylabel="distance from the true position (m)", ylim=(0, None),
                title="error along the path")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def figure_2_11(first, second, kept, lost, new, titles):
    """Figure 2.11: one scene from two viewpoints, with keypoints found again, lost and new, arrays of (n, 2) pixels.

    kept is a pair of arrays, where the same keypoints lie in the first and in the second frame.
    """
    figure, axes = style.frame_panels(first, 2)
    for panel, image, title, again in zip(axes, (first, second), titles, kept, strict=True):
        style.show_image(panel, image, title)
        panel.scatter(*again.T, s=5, color=GREEN, linewidths=0, label=f"{len(again)} found again")
    axes[0].scatter(*lost.T, s=9, color=RED, marker="x", linewidths=0.8, label=f"{len(lost)} not found again")
    axes[1].scatter(*new.T, s=9, color=ORANGE, marker="^", linewidths=0, label=f"{len(new)} new")
    style.legend_below(figure, axes, 3)
    return figure


def figure_2_12(frame, frame_keypoints, label_map, label_keypoints, titles):
    """Figure 2.12: a frame, Shi-Tomasi keypoints on it, and Shi-Tomasi keypoints on its label map, with counts."""
    figure, axes = style.frame_panels(frame, 3)
    style.show_image(axes[0], frame, f"(a) {titles[0]}")
    style.show_image(axes[1], frame, f"(b) {len(frame_keypoints)} keypoints on the frame")
    axes[1].scatter(*frame_keypoints.T, **KEYPOINT)
    in_colors = style.label_colors(label_map, frame)
    style.show_image(axes[2], in_colors, f"(c) {len(label_keypoints)} keypoints on {titles[1]}")
    dots = axes[2].scatter(*label_keypoints.T, s=7, color="white", edgecolors="black", linewidths=0.4, label="keypoint")
    style.class_legend(figure, label_map, also=[dots])
    return figure


def _diagram(xlim, ylim, **size):
    figure, axes = style.new_figure(**size)
    axes.set(xlim=xlim, ylim=ylim)
    axes.set_axis_off()
    return figure, axes


def _arrow(axes, start, end, color="black", zorder=1):
    axes.annotate("", end, start, zorder=zorder, arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 0.9})


def _formula(axes, point, text, offset, color):
    """A formula `offset` points of the page away from a point of the plot."""
    axes.annotate(text, point, offset, textcoords="offset points", ha="center", va="center", color=color, fontsize=10,
                  parse_math=True)


def _numbers(axes, values, title, form, colors=None):
    """An array as a table of numbers, on `colors` (h, w, 4) or on a scale whose middle is zero."""
    limit = np.abs(values).max()
    style.show_image(axes, values if colors is None else colors, title, cmap="PuOr", vmin=-2 * limit, vmax=2 * limit)
    for (row, column), value in np.ndenumerate(values):
        axes.text(column, row, format(value, form), ha="center", va="center")
