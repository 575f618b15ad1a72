"""The one place that compares: a table of runs goes in, a table of comparisons comes out.

**Runs** (`runner.run_all`) have one row a run: sequence, run, source, method, dilation_width,
estimator, repetition, frames, mean_keypoints, flagged, and one column for each of METRICS.

**Comparisons** (`comparisons`) have one row for each method, reference, metric and estimator: the
ratio of the method's error to the reference's, the interval of this ratio, a verdict, and the ratio
of every sequence.

A ratio is formed in three steps:

1. For each sequence, the geometric mean of the method's errors over the repetitions is divided by
   that of the reference. Half and double are then equally far from 1, which is not so for
   percentages. Every run counts with its own errors, also one that failed.
2. The ratio is the Hodges-Lehmann estimate over the sequences: the median of the means of all pairs
   of logarithms. One sequence on which a method fails moves it less than it moves a mean.
3. Its interval is that of Wilcoxon's signed-rank test, which is exact. It estimates how far the
   ratio could be off if other sequences of the same kind had been recorded.

The verdict is "lower" or "higher" if the interval excludes 1, and otherwise "no clear difference".
With fewer than MIN_SEQUENCES sequences it is "too few sequences to tell". The rows that answer the
main question are those that `decide`.

How often a method fails is a question of its own, which the ratio does not answer. A run has
failed if one of its steps has, or if it is lost (`metrics.step_errors`). `failures` counts such
runs, and compares their shares by a sign test over the sequences.

Beside the ratio stand the geometric mean of the sequences' ratios with Student's t interval, which
one failing sequence widens until it says nothing; and `detectable`, the mean ratio that so few and
so different sequences would show in 80 % of studies.

Both the interval and the counts of failures were chosen when the results on real frames were known.
The reason is the error rates in docs/reading-results.md.
"""

from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import bdtr, stdtrit

from keypoint_study import methods
from keypoint_study.errors import ERRORS
from keypoint_study.jobs import CONTROL_WIDTH, ESTIMATORS
from keypoint_study.methods import MASK_CONTROLS
from keypoint_study.sources import UNMASKED

# {name: title} of the methods and errors that are compared. The judging metrics decide.
METHODS = {
    name: method.title
    for name, method in methods.METHODS.items()
    if method.group != methods.THESIS_ONLY
}
SEGMENTATION_FREE_CONTROLS = [
    name for name, method in methods.METHODS.items() if method.group == methods.CONTROL
]
METRICS = {name: error.title for name, error in ERRORS.items()}
JUDGING_METRICS = {name: error.title for name, error in ERRORS.items() if error.decides}

# of `comparisons`, before those of the sequences
COLUMNS = (
    "source",
    "method",
    "dilation_width",
    "keypoints",
    "reference_source",
    "reference",
    "metric",
    "estimator",
    "label",
    "tested",
    "shown",
    "decides",
    "ratio",
    "low",
    "high",
    "mean",
    "mean_low",
    "mean_high",
    "detectable",
    "n",
    "above",
    "far_off",
    "verdict",
    "failed",
    "reference_failed",
    "more_failures",
    "fewer_failures",
    "failures_verdict",
)

USUAL_JUDGE = "refined"  # the estimator that decides, since shuffling changes it least
MIN_FOR_INTERVAL = 3  # values of a mean
# With fewer sequences, all ratios lie on the same side of 1 by chance in more than 5 % of cases (2
# / 2**n).
MIN_SEQUENCES = 6
LEVEL = 95  # percent, of all intervals
POWER = 80  # percent of studies that would show the detectable ratio
# a sequence is named beside the mean if its ratio differs from the median by more than this factor
FAR_OFF = 3
LOWER, HIGHER, NO_CLEAR_DIFFERENCE, TOO_FEW = (
    "lower",
    "higher",
    "no clear difference",
    "too few sequences to tell",
)


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
    # the chance of each rank sum: every rank belongs to a positive difference in half of the cases
    chances = np.ones(1)
    for rank in range(1, len(numbers) + 1):
        chances = np.convolve(chances, [0.5, *[0] * (rank - 1), 0.5])
    rejected = int((chances.cumsum() <= (100 - level) / 200).sum())  # rank sums at either end
    estimate = float(np.median(pair_means))
    if not rejected:
        return estimate, np.nan, np.nan
    return estimate, float(pair_means[rejected - 1]), float(pair_means[-rejected])


def typical_ratio(ratios: ArrayLike) -> dict[str, Any]:
    """Return what `comparisons` says of one ratio a sequence.

    {ratio, low, high (`typical_interval` of the logarithms); mean, mean_low, mean_high (the
    geometric mean, `mean_interval`); detectable (a ratio above 1); n (sequences), above (those with
    a ratio above 1); verdict}. The verdict is LOWER or HIGHER if the interval low to high excludes
    1, and TOO_FEW for fewer than MIN_SEQUENCES sequences.
    """
    logarithms = np.log(np.asarray(ratios, float))
    logarithms = logarithms[np.isfinite(logarithms)]
    n = len(logarithms)
    mean, detectable = np.nan, np.nan
    if n:
        mean = logarithms.mean()
    if n >= MIN_FOR_INTERVAL:
        reach = stdtrit(n - 1, (100 + LEVEL) / 200) + stdtrit(n - 1, POWER / 100)
        detectable = reach * logarithms.std(ddof=1) / np.sqrt(n)
    intervals = [*typical_interval(logarithms), mean, *mean_interval(logarithms), detectable]
    names = ("ratio", "low", "high", "mean", "mean_low", "mean_high", "detectable")
    numbers = dict(zip(names, np.exp(intervals).tolist(), strict=True))
    above = int((logarithms > 0).sum())
    verdict = _verdict(numbers["low"], numbers["high"], n)
    return {**numbers, "n": n, "above": above, "verdict": verdict}


def _verdict(low: float, high: float, n: int) -> str:
    """Return the verdict on a ratio with the interval (low, high) over n sequences."""
    if n < MIN_SEQUENCES:
        return TOO_FEW
    if high < 1:
        return LOWER
    if low > 1:
        return HIGHER
    return NO_CLEAR_DIFFERENCE


def ratios(rows: pd.DataFrame, reference: pd.DataFrame, metric: str) -> pd.Series:
    """Return, for each sequence, the error of some runs divided by the error of the reference runs.

    metric: the column of the error. Sequences without a positive error in both tables are left out.
    """
    logarithms = _mean_logarithms(rows, metric) - _mean_logarithms(reference, metric)
    return np.exp(logarithms.dropna())


def _mean_logarithms(runs: pd.DataFrame, metric: str) -> pd.Series:
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


def comparisons(runs: pd.DataFrame) -> pd.DataFrame:
    """Compare every method with all keypoints, and masks with controls and other sources' masks.

    Masks are compared with every control. Returns a table with the columns source, method,
    dilation_width (pixels), keypoints (mean number); reference_source, reference (the method
    compared with); metric, estimator; label (see `labels`); tested (whether the width is the
    `tested_width`); shown (whether it is that, or the source has no masks of that width); decides
    (whether the row is of the tested width, a judging metric and the `judging_estimator`); those of
    `typical_ratio`; far_off (see `far_off`); those of `failures`; and one column for each sequence
    with its ratio.
    Masks help if both rows that decide are LOWER than with all keypoints. The segmentation helps if
    they are also LOWER than with each of SEGMENTATION_FREE_CONTROLS.
    An error that no sequence has with both methods has no row.
    """
    runs = runs.assign(label=labels(runs))
    judging = judging_estimator(runs)
    metrics = [name for name in METRICS if name in runs and runs[name].notna().any()]
    rows = []
    for estimator in ESTIMATORS:
        variants = _variants(runs[runs["estimator"] == estimator], metrics)
        for (variant, errors), (reference, reference_errors) in product(variants, variants):
            if not _is_compared(variant, reference):
                continue
            of_failures = failures(errors["failed"], reference_errors["failed"])
            for metric in metrics:
                by_sequence = np.exp((errors[metric] - reference_errors[metric]).dropna())
                if by_sequence.empty:
                    continue
                row = {
                    **variant,
                    "reference_source": reference["source"],
                    "reference": reference["method"],
                    "estimator": estimator,
                    "metric": metric,
                    "decides": variant["tested"]
                    and metric in JUDGING_METRICS
                    and estimator == judging,
                    "far_off": far_off(by_sequence),
                    **typical_ratio(by_sequence),
                    **of_failures,
                    **by_sequence,
                }
                rows.append(row)
    table = pd.DataFrame(rows, columns=[*COLUMNS, *sorted(runs["sequence"].unique())])
    masked = table[table["tested"].astype(bool) & (table["method"] == "masked")]
    table["shown"] = table["tested"] | ~table["source"].isin(masked["source"])
    return table


def sequences_of(table: pd.DataFrame) -> list[str]:
    """Return the names of the columns of `comparisons` with the ratio of each sequence."""
    return list(table.columns[len(COLUMNS) :])


def has_failed(runs: pd.DataFrame) -> pd.Series:
    """Return for each run whether a step of it failed or it is lost (`metrics.step_errors`)."""
    return (runs["failed"] > 0) | (runs["lost"] > 0)


def count_failed(runs: pd.DataFrame) -> str:
    """Return how many of some runs failed, such as "2 of 40"."""
    return f"{has_failed(runs).sum()} of {len(runs)}"


def failures(failed: pd.Series, reference: pd.Series) -> dict[str, Any]:
    """Compare how often runs fail. failed, reference: of each run, by sequence (index).

    Returns {failed, reference_failed (such as "2 of 40"); more_failures, fewer_failures (sequences
    on which a larger or a smaller share of runs failed than with the reference); failures_verdict}.
    The verdict is that of a sign test (exact, two-sided) over these sequences. TOO_FEW if all
    sequences together are too few.
    """
    shares, reference_shares = (runs.groupby(level=0).mean() for runs in (failed, reference))
    differences = (shares - reference_shares).dropna()
    more, fewer = int((differences > 0).sum()), int((differences < 0).sum())
    verdict = NO_CLEAR_DIFFERENCE
    if len(differences) < MIN_SEQUENCES:
        verdict = TOO_FEW
    elif 2 * bdtr(min(more, fewer), more + fewer, 0.5) <= 1 - LEVEL / 100:
        verdict = HIGHER if more > fewer else LOWER
    return {
        "failed": f"{failed.sum()} of {len(failed)}",
        "reference_failed": f"{reference.sum()} of {len(reference)}",
        "more_failures": more,
        "fewer_failures": fewer,
        "failures_verdict": verdict,
    }


def _variants(
    runs: pd.DataFrame, metrics: list[str]
) -> list[tuple[dict[str, Any], dict[str, pd.Series]]]:
    """Split the runs by method, source and width.

    Returns for each part its columns of `comparisons`, and by metric the mean logarithms of its
    errors, which are then found only once; under "failed", whether each run has failed.
    """
    variants = []
    for method in METHODS:
        by_width = runs[runs["method"] == method].groupby(
            ["source", "dilation_width"], dropna=False, sort=False
        )
        for (source, width), rows in by_width:
            tested_at = tested_width(of_source(runs, source))
            tested = pd.isna(width) or tested_at in (None, width)
            columns = {
                "source": source,
                "method": method,
                "dilation_width": width,
                "keypoints": rows.groupby("sequence")["mean_keypoints"].mean().mean(),
                "label": rows["label"].iloc[0],
                "tested": bool(tested),
            }
            errors = {metric: _mean_logarithms(rows, metric) for metric in metrics}
            errors["failed"] = has_failed(rows.set_index("sequence"))
            variants.append((columns, errors))
    return variants


def _is_compared(variant: dict[str, Any], reference: dict[str, Any]) -> bool:
    """Return whether `comparisons` compares a variant with a reference, which may be itself."""
    if reference["method"] == "baseline":
        return True
    if variant is reference or variant["method"] != "masked":
        return False
    if not (variant["tested"] and reference["tested"]):
        return False
    return variant["source"] == reference["source"] or reference["method"] == "masked"


def overall(verdicts: Iterable[str]) -> str:
    """Return the verdict of several metrics together.

    It is TOO_FEW if one of them has too few sequences, or if there are no verdicts. It is LOWER or
    HIGHER if all of them agree.
    """
    distinct = set(verdicts)
    if not distinct or TOO_FEW in distinct:
        return TOO_FEW
    if len(distinct) > 1:
        return NO_CLEAR_DIFFERENCE
    return distinct.pop()


def judging_estimator(runs: pd.DataFrame) -> str:
    """Return the estimator that decides.

    It is the USUAL_JUDGE if it was run, and otherwise the first that was.
    """
    estimators = list(runs["estimator"])
    return USUAL_JUDGE if USUAL_JUDGE in estimators else estimators[0]


def shuffle_spread(runs: pd.DataFrame) -> pd.DataFrame:
    """Measure how much shuffling the matched points before RANSAC changes the RMSE.

    The runs are those with all keypoints. Returns one row for each estimator and sequence: mean,
    lowest, highest, factor (highest over lowest).
    """
    baseline = runs[runs["method"] == "baseline"]
    table = spread(baseline, "rmse", by=["estimator", "sequence"]).reset_index()
    return table.assign(factor=table["highest"] / table["lowest"])


def labels(runs: pd.DataFrame) -> pd.Series:
    """Label each run with its method and the width of its masks.

    If there are several sources, the label begins with the run's source. Own keypoints and paths
    are labelled with the name of their source.
    """
    width = runs["dilation_width"].where(runs["method"] == "masked")
    width = width.map(", width {:g}".format, na_action="ignore").astype(object).fillna("")
    label = runs["method"].map(METHODS) + width
    if len(sources(runs)) > 1:
        label = (runs["source"] + ": " + label).str.removeprefix(": ")  # all keypoints have none
    return label.mask(runs["method"].isin(UNMASKED), runs["source"])


# Parts of a table of runs


def of_method(runs: pd.DataFrame, method: str, estimator: str | None = None) -> pd.DataFrame:
    """Return the runs of one method under one estimator.

    estimator: by default the thesis's estimator if it was run, as for the tables of the thesis.
    """
    if estimator is None:
        estimators_run = [name for name in ESTIMATORS if (runs["estimator"] == name).any()]
        estimator = next(iter(estimators_run), "thesis")
    return runs[(runs["method"] == method) & (runs["estimator"] == estimator)]


def of_source(runs: pd.DataFrame, source: str) -> pd.DataFrame:
    """Return the runs of one source of masks.

    The runs with all keypoints are among them, since they belong to every source.
    """
    return runs[runs["source"].isin([source, ""])]


def sources(runs: pd.DataFrame) -> list[str]:
    """Return the names of the sources, in the order of their runs."""
    return [name for name in runs["source"].unique() if name]


def tested_width(runs: pd.DataFrame) -> int | None:
    """Return the dilation width (pixels) at which masks are tested.

    It is that of the controls, or else the only width of masks. Returns CONTROL_WIDTH if the width
    is not unique, and None for ready-made masks.
    """
    masked = runs.loc[runs["method"] == "masked", "dilation_width"]
    if len(masked) and masked.isna().all():
        return None
    controls = runs.loc[runs["method"].isin(MASK_CONTROLS), "dilation_width"].dropna()
    widths = masked.unique()
    if len(controls):
        widths = controls.unique()
    if len(widths) != 1:
        return CONTROL_WIDTH
    return int(widths[0])


def keypoints_left(runs: pd.DataFrame) -> pd.Series:
    """Return the mean number of keypoints that masks of the `tested_width` leave, by sequence."""
    masked = runs[runs["method"] == "masked"]
    widths = masked["dilation_width"]
    rows = masked[widths.isna() | (widths == tested_width(runs))]
    return rows.groupby("sequence")["mean_keypoints"].mean()


def spread(rows: pd.DataFrame, column: str, by: str | list[str] = "sequence") -> pd.DataFrame:
    """Return mean, lowest and highest of a column over the repetitions.

    There is one row for each value of `by`.
    """
    table = rows.groupby(by)[column].agg(mean="mean", lowest="min", highest="max")
    # rounding may put the mean of equal values outside their range, which gives an error bar of
    # negative length
    return table.assign(mean=table["mean"].clip(table["lowest"], table["highest"]))
