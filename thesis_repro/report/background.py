"""The figures of chapter 2, drawn anew from the project's own network and data: networks, odometry, keypoints."""

import cv2
import matplotlib
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Polygon, Rectangle

from thesis_repro.odometry import metrics
from thesis_repro.report.style import (
    BASELINE,
    BLUE,
    GREEN,
    KEYPOINT,
    ORANGE,
    PINK,
    RED,
    SKY,
    TRUTH,
    frame_panels,
    label_colors,
    new_figure,
    show_image,
)

GRAY = "#777777"
MARKED = "#d40000"  # what a text calls red


def figure_2_01():
    """A basic convolutional network as a diagram."""
    figure, axes = new_figure(height=2.5)
    axes.set(xlim=(0, 18.6), ylim=(0, 5.6))
    axes.set_axis_off()
    middle = 3.1
    # what, its detail, left edge, side of an image, number of images
    stages = [("input", "image", 0.2, 3.2, 1, "#aaaaaa"), ("convolution", "a map a kernel", 3.5, 2.8, 5, BLUE),
              ("activation", "ReLU", 6.9, 2.8, 5, SKY), ("pooling", "2x2, largest", 10.3, 1.4, 5, ORANGE)]
    ends = []
    for name, detail, left, side, sheets, color in stages:
        shift = 0.15 * (sheets - 1)
        for sheet in range(sheets):
            offset = 0.15 * sheet
            axes.add_patch(Rectangle((left + offset, middle - side / 2 + shift / 2 - offset), side * 0.65, side,
                                     facecolor=color, edgecolor="white", linewidth=0.8))
        center = left + (side * 0.65 + shift) / 2
        ends.append((left, left + side * 0.65 + shift))
        _two_lines(axes, center, name, detail)
    for (_, right), (left, _) in zip(ends, ends[1:]):
        _arrow(axes, (right + 0.1, middle), (left - 0.1, middle))
    columns = [(13.6, "dense", "every input, weighted", 6, GREEN), (16.3, "softmax", "class scores", 4, RED)]
    _arrow(axes, (ends[-1][1] + 0.1, middle), (columns[0][0] - 0.4, middle))
    heights = [[middle + (index - (count - 1) / 2) * 0.62 for index in range(count)] for _, _, _, count, _ in columns]
    for start in heights[0]:
        for end in heights[1]:
            axes.plot((columns[0][0], columns[1][0]), (start, end), color="#bbbbbb", linewidth=0.5, zorder=0)
    for (x, name, detail, _, color), ys in zip(columns, heights, strict=True):
        for y in ys:
            axes.add_patch(Circle((x, y), 0.23, color=color))
        _two_lines(axes, x, name, detail)
    for number, y in enumerate(reversed(heights[1]), 1):
        axes.text(columns[1][0] + 0.45, y, f"class {number}", va="center", fontsize=8)
    return figure


def figure_2_02(patch, kernel, feature_map, activated, where):
    """A patch of the input, one kernel of the trained network's first layer, its feature map, and what ReLU leaves.

    The maps have the patch's size; `where` (row, column) is a pixel whose 3x3 neighbourhood is marked.
    """
    figure, axes = new_figure(1, 4, height=2.5)
    row, column = where
    reach = kernel.shape[0] // 2
    largest, limit = np.abs(kernel).max(), np.abs(feature_map).max()
    show_image(axes[0], patch, f"input, {patch.shape[0]}x{patch.shape[1]}", vmin=0, vmax=255)
    show_image(axes[1], kernel, "kernel, {}x{}".format(*kernel.shape), cmap="PuOr", vmin=-largest, vmax=largest)
    for (i, j), weight in np.ndenumerate(kernel):
        axes[1].text(j, i, f"{weight:.2f}", ha="center", va="center", fontsize=8,
                     color="white" if abs(weight) > 0.6 * largest else "black")
    show_image(axes[2], feature_map, "feature map", cmap="PuOr", vmin=-limit, vmax=limit)
    show_image(axes[3], activated, "normalised, ReLU", vmin=0)
    for panel, text in zip(axes, ("gray value", "weight", "response", "activation"), strict=True):
        figure.colorbar(panel.images[0], ax=panel, location="bottom", shrink=0.85, pad=0.03, label=text)
    for panel, radius in ((axes[0], reach + 0.5), (axes[2], 0.5), (axes[3], 0.5)):
        panel.add_patch(Rectangle((column - radius, row - radius), 2 * radius, 2 * radius, fill=False, edgecolor=MARKED,
                                  linewidth=1.4))
    for panel, values, digits in ((axes[2], feature_map, 2), (axes[3], activated, 2)):
        below = row < values.shape[0] / 2  # where there is room for it
        panel.annotate(f"{values[row, column]:.{digits}f}", (column, row), (0, -11 if below else 11),
                       textcoords="offset points", ha="center", va="center", fontsize=8, color=MARKED,
                       bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85})
    return figure


def figure_2_03():
    """Sigmoid against ReLU, with their derivatives."""
    x = np.linspace(-6, 6, 241)
    sigmoid = 1 / (1 + np.exp(-x))
    figure, axes = new_figure(2, 2, height=3.6, sharex=True)
    step = (np.array([-6, 0]), np.zeros(2)), (np.array([0, 6]), np.ones(2))
    for column, (title, value, slopes) in enumerate((
            ("sigmoid, 1 / (1 + exp(-x))", sigmoid, [(x, sigmoid * (1 - sigmoid))]),
            ("ReLU, max(0, x)", np.maximum(x, 0), step))):
        axes[0, column].plot(x, value, color=BLUE)
        axes[0, column].set_title(title)
        for slope in slopes:
            axes[1, column].plot(*slope, color=RED)
        axes[1, column].set(xlabel="x (no unit)", ylim=(-0.06, 1.06))
    axes[1, 1].plot(0, 0, "o", color=RED, markersize=4, markerfacecolor="white")  # at 0 it has none
    axes[1, 1].plot(0, 1, "o", color=RED, markersize=4, markerfacecolor="white")
    axes[0, 0].set_ylabel("activation (no unit)")
    axes[1, 0].set_ylabel("its derivative (no unit)")
    return figure


def figure_2_04():
    """A 4x4 array under 2x2 max pooling with stride 2."""
    values = np.random.default_rng(0).permutation(np.arange(1, 17)).reshape(4, 4)
    pooled = values.reshape(2, 2, 2, 2).max(axis=(1, 3))
    figure, axes = new_figure(height=2.6)
    axes.set(xlim=(0, 9.4), ylim=(4.9, -0.1), aspect="equal")
    axes.set_axis_off()
    colors = np.array([[SKY, ORANGE], [GREEN, PINK]])
    for array, left, top, block in ((values, 0.1, 0.2, 2), (pooled, 7.2, 1.2, 1)):
        for (row, column), value in np.ndenumerate(array):
            chosen = value == pooled[row // block, column // block]
            axes.add_patch(Rectangle((left + column, top + row), 1, 1, facecolor=colors[row // block, column // block],
                                     alpha=0.75 if chosen else 0.25, edgecolor="white", linewidth=1.5))
            axes.text(left + column + 0.5, top + row + 0.5, value, ha="center", va="center", fontsize=11,
                      weight="bold" if chosen else "normal")
    _arrow(axes, (4.6, 2.2), (6.8, 2.2))
    axes.text(5.7, 1.95, "2x2 max pooling", ha="center", va="bottom", fontsize=8)
    axes.text(5.7, 2.45, "stride 2", ha="center", va="top", fontsize=8)
    axes.text(2.1, 4.55, "feature map, 4x4", ha="center", va="center")
    axes.text(8.2, 3.55, "pooled, 2x2", ha="center", va="center")
    return figure


def figure_2_05():
    """A feature vector through a dense layer and softmax to class scores."""
    rng = np.random.default_rng(0)
    features, weights = rng.normal(size=5).round(1), rng.normal(size=(5, 3)).round(1)
    logits = features @ weights
    scores = np.exp(logits) / np.exp(logits).sum()
    figure, axes = new_figure(height=2.8)
    axes.set(xlim=(0, 11), ylim=(-0.5, 5.1), aspect="equal")
    axes.set_axis_off()
    outputs = [3.0, 2.0, 1.0]
    for row, feature in enumerate(features):
        for column, y in enumerate(outputs):
            weight = weights[row, column]
            axes.plot((1.0, 4.4), (row, y), color=RED if weight < 0 else BLUE, linestyle="--" if weight < 0 else "-",
                      linewidth=0.3 + 1.2 * abs(weight), alpha=0.7)
        axes.add_patch(Circle((1.0, row), 0.36, facecolor="white", edgecolor="black", zorder=3))
        axes.text(1.0, row, f"{feature:.1f}", ha="center", va="center", fontsize=7.5, zorder=4)
    for column, y in enumerate(outputs):
        axes.add_patch(Circle((4.4, y), 0.4, facecolor="white", edgecolor="black", zorder=3))
        axes.text(4.4, y, f"{logits[column]:.2f}", ha="center", va="center", fontsize=7.5, zorder=4)
        _arrow(axes, (4.9, y), (6.2, y))
        axes.add_patch(Rectangle((6.4, y - 0.28), 2.6 * scores[column], 0.56, color=GREEN))
        axes.text(6.55 + 2.6 * scores[column], y, f"class {column + 1}: {scores[column]:.2f}", va="center", fontsize=8)
    for x, text in ((1.0, "feature vector"), (4.4, "dense layer"), (7.4, "softmax")):
        axes.text(x, 4.8, text, ha="center")
    axes.legend(handles=[Line2D([], [], color=BLUE, label="positive weight"),
                         Line2D([], [], color=RED, linestyle="--", label="negative weight")],
                loc="lower right", bbox_to_anchor=(1, -0.02))
    return figure


def figure_2_06():
    """Steps of stochastic gradient descent on a loss surface with two valleys."""
    rng = np.random.default_rng(0)
    steps, rate, noise = 40, 0.1, 1.2

    def loss(x, y):
        return 0.5 * (x**2 - 1.5) ** 2 + 0.6 * y**2 + 0.35 * x

    def gradient(x, y):
        return np.array([2 * x * (x**2 - 1.5) + 0.35, 1.2 * y])

    path = [np.array([0.35, 1.9])]
    for _ in range(steps):
        path.append(path[-1] - rate * (gradient(*path[-1]) + noise * rng.normal(size=2)))
    path = np.array(path)
    x, y = np.meshgrid(np.linspace(-2.2, 2.2, 200), np.linspace(-1.6, 2.2, 160))
    figure, axes = new_figure(height=3.4)
    levels = axes.contourf(x, y, loss(x, y), 24, cmap="cividis")
    axes.plot(*path.T, color="white", linewidth=1, marker="o", markersize=3)
    axes.plot(*path[0], marker="s", color=RED, markersize=9, markeredgecolor="white", linestyle="none", label="start")
    axes.plot(*path[-1], marker="*", color=RED, markersize=14, markeredgecolor="white", linestyle="none",
              label=f"after {steps} steps")
    axes.set(xlabel="first weight (no unit)", ylabel="second weight (no unit)", xlim=(-2.2, 2.2), ylim=(-1.6, 2.2))
    axes.grid(visible=False)
    for sign in (-1, 1):  # along y = 0 the valleys lie where the slope 2 x (x^2 - 1.5) + 0.35 vanishes
        at = next(root.real for root in np.roots([2, 0, -3, 0.35]) if sign * root.real > 1)
        axes.annotate(f"valley of loss {loss(at, 0):.2f}", (at, 0), (at, -0.75), color="white", ha="center", fontsize=8,
                      arrowprops={"arrowstyle": "-", "color": "white", "lw": 0.8})
    axes.legend(loc="lower right", labelcolor="white", ncols=2)
    figure.colorbar(levels, label="loss (no unit)")
    return figure


UNET_PARTS = {"InputLayer": ("input", "#999999"), "Activation": ("convolution, normalisation, ReLU", BLUE),
              "MaxPooling2D": ("max pooling", ORANGE), "Conv2DTranspose": ("transposed convolution", GREEN),
              "Concatenate": ("concatenation", SKY), "output": ("1x1 convolution, softmax", RED)}


def figure_2_07(model):
    """The U-Net drawn from the Keras model itself: a box a stage, as high as its image and as wide as its channels.

    Shapes and skip connections are read from the model's layers, so another depth or width draws itself.
    """
    skips, stages = {}, []  # concatenation: what it joins; (kind, name, side, channels)
    for layer in model.layers:
        kind = "output" if layer is model.layers[-1] else type(layer).__name__
        if kind in UNET_PARTS:
            stages.append((kind, layer.name, *layer.output.shape[2:]))
        if kind == "Concatenate":
            skips[layer.name] = [tensor._keras_history.operation.name for tensor in layer.input]
    figure, axes = new_figure(height=4.2)
    largest = stages[0][2]
    x, places, bottom = 0.0, {}, 0.0
    for kind, name, side, channels in stages:
        width, height = 0.09 + 0.045 * np.log2(channels), 0.35 + 1.05 * side / largest
        y = -1.5 * np.log2(largest / side)
        axes.add_patch(Rectangle((x, y - height / 2), width, height, color=UNET_PARTS[kind][1], linewidth=0))
        axes.text(x + width / 2, y + height / 2 + 0.06, channels, ha="center", va="bottom", fontsize=6)
        places[name] = x, x + width, y
        bottom = min(bottom, y - height / 2)
        if kind in ("InputLayer", "MaxPooling2D", "Concatenate"):
            axes.text(x + width / 2, y - height / 2 - 0.08, f"{side}x{side}", ha="center", va="top", fontsize=7)
        x += width + 0.32
    for name, sources in skips.items():
        _, right, y = min(places[source] for source in sources)
        left, _, level = places[name]
        axes.plot((right + 0.05, left - 0.1), (y, level), color=GRAY, linewidth=0.9, zorder=0)  # behind the boxes
        _arrow(axes, (left - 0.22, level), (left - 0.01, level), GRAY, zorder=2)
    order = [place for _, place in sorted(places.items(), key=lambda item: item[1])]
    for (_, right, y), (left, _, below) in zip(order, order[1:]):
        axes.plot((right, left), (y, below), color="#bbbbbb", linewidth=0.8, zorder=0)
    axes.set(xlim=(-0.35, x), ylim=(bottom - 0.4, 1.0))
    axes.set_axis_off()
    handles = [Patch(color=color, label=text) for text, color in UNET_PARTS.values()]
    handles.append(Line2D([], [], color=GRAY, marker=">", markersize=5, label="skip connection"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def figure_2_08(poses, title):
    """Camera poses C of a sequence from above, with the relative motions T between them (Equations 2.2, 2.3).

    poses: a few (n, 4, 4) camera-to-world poses, metres. A wedge opens to where the camera looks.
    """
    poses = np.linalg.inv(poses[0]) @ poses  # the first camera is where the path starts and looks ahead
    positions = poses[:, [0, 2], 3]
    forward, right = poses[:, [0, 2], 2], poses[:, [0, 2], 0]
    extent = np.ptp(positions, axis=0)
    size = 0.06 * max(extent.max(), 1e-6)
    upright = extent[1] > extent[0]  # the plot's long side is its width, so a path that leads away is laid on its side
    relative = [np.linalg.inv(before) @ after for before, after in zip(poses, poses[1:])]  # Equation 2.3, for T
    figure, axes = new_figure(height=3.6)

    def lay(points):
        return points[..., ::-1] if upright else points

    def to_the_left(start, end):  # as seen on the page
        along = lay(end - start) * ((1, -1) if upright else (1, 1))
        along = along / max(np.linalg.norm(along), 1e-9)
        return np.array([-along[1], along[0]])

    for index, (position, ahead, aside) in enumerate(zip(positions, forward, right)):
        wedge = [position, position + size * (ahead + 0.6 * aside), position + size * (ahead - 0.6 * aside)]
        axes.add_patch(Polygon(lay(np.array(wedge)), facecolor=SKY, edgecolor=BLUE, alpha=0.8, linewidth=1))
        axes.annotate(f"$C_{{{index}}}$", lay(position), -17 * to_the_left(position, position + ahead),
                      textcoords="offset points", ha="center", va="center", fontsize=11, parse_math=True)
    for index, (start, end, motion) in enumerate(zip(positions, positions[1:], relative), 1):
        axes.annotate("", lay(end), lay(start), arrowprops={
            "arrowstyle": "-|>", "color": RED, "lw": 1.1, "shrinkA": 3, "shrinkB": 3,
            "connectionstyle": "arc3,rad=-0.35"})
        angle = metrics.angles(motion)
        side = to_the_left(start, end)
        horizontal = "left" if side[0] > 0.3 else "right" if side[0] < -0.3 else "center"
        axes.annotate(f"$T_{{{index},{index - 1}}}$\n{np.linalg.norm(motion[:3, 3]):.1f} m, {angle:.1f}°",
                      lay((start + end) / 2), (18 + 6 * abs(side[1])) * side, textcoords="offset points", ha=horizontal,
                      va="bottom" if side[1] > 0.3 else "top" if side[1] < -0.3 else "center", fontsize=8, color=RED,
                      parse_math=True)
    axes.plot(*lay(positions).T, linestyle="none", marker="o", markersize=3.5, color="black")
    names = ["x, to the right of the first camera (m)", "z, ahead of the first camera (m)"]
    axes.set(xlabel=names[1] if upright else names[0], ylabel=names[0] if upright else names[1], title=title)
    if upright:
        axes.yaxis.set_inverted(True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08, 0.5)
    return figure


def figure_2_09(first, second, title):
    """ORB matches between two frames of one sequence, the 60 best ones (smallest descriptor distance)."""
    orb = cv2.ORB_create(1000)
    points, descriptors = orb.detectAndCompute(first, None)
    others, other_descriptors = orb.detectAndCompute(second, None)
    matches = []
    if points and others:
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, other_descriptors)
    best = sorted(matches, key=lambda match: match.distance)[:60]
    gap = np.full((first.shape[0] // 25, first.shape[1]), 255, np.uint8)
    both = np.vstack([first, gap, second])
    figure, axes = frame_panels(both)
    show_image(axes[0], both, f"{title}: the {len(best)} best of {len(matches)} ORB matches")
    lower = first.shape[0] + gap.shape[0]
    distances = [match.distance for match in best] or [0, 1]
    scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(min(distances), max(distances)), "plasma")
    for match in reversed(best):  # the best on top
        (u, v), (x, y) = points[match.queryIdx].pt, others[match.trainIdx].pt
        axes[0].plot((u, x), (v, y + lower), linewidth=0.8, color=scale.to_rgba(match.distance), marker="o",
                     markersize=2)
    figure.colorbar(scale, ax=axes[0], location="right", shrink=0.7, pad=0.01, label="bits of 256 that differ")
    figure.set_figheight(0.92 * figure.get_figheight())  # the bar takes some of the width
    return figure


def figure_2_10(estimated, true, title):
    """Drift: an estimated against the true path (n, 3), metres, and the distance between them growing along it."""
    figure, axes = new_figure(1, 2, height=3.2)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))])
    error = np.linalg.norm(estimated - true, axis=1)
    axes[0].plot(true[:, 0], true[:, 2], color=TRUTH, label="true path")
    axes[0].plot(estimated[:, 0], estimated[:, 2], color=BASELINE, linestyle="--", label="estimated path")
    for index in np.linspace(0, len(true) - 1, 12).astype(int):
        axes[0].plot(*np.array([true[index], estimated[index]])[:, [0, 2]].T, color="#aaaaaa", linewidth=0.8, zorder=0)
    axes[0].set(xlabel="x (m)", ylabel="z (m)", title=title)
    axes[0].set_aspect("equal", adjustable="datalim")
    axes[1].plot(along, error, color=RED)
    axes[1].set(xlabel="distance travelled (m)", ylabel="distance from the true position (m)", ylim=(0, None),
                title="error along the path")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def figure_2_11(first, second, kept, lost, new, titles):
    """One scene from two viewpoints: keypoints found again, lost and new; arrays of (n, 2) pixels.

    kept is a pair of arrays, where the same keypoints lie in the first and in the second frame.
    """
    figure, axes = frame_panels(first, 2)
    again = (GREEN, "o", 5, "found again")
    for panel, image, title, groups in (
            (axes[0], first, titles[0], ((kept[0], again), (lost, (RED, "x", 10, "not found again")))),
            (axes[1], second, titles[1], ((kept[1], again), (new, (ORANGE, "^", 8, "new"))))):
        show_image(panel, image, f"{title}: " + ", ".join(f"{len(points)} {text}" for points, (*_, text) in groups))
        for points, (color, marker, size, _) in groups:
            panel.scatter(*points.T, s=size, color=color, marker=marker, linewidths=0.8 if marker == "x" else 0)
    figure.legend(handles=[Line2D([], [], linestyle="none", marker=marker, color=color, markersize=5, label=text)
                           for color, marker, text in ((GREEN, "o", "found again"), (RED, "x", "not found again"),
                                                       (ORANGE, "^", "new"))], loc="outside lower center", ncols=3)
    return figure


def figure_2_12(frame, frame_keypoints, label_map, label_keypoints, titles):
    """A frame, Shi-Tomasi on the frame, and Shi-Tomasi on its label map (at the frame's size), with counts."""
    figure, axes = frame_panels(frame, 3)
    show_image(axes[0], frame, f"(a) {titles[0]}")
    show_image(axes[1], frame, f"(b) {len(frame_keypoints)} keypoints on the frame")
    axes[1].scatter(*frame_keypoints.T, **KEYPOINT)
    show_image(axes[2], label_colors(label_map, frame), f"(c) {len(label_keypoints)} keypoints on {titles[1]}")
    axes[2].scatter(*label_keypoints.T, s=7, color="white", edgecolors="black", linewidths=0.4)
    return figure


def _arrow(axes, start, end, color="black", zorder=1):
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=8, color=color, linewidth=0.9,
                                   shrinkA=0, shrinkB=0, zorder=zorder))


def _two_lines(axes, x, name, detail):
    axes.text(x, 0.75, name, ha="center", va="center")
    axes.text(x, 0.2, detail, ha="center", va="center", fontsize=7, color=GRAY)
