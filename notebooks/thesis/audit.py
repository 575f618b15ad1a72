"""The audit: where the thesis contradicts itself, its code or its libraries, and what that does.

audit.json holds the rows. A measurement is one line of a row's numbers: notebook 09,
`audit_of_tables` and `audit_of_data` make them, and `audit_table` joins them to the rows. Ratios
come from `keypoint_study.ratios`. Intervals of other means are those of Student's t over `n`
values: sequences unless said otherwise.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import comparisons, ratios

ROWS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))["rows"]
CALLED = {  # column of a table: its name in the audit
    "rmse": "RMSE",
    "mae": "MAE",
    "mean_keypoints": "keypoints",
    "rotation": comparisons.METRIC_TITLES["rotation"],
    "in_turns": "rotation error in turns",
    "on_straights": "rotation error on straights",
    "se3": "aligned ATE",
    "translation_percent": "translation error over 20 m",
    "rotation_deg_per_100m": "rotation error over 20 m",
}
TEXTS = ["quantity", "metric", "estimator", "unit", "data"]
VALUES = ["quantity", "metric", "estimator", "value", "unit", "low", "high", "n", "frames", "data"]


def measurement(
    row: str, quantity: str, values: Any, unit: str = "", **more: Any
) -> dict[str, Any]:
    """Return one measurement for a row of the audit: a mean, its interval and number of values.

    more: further columns (metric, estimator, frames, data).
    """
    numbers = np.asarray(values, float).ravel()
    numbers = numbers[~np.isnan(numbers)]
    mean = numbers.mean() if len(numbers) else np.nan
    low, high = ratios.mean_interval(numbers)
    texts = {"row": row, "quantity": quantity, "unit": unit}
    return {**texts, "value": mean, "low": low, "high": high, "n": len(numbers), **more}


def share(row: str, quantity: str, percentages: Any, **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the mean of shares in percent.

    The interval is cut at 0 and 100, which no share exceeds. A transform that needs no cut (the
    logit) is not defined for shares of exactly 0 or 100, which occur.
    """
    mean = measurement(row, quantity, percentages, "%", **more)
    low, high = np.clip([mean["low"], mean["high"]], 0, 100).tolist()
    return {**mean, "low": low, "high": high}


def ratio(
    row: str, quantity: str, of_streets: Any, geometric_mean: bool = False, **more: Any
) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the ratio over one ratio a sequence.

    It is the typical ratio, or the geometric mean.
    """
    names = ("mean", "mean_low", "mean_high") if geometric_mean else ("ratio", "low", "high")
    typical = ratios.typical_ratio(of_streets)
    value, low, high = (typical[name] for name in names)
    return measurement(
        row, quantity, [], "ratio", value=value, low=low, high=high, n=typical["n"], **more
    )


def audit_table(measurements: list[dict[str, Any]], data: str = "this run") -> pd.DataFrame:
    """Return the audit as a table with one line a measurement.

    The first line of each row has the row's texts. data: the origin of measurements that name none.
    Numbers are rounded (see `rounded`). Raises KeyError for a measurement of an unknown row.
    """
    headings = {"does": "the thesis or its code", "right": "what would be right"}
    words = pd.DataFrame(ROWS).rename(columns=headings)
    numbers = pd.DataFrame(measurements).reindex(columns=["row", *VALUES])
    if unknown := set(numbers["row"]) - set(words["row"]):
        raise KeyError(*unknown)
    numbers = numbers.astype(dict.fromkeys(TEXTS, object)).fillna({"data": data})
    lines = words.merge(numbers, on="row", how="left").fillna(dict.fromkeys(TEXTS, ""))
    repeated = lines["row"].duplicated()
    lines.loc[repeated, words.columns.drop("row")] = ""
    bounds = ["value", "low", "high"]
    lines[bounds] = lines[bounds].map(rounded)
    return lines.astype({"n": "Int64", "frames": "Int64"})


def rounded(value: float) -> float:
    """Round a number to four significant digits, or to eight close to 1.

    Eight show whether an interval excludes 1.
    """
    digits = 8 if abs(value - 1) < 5e-4 else 4
    return float(f"{value:.{digits}g}")


def clear_effects(table: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of the table with a ratio of errors whose interval excludes 1.

    Row 14, a largest over a smallest error, cannot be below 1 and is left out.
    """
    no_errors = ["", CALLED["mean_keypoints"]]
    lines = table[(table["unit"] == "ratio") & ~table["metric"].isin(no_errors)]
    return lines[((lines["low"] > 1) | (lines["high"] < 1)) & (lines["row"] != "14")]
