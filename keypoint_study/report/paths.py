"""The figure of paths: from above, and how far each is from the ground truth."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from keypoint_study.report.style import COLUMN_WIDTH, PAGE_WIDTH, TRUTH, line_style, new_figure
from thesis_repro.errors import one_line
from thesis_repro.odometry import metrics

MARGIN = 0.05  # of the range of an axis
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
    rows, columns = 1, 2
    if width <= COLUMN_WIDTH:
        rows, columns = 2, 1
    if true is None:
        rows, columns = 1, 1
    drawing, panels = new_figure(rows, columns, 3.4 * rows, width, squeeze=False)
    above, *below = panels.flat
    strayed = _strayed(paths, true)
    for index, (name, poses) in enumerate(paths.items()):
        label = one_line(name)
        if name in strayed:
            label += " (leaves the picture)"
        above.plot(poses[:, 0, 3], poses[:, 2, 3], label=label, **line_style(index))
    if true is not None:
        look = {"color": TRUTH, "linewidth": 2.2, "alpha": 0.6, "zorder": 1}
        above.plot(true[:, 0, 3], true[:, 2, 3], label="ground truth", **look)
        _draw_distances(below[0], paths, true, strayed)
    if true is not None and strayed:
        shown = [true, *(poses for name, poses in paths.items() if name not in strayed)]
        places = np.concatenate([poses[:, [0, 2], 3] for poses in shown])
        low, high = places.min(0), places.max(0)
        half = (0.5 + MARGIN) * (high - low).max()
        (left, right), (bottom, top) = np.transpose(
            [(low + high) / 2 - half, (low + high) / 2 + half]
        )
        above.set(xlim=(left, right), ylim=(bottom, top))
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{one_line(title)} from above")
    above.set_aspect("equal", adjustable="box" if strayed else "datalim")
    names = 3 if width > COLUMN_WIDTH else 1
    handles = above.get_legend_handles_labels()
    drawing.legend(*handles, loc="outside lower center", ncols=names)
    return drawing


def _distances(poses: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)


def _strayed(paths: dict[str, np.ndarray], true: np.ndarray | None) -> list[str]:
    """Return the names of the paths to cut; none if all have strayed."""
    if true is None:
        return []
    extent = np.ptp(true[:, :3, 3], axis=0).max()
    names = [
        name for name, poses in paths.items() if _distances(poses, true).max() > STRAYED * extent
    ]
    return names if len(names) < len(paths) else []


def _draw_distances(
    panel: Axes, paths: dict[str, np.ndarray], true: np.ndarray, strayed: list[str]
) -> None:
    travelled = metrics.travelled(true)
    highest = 0.0
    for index, (name, poses) in enumerate(paths.items()):
        distance = _distances(poses, true)
        panel.plot(travelled, distance, **line_style(index))
        if name not in strayed:
            highest = max(highest, distance.max())
    panel.set(
        xlabel="travelled (m)",
        ylabel="distance from the truth (m)",
        title="error along the way",
        ylim=(0, None),
    )
    if strayed and highest:
        panel.set_ylim(0, (1 + MARGIN) * highest)
