"""Trajectories against the truth: one table of errors and one picture of several of them."""

from contextlib import suppress
from pathlib import Path

import evo
import numpy as np
import pandas as pd

from thesis_repro import InputError
from thesis_repro.files import atomic
from thesis_repro.kitti import read_poses
from thesis_repro.odometry import metrics
from thesis_repro.report import texts
from thesis_repro.report.style import TRUTH, line_style, new_figure, plt

# what a table shows of a row of `evaluate`: heads of columns
COLUMNS = {"rmse_m": "RMSE m", "mae_m": "MAE m", "ate_rmse_m": "ATE m", "ate_max_m": "largest m",
           "rpe_translation_rmse_m": "RPE m", "rpe_rotation_rmse_deg": "RPE deg", "t_rel_percent": "t_rel %",
           "r_rel_deg_per_100m": "r_rel deg/100m", "scale": "scale"}


def read(files, true):
    """Trajectories in KITTI's form by name, (n, 4, 4) each, n being that of the true poses.

    The names are those of the files without their endings, or the paths where two would have the same.
    """
    names = [Path(file).stem for file in files]
    names = names if len(set(names)) == len(names) else map(str, files)
    paths = dict(zip(names, map(read_poses, files)))
    for file, poses in zip(files, paths.values()):
        if len(poses) != len(true):
            raise InputError(f"{file}: {len(poses)} poses, but the sequence has {len(true)} true ones; one a frame is "
                             "needed in both")
    return paths


def evaluate(paths, true, alignment="none"):
    """The errors of each path, a list of dicts of numbers (None where one is not determined).

    paths: {name: (n, 4, 4) poses}. RMSE and MAE are the thesis's whatever the alignment is; the others are of the path
    as `metrics.align` leaves it.
    """
    rows, after = [], aligned(paths, true, alignment)
    for name, poses in paths.items():
        ate = metrics.ate(poses, true, alignment)
        row = {"trajectory": name, "poses": len(poses), "alignment": alignment, "rmse_m": metrics.rmse(poses, true),
               "mae_m": metrics.mae(poses, true), "note": ate.pop("note"), "scale": ate.pop("scale"),
               **{f"ate_{key}_m": value for key, value in ate.items()}}
        if name in after:  # else ate's note says why it cannot be aligned
            rpe, segments = metrics.rpe(after[name], true), metrics.kitti_errors(after[name], true)
            row |= {f"rpe_{key}_{'deg' if key.startswith('rotation') else 'm'}": value for key, value in rpe.items()}
            row |= {"t_rel_percent": segments["translation_percent"], "segments": segments["segments"],
                    "r_rel_deg_per_100m": 100 * segments["rotation_deg_per_m"], "note": row["note"] or segments["note"]}
        rows.append({key: None if value != value else value for key, value in row.items()})
    return rows


def aligned(paths, true, alignment):
    """The paths as `metrics.align` leaves them; those that it cannot align are left out."""
    after = {}
    for name, poses in paths.items():
        with suppress(evo.EvoException):
            after[name], _ = metrics.align(poses, true, alignment)
    return after


def text(rows, alignment="none"):
    """The rows of `evaluate` as a table for reading, with a word on what is in it."""
    heads = {key: head for key, head in COLUMNS.items() if key != "scale" or alignment in ("sim3", "scale")}
    table = pd.DataFrame(rows, columns=["trajectory", *heads]).astype(dict.fromkeys(heads, float)).rename(columns=heads)
    return texts.render("evaluate.txt.j2", rows=rows, alignment=alignment, table=table.to_string(
        index=False, float_format="%.6f", na_rep="-")).rstrip()


def figure(paths, true, title):
    """The paths from above and, where the truth is known, their distance from it along the way.

    paths: {name: (n, 4, 4) poses} as they are to be compared. true: (n, 4, 4), or None.
    """
    drawing, panels = new_figure(1, 1 if true is None else 2, height=3.4, squeeze=False)
    above, error = panels[0, 0], panels[0, -1]
    for index, (name, poses) in enumerate(paths.items()):
        above.plot(poses[:, 0, 3], poses[:, 2, 3], label=name, **line_style(index))
        if true is not None:
            distance = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
            error.plot(metrics.travelled(true), distance, **line_style(index))
    if true is not None:
        above.plot(true[:, 0, 3], true[:, 2, 3], color=TRUTH, linewidth=2.2, alpha=0.6, label="ground truth", zorder=1)
        error.set(xlabel="travelled (m)", ylabel="distance from the truth (m)", title="error along the way",
                  ylim=(0, None))
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{title} from above")
    above.set_aspect("equal", adjustable="datalim")
    drawing.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawing


def write(path, drawing):
    """Write a figure in the format that the file's ending names."""
    with atomic(path) as temporary:
        drawing.savefig(temporary, bbox_inches="tight", pad_inches=0.04)
    plt.close(drawing)
