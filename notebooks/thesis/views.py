"""Pictures of frames: masks, keypoints, tracks, and keypoints that jump from frame to frame.

The thesis names such jumps as a cause of errors (Sections 4.2, 5.1).
"""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.ticker import MaxNLocator

from keypoint_study.report import style
from keypoint_study.report.style import GREEN, RED
from thesis_repro import masks
from thesis_repro.odometry import THESIS
from thesis_repro.odometry.loop import detect, track


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


# Keypoints from frame to frame


SAME = 2.0  # pixels: a keypoint within this distance of a tracked keypoint is the same one


class View(NamedTuple):
    """A window of a frame: crop and edges (h, w), and points (n, 2) in pixels of the crop."""

    frame: int
    crop: np.ndarray
    edges: np.ndarray
    keypoints: np.ndarray
    # keypoints of the previous frame, tracked to this one; None for the first frame
    expected: np.ndarray | None
    jumped: int  # number of expected points without a keypoint of this frame within SAME pixels


def follow_window(
    frames: Sequence[np.ndarray],
    label_maps: Sequence[np.ndarray],
    dilation_width: int,
    first: int = 0,
) -> list[View]:
    """Show how masked keypoints jump between consecutive frames (Figure 4.8).

    Returns a View of each frame.
    frames: (height, width) uint8 each. label_maps: one for each frame, (h, w) uint8 of any size.
    first: number of the first frame. The window has a quarter of the frame's height. It starts
    where most keypoints jump between the first two frames, or in the middle of the frame if none
    jumps. Then it follows the median motion of its keypoints.
    """
    size = np.array(frames[0].shape[::-1])
    half = size.min() // 8
    edge_images = [masks.edges(label_map, frames[0].shape) for label_map in label_maps]
    points = [
        detect(frame, THESIS, masks.dilate(edge_image, dilation_width))
        for frame, edge_image in zip(frames, edge_images, strict=True)
    ]
    tracked, followed = _track(frames[0], frames[1], points[0])
    jumping = points[0][followed & _far(tracked, points[1])]
    center = _densest(jumping, half) if len(jumping) else size / 2
    views: list[View] = []
    in_window = expected = np.zeros((0, 2), np.float32)
    for index, (frame, edge_image) in enumerate(zip(frames, edge_images, strict=True)):
        if index:
            tracked, followed = _track(frames[index - 1], frame, in_window)
            expected = tracked[followed]
            if len(expected):
                center = center + np.median(expected - in_window[followed], axis=0)
        low = np.clip(np.round(center - half).astype(int), 0, size - 2 * half)
        high = low + 2 * half
        crop = np.s_[low[1] : high[1], low[0] : high[0]]
        in_window = _inside(points[index], low, high)
        expected = _inside(expected, low, high)
        jumped = int(_far(expected, points[index]).sum())
        shown = expected - low if index else None
        keypoints = in_window - low
        views.append(View(first + index, frame[crop], edge_image[crop], keypoints, shown, jumped))
    return views


def _densest(points: np.ndarray, half: int) -> np.ndarray:
    """Return the point with most points in the window around it, which reaches `half` pixels."""
    near = np.abs(points[:, None] - points).max(axis=-1) < half
    return points[near.sum(axis=1).argmax()]


def _track(
    before: np.ndarray, after: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Track keypoints (n, 2) to the next frame.

    Returns their positions (n, 2) there and whether tracking back agrees with them, (n,) bool.
    """
    if not len(corners):
        return corners, np.zeros(0, bool)
    tracked, followed = track(before, after, corners)
    back, returned = track(after, before, tracked)
    agrees = np.linalg.norm(back - corners, axis=1) < SAME
    return tracked, followed & returned & agrees


def _inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the points inside a window with the corners `low` and `high`."""
    inside = (points >= low) & (points < high)
    return points[inside.all(axis=1)]


def _far(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return, for each point, whether no point of `others` is within SAME pixels."""
    distances = np.linalg.norm(points[:, None] - others, axis=-1)
    return np.asarray(distances.min(axis=1, initial=np.inf) > SAME)


def found_again(
    first: np.ndarray,
    second: np.ndarray,
    first_mask: np.ndarray | None = None,
    second_mask: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the keypoints of a frame again in a later one; returns four arrays of (n, 2) pixels.

    They are the positions of found keypoints in the first frame and in the second frame, the lost
    keypoints of the first frame, and the new keypoints of the second. A keypoint is found if
    Lucas-Kanade tracks it to within SAME pixels of a keypoint of the second frame. The masks are
    for the detector, (height, width) uint8.
    """
    before = detect(first, THESIS, first_mask)
    after = detect(second, THESIS, second_mask)
    tracked, followed = _track(first, second, before)
    again = followed & ~_far(tracked, after)
    new = _far(after, tracked[again])
    return before[again], tracked[again], before[~again], after[new]


def table_of_lost(
    frames: Sequence[np.ndarray], masks_of: dict[str, Sequence[np.ndarray | None]]
) -> pd.DataFrame:
    """Return the share of keypoints of consecutive frames that the next frame does not find again.

    masks_of: {text: a mask for each frame, or None}; one row for each.
    """
    rows = []
    for text, chosen in masks_of.items():
        pairs = zip(frames, frames[1:], chosen, chosen[1:])
        again, _, lost, _ = zip(*(found_again(*pair) for pair in pairs))
        missing, detected = len(np.concatenate(lost)), len(np.concatenate([*again, *lost]))
        share = round(100 * missing / max(detected, 1), 1)
        rows.append({"keypoints": text, "detected": detected, "not found again (%)": share})
    return pd.DataFrame(rows)
