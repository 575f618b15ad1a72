"""The one place that compares runs: a tidy table of runs in, a tidy table of comparisons out.

**Runs** (`runner.run`, one row a run): sequence, run, source, method, dilation_width, estimator, repetition, frames,
mean_keypoints, flagged, and one column for each of METRICS.

**Comparisons** (`comparisons`, one row for each method, reference, metric and estimator): the ratio of the method's
error to the reference's, its interval, and the ratio of every sequence in a column of its own.

How a ratio is formed:

1. Within a sequence, the geometric mean of the errors over the repetitions, divided by that of the reference. Half
   and double are then equally far from 1, which percentages do not give.
2. Over sequences, the geometric mean of these ratios.
3. The interval is a bootstrap: whole sequences are drawn anew, DRAWS times. It says how far the mean could be off had
   other sequences of the same kind been driven. Few sequences make it too narrow.
"""

from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from thesis_repro.odometry.metrics import RELATIVE_LENGTH
from thesis_repro.study.controls import MASKS
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS

# The errors that are compared, and what they are called. The first two decide (see `primary_comparison`): a constant
# angle between camera and ground truth moves neither.
JUDGING_METRICS = {"rmse_boresight_corrected": "RMSE, mounting angle removed", "rotation": "rotation error a frame"}
SECONDARY_METRICS = {"rmse": "RMSE", "mae": "MAE", "se3": "aligned ATE",
                     "translation_percent": f"translation error over {RELATIVE_LENGTH:g} m",
                     "rotation_deg_per_100m": f"rotation error over {RELATIVE_LENGTH:g} m",
                     "t_rel": "KITTI's t_rel", "r_rel": "KITTI's r_rel"}
METRICS = {**JUDGING_METRICS, **SECONDARY_METRICS}
UNITS = {"rmse_boresight_corrected": "m", "rotation": "deg", "rmse": "m", "mae": "m", "se3": "m",
         "translation_percent": "%", "rotation_deg_per_100m": "deg/100 m",
         "t_rel": "%", "r_rel": "deg/100 m"}

METHODS = {  # in the order in which they are shown
    "baseline": "all keypoints",
    "masked": "segmentation mask",
    "exact-boundaries": "exact class boundaries",
    "corrected": "corrected mask",
    "fallback": "mask with fallback",
    "static-boundaries": "boundaries of static things",
    "static": "all but movable things",
    "inverse": "all but the boundaries",
    "true-labels": "true label maps",
    "other-frame": "mask of another frame",
    "mirrored": "mirrored mask",
    "random-lines": "random lines",
    "image-edges": "edges of the image",
    "fewer": "fewer keypoints",
    "spread": "keypoints spread out",
}
SEGMENTATION_FREE_CONTROLS = ("other-frame", "mirrored", "random-lines", "image-edges", "fewer", "spread")

MIN_FOR_INTERVAL = 3  # sequences; drawing anew from fewer says nothing
# With fewer sequences all of them lie on one side of 1 by chance more often than one time in twenty (2 / 2**n).
MIN_SEQUENCES = 6
LEVEL = 95  # percent, of all intervals
FAR_OFF = 3  # times the median: a sequence with such a ratio is named beside the mean
DRAWS = 10_000
LOWER, HIGHER, NO_CLEAR_DIFFERENCE = ("lower", "higher", "no clear difference")


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """Bootstrap interval (low, high) of the mean of one value a sequence; NaN values are left out.

    (NaN, NaN) for fewer than MIN_FOR_INTERVAL values.
    """
    numbers = np.asarray(values, float)
    numbers = numbers[~np.isnan(numbers)]
    if len(numbers) < MIN_FOR_INTERVAL:
        return np.nan, np.nan
    drawn = np.random.default_rng(0).integers(0, len(numbers), (DRAWS, len(numbers)))
    low, high = np.percentile(numbers[drawn].mean(axis=1), [(100 - LEVEL) / 2, (100 + LEVEL) / 2])
    return float(low), float(high)


def geometric_mean(ratios: ArrayLike) -> dict[str, Any]:
    """{ratio, low, high, n, verdict} of one ratio a sequence: geometric mean and `mean_interval` of the logarithms.

    The verdict is LOWER or HIGHER where the interval of at least MIN_SEQUENCES sequences excludes 1.
    """
    logarithms = np.log(np.asarray(ratios, float))
    logarithms = logarithms[np.isfinite(logarithms)]
    low, high = np.exp(mean_interval(logarithms))
    ratio = float(np.exp(logarithms.mean())) if len(logarithms) else np.nan
    low, high = np.minimum(low, ratio), np.maximum(high, ratio)  # of equal ratios, rounding may put the mean outside
    verdict = LOWER if high < 1 else HIGHER if low > 1 else NO_CLEAR_DIFFERENCE
    return {"ratio": ratio, "low": float(low), "high": float(high), "n": len(logarithms),
            "verdict": verdict if len(logarithms) >= MIN_SEQUENCES else NO_CLEAR_DIFFERENCE}


def ratios(rows: pd.DataFrame, reference: pd.DataFrame, metric: str) -> pd.Series:
    """The ratio of a metric in some rows of runs to that in the reference rows, by sequence.

    Sequences that only one side has, or whose error is zero or missing, are left out.
    """
    def logarithms(runs: pd.DataFrame) -> pd.Series:
        positive = runs.loc[runs[metric] > 0]
        return np.log(positive.set_index("sequence")[metric].astype(float)).groupby(level=0).mean()

    return np.exp((logarithms(rows) - logarithms(reference)).dropna())


def far_off(ratios: pd.Series) -> list[str]:
    """The sequences whose ratio is more than FAR_OFF times the median of all, or less than the FAR_OFF-th part of it.

    In one of the two runs they got lost. Fewer than MIN_FOR_INTERVAL sequences do not tell which of them.
    """
    if len(ratios) < MIN_FOR_INTERVAL:
        return []
    logarithms = np.log(ratios)
    return list(ratios.index[(logarithms - logarithms.median()).abs() > np.log(FAR_OFF)])


def comparisons(runs: pd.DataFrame) -> pd.DataFrame:
    """Every method against all keypoints, and masks against every control and every other source.

    Columns: source, method, dilation_width (pixels), keypoints (mean number); reference_source, reference; metric,
    estimator; tested (whether the width is the one put to the test, `tested_width`); ratio, low, high, n,
    far_off (see `far_off`), verdict; then the ratio of each sequence, in a column with its name.
    """
    metrics = [name for name in METRICS if name in runs and runs[name].notna().any()]
    rows = []
    for estimator in ESTIMATORS:
        arms = _arms(runs[runs["estimator"] == estimator])
        for (own, own_rows), (other, other_rows) in product(arms, arms):
            if not _is_compared(own, other):
                continue
            row = {**own, "reference_source": other["source"], "reference": other["method"], "estimator": estimator}
            for metric in metrics:
                by_sequence = ratios(own_rows, other_rows, metric)
                rows.append({**row, "metric": metric, "far_off": far_off(by_sequence),
                             **geometric_mean(by_sequence), **by_sequence})
    columns = ["source", "method", "dilation_width", "keypoints", "reference_source", "reference", "metric",
               "estimator", "tested", "ratio", "low", "high", "n", "far_off", "verdict"]
    return pd.DataFrame(rows, columns=[*columns, *sorted(runs["sequence"].unique())])


def _arms(runs: pd.DataFrame) -> list[tuple[dict[str, Any], pd.DataFrame]]:
    """What is compared: (source, method, dilation_width, keypoints, tested) with its rows; all keypoints first."""
    order = list(METHODS)
    known = runs[runs["method"].isin(order)]
    widths = {source: tested_width(of_source(runs, source)) for source in known["source"].unique()}
    arms = [({"source": source, "method": method, "dilation_width": width,
              "keypoints": rows.groupby("sequence")["mean_keypoints"].mean().mean(),
              "tested": bool(pd.isna(width) or width == widths[source])}, rows)
            for (source, method, width), rows in known.groupby(["source", "method", "dilation_width"], dropna=False,
                                                               sort=False)]
    return sorted(arms, key=lambda arm: order.index(arm[0]["method"]))


def _is_compared(own: dict[str, Any], other: dict[str, Any]) -> bool:
    """All against all keypoints; masks of the tested width also against their controls and other sources' masks."""
    are_tested = own["method"] == "masked" and own["tested"] and other["tested"] and other is not own
    return other["method"] == "baseline" or are_tested and (own["source"] == other["source"]
                                                            or other["method"] == "masked")


def primary_comparison(table: pd.DataFrame, source: str | None = None) -> pd.DataFrame:
    """The rows of `comparisons` that answer the question of this project: do masks from a segmentation help?

    Masks of the tested width against all keypoints, under the refined estimator where it was run, by JUDGING_METRICS.
    Under the thesis's estimator, shuffling the matched points moves errors by more than the effect in question.
    Masks help where both verdicts are LOWER; the segmentation helps where masks are LOWER than each of
    SEGMENTATION_FREE_CONTROLS too (`against`).
    """
    return against(table[table["tested"]], ["baseline"], source)


def against(table: pd.DataFrame, references: Iterable[str], source: str | None = None) -> pd.DataFrame:
    """The rows of `comparisons` that set masks against some references, judged as `primary_comparison` is."""
    rows = table[(table["method"] == "masked") & table["reference"].isin(list(references))
                 & table["metric"].isin(JUDGING_METRICS)]
    rows = rows if source is None else rows[rows["source"] == source]
    return rows[rows["estimator"] == judging_estimator(rows)]


def overall(verdicts: Iterable[str]) -> str:
    """The verdict of several metrics together: LOWER or HIGHER where all of them say so."""
    distinct = set(verdicts)
    return distinct.pop() if len(distinct) == 1 else NO_CLEAR_DIFFERENCE


def judging_estimator(table: pd.DataFrame) -> str:
    """The estimator that decides: the refined one where the runs or comparisons have it."""
    return "refined" if (table["estimator"] == "refined").any() else "thesis"


def shuffle_spread(runs: pd.DataFrame) -> pd.DataFrame:
    """How much shuffling the matched points before RANSAC changes the RMSE, with all keypoints.

    One row for each estimator and sequence: repetitions, lowest, highest, factor (highest over lowest).
    """
    rows = runs[runs["method"] == "baseline"].groupby(["estimator", "sequence"])["rmse"]
    table = rows.agg(repetitions="size", lowest="min", highest="max").reset_index()
    return table.assign(factor=table["highest"] / table["lowest"])


# Parts of a table of runs


def of_method(runs: pd.DataFrame, method: str, estimator: str | None = None) -> pd.DataFrame:
    """The rows of one method under one estimator.

    estimator: by default the one of the thesis's tables, which is the thesis's own where it was run.
    """
    if estimator is None:
        estimator = next((name for name in ESTIMATORS if (runs["estimator"] == name).any()), "thesis")
    return runs[(runs["method"] == method) & (runs["estimator"] == estimator)]


def of_source(runs: pd.DataFrame, source: str) -> pd.DataFrame:
    """The runs of one source of masks, and those with all keypoints, which belong to every one."""
    return runs[runs["source"].isin([source, ""])]


def sources(runs: pd.DataFrame) -> list[str]:
    """The names of the sources, in the order of their runs."""
    return [name for name in runs["source"].unique() if name]


def tested_width(runs: pd.DataFrame) -> int | None:
    """The dilation width (pixels) at which masks are put to the test: that of the controls, or the only one there is.

    CONTROL_WIDTH where neither says it; None for masks that came ready made.
    """
    masked = runs.loc[runs["method"] == "masked", "dilation_width"]
    if len(masked) and masked.isna().all():
        return None
    of_controls = runs.loc[runs["method"].isin(MASKS), "dilation_width"].dropna().unique()
    widths = of_controls if len(of_controls) else masked.unique()
    return int(widths[0]) if len(widths) == 1 else CONTROL_WIDTH


def keypoints_left(runs: pd.DataFrame) -> pd.Series:
    """The mean number of keypoints that masks of the `tested_width` leave, by sequence."""
    width = tested_width(runs)
    rows = runs[runs["method"] == "masked"]
    if width is not None:
        rows = rows[rows["dilation_width"] == width]
    return rows.groupby("sequence")["mean_keypoints"].mean()


def spread(rows: pd.DataFrame, column: str, by: str = "sequence") -> pd.DataFrame:
    """Mean, lowest and highest of a column over the repetitions: a table with one row for each value of `by`."""
    table = rows.groupby(by)[column].agg(mean="mean", lowest="min", highest="max")
    # rounding may put the mean of equal values outside their range, and an error bar would have a negative length
    return table.assign(mean=table["mean"].clip(table["lowest"], table["highest"]))
