"""The figure of paths: from above, and how far each is from the ground truth."""

from collections.abc import Collection

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keypoint_study.report.style import COLUMN_WIDTH, PAGE_WIDTH, TRUTH, line_style, new_figure
from thesis_repro.errors import one_line
from thesis_repro.odometry import metrics

MARGIN = 0.05  # of the range of an axis


def figure_of_paths(
    paths: dict[str, np.ndarray], true: np.ndarray | None, title: str, width: float = PAGE_WIDTH
) -> Figure:
    """Draw paths from above and, if the ground truth is known, their distance from it.

    A path that strays far from the ground truth is cut, and the legend says so. So it does not make
    the others too small to be seen.
    paths: {name: (n, 4, 4) poses, aligned}. true: (n, 4, 4), or None. width: inches; in one column
    the panels are below each other.
    """
    rows, columns = (1, 2) if width > COLUMN_WIDTH else (2, 1)
    if true is None:
        rows, columns = 1, 1
    drawing, panels = new_figure(rows, columns, 3.4 * rows, width, squeeze=False)
    above = panels.flat[0]
    places = {name: poses[:, [0, 2], 3] for name, poses in paths.items()}
    kept = list(paths)
    if true is not None:
        distances = {}
        for name, poses in paths.items():
            distances[name] = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
        # a path that is farther off somewhere has strayed; nothing is cut if all have
        limit = np.ptp(true[:, :3, 3], axis=0).max()
        kept = [name for name in paths if distances[name].max() <= limit] or kept
        _draw_distances(panels.flat[1], distances, metrics.travelled(true), kept)
        x, z = true[:, [0, 2], 3].T
        above.plot(x, z, label="ground truth", color=TRUTH, linewidth=2.2, alpha=0.6, zorder=1)
    for index, (name, each) in enumerate(places.items()):
        label = one_line(name)
        if name not in kept:
            label += " (leaves the picture)"
        above.plot(*each.T, label=label, **line_style(index))
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{one_line(title)} from above")
    above.set_aspect("equal", adjustable="datalim")
    if true is not None and len(kept) < len(places):
        _cut(above, [true[:, [0, 2], 3], *(places[name] for name in kept)])
    handles = above.get_legend_handles_labels()
    names = 3 if width > COLUMN_WIDTH else 1
    drawing.legend(*handles, loc="outside lower center", ncols=names)
    return drawing


def _cut(panel: Axes, shown: list[np.ndarray]) -> None:
    """Limit a panel to a square around paths. shown: (n, 2) each."""
    points = np.concatenate(shown)
    middle = (points.min(0) + points.max(0)) / 2
    half = (0.5 + MARGIN) * np.ptp(points, axis=0).max()
    (left, bottom), (right, top) = middle - half, middle + half
    panel.set(xlim=(left, right), ylim=(bottom, top))
    panel.set_aspect("equal", adjustable="box")


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
