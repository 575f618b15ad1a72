"""Figures of chapter 3, 4.1 to 4.5, 4.8 and A.1: augmentation, the network, training, prediction and masks."""

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from thesis_repro.cityscapes import LABELS, colorize
from thesis_repro.report.style import (
    BLUE,
    KEYPOINT,
    ORANGE,
    PAGE_WIDTH,
    PINK,
    SKY,
    frame_panels,
    label_colors,
    line_style,
    new_figure,
    show_image,
)

EDGE = (255, 140, 0)  # red, green, blue of edges drawn on a frame


def figure_augmentation(examples):
    """Figures 3.1 and 3.2: four panels from a dict of titles and images (gray, or label maps as colours)."""
    figure, axes = new_figure(2, 2, height=7.0)
    for panel, (title, image) in zip(axes.flat, examples.items(), strict=True):
        show_image(panel, image, title)
    return figure


def figure_3_03(image, label_map, prediction, label):
    """Intersection and union of a prediction and its label map for one class, with the IoU (Equation 3.1).

    image: (h, w) gray or (h, w, 3) colours.
    """
    true, predicted = label_map == label.id, prediction == label.id
    both, either = (true & predicted).sum(), (true | predicted).sum()
    figure, axes = new_figure(1, 3, height=3.0)
    dimmed = np.dstack([image] * 3)[..., :3] // 3 + 150
    for panel, where, title in ((axes[0], true, f"label map: {true.sum():,} pixels"),
                                (axes[1], predicted, f"prediction: {predicted.sum():,} pixels")):
        picture = dimmed.copy()
        picture[where] = _rgb(BLUE)
        show_image(panel, picture, title)
    picture = dimmed.copy()
    picture[true & ~predicted], picture[predicted & ~true] = _rgb(ORANGE), _rgb(SKY)
    picture[true & predicted] = _rgb(BLUE)
    show_image(axes[2], picture, f"IoU = {both:,} / {either:,} = {both / max(either, 1):.2f}")
    figure.legend(handles=[Patch(color=BLUE, label="intersection"), Patch(color=ORANGE, label="only in the label map"),
                           Patch(color=SKY, label="only in the prediction")],
                  title=f"class {label.name}; the three colours together are the union", title_fontsize=8,
                  loc="outside lower center", ncols=3)
    return figure


def figure_3_04():
    """Focal loss against the probability of the true class for several gamma, alpha being 1 (Equation 3.7)."""
    p = np.linspace(0.005, 1, 400)
    figure, axes = new_figure(height=3.0)
    for index, gamma in enumerate((0, 0.5, 1, 2, 5)):
        name = f"γ = {gamma:g}" + (" (cross-entropy)" if gamma == 0 else "")
        axes.plot(p, -((1 - p) ** gamma) * np.log(p), label=name, **line_style(index))
    axes.set(xlabel="probability p of the true class (no unit)", ylabel="focal loss, α = 1 (no unit)",
             xlim=(0, 1), ylim=(0, 5))
    axes.legend()
    return figure


def figure_3_05(counts, n_images):
    """Pixels of each category in the training data at hand; counts: (35,) by label id."""
    present = sorted((label for label in LABELS[:len(counts)] if counts[label.id]), key=lambda label: -counts[label.id])
    figure, axes = new_figure(height=3.4)
    axes.bar([label.name for label in present], [counts[label.id] for label in present],
             color=[np.array(label.color) / 255 for label in present], edgecolor="#555555", linewidth=0.5)
    axes.set(yscale="log", ylabel="pixels", xlabel="category", title=f"{n_images} training label maps")
    axes.set_xticks(range(len(present)), [label.name for label in present], rotation=45, ha="right",
                    rotation_mode="anchor", fontsize=8)
    axes.margins(x=0.01)
    axes.grid(axis="x", visible=False)
    return figure


def figure_3_06(frame, label_map, edge_image, mask, dilation_width):
    """A frame, its predicted label map, the Canny edges of the label map, and the edges dilated."""
    figure, axes = frame_panels(frame, 2, 2)
    show_image(axes[0], frame, "frame")
    show_image(axes[1], label_colors(label_map, frame), "predicted label map")
    show_image(axes[2], edge_image, "Canny edges (5, 15) of the label map")
    show_image(axes[3], mask, f"edges dilated by {dilation_width}x{dilation_width}")
    figure.set_figheight(figure.get_figheight() + 0.45)  # the legend's
    _class_legend(figure, label_map)
    return figure


def figure_masks(frame, masks, keypoints, true_edges=None):
    """Masks of one frame side by side, {title: (h, w)}, with their keypoints, {title: (n, 2)}, and the true boundaries.

    What a mask keeps is light. true_edges: (h, w), 255 on them, or None where they are not known.
    """
    figure, axes = frame_panels(frame, -(-len(masks) // 2), 2)
    for panel, (title, mask) in zip(axes, masks.items(), strict=False):
        picture = np.dstack([np.where(mask > 0, frame // 2 + 127, frame // 3)] * 3)
        if true_edges is not None:
            picture[true_edges > 0] = EDGE
        show_image(panel, picture, title)
        panel.scatter(*keypoints[title].T, **KEYPOINT)
    for panel in axes[len(masks):]:
        panel.set_axis_off()
    return figure


def figure_4_01(history):
    """Training and validation curves: F1 score, IoU score, loss; one point an epoch."""
    figure, axes = new_figure(1, 3, height=2.6)
    best = history["epoch"][history["val_loss"].idxmin()]
    for panel, (column, title) in zip(axes, (("f1-score", "(a) F1 score"), ("iou_score", "(b) IoU score"),
                                             ("loss", "(c) loss")), strict=True):
        panel.plot(history["epoch"], history[column], color=BLUE, label="training")
        panel.plot(history["epoch"], history[f"val_{column}"], color=ORANGE, linestyle="--", label="validation")
        panel.axvline(best, color="#666666", linewidth=1.2, linestyle=":", label=f"lowest validation loss ({best})")
        panel.set(title=title, xlabel="epoch", ylabel=f"{title[4:]} (no unit)")
        panel.xaxis.get_major_locator().set_params(integer=True)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def figure_4_02(image, label_map, prediction, whose):
    """An image of the Cityscapes validation split, its label map and its prediction (Section 4.1).

    whose: the model's name, as "the model of this run".
    """
    figure, axes = new_figure(1, 3, height=3.0)
    show_image(axes[0], image, "image")
    show_image(axes[1], colorize(label_map), "label map")
    show_image(axes[2], colorize(prediction), f"prediction of {whose}")
    _class_legend(figure, label_map, prediction)
    return figure


def figure_4_03(frame, prediction, title, label_map=None):
    """A KITTI frame, its predicted label map at the network's size, and its true one where there is any."""
    maps = {"prediction": prediction} | ({} if label_map is None else {"true label map": label_map})
    figure, axes = frame_panels(frame, 1 + len(maps), width=PAGE_WIDTH)
    figure.set_figheight(figure.get_figheight() + 0.45)  # the legend's
    show_image(axes[0], frame, title)
    for panel, (text, shown) in zip(axes[1:], maps.items(), strict=True):
        show_image(panel, label_colors(shown, frame), text)
    _class_legend(figure, *maps.values())
    return figure


def figure_4_04(frame, edge_image, keypoints, title):
    """Keypoints, (n, 2) pixels, that the mask left along the predicted boundaries."""
    figure, (axes,) = frame_panels(frame)
    brighter = np.clip(230 * (frame / max(np.percentile(frame, 98), 1)) ** 0.6, 0, 255).astype(np.uint8)
    show_image(axes, _with_edges(brighter, edge_image), title)
    axes.scatter(*keypoints.T, s=9, color=KEYPOINT["color"], edgecolors="black", linewidths=0.4)
    return figure


def figure_4_05(frame, all_keypoints, prediction, mask, kept_keypoints, dilation_width, title):
    """The procedure in five panels: frame, all keypoints, prediction, dilated edges, kept keypoints."""
    figure, axes = frame_panels(frame, 5, width=0.78 * PAGE_WIDTH)
    show_image(axes[0], frame, f"(a) {title}")
    show_image(axes[1], frame, f"(b) all {len(all_keypoints)} Shi-Tomasi keypoints")
    axes[1].scatter(*all_keypoints.T, **KEYPOINT)
    show_image(axes[2], label_colors(prediction, frame), "(c) prediction")
    show_image(axes[3], mask, f"(d) Canny edges dilated by {dilation_width}x{dilation_width}")
    show_image(axes[4], frame, f"(e) the {len(kept_keypoints)} keypoints that the mask keeps")
    axes[4].scatter(*kept_keypoints.T, **KEYPOINT)
    figure.set_figheight(figure.get_figheight() + 0.45)  # the legend's
    _class_legend(figure, prediction)
    return figure


def figure_4_08(views, title):
    """One object in consecutive frames and how its keypoints jump: views of `flicker.follow`."""
    figure, axes = new_figure(1, len(views), height=3.4)
    for panel, view in zip(axes, views, strict=True):
        text = f"frame {view.frame}: {len(view.keypoints)} keypoints"
        if view.expected is not None:
            text += f",\n{view.jumped} of {len(view.expected)} tracked here gone"
        show_image(panel, _with_edges(view.crop, view.edges), text)
        panel.scatter(*view.keypoints.T, **{**KEYPOINT, "s": 12})
        if view.expected is not None:
            panel.scatter(*view.expected.T, s=34, facecolors="none", edgecolors=PINK, linewidths=1.1)
        # a ring at the rim must not stretch the panel
        panel.set(xlim=(-0.5, view.crop.shape[1] - 0.5), ylim=(view.crop.shape[0] - 0.5, -0.5))
    figure.legend(handles=[
        Patch(color=np.array(EDGE) / 255, label="edges of the predicted label map"),
        Line2D([], [], linestyle="none", marker="o", markersize=4, color=KEYPOINT["color"], label="keypoints"),
        Line2D([], [], linestyle="none", marker="o", markersize=6, markerfacecolor="none", color=PINK,
               label="keypoints of the frame before that could be tracked to here")],
        loc="outside lower center", ncols=3)
    figure.suptitle(title, fontsize=9)
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


def _with_edges(frame, edge_image):
    picture = np.dstack([frame] * 3)
    picture[edge_image > 0] = EDGE
    return picture


def _rgb(color):
    return tuple(int(color[index:index + 2], 16) for index in (1, 3, 5))


def _class_legend(figure, *label_maps):
    names = {}  # Cityscapes gives several labels one colour
    for index in np.unique(np.concatenate([np.unique(label_map) for label_map in label_maps])):
        names.setdefault(LABELS[index].color, []).append(LABELS[index].name)
    handles = [Patch(color=np.array(color) / 255, label=", ".join(some)) for color, some in names.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=7)
