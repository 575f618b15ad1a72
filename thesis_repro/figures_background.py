"""The figures of chapter 2, drawn anew from the project's own network and data: networks, odometry, keypoints."""

import cv2
import numpy as np
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

from thesis_repro.figures import (BASELINE, BLUE, GREEN, KEYPOINT, ORANGE, RED, SKY, TRUTH, label_colors, new_figure,
                                  show_image)


def figure_2_01():
    """A basic convolutional network as a diagram."""
    figure, axes = new_figure(height=2.6)
    axes.set(xlim=(0, 17.2), ylim=(0, 5.4))
    axes.set_axis_off()
    stages = [("input", 0.3, 3.0, 1, "#bbbbbb"), ("convolution", 3.0, 2.8, 5, BLUE), ("activation", 6.0, 2.8, 5, SKY),
              ("pooling", 9.0, 1.5, 5, ORANGE)]
    middle = 2.9
    for name, left, side, sheets, color in stages:
        for sheet in range(sheets):
            axes.add_patch(Rectangle((left + 0.16 * sheet, middle - side / 2 - 0.16 * sheet), side * 0.62, side,
                                     facecolor=color, edgecolor="white", linewidth=0.8))
        axes.text(left + side * 0.31 + 0.08 * sheets, 0.25, name, ha="center")
    for x, name, count, color in ((12.0, "dense", 7, GREEN), (14.6, "softmax", 4, RED)):
        for index in range(count):
            axes.add_patch(Circle((x, middle + (index - (count - 1) / 2) * 0.6), 0.22, color=color))
        axes.text(x, 0.25, name, ha="center")
    for start in ((middle + (i - 3) * 0.6) for i in range(7)):
        for end in ((middle + (j - 1.5) * 0.6) for j in range(4)):
            axes.plot((12.22, 14.38), (start, end), color="#bbbbbb", linewidth=0.4, zorder=0)
    for start, end in ((2.35, 2.95), (5.45, 5.95), (8.45, 8.95), (10.7, 11.6)):
        axes.add_patch(FancyArrowPatch((start, middle), (end, middle), arrowstyle="-|>", mutation_scale=8, color="black"))
    axes.text(15.2, middle, "class\nprobabilities", va="center", fontsize=8)
    return figure


def figure_2_02(patch, kernel, feature_map, activated):
    """One input patch, one kernel of the trained network's first layer, its feature map, and what ReLU leaves of it."""
    figure, axes = new_figure(1, 4, height=2.2)
    limit = np.abs(feature_map).max()
    show_image(axes[0], patch, f"input, {patch.shape[0]}x{patch.shape[1]}", vmin=0, vmax=255)
    show_image(axes[1], kernel, "kernel, 3x3", cmap="PuOr", vmin=-np.abs(kernel).max(), vmax=np.abs(kernel).max())
    for (row, column), weight in np.ndenumerate(kernel):
        axes[1].text(column, row, f"{weight:.2f}", ha="center", va="center", fontsize=7)
    show_image(axes[2], feature_map, "feature map", cmap="PuOr", vmin=-limit, vmax=limit)
    show_image(axes[3], activated, "after normalisation and ReLU")
    return figure


def figure_2_03():
    """Sigmoid against ReLU."""
    x = np.linspace(-6, 6, 241)
    figure, axes = new_figure(1, 2, height=2.4)
    axes[0].plot(x, 1 / (1 + np.exp(-x)), color=BLUE)
    axes[0].set(title="sigmoid, 1 / (1 + exp(-x))", xlabel="x", ylabel="activation")
    axes[1].plot(x, np.maximum(x, 0), color=RED)
    axes[1].set(title="ReLU, max(0, x)", xlabel="x")
    return figure


def figure_2_04(seed=0):
    """A 4x4 array under 2x2 max pooling with stride 2."""
    values = np.random.default_rng(seed).integers(0, 10, (4, 4))
    pooled = values.reshape(2, 2, 2, 2).max(axis=(1, 3))
    figure, axes = new_figure(1, 2, height=2.3)
    for panel, array, title in ((axes[0], values, "input, 4x4"), (axes[1], pooled, "largest of each 2x2 block")):
        blocks = np.arange(4).reshape(2, 2) if len(array) == 2 else np.arange(4).reshape(2, 2).repeat(2, 0).repeat(2, 1)
        panel.imshow(np.array([[0.34, 0.71, 0.91], [0.9, 0.62, 0.0], [0.0, 0.62, 0.45], [0.8, 0.47, 0.65]])[blocks],
                     alpha=0.45)
        for (row, column), value in np.ndenumerate(array):
            panel.text(column, row, value, ha="center", va="center", fontsize=12)
        panel.set_title(title)
        panel.set_axis_off()
    return figure


def figure_2_05(seed=0):
    """A feature vector through a dense layer and softmax to class scores."""
    rng = np.random.default_rng(seed)
    features, weights = rng.normal(size=5).round(1), rng.normal(size=(5, 3)).round(1)
    logits = features @ weights
    scores = np.exp(logits) / np.exp(logits).sum()
    figure, axes = new_figure(height=2.6)
    axes.set(xlim=(0, 10), ylim=(-0.6, 5.2))
    axes.set_axis_off()
    outputs = [1.0, 2.0, 3.0]
    for row, feature in enumerate(features):
        for column, y in enumerate(outputs):
            weight = weights[row, column]
            axes.plot((1.5, 4.7), (row, y), color=RED if weight < 0 else BLUE, linewidth=abs(weight) * 1.2, alpha=0.6)
        axes.add_patch(Circle((1.5, row), 0.3, facecolor="white", edgecolor="black", zorder=3))
        axes.text(1.5, row, f"{feature:.1f}", ha="center", va="center", fontsize=7, zorder=4)
    for column, y in enumerate(outputs):
        axes.add_patch(Circle((4.7, y), 0.33, facecolor="white", edgecolor="black", zorder=3))
        axes.text(4.7, y, f"{logits[column]:.2f}", ha="center", va="center", fontsize=7, zorder=4)
        axes.add_patch(FancyArrowPatch((5.1, y), (6.4, y), arrowstyle="-|>", mutation_scale=8, color="black"))
        axes.add_patch(Rectangle((6.5, y - 0.28), 2.4 * scores[column], 0.56, color=GREEN))
        axes.text(6.6 + 2.4 * scores[column], y, f"class {column + 1}: {scores[column]:.2f}", va="center", fontsize=8)
    for x, text in ((1.5, "feature vector"), (4.7, "dense layer"), (7.6, "softmax")):
        axes.text(x, 4.85, text, ha="center")
    axes.text(3.1, -0.55, "blue: positive weight, red: negative", ha="center", fontsize=7, color="#777777")
    return figure


def figure_2_06(seed=0, steps=40, rate=0.12, noise=1.2):
    """Steps of stochastic gradient descent on a loss surface with two valleys."""
    rng = np.random.default_rng(seed)

    def loss(x, y):
        return 0.5 * (x**2 - 1.5) ** 2 + 0.6 * y**2 + 0.35 * x

    def gradient(x, y):
        return np.array([2 * x * (x**2 - 1.5) + 0.35, 1.2 * y])

    path = [np.array([0.35, 1.9])]
    for _ in range(steps):
        path.append(path[-1] - rate * (gradient(*path[-1]) + noise * rng.normal(size=2)))
    path = np.array(path)
    x, y = np.meshgrid(np.linspace(-2.2, 2.2, 200), np.linspace(-1.6, 2.2, 160))
    figure, axes = new_figure(height=3.2)
    levels = axes.contourf(x, y, loss(x, y), 24, cmap="cividis")
    axes.plot(*path.T, color="white", linewidth=1, marker="o", markersize=3)
    axes.plot(*path[0], marker="s", color=ORANGE, markersize=8, linestyle="none", label="start")
    axes.plot(*path[-1], marker="*", color=ORANGE, markersize=13, linestyle="none", label=f"after {steps} steps")
    axes.set(xlabel="first weight", ylabel="second weight", xlim=(-2.2, 2.2), ylim=(-1.6, 2.2))
    axes.grid(visible=False)
    axes.legend(loc="lower right", labelcolor="white")
    figure.colorbar(levels, label="loss")
    return figure


def figure_2_07(model):
    """The U-Net drawn from the Keras model itself: one bar a stage, as high as its image and as wide as its channels.

    Shapes and skip connections are read from the model's layers, so another depth or width draws itself.
    """
    skips, stages = {}, []
    for layer in model.layers:
        kind = type(layer).__name__
        if kind in ("InputLayer", "MaxPooling2D", "Conv2DTranspose", "Concatenate", "Activation"):
            stages.append((kind, layer.name, tuple(layer.output.shape[1:])))
        if kind == "Concatenate":
            skips[layer.name] = [tensor._keras_history.operation.name for tensor in layer.input]
    stages.append(("output", model.layers[-1].name, tuple(model.output.shape[1:])))
    colors = {"InputLayer": "#999999", "Activation": BLUE, "MaxPooling2D": ORANGE, "Conv2DTranspose": GREEN,
              "Concatenate": SKY, "output": RED}
    names = {"InputLayer": "input", "Activation": "convolution, normalisation, ReLU", "MaxPooling2D": "max pooling",
             "Conv2DTranspose": "transposed convolution", "Concatenate": "concatenation", "output": "softmax"}
    figure, axes = new_figure(height=3.9)
    largest, x, place, level, levels = stages[0][2][0], 0.0, {}, 0.0, []
    for kind, _, (side, _, _) in stages:
        levels.append(np.log2(largest / side))
    for (kind, name, (side, _, channels)), level in zip(stages, levels, strict=True):
        width, height = 0.10 + 0.05 * np.log2(channels + 1), 0.25 + 1.1 * side / largest
        y = -1.55 * level
        axes.add_patch(Rectangle((x, y - height / 2), width, height, color=colors[kind], linewidth=0))
        axes.text(x + width / 2, y + height / 2 + 0.08, channels, ha="center", va="bottom", fontsize=5.5)
        if kind in ("InputLayer", "MaxPooling2D", "Conv2DTranspose", "output"):
            axes.text(x + width / 2, y - height / 2 - 0.08, f"{side}x{side}", ha="center", va="top", fontsize=5.5)
        place[name] = (x, y, width)
        x += width + 0.24
    for name, sources in skips.items():
        source = max(sources, key=lambda other: abs(place[other][0] - place[name][0]))
        (x0, y0, w0), (x1, y1, _) = place[source], place[name]
        axes.add_patch(FancyArrowPatch((x0 + w0, y0), (x1, y1), arrowstyle="-|>", mutation_scale=7, color="#888888",
                                       linewidth=0.8, zorder=0))
    axes.set(xlim=(-0.3, x), ylim=(-1.55 * max(levels) - 0.9, 1.1))
    axes.set_axis_off()
    figure.legend(handles=[Rectangle((0, 0), 1, 1, color=color, label=names[kind]) for kind, color in colors.items()],
                  loc="outside lower center", ncols=3, fontsize=7)
    return figure


def figure_2_08(poses, title):
    """Camera poses C of a sequence from above, with the relative motions T between them (Equations 2.2, 2.3).

    poses: a few (n, 4, 4) camera-to-world poses, metres.
    """
    figure, axes = new_figure(height=3.4)
    positions = poses[:, [0, 2], 3]
    length = 0.35 * np.linalg.norm(np.diff(positions, axis=0), axis=1).mean()
    for index, (pose, position) in enumerate(zip(poses, positions)):
        for axis, color in ((0, RED), (2, BLUE)):
            axes.annotate("", position + length * pose[[0, 2], axis], position,
                          arrowprops={"arrowstyle": "-|>", "color": color, "lw": 1.2})
        axes.text(*(position - 0.35 * length * pose[[0, 2], 2]), f"$C_{{{index}}}$", ha="center", va="top", fontsize=9)
    for index, (start, end) in enumerate(zip(positions, positions[1:]), 1):
        axes.annotate("", end, start, arrowprops={"arrowstyle": "-", "color": "#999999", "lw": 0.9, "ls": "--",
                                                  "connectionstyle": "arc3,rad=0.25"})
        middle = (start + end) / 2
        side = np.array([end[1] - start[1], start[0] - end[0]]) * 0.22
        axes.text(*(middle + side), f"$T_{{{index},{index - 1}}}$", ha="center", va="center", fontsize=8, color="#555555")
    axes.plot(*positions.T, linestyle="none", marker="o", markersize=3, color="black")
    axes.set(xlabel="x (m)", ylabel="z (m)", title=title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.15)
    return figure


def figure_2_09(first, second, title, matches_shown=60):
    """ORB matches between two frames of one sequence, the best ones (smallest descriptor distance)."""
    orb = cv2.ORB_create(1000)
    (points, descriptors), (others, other_descriptors) = (orb.detectAndCompute(image, None) for image in (first, second))
    matches = sorted(cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, other_descriptors),
                     key=lambda match: match.distance)[:matches_shown]
    figure, axes = new_figure(height=2 * 7.2 * first.shape[0] / first.shape[1] + 0.3)
    show_image(axes, np.vstack([first, second]), f"{title}: the {len(matches)} best of ORB's matches")
    for index, match in enumerate(matches):
        u, v = points[match.queryIdx].pt
        x, y = others[match.trainIdx].pt
        axes.plot((u, x), (v, y + first.shape[0]), linewidth=0.6, color=(SKY, ORANGE, GREEN)[index % 3])
    return figure


def figure_2_10(estimated, true, title):
    """Drift: an estimated against the true path (n, 3), and the distance between them growing along it."""
    figure, axes = new_figure(1, 2, height=3.0)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
    axes[0].plot(true[:, 0], true[:, 2], color=TRUTH, label="true path")
    axes[0].plot(estimated[:, 0], estimated[:, 2], color=BASELINE, linestyle="--", label="estimated path")
    for index in np.linspace(0, len(true) - 1, 12).astype(int):
        axes[0].plot(*np.array([true[index], estimated[index]])[:, [0, 2]].T, color="#bbbbbb", linewidth=0.8, zorder=0)
    axes[0].set(xlabel="x (m)", ylabel="z (m)", title=title)
    axes[0].set_aspect("equal", adjustable="datalim")
    axes[0].legend()
    axes[1].plot(along, np.linalg.norm(estimated - true, axis=1), color=RED)
    axes[1].set(xlabel="distance travelled (m)", ylabel="distance from the true position (m)", ylim=(0, None))
    return figure


def figure_2_11(first, second, kept, lost, new, title):
    """One scene from two viewpoints: keypoints found again, lost and new; arrays of (n, 2) pixels.

    kept is a pair of arrays, where the same keypoints lie in the first and in the second frame.
    """
    figure, axes = new_figure(2, 1, height=2 * (7.2 * first.shape[0] / first.shape[1] + 0.25) + 0.3)
    for panel, image, groups, name in (
            (axes[0], first, ((kept[0], GREEN, "found again"), (lost, RED, "not found again")), "first view"),
            (axes[1], second, ((kept[1], GREEN, "found again"), (new, ORANGE, "new")), "second view")):
        show_image(panel, image, f"{title}, {name}: " + ", ".join(f"{len(p)} {text}" for p, _, text in groups))
        for points, color, _ in groups:
            panel.scatter(*points.T, **{**KEYPOINT, "color": color})
    return figure


def figure_2_12(frame, frame_keypoints, label_map, label_keypoints):
    """A frame, Shi-Tomasi on the frame, and Shi-Tomasi on its label map (at the frame's size), with counts."""
    figure, axes = new_figure(3, 1, height=3 * (7.2 * frame.shape[0] / frame.shape[1] + 0.25))
    show_image(axes[0], frame, "(a) frame")
    show_image(axes[1], frame, f"(b) {len(frame_keypoints)} keypoints on the frame")
    axes[1].scatter(*frame_keypoints.T, **KEYPOINT)
    show_image(axes[2], label_colors(label_map, frame), f"(c) {len(label_keypoints)} keypoints on its label map")
    axes[2].scatter(*label_keypoints.T, **{**KEYPOINT, "color": "white", "s": 6})
    return figure
