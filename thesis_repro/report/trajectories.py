"""Trajectories compared with the ground truth: a table of their errors and a figure of their
paths.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from evo import EvoException
from matplotlib.figure import Figure

from thesis_repro.data.trajectories import read_poses, read_tum
from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics
from thesis_repro.report.style import TRUTH, line_style, new_figure
from thesis_repro.running.files import listed

# keys of a row of `evaluate`, and their column names in a table
COLUMNS = {
    "rmse_m": "RMSE m",
    "mae_m": "MAE m",
    "ate_rmse_m": "ATE m",
    "ate_max_m": "largest m",
    "rpe_translation_rmse_m": "RPE m",
    "rpe_rotation_rmse_deg": "RPE deg",
    "t_rel_percent": "t_rel %",
    "r_rel_deg_per_100m": "r_rel deg/100 m",
    "scale": "scale",
}


def by_sequence(
    paths: Iterable[Path], root: str | Path | None, sequence: str | None = None
) -> dict[str, dict[str, Path]]:
    """Return the files of trajectories, {sequence: {trajectory: file}}. A trajectory is named by
    its path.

    paths: files of one sequence, or folders with a file NN.txt or NN.tum for each sequence with
    ground truth in a KITTI root. sequence: the only sequence to return, or None for all.
    """
    files: dict[str, dict[str, Path]] = {}
    for path in paths:
        path_files: dict[Any, Path] = {sequence: path}
        if path.is_dir():
            names = (
                [sequence]
                if sequence
                else [file.stem for file in listed(Path(root or "", "poses"), "*.txt")]
            )
            found = [file for file in listed(path, "*.t[xu][tm]") if file.stem in names]
            path_files = {file.stem: file for file in found}
            for file in found:
                if file != path_files[file.stem]:
                    raise InputError(f"{file}: {path_files[file.stem].name} is there too; move one")
        if not path_files or None in path_files:
            raise InputError(
                f"{path}: name its sequence with --sequence; a folder must contain NN.txt or NN.tum for a "
                "sequence with ground truth in --kitti"
            )
        for name, file in path_files.items():
            of_sequence = files.setdefault(name, {})
            short = str(path.with_suffix("") if path.is_file() else path)
            of_sequence[str(path) if short in of_sequence else short] = file
    return files


def read(
    file: Path, times: np.ndarray, frames: int | None = None, **matching: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Read a trajectory in KITTI's or TUM's format: (indices of its frames (n,), poses (n, 4, 4)).

    times: of the ground truth, seconds. A file in KITTI's format needs one pose for each time; for
    TUM's format see `read_tum`, which gets `matching`. frames: use only the first ones. Raises
    InputError for any other file.
    """
    first = ""
    # read_poses reports these errors
    with suppress(OSError, ValueError), open(file, encoding="utf-8-sig") as lines:
        first = next((line for line in lines if not line.startswith("#")), "")
    if len(first.split()) == 8:
        matched, poses = read_tum(file, times, **matching)
        return matched[matched < len(times[:frames])], poses[matched < len(times[:frames])]
    poses, times = read_poses(file)[:frames], times[:frames]
    if len(poses) != len(times):
        raise InputError(
            f"{file}: {len(poses)} poses, but the ground truth has {len(times)}; KITTI's format needs one "
            "for each frame (TUM's format has times and may leave frames out)"
        )
    return np.arange(len(poses)), poses


def evaluate(
    paths: dict[str, tuple[np.ndarray, np.ndarray]],
    true: np.ndarray,
    alignment: str = "none",
    sequence: str = "",
) -> list[dict[str, Any]]:
    """Return the errors of each path. An error that is not determined is None.

    paths: {name: (frames, poses)} from `read`; true: (n, 4, 4). RMSE and MAE follow the thesis and
    ignore `alignment`. The other errors are of the path after `metrics.align`. The RPE is from one
    pose of the path to the next.
    """
    rows, aligned_paths = [], aligned(paths, true, alignment)
    for name, (frames, poses) in paths.items():
        truth = true[frames]
        ate = metrics.ate(poses, truth, alignment)
        row = {
            "trajectory": name,
            "sequence": sequence,
            "poses": len(poses),
            "frames": len(true),
            "alignment": alignment,
            "rmse_m": metrics.rmse(poses, truth),
            "mae_m": metrics.mae(poses, truth),
            "note": ate.pop("note"),
            "scale": ate.pop("scale"),
            **{f"ate_{key}_m": value for key, value in ate.items()},
        }
        if name in aligned_paths:  # else the note of the ATE says why the path cannot be aligned
            rpe = metrics.rpe(aligned_paths[name], truth)
            segments = metrics.kitti_errors(aligned_paths[name], truth)
            row |= {
                f"rpe_{key}_{'deg' if key.startswith('rotation') else 'm'}": value
                for key, value in rpe.items()
            }
            row |= {
                "t_rel_percent": segments["t_rel"],
                "segments": segments["segments"],
                "r_rel_deg_per_100m": segments["r_rel"],
                "note": row["note"] or segments["note"],
            }
        rows.append({key: None if value != value else value for key, value in row.items()})
    return rows


def means(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield a row like those of `evaluate` with the means of each trajectory that has several
    sequences.
    """
    sets = pd.DataFrame(rows).groupby("trajectory", sort=False)["sequence"].agg(", ".join)
    for name, errors in pd.DataFrame(rows).groupby("trajectory", sort=False):
        if len(errors) > 1:
            of = sets[name] if sets.nunique() > 1 else len(errors)
            mean = errors.drop(columns=["poses", "frames", "segments"], errors="ignore").mean(
                numeric_only=True
            )
            yield {
                "trajectory": name,
                "sequence": f"mean of {of}",
                "poses": int(errors["poses"].sum()),
                **mean.to_dict(),
                "note": "",
            }


def aligned(
    paths: dict[str, tuple[np.ndarray, np.ndarray]], true: np.ndarray, alignment: str
) -> dict[str, np.ndarray]:
    """Return {name: poses} after `metrics.align`, without the paths that cannot be aligned."""
    aligned_paths = {}
    for name, (frames, poses) in paths.items():
        with suppress(EvoException):
            aligned_paths[name], _ = metrics.align(poses, true[frames], alignment)
    return aligned_paths


def table(rows: list[dict[str, Any]], alignment: str = "none") -> pd.DataFrame:
    """Return the rows of `evaluate` and `means` as a table for display."""
    columns = {
        key: name
        for key, name in COLUMNS.items()
        if key != "scale" or alignment in ("sim3", "scale")
    }
    table = pd.DataFrame(rows, columns=["trajectory", "sequence", "poses", *columns])
    return table.astype(dict.fromkeys(columns, float)).rename(columns=columns)


def figure(
    paths: dict[str, np.ndarray],
    true: np.ndarray | None,
    title: str,
    frames: dict[str, np.ndarray] | None = None,
) -> Figure:
    """Draw the paths from above and, if the ground truth is known, their distance from it.

    paths: {name: (n, 4, 4) aligned poses}. true: (n, 4, 4), or None. frames: {name: frame indices
    of its poses}, or None if every path has a pose for each frame.
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
        above.plot(
            true[:, 0, 3],
            true[:, 2, 3],
            color=TRUTH,
            linewidth=2.2,
            alpha=0.6,
            label="ground truth",
            zorder=1,
        )
        error.set(
            xlabel="travelled (m)",
            ylabel="distance from the truth (m)",
            title="error along the way",
            ylim=(0, None),
        )
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{title} from above")
    above.set_aspect("equal", adjustable="datalim")
    drawing.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawing
