"""Tables 4.1 to 4.3 and the time of a frame, with units and few digits.

Runs are rows of the table of `runner.run_jobs`. Equation 4.1 and the choice of a width are in
`section_4_2`.
"""

from pathlib import Path
from typing import Any

import pandas as pd

from thesis import section_4_2
from thesis.captions import REPORTED
from thesis_repro.study import compare

IMPROVED = "sequences improved"  # a row of counts


def three_digits(value: float) -> float:
    """Round a number to three significant digits."""
    return float(f"{value:.3g}")


def read(path: Path) -> pd.DataFrame:
    """Read a CSV file as a table with nullable integers.

    Returns an empty table if the file does not exist.
    """
    if not path.is_file():
        return pd.DataFrame()
    # a name may look like a number or a missing value
    texts = dict.fromkeys(("sequence", "masks", "source"), str)
    table = pd.read_csv(path, dtype=texts, keep_default_na=False, na_values=[""])
    return table.convert_dtypes()


def table_4_1(masked: pd.DataFrame, reported_as: str) -> pd.DataFrame:
    """Table 4.1: each sequence's best dilation width and mean number of keypoints.

    masked: the runs with masks of each width. The last columns have the thesis's numbers;
    reported_as: how to name them.
    """
    best = section_4_2.best_widths(masked)
    reported = pd.DataFrame(REPORTED["table_4_1"]).set_index("sequence")
    reported = reported.reindex(best.index).astype("Int64")
    table = pd.DataFrame(index=best.index)
    table["frames"] = best["frames"]
    table["dilation width (pixels)"] = best["dilation_width"]
    table["mean keypoints"] = best["mean_keypoints"].round().astype(int)
    table["failed runs"] = _failed_of(section_4_2.of_chosen_width(masked))
    table[f"width, {reported_as}"] = reported["dilation_width"]
    table[f"mean keypoints, {reported_as}"] = reported["mean_keypoints"]
    return table.reset_index()


REPORTED_CHANGES = {
    "rmse": "table_4_2_rmse_percent_change",
    "mae": "table_4_3_mae_percent_change",
}
SINGLE = "change (%), one run each"
NULL = "change (%), one run each, if masks did nothing"


def table_of_change(
    masked: pd.DataFrame,
    baseline: pd.DataFrame,
    shuffled: pd.DataFrame,
    metric: str,
    reported_as: str,
) -> pd.DataFrame:
    """Tables 4.2 and 4.3: a metric with all keypoints and with the best mask, and Equation 4.1.

    masked, baseline: the runs with masks of each width, and with all keypoints. The metric ("rmse"
    or "mae") is in metres, Equation 4.1 in percent. The column "one run each" has the thesis's
    literal procedure: one run of all keypoints and of each width (repetition 0), also to choose the
    width. Beside it stands what this procedure gives if masks do nothing
    (`section_4_2.null_distribution`), simulated from `shuffled`: runs with all keypoints, many
    repetitions.
    The last rows have the sum of the percentages (the thesis's "aggregate"), their mean with
    Student's t interval, and their median.
    """
    best = section_4_2.of_chosen_width(masked)
    change = section_4_2.changes(best, baseline, metric)
    single = section_4_2.changes_of_repetition(masked, baseline, metric)
    studies = section_4_2.null_distribution(shuffled, masked["dilation_width"].nunique(), metric)
    reported = pd.Series(REPORTED[REPORTED_CHANGES[metric]])
    columns = {"change (%)": (change, _summary(change))}
    columns[SINGLE] = single, _summary(single)
    if len(studies.columns):
        columns[NULL] = studies.mean(), _summary_of_studies(studies)
    columns[f"change (%), {reported_as}"] = reported, _summary(reported)
    errors = pd.DataFrame(index=sorted(baseline["sequence"].unique()))
    for method, rows in {"all keypoints": baseline, "best mask": best}.items():
        mean = rows.groupby("sequence")[metric].mean()
        errors[f"{metric.upper()}, {method} (m)"] = mean.map(three_digits)
        errors[f"failed runs, {method}"] = _failed_of(rows)
    by_sequence = pd.DataFrame({name: changes for name, (changes, _) in columns.items()})
    last_rows = pd.DataFrame({name: summary for name, (_, summary) in columns.items()}, dtype=float)
    changes = pd.concat([by_sequence.reindex(errors.index), last_rows]).round(2)
    table = errors.reindex(changes.index).join(changes)
    return table.rename_axis("sequence").reset_index()


def _failed_of(runs: pd.DataFrame) -> pd.Series:
    """Return the failed runs of each sequence as a text, "2 of 5"."""
    failed = {name: compare.count_failed(rows) for name, rows in runs.groupby("sequence")}
    return pd.Series(failed, dtype=str)


CI = f"mean, {compare.LEVEL} % CI over sequences"


def _summary(changes: pd.Series) -> dict[str, float]:
    """Return the last rows of Tables 4.2 and 4.3 for one column of changes (%)."""
    low, high = compare.mean_interval(changes)
    return {
        "sum (the thesis's aggregate)": changes.sum(min_count=1),
        "mean": changes.mean(),
        f"{CI}, from": low,
        f"{CI}, to": high,
        "median": changes.median(),
        IMPROVED: (changes < 0).sum(),
    }


def _summary_of_studies(studies: pd.DataFrame) -> dict[str, float]:
    """Return the last rows for simulated studies (%), one row a study: means over the studies."""
    means = studies.mean(axis=1)
    low, high = section_4_2.middle(means)
    middle = f"mean, middle {compare.LEVEL} % of {len(studies)} simulated studies"
    return {
        "sum (the thesis's aggregate)": studies.sum(axis=1).mean(),
        "mean": means.mean(),
        f"{middle}, from": low,
        f"{middle}, to": high,
        "median": studies.median(axis=1).mean(),
        IMPROVED: (studies < 0).sum(axis=1).mean(),
    }


def procedure(runs: pd.DataFrame, shuffled: pd.DataFrame) -> list[dict[str, Any]]:
    """Return what the thesis's literal procedure gives (Tables 4.2 and 4.3), one dict a metric.

    shuffled: runs with all keypoints, to simulate the procedure if masks did nothing.

    Changes are in percent: mean, median, improved and failed (sequences) of repetition 0; lowest
    and highest mean of a repetition; null_mean, null_low, null_high and null_improved if masks did
    nothing (`section_4_2.null_distribution`).
    """
    masked, baseline = compare.of_method(runs, "masked"), compare.of_method(runs, "baseline")
    widths = masked["dilation_width"].nunique()
    # the embedded world repeats only one width, and one width is no choice
    widths_run = masked.groupby("repetition")["dilation_width"].nunique()
    repetitions = sorted(widths_run.index[widths_run == widths])
    best = section_4_2.of_chosen_width(masked[masked["repetition"] == 0])
    rows = []
    for metric in ("rmse", "mae"):
        by_repetition = [
            section_4_2.changes_of_repetition(masked, baseline, metric, repetition)
            for repetition in repetitions
        ]
        means = [changes.mean() for changes in by_repetition]
        studies = section_4_2.null_distribution(shuffled, widths, metric)
        null_low, null_high = section_4_2.middle(studies.mean(axis=1))
        row = {
            "name": compare.METRICS[metric],
            "widths": widths,
            "sequences": len(by_repetition[0]),
            "mean": means[0],
            "median": by_repetition[0].median(),
            "improved": int((by_repetition[0] < 0).sum()),
            "failed": int(compare.has_failed(best).sum()),
            "lowest": min(means),
            "highest": max(means),
            "repetitions": len(means),
            "studies": len(studies),
            "null_mean": studies.mean(axis=1).mean(),
            "null_low": null_low,
            "null_high": null_high,
            "null_improved": (studies < 0).sum(axis=1).mean(),
        }
        rows.append(row)
    return rows


def table_budget(measured: pd.DataFrame) -> pd.DataFrame:
    """Return the milliseconds of each stage for one frame, one column a method.

    The last rows have their sum and the frames a second. measured: method, stage and milliseconds,
    from `timing.measure`.
    """
    table = measured.pivot(index="stage", columns="method", values="milliseconds")
    table = table.loc[measured["stage"].unique(), measured["method"].unique()]
    total = table.sum()
    summary = pd.DataFrame({"all stages (ms)": total, "frames a second": 1000 / total}).T
    stages = table.round(2).rename("{} (ms)".format)
    table = pd.concat([stages, summary.round(1)])
    return table.rename_axis("stage", axis=0).rename_axis(None, axis=1).reset_index()
