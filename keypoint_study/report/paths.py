"""The figure of paths: from above, and how far each is from the ground truth."""

from collections.abc import Collection
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keypoint_study.report.style import COLUMN_WIDTH, PAGE_WIDTH, TRUTH, line_style, new_figure
from thesis_repro.errors import one_line
from thesis_repro.odometry import metrics

MARGIN = 0.05  # of the range of an axis
OF_TRUTH: dict[str, Any] = {"color": TRUTH, "linewidth": 2.2, "alpha": 0.6, "zorder": 1}
STRAYED = 1  # times the true path's extent: a path that is farther off somewhere is cut


def figure_of_paths(
    paths: dict[str, np.ndarray], true: np.ndarray | None, title: str, width: float = PAGE_WIDTH
) -> Figure:
    """Draw paths from above and, if the ground truth is known, their distance from it.

    A path that strays far from the ground truth is cut, and the legend says so. So it does not make
    the others too small to be seen.
    paths: {name: (n, 4, 4) poses, aligned}. true: (n, 4, 4), or None. width: inches; in one column
    the panels are below each other.
    """
    columns = 1 if true is None or width <= COLUMN_WIDTH else 2
    rows = 1 if true is None else 3 - columns
    drawing, panels = new_figure(rows, columns, 3.4 * rows, width, squeeze=False)
    above = panels.flat[0]
    places = {name: poses[:, [0, 2], 3] for name, poses in paths.items()}
    kept = places
    if true is not None:
        distances = {
            name: np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
            for name, poses in paths.items()
        }
        limit = STRAYED * np.ptp(true[:, :3, 3], axis=0).max()
        # nothing is cut if all have strayed
        kept = {name: each for name, each in places.items() if distances[name].max() <= limit}
        kept = kept or places
        _draw_distances(panels.flat[1], distances, metrics.travelled(true), kept)
        above.plot(*true[:, [0, 2], 3].T, label="ground truth", **OF_TRUTH)
    for index, (name, each) in enumerate(places.items()):
        label = one_line(name) + " (leaves the picture)" * (name not in kept)
        above.plot(*each.T, label=label, **line_style(index))
    if true is not None and len(kept) < len(places):
        shown = np.concatenate([true[:, [0, 2], 3], *kept.values()])
        middle = (shown.min(0) + shown.max(0)) / 2
        half = (0.5 + MARGIN) * np.ptp(shown, axis=0).max()
        (left, bottom), (right, top) = middle - half, middle + half
        above.set(xlim=(left, right), ylim=(bottom, top))
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{one_line(title)} from above")
    above.set_aspect("equal", adjustable="box" if len(kept) < len(places) else "datalim")
    handles = above.get_legend_handles_labels()
    names = 3 if width > COLUMN_WIDTH else 1
    drawing.legend(*handles, loc="outside lower center", ncols=names)
    return drawing


def _draw_distances(
    panel: Axes, distances: dict[str, np.ndarray], travelled: np.ndarray, kept: Collection[str]
) -> None:
    for index, distance in enumerate(distances.values()):
        panel.plot(travelled, distance, **line_style(index))
    highest = max(distances[name].max() for name in kept)
    panel.set(
        xlabel="travelled (m)",
        ylabel="distance from the truth (m)",
        title="error along the way",
        ylim=(0, (1 + MARGIN) * highest or None),
    )
