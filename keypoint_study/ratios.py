"""From errors of runs to one ratio a sequence, the typical ratio, and its interval.

1. For each sequence, the geometric mean of the errors over the repetitions is divided by that of
   the reference. Half and double are then equally far from 1, which is not so for percentages.
   Every run counts with its own errors, also one that failed.
2. The typical ratio is the Hodges-Lehmann estimate over the sequences: the median of the means of
   all pairs of logarithms. One sequence on which a method fails moves it less than it moves a mean.
3. Its interval is that of Wilcoxon's signed-rank test, which is exact. It estimates how far the
   ratio could be off if other sequences of the same kind had been recorded.

Beside it stands the geometric mean with Student's t interval, which one failing sequence widens
until it says nothing.

How often a method fails is a question of its own, which the ratio does not answer. A run has failed
if one of its steps has, or if it is lost (`metrics.step_errors`).

The interval and the counts of failures were chosen when the results on real frames were known. The
reason is the error rates in docs/reading-results.md.
"""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import bdtr, stdtrit

from keypoint_study.verdicts import LEVEL, NARROW_LEVEL

MIN_FOR_INTERVAL = 3  # values of a mean
# a sequence is named beside the mean if its ratio differs from the median by more than this factor
FAR_OFF = 3


def mean_interval(values: ArrayLike) -> tuple[float, float]:
    """Return Student's t interval (low, high) of the mean of one value a sequence.

    NaN values are left out. Returns (NaN, NaN) for fewer than MIN_FOR_INTERVAL values.
    """
    numbers = np.asarray(values, float)
    numbers = numbers[~np.isnan(numbers)]
    if len(numbers) < MIN_FOR_INTERVAL:
        return np.nan, np.nan
    standard_error = numbers.std(ddof=1) / np.sqrt(len(numbers))
    reach = standard_error * stdtrit(len(numbers) - 1, (100 + LEVEL) / 200)
    return float(numbers.mean() - reach), float(numbers.mean() + reach)


def typical_interval(values: ArrayLike, level: float = LEVEL) -> tuple[float, float, float]:
    """Return the Hodges-Lehmann estimate of one value a sequence and its interval (low, high).

    values: without NaN. level: percent, at least, of the interval. It holds the centres that
    Wilcoxon's signed-rank test (exact, two-sided) does not reject, so it is (NaN, NaN) for so few
    values that this test rejects nothing.
    """
    numbers = np.asarray(values, float)
    if not len(numbers):
        return np.nan, np.nan, np.nan
    first, second = np.triu_indices(len(numbers))
    pair_means = np.sort((numbers[first] + numbers[second]) / 2)
    rejected = rejected_sums(len(numbers), level)
    estimate = float(np.median(pair_means))
    if not rejected:
        return estimate, np.nan, np.nan
    return estimate, float(pair_means[rejected - 1]), float(pair_means[-rejected])


def rejected_sums(n: int, level: float = LEVEL) -> int:
    """Return how many sums of ranks, from 0 on, the exact signed-rank test of n values rejects."""
    # the chance of each rank sum: every rank belongs to a positive difference in half of the cases
    chances = np.ones(1)
    for rank in range(1, n + 1):
        chances = np.convolve(chances, [0.5, *[0] * (rank - 1), 0.5])
    return int((chances.cumsum() <= (100 - level) / 200).sum())  # at either end


def typical_ratio(ratios: ArrayLike) -> dict[str, Any]:
    """Return the typical ratio of one ratio a sequence, and what stands beside it.

    {ratio, low, high (`typical_interval` of the logarithms); mean, mean_low, mean_high (the
    geometric mean, `mean_interval`); n (sequences), above (those with a ratio above 1)}
    """
    logarithms = np.log(np.asarray(ratios, float))
    logarithms = logarithms[np.isfinite(logarithms)]
    mean = logarithms.mean() if len(logarithms) else np.nan
    intervals = [*typical_interval(logarithms), mean, *mean_interval(logarithms)]
    names = ("ratio", "low", "high", "mean", "mean_low", "mean_high")
    numbers = dict(zip(names, np.exp(intervals).tolist(), strict=True))
    return {**numbers, "n": len(logarithms), "above": int((logarithms > 0).sum())}


def narrow_interval(ratios: ArrayLike) -> tuple[float, float]:
    """Return the interval (low, high) of NARROW_LEVEL of the typical ratio."""
    _, low, high = np.exp(typical_interval(np.log(ratios), NARROW_LEVEL))
    return float(low), float(high)


def side_of_one(low: float, high: float) -> int:
    """Return on which side of 1 an interval lies: -1 below, 1 above, 0 if it is around 1 or NaN."""
    return int(low > 1) - int(high < 1)


def side_of_counts(more: int, fewer: int) -> int:
    """Return which of two counts of sequences is clearly larger: 1 `more`, -1 `fewer`, 0 neither.

    It is an exact two-sided sign test.
    """
    if 2 * bdtr(min(more, fewer), more + fewer, 0.5) > 1 - LEVEL / 100:
        return 0
    return int(np.sign(more - fewer))


def ratios_of(rows: pd.DataFrame, reference: pd.DataFrame, metric: str) -> pd.Series:
    """Return, for each sequence, the error of some runs divided by the error of the reference runs.

    metric: the column of the error. Sequences without a positive error in both tables are left out.
    """
    logarithms = mean_logarithms(rows, metric) - mean_logarithms(reference, metric)
    return np.exp(logarithms.dropna())


def mean_logarithms(runs: pd.DataFrame, metric: str) -> pd.Series:
    """Return the mean logarithm of the positive errors of each sequence."""
    positive = runs.loc[runs[metric] > 0]
    errors = positive.set_index("sequence")[metric].astype(float)
    return np.log(errors).groupby(level=0).mean()


def far_off(ratios: pd.Series) -> list[str]:
    """Return the sequences whose ratio differs from the median by more than the factor FAR_OFF.

    On these sequences the odometry went wrong with one of the two methods. The list is empty for
    fewer than MIN_FOR_INTERVAL sequences, where the median does not show which sequence is the
    exception.
    """
    if len(ratios) < MIN_FOR_INTERVAL:
        return []
    logarithms = np.log(ratios)
    distances = (logarithms - logarithms.median()).abs()
    return list(ratios.index[distances > np.log(FAR_OFF)])


def has_failed(runs: pd.DataFrame) -> pd.Series:
    """Return for each run whether a step of it failed or it is lost (`metrics.step_errors`)."""
    return (runs["failed"] > 0) | (runs["lost"] > 0)


def count_failed(runs: pd.DataFrame) -> str:
    """Return how many runs of one sequence failed, such as "2 of 5"."""
    return f"{has_failed(runs).sum()} of {len(runs)}"


def failing_sequences(failed: pd.Series) -> int:
    """Return the number of sequences on which half of the runs or more have failed.

    failed: of each run, by sequence (index). Repetitions are no units, so a sequence counts once.
    """
    return int((failed.groupby(level=0).mean() >= 0.5).sum())


def count_failing(failed: pd.Series) -> str:
    """Return on how many sequences half of the runs or more have failed, such as "1 of 11"."""
    return f"{failing_sequences(failed)} of {failed.index.nunique()}"


def range_over_repetitions(
    rows: pd.DataFrame, column: str, by: str | list[str] = "sequence"
) -> pd.DataFrame:
    """Return mean, lowest and highest of a column over the repetitions.

    There is one row for each value of `by`.
    """
    table = rows.groupby(by)[column].agg(mean="mean", lowest="min", highest="max")
    # rounding may put the mean of equal values outside their range, which gives an error bar of
    # negative length
    return table.assign(mean=table["mean"].clip(table["lowest"], table["highest"]))


def range_of_shuffles(runs: pd.DataFrame) -> pd.DataFrame:
    """Measure how much shuffling the matched points before RANSAC changes the RMSE.

    The runs are those with all keypoints. Returns one row for each estimator and sequence: mean,
    lowest, highest, factor (highest over lowest).
    """
    baseline = runs[runs["method"] == "baseline"]
    by = ["estimator", "sequence"]
    table = range_over_repetitions(baseline, "rmse", by).reset_index()
    return table.assign(factor=table["highest"] / table["lowest"])
