"""Figures 4.2 to 4.5 and 4.8: predictions, and the keypoints that masks leave on frames."""

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from thesis_repro.cityscapes import colorize
from thesis_repro.report import style
from thesis_repro.report.style import EDGE_COLOR, KEYPOINT, PAGE_WIDTH, PINK


def figure_4_02(image, label_map, prediction, whose):
    """Figure 4.2: an image of the Cityscapes validation split, its label map and its prediction (Section 4.1).

    whose: the model's name, as "the model of this run".
    """
    figure, axes = style.new_figure(1, 3, height=2.5)
    style.show_image(axes[0], image, "image")
    style.show_image(axes[1], colorize(label_map), "label map")
    style.show_image(axes[2], colorize(prediction), f"prediction of\n{whose}")
    style.class_legend(figure, label_map, prediction)
    return figure


def figure_4_03(frame, prediction, title, label_map=None):
    """Figure 4.3: a KITTI frame, its predicted label map at the network's size, and its true one where there is any."""
    label_maps = {"prediction": prediction} | ({} if label_map is None else {"true label map": label_map})
    figure, axes = style.frame_panels(frame, 1 + len(label_maps))
    style.show_image(axes[0], frame, title)
    for panel, (text, shown) in zip(axes[1:], label_maps.items(), strict=True):
        style.show_image(panel, style.label_colors(shown, frame), text)
    style.class_legend(figure, *label_maps.values())
    return figure


def figure_4_04(frame, edge_image, keypoints, title):
    """Figure 4.4: keypoints, (n, 2) pixels, that the mask left along the predicted boundaries."""
    figure, (axes,) = style.frame_panels(frame)
    brighter = np.clip(230 * (frame / max(np.percentile(frame, 98), 1)) ** 0.6, 0, 255).astype(np.uint8)
    style.show_image(axes, _with_edges(brighter, edge_image), title)
    axes.scatter(*keypoints.T, s=9, color=KEYPOINT["color"], edgecolors="black", linewidths=0.4)
    return figure


def figure_4_05(frame, all_keypoints, prediction, mask, kept_keypoints, dilation_width, title):
    """Figure 4.5: the procedure in five panels: frame, all keypoints, prediction, dilated edges, kept keypoints."""
    figure, axes = style.frame_panels(frame, 5, width=0.78 * PAGE_WIDTH)
    style.show_image(axes[0], frame, f"(a) {title}")
    style.show_image(axes[1], frame, f"(b) all {len(all_keypoints)} Shi-Tomasi keypoints")
    style.show_image(axes[2], style.label_colors(prediction, frame), "(c) prediction")
    style.show_image(axes[3], mask, f"(d) Canny edges dilated by {dilation_width}x{dilation_width}")
    style.show_image(axes[4], frame, f"(e) the {len(kept_keypoints)} keypoints that the mask keeps")
    for panel, points in ((axes[1], all_keypoints), (axes[4], kept_keypoints)):
        panel.scatter(*points.T, **KEYPOINT)
    style.class_legend(figure, prediction)
    return figure


def figure_4_08(views, title):
    """Figure 4.8: one place in consecutive frames and how its keypoints jump: views of `flicker.follow`."""
    figure, axes = style.new_figure(1, len(views), height=3.4)
    for panel, view in zip(axes, views, strict=True):
        height, width = view.crop.shape
        text = f"frame {view.frame}: {len(view.keypoints)} keypoints"
        if view.expected is not None:
            text += f",\n{view.jumped} of {len(view.expected)} tracked here gone"
            panel.scatter(*view.expected.T, s=34, facecolors="none", edgecolors=PINK, linewidths=1.1)
        style.show_image(panel, _with_edges(view.crop, view.edges), text)
        panel.scatter(*view.keypoints.T, **{**KEYPOINT, "s": 12})
        panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))  # a ring at the rim must not stretch the panel
    points = {"linestyle": "none", "marker": "o"}
    figure.legend(handles=[
        Patch(color=np.array(EDGE_COLOR) / 255, label="edges of the predicted label map"),
        Line2D([], [], **points, markersize=4, color=KEYPOINT["color"], label="keypoints"),
        Line2D([], [], **points, markersize=6, markerfacecolor="none", color=PINK,
               label="keypoints of the frame before, tracked to here")], loc="outside lower center", ncols=3)
    figure.suptitle(title, fontsize=9)
    return figure


def _with_edges(frame, edge_image):
    picture = np.dstack([frame] * 3)
    picture[edge_image > 0] = EDGE_COLOR
    return picture
