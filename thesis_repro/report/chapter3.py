"""The figures of chapter 3 and A.1: intersection over union, masks, the network's layers."""

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from thesis_repro.report import style
from thesis_repro.report.style import BLUE, EDGE_COLOR, KEYPOINT, ORANGE, SKY


def figure_3_03(image, label_map, prediction, label):
    """Figure 3.3: intersection and union of a prediction and its label map for one class (Equation 3.1).

    image: (h, w) gray or (h, w, 3) colours.
    """
    true, predicted = label_map == label.id, prediction == label.id
    intersection, union = (true & predicted).sum(), (true | predicted).sum()
    figure, axes = style.new_figure(1, 3, height=2.9)
    dimmed = np.dstack([image] * 3)[..., :3] // 3 + 150
    for panel, areas, title in (
            (axes[0], {BLUE: true}, f"label map: {true.sum():,} pixels"),
            (axes[1], {BLUE: predicted}, f"prediction: {predicted.sum():,} pixels"),
            (axes[2], {ORANGE: true & ~predicted, SKY: predicted & ~true, BLUE: true & predicted},
             f"IoU = {intersection:,} / {union:,} = {intersection / max(union, 1):.2f}")):
        picture = dimmed.copy()
        for color, area in areas.items():
            picture[area] = 255 * np.array(to_rgb(color))
        style.show_image(panel, picture, title)
    figure.legend(handles=[Patch(color=BLUE, label="intersection"), Patch(color=ORANGE, label="only in the label map"),
                           Patch(color=SKY, label="only in the prediction")],
                  title=f"class {label.name}; the three colours together are the union", title_fontsize=8,
                  loc="outside lower center", ncols=3)
    return figure


def figure_3_06(frame, label_map, edge_image, mask, dilation_width):
    """Figure 3.6: a frame, its predicted label map, the Canny edges of the label map, and the edges dilated."""
    figure, axes = style.frame_panels(frame, 2, 2)
    style.show_image(axes[0], frame, "frame")
    style.show_image(axes[1], style.label_colors(label_map, frame), "predicted label map")
    style.show_image(axes[2], edge_image, "Canny edges (5, 15) of the label map")
    style.show_image(axes[3], mask, f"edges dilated by {dilation_width}x{dilation_width}")
    style.class_legend(figure, label_map)
    return figure


def figure_masks(frame, masks, keypoints, true_edges=None):
    """Masks of one frame side by side, {title: (h, w)}, with their keypoints, {title: (n, 2)}, and the true boundaries.

    What a mask keeps is light. true_edges: (h, w), 255 on them, or None where they are not known.
    """
    figure, axes = style.frame_panels(frame, -(-len(masks) // 2), 2)
    for panel, (title, mask) in zip(axes, masks.items(), strict=False):
        picture = np.dstack([np.where(mask > 0, frame // 2 + 127, frame // 3)] * 3)
        if true_edges is not None:
            picture[true_edges > 0] = EDGE_COLOR
        style.show_image(panel, picture, title)
        panel.scatter(*keypoints[title].T, **KEYPOINT)
    for panel in axes[len(masks):]:
        panel.set_axis_off()
    return figure


def figure_a_01(rows, total, trainable):
    """Figure A.1: the model summary from the rows of `unet.summary_rows`."""
    lines = [("Layer (type)", "Output shape", "Parameters", "Connected to"),
             *((row["layer"], row["output_shape"], f"{row['params']:,}", row["connected_to"]) for row in rows),
             ("", "", "", ""), ("Parameters, total", "", f"{total:,}", ""), ("trainable", "", f"{trainable:,}", ""),
             ("not trainable", "", f"{total - trainable:,}", "")]
    figure, axes = style.new_figure(height=0.155 * len(lines))
    axes.set(xlim=(0, 1), ylim=(len(lines), 0))
    axes.set_axis_off()
    for number, line in enumerate(lines):
        for cell, x, side in zip(line, (0.0, 0.36, 0.62, 0.66), ("left", "left", "right", "left"), strict=True):
            axes.text(x, number + 0.5, cell, ha=side, va="center", fontsize=6.5, family="monospace",
                      weight="bold" if number == 0 else "normal")
    axes.axhline(1, color="black", linewidth=0.8)
    return figure
