"""The figure of paths: from above, and how far each is from the ground truth."""

import numpy as np
from matplotlib.figure import Figure

from keypoint_study.report.style import TRUTH, line_style, new_figure
from thesis_repro.errors import one_line
from thesis_repro.odometry import metrics


def figure(paths: dict[str, np.ndarray], true: np.ndarray | None, title: str) -> Figure:
    """Draw paths from above and, if the ground truth is known, their distance from it.

    paths: {name: (n, 4, 4) poses, aligned}. true: (n, 4, 4), or None.
    """
    columns = 2
    if true is None:
        columns = 1
    drawing, panels = new_figure(1, columns, height=3.4, squeeze=False)
    above = panels[0, 0]
    for index, (name, poses) in enumerate(paths.items()):
        above.plot(poses[:, 0, 3], poses[:, 2, 3], label=one_line(name), **line_style(index))
    if true is not None:
        above.plot(
            true[:, 0, 3],
            true[:, 2, 3],
            color=TRUTH,
            linewidth=2.2,
            alpha=0.6,
            label="ground truth",
            zorder=1,
        )
        below = panels[0, 1]
        travelled = metrics.travelled(true)
        for index, poses in enumerate(paths.values()):
            distance = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
            below.plot(travelled, distance, **line_style(index))
        below.set(
            xlabel="travelled (m)",
            ylabel="distance from the truth (m)",
            title="error along the way",
            ylim=(0, None),
        )
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{one_line(title)} from above")
    above.set_aspect("equal", adjustable="datalim")
    drawing.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawing
