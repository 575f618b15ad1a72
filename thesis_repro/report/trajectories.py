"""Trajectories compared with the ground truth: a table of their errors, a figure of their paths."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from evo import EvoException
from matplotlib.axes import Axes
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


class Trajectory(NamedTuple):
    """A trajectory that has a pose for some or all frames of its sequence."""

    frames: np.ndarray  # (n,) indices of the frames
    poses: np.ndarray  # (n, 4, 4) camera to world, metres


def by_sequence(
    paths: Iterable[Path], root: str | Path | None, sequence: str | None = None
) -> dict[str, dict[str, Path]]:
    """Return the files of trajectories, {sequence: {trajectory: file}}.

    A trajectory is named by its path.
    paths: files of one sequence, or folders with a file NN.txt or NN.tum for each sequence with
    ground truth in a KITTI root. sequence: the only sequence to return, or None for all. Raises
    InputError for a file without a sequence, a folder without files and two files of one sequence.
    """
    files: dict[str, dict[str, Path]] = {}
    for path in paths:
        path_files: dict[Any, Path] = {sequence: path}
        if path.is_dir():
            path_files = _files_in(path, root, sequence)
        if not path_files or None in path_files:
            raise InputError(
                f"{path}: name its sequence with --sequence; a folder must contain NN.txt or NN.tum for a "
                "sequence with ground truth in --kitti"
            )
        short = str(path)
        if path.is_file():
            short = str(path.with_suffix(""))
        for name, file in path_files.items():
            of_sequence = files.setdefault(name, {})
            if short in of_sequence:
                of_sequence[str(path)] = file
            else:
                of_sequence[short] = file
    return files


def _files_in(folder: Path, root: str | Path | None, sequence: str | None) -> dict[str, Path]:
    """Return {sequence: file} of one folder, see `by_sequence`."""
    names = [sequence]
    if not sequence:
        names = [file.stem for file in listed(Path(root or "", "poses"), "*.txt")]
    files: dict[str, Path] = {}
    for file in listed(folder, "*.t[xu][tm]"):
        if file.stem not in names:
            continue
        if file.stem in files:
            raise InputError(f"{files[file.stem]}: {file.name} is there too; move one")
        files[file.stem] = file
    return files


def read(file: Path, times: np.ndarray, frames: int | None = None, **matching: Any) -> Trajectory:
    """Read a trajectory in KITTI's or TUM's format.

    times: of the ground truth, seconds. A file in KITTI's format needs one pose for each time; for
    TUM's format see `read_tum`, which gets `matching`. frames: use only the first ones. Raises
    InputError for any other file.
    """
    used_times = times[:frames]
    if _columns(file) == 8:
        matched, poses = read_tum(file, times, **matching)
        used = matched < len(used_times)
        return Trajectory(matched[used], poses[used])
    poses = read_poses(file)[:frames]
    if len(poses) != len(used_times):
        raise InputError(
            f"{file}: {len(poses)} poses, but the ground truth has {len(used_times)}; KITTI's format needs one "
            "for each frame (TUM's format has times and may leave frames out)"
        )
    return Trajectory(np.arange(len(poses)), poses)


def _columns(file: Path) -> int:
    """Return how many words the first line has that is no comment; 0 if it cannot be read."""
    with suppress(OSError, ValueError), open(file, encoding="utf-8-sig") as lines:
        for line in lines:
            if not line.startswith("#"):
                return len(line.split())
    return 0  # `read_poses` reports the error


def evaluate(
    paths: dict[str, Trajectory],
    true: np.ndarray,
    alignment: str = "none",
    sequence: str = "",
) -> list[dict[str, Any]]:
    """Return the errors of each path. An error that is not determined is None.

    paths: {name: trajectory} from `read`; true: (n, 4, 4). RMSE and MAE follow the thesis and
    ignore `alignment`. The other errors are of the path after `metrics.align`. The RPE is from one
    pose of the path to the next.
    """
    rows = []
    aligned_paths = aligned(paths, true, alignment)
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
        }
        for statistic, value in ate.items():
            row[f"ate_{statistic}_m"] = value
        if name in aligned_paths:  # else the note of the ATE says why the path cannot be aligned
            relative = _relative_errors(aligned_paths[name], truth)
            note = relative.pop("note")
            row |= relative
            row["note"] = row["note"] or note
        rows.append({key: _or_none(value) for key, value in row.items()})
    return rows


def _relative_errors(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Return the RPE and the errors of the KITTI benchmark under the keys of `evaluate`."""
    errors: dict[str, Any] = {}
    for statistic, value in metrics.rpe(poses, truth).items():
        unit = "m"
        if statistic.startswith("rotation"):
            unit = "deg"
        errors[f"rpe_{statistic}_{unit}"] = value
    segments = metrics.kitti_errors(poses, truth)
    errors["t_rel_percent"] = segments["t_rel"]
    errors["segments"] = segments["segments"]
    errors["r_rel_deg_per_100m"] = segments["r_rel"]
    errors["note"] = segments["note"]
    return errors


def _or_none(value: Any) -> Any:
    """Return a value, or None for NaN, which JSON has not."""
    if value != value:
        return None
    return value


def means(rows: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield a row with the means of each trajectory that has several sequences.

    rows: of `evaluate`. Some sequences do not have all errors; the row's note counts them.
    """
    by_trajectory = pd.DataFrame(rows).groupby("trajectory", sort=False)
    sequences = by_trajectory["sequence"].agg(", ".join)
    differ = sequences.nunique() > 1
    for name, errors in by_trajectory:
        if len(errors) == 1:
            continue
        averaged = str(len(errors))
        if differ:
            averaged = sequences[name]
        counts = ["poses", "frames", "segments"]
        values = errors.drop(columns=counts, errors="ignore")
        mean = values.mean(numeric_only=True)
        yield {
            "trajectory": name,
            "sequence": f"mean of {averaged}",
            "poses": int(errors["poses"].sum()),
            **mean.to_dict(),
            "note": _note_of_fewer(values[mean.index].count(), len(errors)),
        }


def _note_of_fewer(counts: pd.Series, sequences: int) -> str:
    """Return what to say about errors that some of the averaged sequences do not have.

    counts: number of values by error.
    """
    fewer = counts[counts.index.isin(COLUMNS) & (counts < sequences)]
    names_by_count = fewer.index.groupby(fewer)
    return "; ".join(
        f"mean of only {count} of {sequences}: {', '.join(names)}"
        for count, names in names_by_count.items()
    )


def aligned(
    paths: dict[str, Trajectory], true: np.ndarray, alignment: str
) -> dict[str, np.ndarray]:
    """Return {name: poses} after `metrics.align`, without the paths that cannot be aligned."""
    aligned_paths = {}
    for name, (frames, poses) in paths.items():
        with suppress(EvoException):
            aligned_paths[name], _ = metrics.align(poses, true[frames], alignment)
    return aligned_paths


def table(rows: list[dict[str, Any]], alignment: str = "none") -> pd.DataFrame:
    """Return the rows of `evaluate` and `means` as a table for display."""
    columns = dict(COLUMNS)
    if alignment not in ("sim3", "scale"):
        del columns["scale"]
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
    columns = 2
    if true is None:
        columns = 1
    drawing, panels = new_figure(1, columns, height=3.4, squeeze=False)
    above = panels[0, 0]
    for index, (name, poses) in enumerate(paths.items()):
        above.plot(poses[:, 0, 3], poses[:, 2, 3], label=name, **line_style(index))
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
        _draw_distances(panels[0, 1], paths, true, frames)
    above.set(xlabel="x (m)", ylabel="z (m)", title=f"{title} from above")
    above.set_aspect("equal", adjustable="datalim")
    drawing.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return drawing


def _draw_distances(
    panel: Axes,
    paths: dict[str, np.ndarray],
    true: np.ndarray,
    frames: dict[str, np.ndarray] | None,
) -> None:
    """Draw the distance of each path from the ground truth over the metres travelled."""
    travelled = metrics.travelled(true)
    for index, (name, poses) in enumerate(paths.items()):
        matched: Any = slice(None)
        if frames is not None:
            matched = frames[name]
        distance = np.linalg.norm(poses[:, :3, 3] - true[matched, :3, 3], axis=1)
        panel.plot(travelled[matched], distance, **line_style(index))
    panel.set(
        xlabel="travelled (m)",
        ylabel="distance from the truth (m)",
        title="error along the way",
        ylim=(0, None),
    )
