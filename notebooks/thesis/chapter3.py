"""Figures of chapter 3 and of masks: label maps, their edges and masks on a frame."""

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from thesis import frames
from thesis_repro.data.cityscapes import Label
from thesis_repro.masks import dilate
from thesis_repro.report import style
from thesis_repro.report.style import BLUE, ORANGE, RED, SKY


def figure_3_03(
    image: np.ndarray, label_map: np.ndarray, prediction: np.ndarray, label: Label
) -> Figure:
    """Figure 3.3: intersection and union of a prediction and its label map for one class.

    Equation 3.1. image: (h, w) gray or (h, w, 3) RGB.
    """
    true = label_map == label.id
    predicted = prediction == label.id
    both = true & predicted
    intersection, union = both.sum(), (true | predicted).sum()
    iou = intersection / max(union, 1)
    panels = {
        f"label map: {true.sum():,} pixels": {ORANGE: true},
        f"prediction: {predicted.sum():,} pixels": {SKY: predicted},
        f"IoU = {intersection:,} / {union:,} = {iou:.2f}": {
            ORANGE: true,
            SKY: predicted,
            BLUE: both,
        },
    }
    dimmed = np.dstack([image] * 3)[..., :3] // 3 + 150
    figure, axes = style.new_figure(1, 3, height=2.9)
    for panel, (title, areas) in zip(axes, panels.items(), strict=True):
        picture = dimmed.copy()
        for color, area in areas.items():
            picture[area] = 255 * np.array(to_rgb(color))
        style.show_image(panel, picture, title)
    handles = [
        Patch(color=ORANGE, label="label map"),
        Patch(color=SKY, label="prediction"),
        Patch(color=BLUE, label="both: the intersection"),
    ]
    figure.legend(
        handles=handles,
        title=f"class {label.name}; the three colours together are the union",
        title_fontsize=8,
        loc="outside lower center",
        ncols=3,
    )
    return figure


def figure_3_06(
    frame: np.ndarray,
    label_map: np.ndarray,
    edge_image: np.ndarray,
    mask: np.ndarray,
    dilation_width: int,
) -> Figure:
    """Figure 3.6: a frame, its predicted label map, its edges and the edges dilated.

    Below, the window with most edges is enlarged. It is marked in the frame and in the label map.
    """
    height, width = np.array(frame.shape) // 5
    windows = [
        np.s_[top : top + height, left : left + width]
        for top in range(0, 4 * height, height // 2)
        for left in range(0, 4 * width, width // 2)
    ]
    window = max(windows, key=lambda window: edge_image[window].sum())
    pictures = {
        "frame": frame,
        "predicted label map": style.label_colors(label_map, frame),
        "edges of the label map": edge_image,
        f"edges dilated by {dilation_width}x{dilation_width}": mask,
        "edges in the marked part": edge_image[window],
        "dilated edges in the marked part": mask[window],
    }
    figure = frames.pictures(frame, pictures, columns=2, label_maps=[label_map])
    # lines of one pixel would drop out where the picture is reduced to the nearest pixels
    figure.axes[2].images[0].set_interpolation("antialiased")
    for panel in figure.axes[:2]:
        corner = window[1].start, window[0].start
        panel.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=RED))
    return figure


def figure_masks(
    frame: np.ndarray,
    masks: dict[str, np.ndarray],
    keypoints: dict[str, np.ndarray],
    true_edges: np.ndarray | None = None,
) -> Figure:
    """Figure "masks": one frame with several masks.

    The kept area is light; true boundaries are drawn on it.
    masks: {title: (h, w)}. keypoints: {title: (n, 2)}. true_edges: (h, w), 255 on boundaries, or
    None if unknown.
    """
    edges = np.zeros_like(frame)
    if true_edges is not None:
        edges = dilate(true_edges, 3)
    pictures = {}
    for title, mask in masks.items():
        shaded = np.where(mask > 0, frame // 2 + 127, frame // 3)
        pictures[title] = frames.with_edges(shaded, edges)
    figure = frames.pictures(frame, pictures, keypoints, columns=2)
    keypoint_color = style.KEYPOINT["color"]
    marks = [
        Patch(facecolor="#bbbbbb", edgecolor="black", label="kept by the mask"),
        Line2D([], [], linestyle="none", marker="o", color=keypoint_color, label="keypoints on it"),
    ]
    if true_edges is not None:
        red, green, blue = style.EDGE_COLOR
        true_color = (red / 255, green / 255, blue / 255)
        marks.append(Line2D([], [], color=true_color, label="true boundaries of classes"))
    figure.legend(handles=marks, loc="outside lower center", ncols=3)
    return figure
