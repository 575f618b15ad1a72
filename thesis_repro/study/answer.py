"""Do masks from a segmentation help? The comparison, which was decided before any run on real frames was seen.

- **Estimator**: the refined one (estimator="refined"). The thesis's spreads so far between orders of the correspondences
  that it sees no effect of the size in question; it stands beside.
- **Metrics**: RMSE (Equation 3.5) once the constant angle between camera and ground truth is taken out, as the other
  sequences of the same recording day give it with all keypoints, the same angle for every method; and the mean error of
  single rotations (degrees a frame), which neither that angle nor earlier errors can move. Both have to agree. Raw
  RMSE, which the thesis reports, stands beside them, and so do aligned ATE and the errors over stretches of 20 m.
- **Width**: 10 pixels (Section 3.6), or what notebook 6 was set to before the runs; never the best of several.
- **Number of keypoints**: what masks of that width leave. The controls with a limit have that number, those with masks
  that width. All keypoints stand for doing nothing.
- **Corrected masks** (`controls.CORRECTED`) were added later, all corrections at once, and judge nothing: they say
  whether the thesis's slips decide the answer.
- **Difference**: the ratio of errors within a sequence, of geometric means over orders; over sequences the geometric
  mean, with a bootstrap interval. Half and double are equally far from 1, which percentages do not give.
- **Masks help** where the interval of masks over all keypoints lies below 1. **The segmentation helps** where the
  intervals of masks over each control that knows no class of the frame lie below 1 too. With fewer than six sequences
  nothing is said of sequences in general, whatever the intervals are.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from thesis_repro.kitti import Sequence
from thesis_repro.odometry import metrics
from thesis_repro.odometry.passes import poses_of
from thesis_repro.odometry.refined import boresight
from thesis_repro.study import results
from thesis_repro.study.jobs import Job

METRICS = {"turned": "RMSE without the angle", "rotation": "rotation error a frame"}  # that judge
SHOWN = {"rmse": "raw RMSE", **METRICS, **results.BESIDE}
POSE = "refined"
METHODS = {"baseline": "all keypoints", **results.CONTROLS}


def with_relative(summary: pd.DataFrame, kitti: Path, folder: Path, frames: int | None = None) -> pd.DataFrame:
    """The summary of `runner.run` with the columns of `metrics.step_errors`, from the runs' own files, and
    `turned`, the RMSE in metres with the angle of `angles` taken out.

    folder: where `runner.run` keeps them. frames: of each sequence, as there.
    """
    paths = refined_paths(summary["sequence"].unique(), kitti, folder, frames)
    angle, rows = angles(paths), []
    for one in summary.itertuples():
        poses = poses_of(pd.read_csv(folder / one.sequence / f"{one.run}.csv"))
        true = paths[one.sequence][1]
        rows.append(metrics.step_errors(poses, true)
                    | {"turned": metrics.rmse(boresight.corrected(poses, angle[one.sequence]), true)})
    return summary.join(pd.DataFrame(rows, index=summary.index))


def refined_paths(names: Iterable[str], kitti: Path, folder: Path, frames: int | None = None
                  ) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{name: (estimated, true)} of all keypoints under the refined estimator, poses (n, 4, 4), for `boresight`."""
    file = Job("", "baseline", estimator=POSE).name
    return {name: (poses_of(pd.read_csv(folder / name / f"{file}.csv")), Sequence(kitti, name).subset(frames).poses)
            for name in names}


def angles(paths: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, np.ndarray]:
    """{name: pitch, yaw, roll in degrees} between camera and truth, from the other sequences of the same recording day;
    0 where there are none, or where they do not determine an angle. paths: of `refined_paths`."""
    found = {}
    for name in paths:
        others = [paths[other] for other in boresight.same_day(name, paths)]
        found[name] = boresight.estimate(others).usable if others else np.zeros(3)
    return found


def logs(rows: pd.DataFrame, metric: str) -> pd.Series:
    """Mean logarithm of a metric over the repetitions, by sequence."""
    return np.log(rows.set_index("sequence")[metric]).groupby(level=0).mean()


def ratios(rows: pd.DataFrame, reference: pd.DataFrame, metric: str) -> pd.Series:
    """By sequence, how many times as large a metric is in some rows as in the reference rows; geometric means."""
    return np.exp((logs(rows, metric) - logs(reference, metric)).dropna())


def mean_ratio(values: ArrayLike) -> tuple[float, float, float]:
    """(geometric mean, low, high) of one ratio a sequence; `results.interval` on their logarithms.

    low and high are NaN for fewer than three sequences.
    """
    logarithms = np.log(np.asarray(values, float))
    low, high = results.interval(logarithms)
    return float(np.exp(np.nanmean(logarithms))), float(np.exp(low)), float(np.exp(high))


def compared(summary: pd.DataFrame, metric: str, estimator: str = POSE) -> pd.DataFrame:
    """Each method of one width against all keypoints, and masks against it: one row a method.

    Columns method, keypoints (mean number), sequences, ratio, low, high (over all keypoints), percent (the thesis's
    mean of percentages), masks, masks_low, masks_high (masks over this method).
    """
    reference, masked = results.of_method(summary, "baseline", estimator), results.of_control(summary, "masked", estimator)
    rows = []
    for method in METHODS:
        runs = results.of_control(summary, method, estimator)
        if not len(runs):
            continue
        own, against = ratios(runs, reference, metric), ratios(masked, runs, metric)
        means = runs.groupby("sequence")[metric].mean() / reference.groupby("sequence")[metric].mean()
        rows.append({"method": method, "sequences": len(own),
                     "keypoints": runs.groupby("sequence")["mean_keypoints"].mean().mean(),
                     **dict(zip(("ratio", "low", "high"), mean_ratio(own), strict=True)),
                     "percent": 100 * (means.mean() - 1),
                     **dict(zip(("masks", "masks_low", "masks_high"), mean_ratio(against), strict=True))})
    return pd.DataFrame(rows)


def lines(summary: pd.DataFrame, metric: str, estimator: str = POSE) -> pd.DataFrame:
    """Error against number of keypoints: one row a sequence, method and setting (width, limit or distance).

    Columns sequence, method, keypoints, mean (geometric, over repetitions), lowest, highest.
    """
    rows = summary[(summary["estimator"] == estimator) & summary["method"].isin(METHODS)]
    setting = rows[["dilation_width", "max_keypoints", "min_distance"]].astype(float).fillna(-1).agg(tuple, axis=1)
    grouped = rows.assign(setting=setting).groupby(["sequence", "method", "setting"], sort=False)
    found = grouped.agg(keypoints=("mean_keypoints", "mean"), lowest=(metric, "min"), highest=(metric, "max"),
                        mean=(metric, lambda values: np.exp(np.log(values).mean())))
    return found.reset_index().drop(columns="setting").sort_values(["sequence", "method", "keypoints"],
                                                                   ignore_index=True)

