"""The audit: where the thesis contradicts itself, its code or its libraries, and what that does.

audit.json holds the rows, and for each number of a row a key and what is measured. `measurement`
makes a number from a row, a key and values; notebook 09 and `audit_numbers` call it. `audit_table`
joins them to the rows. The page in git has the words of each row once, and the numbers of two runs
beside them.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import ratios
from keypoint_study.report import style
from thesis import REPORTED

ROWS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))["rows"]
MEASURED = {row["row"]: row.pop("measured", {}) for row in ROWS}  # {row: {key: what is measured}}
TEXTS = ["quantity", "metric", "estimator", "unit", "data"]
VALUES = ["quantity", "metric", "estimator", "value", "unit", "low", "high", "n", "frames", "data"]
# the thesis's changes in percent, one row a sequence
CHANGES = pd.DataFrame(
    {
        "RMSE": REPORTED["table_4_2_rmse_percent_change"],
        "MAE": REPORTED["table_4_3_mae_percent_change"],
    }
)
WIDTHS = range(9, 12)  # the dilation widths that the thesis calls best
WORDS = ["where", "the thesis or its code", "what would be right", "switch"]
NAMED = ["row", "quantity", "metric", "estimator", "unit"]  # what a number is
ARITHMETIC = "the thesis's numbers"  # in the column data: needs no run


def measurement(row: str, key: str, values: Any, unit: str = "", **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: a mean, its interval and number of values.

    key: of what is measured, in audit.json. more: further columns (metric, estimator, frames,
    data). Raises KeyError for an unknown row or key.
    """
    numbers = np.asarray(values, float).ravel()
    numbers = numbers[~np.isnan(numbers)]
    mean = numbers.mean() if len(numbers) else np.nan
    low, high = ratios.mean_interval(numbers)
    texts = {"row": row, "quantity": MEASURED[row][key], "unit": unit}
    return {**texts, "value": mean, "low": low, "high": high, "n": len(numbers), **more}


def share(row: str, key: str, percentages: Any, **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the mean of shares in percent.

    The interval is cut at 0 and 100, which no share exceeds. A transform that needs no cut (the
    logit) is not defined for shares of exactly 0 or 100, which occur.
    """
    mean = measurement(row, key, percentages, "%", **more)
    low, high = np.clip([mean["low"], mean["high"]], 0, 100).tolist()
    return {**mean, "low": low, "high": high}


def ratio(
    row: str, key: str, by_sequence: Any, geometric_mean: bool = False, **more: Any
) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the ratio over one ratio a sequence.

    It is the typical ratio, or the geometric mean.
    """
    names = ("mean", "mean_low", "mean_high") if geometric_mean else ("ratio", "low", "high")
    typical = ratios.typical_ratio(by_sequence)
    value, low, high = (typical[name] for name in names)
    return measurement(
        row, key, [], "ratio", value=value, low=low, high=high, n=typical["n"], **more
    )


def on(quantity: str, threads: int) -> str:
    """Return the words for a time on so many threads. If they say nothing, it is one."""
    return quantity if threads == 1 else f"{quantity}, {threads} threads"


def audit_table(measurements: list[dict[str, Any]], data: str = "this run") -> pd.DataFrame:
    """Return the audit as a table with one line a measurement.

    The first line of each row has the row's texts. data: the origin of measurements that name none.
    Numbers are rounded (see `rounded`).
    """
    headings = {"does": "the thesis or its code", "right": "what would be right"}
    words = pd.DataFrame(ROWS).rename(columns=headings)
    numbers = pd.DataFrame(measurements).reindex(columns=["row", *VALUES])
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
    lines = table[(table["unit"] == "ratio") & ~table["metric"].isin(["", "keypoints"])]
    return lines[((lines["low"] > 1) | (lines["high"] < 1)) & (lines["row"] != "14")]


# The page


def page(folder: Path, real: Path, note: str) -> str:
    """Return the page, made from audit.csv of the run in git and of the one on real frames.

    folder: of the page and of the run in git. real: in it. note: names the data of the run in git.
    """
    at = real.name
    data = {"embedded world": note, "real frames": f"[{at}]({at}/README.md)"}
    tables = dict(zip(data, map(_read, (folder, real))))
    notes = []
    for name, table in tables.items():
        times = [each for each in table["data"].unique() if each.startswith("timed on")]
        notes.append(f"Column {name}: {'; '.join([data[name], *times])}.")
    notes.append("In parentheses: 95 % intervals. Numbers of sequences and frames:")
    notes.append(f"[audit.csv](audit.csv), [{at}/audit.csv]({at}/audit.csv).")
    return f"{style.markdown(side_by_side(tables))}\n{' '.join(notes)}\n"


def side_by_side(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Return audits as one table: a column of values, with their 95 % intervals, for each of them.

    Another column has what is arithmetic with the thesis's numbers, the same in all. The first line
    of a row has the row's words, those of the first audit. tables: {name: its audit.csv, as texts}.
    """
    lines = pd.concat([table.assign(column=name) for name, table in tables.items()])
    lines["column"] = lines["column"].mask(lines["data"] == ARITHMETIC, ARITHMETIC)
    lines["number"] = [*map(_number, lines["value"], lines["low"], lines["high"])]
    is_measured = lines["quantity"] != ""
    # a row without numbers has one line, unless another audit has numbers for it
    has_numbers = lines["row"].isin(lines.loc[is_measured, "row"])
    shown = lines.loc[is_measured | ~has_numbers, NAMED].drop_duplicates()
    shown = shown.sort_values("row", key=lambda row: row.astype(int), kind="stable")
    for column in (ARITHMETIC, *tables):
        numbers = lines.loc[lines["column"] == column, [*NAMED, "number"]].drop_duplicates()
        shown = shown.merge(numbers.rename(columns={"number": column}), how="left", on=NAMED)
    words = lines.drop_duplicates("row")[["row", *WORDS]]
    table = words.merge(shown.fillna(""), on="row", how="right")
    table.loc[table["row"].duplicated(), WORDS] = ""
    return table


def _read(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "audit.csv", dtype=str, keep_default_na=False)


def _number(value: str, low: str, high: str) -> str:
    """Return a value and its interval, if it has one: "0.766 (0.43 to 5.9)"."""
    if not value:
        return ""
    ends = f" ({float(low):g} to {float(high):g})" if low and high else ""
    return f"{float(value):g}{ends}"
