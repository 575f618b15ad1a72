"""Trajectories against the truth: one table of errors and one picture of several of them."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
from evo import EvoException

from thesis_repro import InputError
from thesis_repro.files import atomic, listed
from thesis_repro.kitti import read_poses, read_tum
from thesis_repro.odometry import metrics
from thesis_repro.report.style import TRUTH, line_style, new_figure, plt

# what a table shows of a row of `evaluate`: heads of columns
COLUMNS = {"rmse_m": "RMSE m", "mae_m": "MAE m", "ate_rmse_m": "ATE m", "ate_max_m": "largest m",
           "rpe_translation_rmse_m": "RPE m", "rpe_rotation_rmse_deg": "RPE deg", "t_rel_percent": "t_rel %",
           "r_rel_deg_per_100m": "r_rel deg/100 m", "scale": "scale"}


def by_sequence(paths, root, sequence=None):
    """The files of trajectories: {sequence: {trajectory: file}}; a trajectory is called as its path without the ending.

    paths: files of one sequence, or folders with NN.txt or NN.tum for each sequence with true poses in a KITTI root
    (of `sequence` alone, where it is given).
    """
    files = {}
    for path in paths:
        of_path = {sequence: path}
        if path.is_dir():
            truths = [sequence] if sequence else [true.stem for true in listed(Path(root or "", "poses"), "*.txt")]
            of_path = {file.stem: file for file in listed(path, "*.t*") if file.stem in truths}
        if not of_path or None in of_path:
            raise InputError(f"{path}: name its sequence with --sequence; a folder must hold NN.txt or NN.tum of a "
                             "sequence whose true poses --kitti holds")
        for name, file in of_path.items():
            files.setdefault(name, {})[str(path.with_suffix("") if path.is_file() else path)] = file
    return files


def read(file, times, frames=None):
    """A trajectory in KITTI's form, or in TUM's: (numbers of frames, their poses), (n,) and (n, 4, 4).

    times: of the true poses, seconds. KITTI's form has a pose for each of them; of TUM's form see `read_tum`.
    frames: how many poses in KITTI's form to take, None for all. Raises InputError for what is neither.
    """
    with suppress(OSError, ValueError), open(file, encoding="utf-8") as lines:  # which read_poses names
        if len(next((line for line in lines if not line.startswith("#")), "").split()) == 8:
            return read_tum(file, times)
    poses = read_poses(file)[:frames]
    if len(poses) != len(times):
        raise InputError(f"{file}: {len(poses)} poses, but the sequence has {len(times)} true ones; one a frame is "
                         "needed in both (TUM's form has times and may leave some out)")
    return np.arange(len(poses)), poses


def evaluate(paths, true, alignment="none", sequence=""):
    """The errors of each path, a list of dicts of numbers (None where one is not determined).

    paths: {name: (frames, poses)} as `read` gives them; true: (n, 4, 4). RMSE and MAE are the thesis's whatever the
    alignment is; the others are of the path as `metrics.align` leaves it. Of a path that leaves frames out, the RPE is
    from one of its poses to the next.
    """
    rows, after = [], aligned(paths, true, alignment)
    for name, (frames, poses) in paths.items():
        its_true = true[frames]
        ate = metrics.ate(poses, its_true, alignment)
        row = {"trajectory": name, "sequence": sequence, "poses": len(poses), "frames": len(true),
               "alignment": alignment, "rmse_m": metrics.rmse(poses, its_true), "mae_m": metrics.mae(poses, its_true),
               "note": ate.pop("note"), "scale": ate.pop("scale"),
               **{f"ate_{key}_m": value for key, value in ate.items()}}
        if name in after:  # else ate's note says why it cannot be aligned
            rpe, segments = metrics.rpe(after[name], its_true), metrics.kitti_errors(after[name], its_true)
            row |= {f"rpe_{key}_{'deg' if key.startswith('rotation') else 'm'}": value for key, value in rpe.items()}
            row |= {"t_rel_percent": segments["translation_percent"], "segments": segments["segments"],
                    "r_rel_deg_per_100m": segments["rotation_deg_per_100m"], "note": row["note"] or segments["note"]}
        rows.append({key: None if value != value else value for key, value in row.items()})
    return rows


def means(rows):
    """Rows of `evaluate` with the means over the sequences of a trajectory that has several, without missing values."""
    for name, of_path in pd.DataFrame(rows).groupby("trajectory", sort=False):
        if len(of_path) > 1:
            errors = of_path.drop(columns=["poses", "frames", "segments"], errors="ignore").mean(numeric_only=True)
            yield {"trajectory": name, "sequence": f"mean of {len(of_path)}", "poses": int(of_path["poses"].sum()),
                   **errors.to_dict(), "note": ""}


def aligned(paths, true, alignment):
    """The poses of the paths as `metrics.align` leaves them; those that it cannot align are left out."""
    after = {}
    for name, (frames, poses) in paths.items():
        with suppress(EvoException):
            after[name], _ = metrics.align(poses, true[frames], alignment)
    return after


def table(rows, alignment="none"):
    """The rows of `evaluate` as a table for reading."""
    heads = {key: head for key, head in COLUMNS.items() if key != "scale" or alignment in ("sim3", "scale")}
    table = pd.DataFrame(rows, columns=["trajectory", "sequence", "poses", *heads])
    return table.astype(dict.fromkeys(heads, float)).rename(columns=heads)


def figure(paths, true, title, frames=None):
    """The paths from above and, where the truth is known, their distance from it along the way.

    paths: {name: (n, 4, 4) poses} as they are to be compared. true: (n, 4, 4), or None. frames: {name: numbers} where
    paths have other frames than all of the true ones.
    """
    drawing, panels = new_figure(1, 1 if true is None else 2, height=3.4, squeeze=False)
    above, error = panels[0, 0], panels[0, -1]
    for index, (name, poses) in enumerate(paths.items()):
        above.plot(poses[:, 0, 3], poses[:, 2, 3], label=name, **line_style(index))
        if true is not None:
            matched = slice(None) if frames is None else frames[name]
            distance = np.linalg.norm(poses[:, :3, 3] - true[matched, :3, 3], axis=1)
            error.plot(metrics.travelled(true)[matched], distance, **line_style(index))
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
