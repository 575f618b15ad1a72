"""Pictures of frames: masks, keypoints, tracks and lines, and the panels that show them."""

from collections.abc import Collection
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator

from keypoint_study.report import style
from keypoint_study.report.style import GREEN, RED
from thesis_repro.data import cityscapes
from thesis_repro.masks import dilate


def pictures(
    frame: np.ndarray,
    pictures: dict[str, Any],
    columns: int = 1,
    label_maps: Collection[np.ndarray] = (),
) -> plt.Figure:
    """Show pictures {title: picture} of a frame's shape.

    A picture may be a pair, with keypoints (n, 2) on it. label_maps: of the classes in a legend.
    """
    figure, axes = style.frame_panels(frame, -(-len(pictures) // columns), columns)
    for panel, (title, shown) in zip(axes, pictures.items()):
        picture, points = shown if isinstance(shown, tuple) else (shown, np.empty((0, 2)))
        style.show_image(panel, picture, title)
        # two thousand dots must not merge, and two hundred must be seen
        size = np.clip(2000 / max(len(points), 1), 1.2, 8)
        panel.scatter(*points.T, **{**style.KEYPOINT, "s": size})
    for panel in axes[len(pictures) :]:
        panel.set_axis_off()
    if label_maps:
        style.class_legend(figure, *label_maps)
    return figure


def with_edges(frame: np.ndarray, edge_image: np.ndarray) -> np.ndarray:
    """Return a gray frame as red, green, blue, with edges marked where `edge_image` is not 0."""
    picture = np.dstack([frame] * 3)
    picture[edge_image > 0] = style.EDGE_COLOR
    return picture


def small_panels(
    names: list[str], xlabel: str = "", figure: Any = None
) -> tuple[Any, list[plt.Axes]]:
    """Return (figure, panels), one small panel for each name, at most four in a row.

    xlabel: label of the lowest panel of each column. figure: a subfigure for the panels, or None
    for a new figure.
    """
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    if figure is None:
        figure = plt.figure(figsize=(style.PAGE_WIDTH, rows * 1.65 + 0.6), layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for panel in panels[len(names) :]:
        panel.remove()
    panels = panels[: len(names)]
    for panel, name in zip(panels, names, strict=True):
        panel.set_title(name, fontsize=8, pad=3)
        panel.tick_params(labelsize=7)
        panel.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    for panel in panels[-columns:]:
        panel.set_xlabel(xlabel, fontsize=8)
    return figure, panels


def gradients(enlarged: np.ndarray, strength: np.ndarray, edge_image: np.ndarray) -> plt.Figure:
    """Draw an enlarged label map, the strength of its gradient, and its edges; (h, w) each."""
    figure, axes = style.frame_panels(enlarged, rows=3)
    style.show_image(axes[0], cityscapes.colorize(enlarged), "ids, enlarged bilinearly")
    style.show_image(axes[1], np.minimum(strength, 60), "|Gx| + |Gy|, up to 60")
    # thin lines would drop out where the picture is reduced
    wider = dilate(edge_image, 5)
    style.show_image(axes[2], wider, "edges: local maxima above the thresholds, drawn wider")
    return figure


def tracks(
    frame: np.ndarray,
    old: np.ndarray,
    new: np.ndarray,
    title: str,
    inliers: np.ndarray | None = None,
) -> plt.Figure:
    """Draw tracks on a frame, from old to new points (n, 2).

    inliers: (n,) booleans; the others are red. None: all are green.
    """
    figure, (axis,) = style.frame_panels(frame)
    style.show_image(axis, frame, title)
    inliers = np.ones(len(old), bool) if inliers is None else inliers
    for chosen, color in ((inliers, GREEN), (~inliers, RED)):
        ends = np.stack([old[chosen], new[chosen]], axis=1)
        axis.plot(*ends.transpose(2, 1, 0), color=color, linewidth=0.7)
    axis.set(xlim=(0, frame.shape[1]), ylim=(frame.shape[0], 0))
    return figure


def lines(frame: np.ndarray, coefficients: np.ndarray, points: np.ndarray) -> plt.Figure:
    """Draw lines a u + b v + c = 0, coefficients (n, 3) in pixels, and a point (n, 2) for each."""
    figure, (axis,) = style.frame_panels(frame)
    style.show_image(axis, frame, f"epipolar lines of {len(points)} inliers, and the points")
    width = frame.shape[1]
    for (a, b, c), point in zip(coefficients, points, strict=True):
        (line,) = axis.plot([0, width], [-c / b, -(c + a * width) / b], linewidth=0.8)
        axis.plot(*point, "o", color=line.get_color(), markersize=4, markerfacecolor="none")
    axis.set(xlim=(0, width), ylim=(frame.shape[0], 0))
    return figure
