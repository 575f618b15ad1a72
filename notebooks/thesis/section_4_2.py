"""What the thesis's own comparison gives (Section 4.2, Tables 4.1 to 4.3).

The choice of a width is in `study.best_width`; all other comparisons are in `study.compare`. A
change is Equation 4.1 of means over the repetitions, in percent; negative is better. `masked` and
`baseline` are the runs with masks and with all keypoints, from `compare.of_method`.
"""

import numpy as np
import pandas as pd

from thesis_repro.study.best_width import (
    best_widths,
    changes,
    chosen_widths,
    of_chosen_width,
    percent_change,
    stability,
)
from thesis_repro.study.compare import LEVEL
from thesis_repro.study.jobs import Job, repeated

__all__ = [
    "best_widths",
    "changes",
    "changes_of_repetition",
    "chosen_widths",
    "independent_widths",
    "middle",
    "null_distribution",
    "of_chosen_width",
    "percent_change",
    "reduced_jobs",
    "stability",
    "time_savings",
]
STUDIES = 4000  # simulated ones


def reduced_jobs(best: pd.DataFrame, repetitions: int = 1) -> list[Job]:
    """Return jobs that limit the detector to as many keypoints as the best masks leave.

    This is each sequence's mean number of keypoints at its best width (Figure 4.12). best: the
    table of `best_widths`.
    """
    jobs = []
    for name, number in best["mean_keypoints"].items():
        limit = max(1, round(number))  # OpenCV takes 0 as "no limit"
        jobs.append(Job(name, "reduced", max_keypoints=limit))
    return repeated(jobs, ["thesis"], repetitions)


def changes_of_repetition(
    masked: pd.DataFrame, baseline: pd.DataFrame, metric: str, repetition: int = 0
) -> pd.Series:
    """Return the change (%) by the thesis's literal procedure, by sequence.

    All keypoints and each width are run once: only the runs of one repetition are used, also to
    choose the width.
    """
    best = of_chosen_width(masked[masked["repetition"] == repetition])
    return changes(best, baseline[baseline["repetition"] == repetition], metric)


def null_distribution(baseline: pd.DataFrame, widths: int, metric: str) -> pd.DataFrame:
    """Simulate the changes (%) that the thesis's literal procedure reports if masks do nothing.

    Then a run with masks is a run with all keypoints whose matched points are shuffled in another
    way. For each sequence, one of its runs with all keypoints is drawn as the benchmark, and
    another one for each of `widths` widths. The one with the lowest RMSE is the best width, and the
    benchmark beats it in one of widths + 1 studies. Returns STUDIES rows, one column a sequence,
    without those that were run only once. A sequence with fewer than widths + 1 runs has all of
    them drawn, which is the best of fewer widths.
    """
    random = np.random.default_rng(0)
    columns = {}
    for name, runs in baseline.groupby("sequence"):
        if len(runs) < 2:
            continue
        errors, rmse = runs[metric].to_numpy(), runs["rmse"].to_numpy()
        drawn = random.permuted(np.tile(np.arange(len(runs)), (STUDIES, 1)), axis=1)
        benchmark, of_widths = drawn[:, 0], drawn[:, 1 : widths + 1]
        best_column = rmse[of_widths].argmin(axis=1)
        best = of_widths[np.arange(STUDIES), best_column]
        columns[name] = percent_change(errors[best], errors[benchmark])
    return pd.DataFrame(columns)


def independent_widths(
    masked: pd.DataFrame, shuffled: pd.DataFrame, metric: str
) -> tuple[float, float]:
    """Return how alike the errors of two widths are, and how many widths count as independent.

    The first is the intraclass correlation of the logarithms of the errors about each sequence's
    mean with all keypoints (shuffled). The second is Kish's effective number, n / (1 + (n - 1) r).
    """
    logarithms = np.log(masked.set_index(["sequence", "repetition", "dilation_width"])[metric])
    levels = np.log(shuffled.set_index("sequence")[metric]).groupby(level=0).mean()
    deviations = logarithms.unstack().dropna().sub(levels, axis=0, level="sequence").to_numpy()
    number = deviations.shape[1]
    if number < 2:
        return np.nan, float(number)
    squares = (deviations**2).sum(axis=1)
    products = (deviations.sum(axis=1) ** 2 - squares) / (number - 1)
    correlation = max(0.0, float(products.sum() / squares.sum()))
    return correlation, number / (1 + (number - 1) * correlation)


def middle(values: pd.Series) -> tuple[float, float]:
    """Return the ends of the middle LEVEL percent of a number of simulated studies."""
    tail = (100 - LEVEL) / 200
    return values.quantile(tail), values.quantile(1 - tail)


def time_savings(seconds: pd.DataFrame) -> pd.Series:
    """Return the change of time (%) from all keypoints for each dilation width (Equation 4.2).

    It is negative if time is saved. seconds: the table of `timing.time_runs`, whose seconds are
    added over the sequences. As in the thesis, they include making the masks and not the
    prediction.
    """
    baseline = seconds[seconds["method"] == "baseline"]
    masked = seconds[seconds["method"] == "masked"]
    masked_seconds = masked.groupby("dilation_width")["seconds"].sum()
    return percent_change(masked_seconds, baseline["seconds"].sum())
