"""Tables 4.1 to 4.3, the errors of all sequences and the time of a frame, with units and few
digits.

`runs` is the table of `runner.run_jobs`. Equation 4.1 and the choice of a width are in
`thesis_tables`.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from thesis_repro.report.captions import REPORTED
from thesis_repro.running.settings import Settings
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import ESTIMATORS


def table_4_1(runs: pd.DataFrame, reported_as: str) -> pd.DataFrame:
    """Table 4.1: each sequence's best dilation width and mean number of keypoints, here and in
    the thesis.
    """
    best = thesis_tables.best_widths(compare.of_method(runs, "masked"))
    reported = (
        pd.DataFrame(REPORTED["table_4_1"])
        .set_index("sequence")
        .reindex(best.index)
        .astype("Int64")
    )
    return pd.DataFrame(
        {
            "frames": best["frames"],
            "dilation width (pixels)": best["dilation_width"],
            "mean keypoints": best["mean_keypoints"].round().astype(int),
            f"width, {reported_as}": reported["dilation_width"],
            f"mean keypoints, {reported_as}": reported["mean_keypoints"],
        }
    ).reset_index()


def table_of_change(
    best: pd.DataFrame, runs: pd.DataFrame, metric: str, reported_as: str
) -> pd.DataFrame:
    """Tables 4.2 and 4.3: the metric (m) with all keypoints and with the best mask, and Equation
    4.1 in percent.

    The column "one run each" has the thesis's literal procedure: one run of all keypoints and of
    each width (repetition 0), also for the choice of the width.
    best: the rows of each sequence's best width (`thesis_tables.of_chosen_width`). The last rows
    have the sum of the percentages (the thesis's "aggregate"), their mean with Student's t
    interval, and their median.
    """
    reported = pd.Series(
        REPORTED[f"table_4_{2 if metric == 'rmse' else 3}_{metric}_percent_change"]
    )
    baseline = compare.of_method(runs, "baseline")
    changes = thesis_tables.changes(best, baseline, metric)
    single, alone = (
        compare.of_method(runs[runs["repetition"] == 0], method)
        for method in ("masked", "baseline")
    )
    literal = thesis_tables.changes(thesis_tables.of_chosen_width(single), alone, metric)
    table = pd.DataFrame(
        {
            f"{metric.upper()}, {method} (m)": rows.groupby("sequence")[metric]
            .mean()
            .map(_three_digits)
            for method, rows in (("all keypoints", baseline), ("best mask", best))
        }
    )
    reported_column, interval = (
        f"change (%), {reported_as}",
        f"mean, {compare.LEVEL} % CI over sequences",
    )
    summary = {}
    columns = {
        "change (%)": changes,
        "change (%), one run each": literal,
        reported_column: reported,
    }
    for name, values in columns.items():
        low, high = compare.mean_interval(values)
        summary[name] = {
            "sum (the thesis's aggregate)": values.sum(min_count=1),
            "mean": values.mean(),
            f"{interval}, from": low,
            f"{interval}, to": high,
            "median": values.median(),
            "sequences improved": (values < 0).sum(),
        }
    table = table.assign(**{name: values.reindex(table.index) for name, values in columns.items()})
    table = pd.concat([table, pd.DataFrame(summary, dtype=float).reindex(columns=table.columns)])
    return table.round(dict.fromkeys(columns, 2)).rename_axis("sequence").reset_index()


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def table_errors(runs: pd.DataFrame) -> pd.DataFrame:
    """Return keypoints and errors with all keypoints and with masks, by sequence, as means over
    the repetitions.
    """
    rows = runs[runs["method"].isin(["baseline", "masked"])]
    metrics = [name for name in compare.METRICS if name in rows and rows[name].notna().any()]
    keys = ["sequence", "estimator", "method", "source", "dilation_width"]
    means = (
        rows.groupby(keys, dropna=False)[["frames", "mean_keypoints", *metrics, "flagged"]]
        .mean()
        .reset_index()
    )
    errors = {
        f"{compare.METRICS[name]} ({compare.UNITS[name]})": means[name].map(_three_digits)
        for name in metrics
    }
    return pd.DataFrame(
        {
            "sequence": means["sequence"],
            "estimator": means["estimator"].map(ESTIMATORS),
            "keypoints": np.where(
                means["source"] == "", means["method"].map(compare.METHODS), means["source"]
            ),
            "width (pixels)": means["dilation_width"].astype("Int64"),
            "frames": means["frames"].astype(int),
            "number": means["mean_keypoints"].round().astype(int),
            **errors,
            "flagged frames": means["flagged"].round(1),
        }
    )


def table_budget(measured: pd.DataFrame) -> pd.DataFrame:
    """Return the milliseconds of each stage for one frame, one column a method, their sum and the
    frames a second.

    measured: method, stage and milliseconds, from `timing.measure`.
    """
    table = measured.pivot(index="stage", columns="method", values="milliseconds")
    table = table.loc[measured["stage"].unique(), measured["method"].unique()]
    summary = pd.DataFrame(
        {"all stages (ms)": table.sum(), "frames a second": 1000 / table.sum()}
    ).T
    table = pd.concat([table.round(2).rename(lambda stage: f"{stage} (ms)"), summary.round(1)])
    return table.rename_axis("stage", axis=0).rename_axis(None, axis=1).reset_index()


# For the page


def read(path: Path) -> pd.DataFrame:
    """Read a CSV file as a table with nullable integers. Returns an empty table if the file
    does not exist.
    """
    return (
        pd.read_csv(path, dtype={"sequence": str}).convert_dtypes()
        if path.is_file()
        else pd.DataFrame()
    )


def html(table: pd.DataFrame) -> Markup:
    """Return a table as HTML with escaped texts. The numbers of a column have the same number
    of digits.
    """
    numeric = [pd.api.types.is_numeric_dtype(dtype) for dtype in table.dtypes]
    shown = pd.DataFrame(
        {
            name: cells.astype(float)
            if cells.dtype == "Float64"
            else cells.astype(object).where(cells.notna(), "")
            for name, cells in table.items()
        }
    )
    return Markup(
        shown.to_html(
            index=False,
            border=0,
            na_rep="",
            justify="unset",
            classes="numbers" if sum(numeric) > len(numeric) / 2 else "words",
        )
    )


def beside_the_thesis(settings: Settings) -> dict[str, Any]:
    """Return this run's numbers for artefacts whose numbers the thesis reports in its text:
    {name: numbers}.
    """
    numbers: dict[str, Any] = {}
    history, chosen = (
        read(settings.build / "model" / "history.csv"),
        read(settings.figures / "table_4_1.csv"),
    )
    seconds = read(settings.figures / "timings" / "seconds.csv")
    if len(history):
        numbers["figure_4_01"] = {
            "epochs": len(history),
            "best": history.loc[history["val_loss"].idxmin()].to_dict(),
        }
    if "mean keypoints" in chosen:
        numbers["figure_4_07"] = {"keypoints": chosen["mean keypoints"].clip(lower=1)}
    if len(seconds):
        numbers["figure_4_17"] = {"saved": 0 - thesis_tables.time_savings(seconds)}
    return numbers
