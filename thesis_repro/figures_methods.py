"""Figures 3.1, 3.2, 3.6, 4.1 to 4.5 and A.1: augmentation, the network, training, prediction and masks."""

import numpy as np
from matplotlib.patches import Patch

from thesis_repro.cityscapes import LABELS, colorize
from thesis_repro.figures import BLUE, KEYPOINT, ORANGE, PAGE_WIDTH, label_colors, new_figure, show_image


def figure_augmentation(examples):
    """Figures 3.1 and 3.2: four panels from a dict of titles and images (gray, or label maps as colours)."""
    figure, axes = new_figure(2, 2, height=7.0)
    for panel, (title, image) in zip(axes.flat, examples.items(), strict=True):
        show_image(panel, image, title)
    return figure


def figure_3_06(frame, label_map, edge_image, mask, dilation_width):
    """A frame, its predicted label map, the Canny edges of the label map, and the edges dilated."""
    figure, axes = new_figure(2, 2, height=3.0)
    show_image(axes[0, 0], frame, "frame")
    show_image(axes[0, 1], label_colors(label_map, frame), "predicted label map")
    show_image(axes[1, 0], edge_image, "Canny edges (5, 15) of the label map")
    show_image(axes[1, 1], mask, f"edges dilated by {dilation_width}x{dilation_width}")
    return figure


def figure_4_01(history):
    """Training and validation curves: F1 score, IoU score, loss; one point an epoch."""
    figure, axes = new_figure(1, 3, height=2.6)
    best = history["epoch"][history["val_loss"].idxmin()]
    for panel, (column, title) in zip(axes, (("f1-score", "(a) F1 score"), ("iou_score", "(b) IoU score"),
                                             ("loss", "(c) loss")), strict=True):
        panel.plot(history["epoch"], history[column], color=BLUE, label="training")
        panel.plot(history["epoch"], history[f"val_{column}"], color=ORANGE, linestyle="--", label="validation")
        panel.axvline(best, color="#999999", linewidth=0.8, linestyle=":", label=f"lowest validation loss ({best})")
        panel.set(title=title, xlabel="epoch")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def figure_4_02(image, label_map, prediction):
    """An image of the Cityscapes validation split, its label map and its prediction (Section 4.1)."""
    figure, axes = new_figure(1, 3, height=3.0)
    show_image(axes[0], image, "image")
    show_image(axes[1], colorize(label_map), "label map")
    show_image(axes[2], colorize(prediction), "prediction")
    _class_legend(figure, label_map, prediction)
    return figure


def figure_4_03(frame, prediction, title):
    """A KITTI frame and its predicted label map at the network's size."""
    figure, axes = new_figure(2, 1, height=5.2)
    show_image(axes[0], frame, title)
    show_image(axes[1], label_colors(prediction, frame), "prediction")
    _class_legend(figure, prediction)
    return figure


def figure_4_04(frame, edge_image, keypoints, title):
    """Keypoints, (n, 2) pixels, that the mask left along the predicted boundaries."""
    figure, axes = new_figure(height=2.9)
    overlay = np.dstack([frame] * 3)
    overlay[edge_image > 0] = (255, 140, 0)
    show_image(axes, overlay, title)
    axes.scatter(*keypoints.T, **KEYPOINT)
    return figure


def figure_4_05(frame, all_keypoints, prediction, mask, kept_keypoints, dilation_width, title):
    """The procedure in five panels: frame, all keypoints, prediction, dilated edges, kept keypoints."""
    height, width = frame.shape
    figure, axes = new_figure(5, 1, height=5 * (PAGE_WIDTH * 0.72 * height / width + 0.28))
    show_image(axes[0], frame, f"(a) {title}")
    show_image(axes[1], frame, f"(b) all {len(all_keypoints)} Shi-Tomasi keypoints")
    axes[1].scatter(*all_keypoints.T, **KEYPOINT)
    show_image(axes[2], label_colors(prediction, frame), "(c) prediction")
    show_image(axes[3], mask, f"(d) Canny edges dilated by {dilation_width}x{dilation_width}")
    show_image(axes[4], frame, f"(e) the {len(kept_keypoints)} keypoints that the mask keeps")
    axes[4].scatter(*kept_keypoints.T, **KEYPOINT)
    return figure


def figure_a_01(rows, total, trainable):
    """The model summary from the rows of `unet.summary_rows`."""
    figure, axes = new_figure(height=0.155 * (len(rows) + 5))
    axes.set_axis_off()
    header = ("Layer (type)", "Output shape", "Parameters", "Connected to")
    cells = [(row["layer"], row["output_shape"], f"{row['params']:,}", row["connected_to"]) for row in rows]
    lines = [header, *cells, ("", "", "", ""), ("Parameters, total", "", f"{total:,}", ""),
             ("trainable", "", f"{trainable:,}", ""), ("not trainable", "", f"{total - trainable:,}", "")]
    for column, x, align in ((0, 0.0, "left"), (1, 0.36, "left"), (2, 0.62, "right"), (3, 0.66, "left")):
        for line, row in enumerate(lines):
            axes.text(x, 1 - (line + 0.5) / len(lines), row[column], ha=align, va="center", fontsize=6.5,
                      family="monospace", weight="bold" if line == 0 else "normal", transform=axes.transAxes)
    axes.axhline(1 - 1 / len(lines), color="black", linewidth=0.8)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    return figure


def _class_legend(figure, *label_maps):
    names = {}  # Cityscapes gives several labels one colour
    for index in np.unique(np.concatenate([np.unique(label_map) for label_map in label_maps])):
        names.setdefault(LABELS[index].color, []).append(LABELS[index].name)
    handles = [Patch(color=np.array(color) / 255, label=", ".join(some)) for color, some in names.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7)
