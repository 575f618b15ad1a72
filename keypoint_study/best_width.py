"""The dilation width that the thesis chooses for each sequence, and how stable this choice is.

A change is Equation 4.1 of means over the repetitions, in percent; negative is better. `masked` and
`baseline` are the runs with masks and with all keypoints, from `comparisons.of_method`.
"""

from typing import Any

import numpy as np
import pandas as pd


def percent_change(value: Any, benchmark: Any) -> Any:
    """Change of a value from a benchmark in percent (Equations 4.1 and 4.2).

    It is negative if the value is smaller.
    """
    return (value - benchmark) / benchmark * 100


def best_widths(masked: pd.DataFrame) -> pd.DataFrame:
    """Return the width with the lowest RMSE of each sequence (Table 4.1).

    One row a sequence: dilation_width, and means over the repetitions of frames, rmse, mae,
    mean_keypoints. The thesis chooses by
    "RMSE and/or MAE" (audit row 31), which does not say which of the two decides. The same sequence
    chooses the width and judges it, so this is the best of 15 results and not a test.
    """
    columns = ["frames", "rmse", "mae", "mean_keypoints"]
    means = masked.groupby(["sequence", "dilation_width"])[columns].mean()
    lowest = means.groupby("sequence")["rmse"].idxmin()
    best = means.loc[lowest].reset_index("dilation_width")
    return best.astype({"dilation_width": int, "frames": int}).sort_index()


def of_chosen_width(masked: pd.DataFrame, widths: pd.Series | None = None) -> pd.DataFrame:
    """Return the masked runs of one width for each sequence.

    widths: by sequence; by default the best ones (`best_widths`).
    """
    if widths is None:
        widths = best_widths(masked)["dilation_width"]
    chosen = masked["sequence"].map(widths.astype(float))
    return masked[masked["dilation_width"] == chosen]


def changes(rows: pd.DataFrame, baseline: pd.DataFrame, metric: str) -> pd.Series:
    """Return the change (%) of a metric in some runs from all keypoints, by sequence.

    This is Equation 4.1.
    """
    means = rows.groupby("sequence")[metric].mean()
    baseline_means = baseline.groupby("sequence")[metric].mean()
    return percent_change(means, baseline_means)


def chosen_widths(masked: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Choose the dilation width of each sequence in three ways, always by RMSE.

    Returns one row a sequence.
    best: the lowest error on the sequence itself, as the thesis chooses. fixed: the lowest mean
    change over all sequences. left_out: the lowest mean change over the other sequences, so that no
    sequence judges the width that it chose; missing if there is no other sequence. The left_out
    choices share data, so the interval of their results is too narrow. If masks did nothing, it
    would exclude 1 in one of three studies of eleven sequences and fifteen widths.
    """
    by_width = masked.groupby("dilation_width")
    table = pd.DataFrame({width: changes(rows, baseline, "rmse") for width, rows in by_width})
    chosen = {
        "best": best_widths(masked)["dilation_width"].reindex(table.index),
        "left_out": [_width_of_lowest_mean(table.drop(index=name)) for name in table.index],
        "fixed": _width_of_lowest_mean(table),
    }
    return pd.DataFrame(chosen, index=table.index).astype("Int64")


def _width_of_lowest_mean(table: pd.DataFrame) -> Any:
    """Return the width (column) with the lowest mean change, or pd.NA if there is none.

    Only widths that every sequence has are considered.
    """
    table = table.dropna(how="all").dropna(axis=1)
    if not table.size:
        return pd.NA
    return table.mean().idxmin()


def stability(masked: pd.DataFrame, baseline: pd.DataFrame) -> pd.DataFrame:
    """Check whether the width that is best in one repetition is also best in others.

    Returns one row a sequence.
    same_best: percent of the pairs of repetitions that agree on the best width. elsewhere: RMSE in
    the other repetitions with the width that is best in one, divided by the RMSE of all keypoints.
    Both are NaN if fewer than two widths were repeated.
    """
    baseline_errors = baseline.groupby("sequence")["rmse"].mean()
    rows = {}
    for name, runs in masked.groupby("sequence"):
        table = runs.pivot(index="repetition", columns="dilation_width", values="rmse")
        errors = table.dropna(axis=1)
        count, widths = errors.shape
        if count < 2 or widths < 2:
            rows[name] = (np.nan, np.nan)
            continue
        best = errors.to_numpy().argmin(axis=1)  # one column a repetition
        agreeing = (best[:, None] == best).sum() - count  # but each repetition with itself
        same_best = agreeing / (count * (count - 1)) * 100
        others = ((errors.sum() - errors) / (count - 1)).to_numpy()  # means without the repetition
        error_elsewhere = others[np.arange(count), best].mean()
        rows[name] = (same_best, error_elsewhere / baseline_errors.get(name, np.nan))
    return pd.DataFrame.from_dict(rows, orient="index", columns=["same_best", "elsewhere"])
