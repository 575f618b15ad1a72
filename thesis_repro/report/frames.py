"""Figures of single frames in chapters 3 and 4: label maps, masks, and the keypoints that masks
keep.
"""

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from thesis_repro.cityscapes import colorize
from thesis_repro.masks import dilate
from thesis_repro.report import style
from thesis_repro.report.style import BLUE, EDGE_COLOR, KEYPOINT, ORANGE, PINK, SKY


def figure_3_03(image, label_map, prediction, label):
    """Figure 3.3: intersection and union of a prediction and its label map for one class (Equation
    3.1).

    image: (h, w) gray or (h, w, 3) RGB.
    """
    true, predicted = label_map == label.id, prediction == label.id
    intersection, union = (true & predicted).sum(), (true | predicted).sum()
    figure, axes = style.new_figure(1, 3, height=2.9)
    dimmed = np.dstack([image] * 3)[..., :3] // 3 + 150
    for panel, areas, title in (
        (axes[0], {BLUE: true}, f"label map: {true.sum():,} pixels"),
        (axes[1], {BLUE: predicted}, f"prediction: {predicted.sum():,} pixels"),
        (
            axes[2],
            {ORANGE: true & ~predicted, SKY: predicted & ~true, BLUE: true & predicted},
            f"IoU = {intersection:,} / {union:,} = {intersection / max(union, 1):.2f}",
        ),
    ):
        picture = dimmed.copy()
        for color, area in areas.items():
            picture[area] = 255 * np.array(to_rgb(color))
        style.show_image(panel, picture, title)
    figure.legend(
        handles=[
            Patch(color=BLUE, label="intersection"),
            Patch(color=ORANGE, label="only in the label map"),
            Patch(color=SKY, label="only in the prediction"),
        ],
        title=f"class {label.name}; the three colours together are the union",
        title_fontsize=8,
        loc="outside lower center",
        ncols=3,
    )
    return figure


def figure_3_06(frame, label_map, edge_image, mask, dilation_width):
    """Figure 3.6: a frame, its predicted label map, the Canny edges of the label map, and the
    edges dilated.
    """
    return _pictures(
        frame,
        {
            "frame": frame,
            "predicted label map": style.label_colors(label_map, frame),
            # thin lines would drop out where the picture is reduced
            "Canny edges (5, 15) of the label map, drawn wider": dilate(edge_image, 5),
            f"edges dilated by {dilation_width}x{dilation_width}": mask,
        },
        columns=2,
        label_maps=[label_map],
    )


def figure_masks(frame, masks, keypoints, true_edges=None):
    """Figure "masks": one frame with several masks. The kept area is light; true boundaries are
    drawn on it.

    masks: {title: (h, w)}. keypoints: {title: (n, 2)}. true_edges: (h, w), 255 on boundaries, or
    None if unknown.
    """
    edges = np.zeros_like(frame) if true_edges is None else dilate(true_edges, 3)
    pictures = {
        title: _with_edges(np.where(mask > 0, frame // 2 + 127, frame // 3), edges)
        for title, mask in masks.items()
    }
    return _pictures(frame, pictures, keypoints, columns=2)


def figure_4_02(image, label_map, prediction, model_name):
    """Figure 4.2: an image of the Cityscapes validation split, its label map and its prediction
    (Section 4.1).
    """
    figure, axes = style.new_figure(1, 3, height=2.5)
    style.show_image(axes[0], image, "image")
    style.show_image(axes[1], colorize(label_map), "label map")
    style.show_image(axes[2], colorize(prediction), f"prediction of\n{model_name}")
    style.class_legend(figure, label_map, prediction)
    return figure


def figure_4_03(frame, prediction, title, label_map=None):
    """Figure 4.3: a KITTI frame, its predicted label map at the network's size, and its true
    label map if known.
    """
    label_maps = {"prediction": prediction} | (
        {} if label_map is None else {"true label map": label_map}
    )
    pictures = {
        text: style.label_colors(label_map, frame) for text, label_map in label_maps.items()
    }
    return _pictures(frame, {title: frame} | pictures, label_maps=label_maps.values())


def figure_4_04(frame, edge_image, keypoints, title):
    """Figure 4.4: the keypoints, (n, 2) pixels, that the mask keeps along the predicted
    boundaries.
    """
    figure, (axes,) = style.frame_panels(frame)
    brighter = np.clip(230 * (frame / max(np.percentile(frame, 98), 1)) ** 0.6, 0, 255).astype(
        np.uint8
    )
    style.show_image(axes, _with_edges(brighter, edge_image), title)
    axes.scatter(*keypoints.T, s=9, color=KEYPOINT["color"], edgecolors="black", linewidths=0.4)
    return figure


def figure_4_05(frame, all_keypoints, prediction, mask, kept_keypoints, dilation_width, title):
    """Figure 4.5: the procedure in five panels: frame, all keypoints, prediction, dilated
    edges, kept keypoints.
    """
    all_title = f"(b) all {len(all_keypoints)} Shi-Tomasi keypoints"
    kept_title = f"(e) the {len(kept_keypoints)} keypoints that the mask keeps"
    return _pictures(
        frame,
        {
            f"(a) {title}": frame,
            all_title: frame,
            "(c) prediction": style.label_colors(prediction, frame),
            f"(d) Canny edges dilated by {dilation_width}x{dilation_width}": mask,
            kept_title: frame,
        },
        {all_title: all_keypoints, kept_title: kept_keypoints},
        label_maps=[prediction],
    )


def figure_4_08(views, title):
    """Figure 4.8: one place in consecutive frames, where keypoints jump. views: from
    `flicker.follow`.
    """
    figure, axes = style.new_figure(1, len(views), height=3.4)
    for panel, view in zip(axes, views, strict=True):
        height, width = view.crop.shape
        text = f"frame {view.frame}: {len(view.keypoints)} keypoints"
        if view.expected is not None:
            text += f";\n{view.jumped} of {len(view.expected)} rings without a keypoint"
            panel.scatter(
                *view.expected.T, s=34, facecolors="none", edgecolors=PINK, linewidths=1.1
            )
        style.show_image(panel, _with_edges(view.crop, view.edges), text)
        panel.scatter(*view.keypoints.T, **{**KEYPOINT, "s": 12})
        # a circle at the border would widen the panel
        panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    marker = {"linestyle": "none", "marker": "o"}
    figure.legend(
        handles=[
            Patch(color=np.array(EDGE_COLOR) / 255, label="edges of the predicted label map"),
            Line2D([], [], **marker, markersize=4, color=KEYPOINT["color"], label="keypoints"),
            Line2D(
                [],
                [],
                **marker,
                markersize=6,
                markerfacecolor="none",
                color=PINK,
                label="where keypoints of the frame before are now",
            ),
        ],
        loc="outside lower center",
        ncols=3,
    )
    figure.suptitle(title, fontsize=9)
    return figure


def _pictures(frame, pictures, keypoints=(), columns=1, label_maps=()):
    """Show pictures {title: picture} of a frame's shape, with keypoints {title: (n, 2)} and a
    legend of label maps.
    """
    figure, axes = style.frame_panels(frame, -(-len(pictures) // columns), columns)
    for panel, (title, picture) in zip(axes, pictures.items()):
        style.show_image(panel, picture, title)
        if title in keypoints:
            panel.scatter(*keypoints[title].T, **KEYPOINT)
    for panel in axes[len(pictures) :]:
        panel.set_axis_off()
    if label_maps:
        style.class_legend(figure, *label_maps)
    return figure


def _with_edges(frame, edge_image):
    picture = np.dstack([frame] * 3)
    picture[edge_image > 0] = EDGE_COLOR
    return picture
