"""The audit: where the thesis contradicts itself, its code or its libraries, and the measured
effect of each.

audit.json holds the rows and lists which columns are measured for them. `table` joins the
measurements to the rows. Ratios come from `study.compare`. Intervals are those of Student's t over
`n` values: sequences unless said otherwise.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from thesis_repro.data.cityscapes import LABELS
from thesis_repro.report.captions import REPORTED
from thesis_repro.study import ablations, compare, thesis_tables

WORDS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))
WIDTHS = range(9, 12)  # the dilation widths that the thesis calls best
TEXTS = ["quantity", "metric", "estimator", "unit", "data"]
NUMBERS = ["quantity", "metric", "estimator", "value", "unit", "low", "high", "n", "frames", "data"]


def measurement(
    row: str, quantity: str, values: Any, unit: str = "", **more: Any
) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the mean of one or several values, its
    interval and their number.

    quantity: a text, or the key of one in audit.json. more: further columns (metric, estimator,
    frames, data).
    """
    numbers = np.asarray(values, float).ravel()
    numbers = numbers[~np.isnan(numbers)]
    low, high = compare.mean_interval(numbers)
    return {
        "row": row,
        "quantity": WORDS["quantities"].get(quantity, quantity),
        "unit": unit,
        "value": numbers.mean() if len(numbers) else np.nan,
        "low": low,
        "high": high,
        "n": len(numbers),
        **more,
    }


def ratio(row: str, quantity: str, ratios: Any, **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the geometric mean of one ratio a sequence."""
    mean = compare.geometric_mean(ratios)
    return measurement(
        row,
        quantity,
        [],
        "ratio",
        value=mean["ratio"],
        low=mean["low"],
        high=mean["high"],
        n=mean["n"],
        **more,
    )


def table(measurements: list[dict[str, Any]], data: str = "this run") -> pd.DataFrame:
    """Return the audit as a table with one line a measurement. The first line of each row has the
    row's texts.

    data: the origin of measurements that name none. Numbers are rounded (see `rounded`). Raises
    ValueError if a measurement's row is not in audit.json.
    """
    words = pd.DataFrame(WORDS["rows"]).rename(
        columns={"does": "the thesis or its code", "right": "what would be right"}
    )
    numbers = (
        pd.DataFrame(measurements)
        .reindex(columns=["row", *NUMBERS])
        .astype(dict.fromkeys(TEXTS, object))
    )
    unknown = set(numbers["row"]) - set(words["row"])
    if unknown:
        raise ValueError(
            f"audit.json has no rows for these measurements: {', '.join(sorted(unknown))}"
        )
    lines = words.merge(numbers.fillna({"data": data}), on="row", how="left").fillna(
        dict.fromkeys(TEXTS, "")
    )
    lines.loc[lines["row"].duplicated(), words.columns.drop("row")] = ""
    lines[["value", "low", "high"]] = lines[["value", "low", "high"]].map(rounded)
    return lines.astype({"n": "Int64", "frames": "Int64"})


def rounded(value: float) -> float:
    """Round a number to four significant digits, or to eight close to 1, to show whether an
    interval excludes 1.
    """
    return float(f"{value:.{8 if abs(value - 1) < 5e-4 else 4}g}")


def measured(table: pd.DataFrame, kind: str) -> list[dict[str, Any]]:
    """Return the measurements that audit.json lists for one kind of table.

    Where audit.json gives a unit, they are means over sequences. Otherwise they are ratios to a
    reference method, or to another column ("over") of the same rows.
    kind: "ablations" (`ablations.measure`), "study" (`runner.run_jobs`), "tracks" and "boundaries"
    (as in `ablations`), "shares" (of pixels, one row a frame).
    """
    measurements = []
    requested = [
        (spec, metric)
        for spec in WORDS["measured"]
        if spec["runs"] == kind
        for metric in spec["metrics"]
    ]
    for spec, metric in requested:
        if metric not in table:
            continue
        by_estimator = "estimator" in table and metric != "mean_keypoints"
        pairs = [(name, name) for name in compare.ESTIMATORS] if by_estimator else [("", "")]
        for estimator, reference_estimator in spec.get("estimators", pairs):
            rows = _select(table, estimator, spec.get("method"), spec.get("widths"))
            names = {
                "metric": spec.get("label", WORDS["metrics"].get(metric, "")),
                "estimator": estimator,
            }
            if "unit" in spec:
                means = rows.groupby("sequence")[metric].mean()
                measurements.append(
                    measurement(spec["row"], spec["quantity"], means, spec["unit"], **names)
                )
            else:
                reference = (
                    rows.assign(**{metric: rows[spec["over"]]})
                    if "over" in spec
                    else _select(
                        table,
                        reference_estimator,
                        spec.get("reference"),
                        spec.get("reference_widths"),
                    )
                )
                ratios = compare.ratios(rows, reference, metric)
                measurements.append(ratio(spec["row"], spec["quantity"], ratios, **names))
    return _with_frames(measurements, table)


def _select(
    table: pd.DataFrame, estimator: str, method: str | None, widths: str | list | None
) -> pd.DataFrame:
    """Select the rows of an estimator, a method and some widths; an empty estimator, or None,
    selects all.
    """
    if estimator and "estimator" in table:
        table = table[table["estimator"] == estimator]
    if widths == "best":
        return thesis_tables.of_chosen_width(compare.of_method(table, "masked"))
    if widths is not None:
        widths = [compare.tested_width(table)] if widths == "tested" else widths
        table = table[table["dilation_width"].isin(widths)]
    return table if method is None else table[table["method"] == method]


def _with_frames(measurements: list[dict[str, Any]], table: pd.DataFrame) -> list[dict[str, Any]]:
    """Add the table's mean number of frames a sequence, if known, and drop measurements without
    values.
    """
    sequences, frames = table.groupby("sequence"), np.nan
    if "frames" in table:
        frames = round(sequences["frames"].first().mean())
    elif "frame" in table:
        frames = round(sequences["frame"].nunique().mean())
    return [{**measurement, "frames": frames} for measurement in measurements if measurement["n"]]


def of_tables() -> list[dict[str, Any]]:
    """Return rows 1, 3, 4, 9, 18, 35, 41, 45, 60, 66, 69, 78 and 89: arithmetic on numbers that the
    thesis reports.
    """
    measurements = []
    for name, key in (
        ("RMSE", "table_4_2_rmse_percent_change"),
        ("MAE", "table_4_3_mae_percent_change"),
    ):
        change = pd.Series(REPORTED[key])
        improved = int((change < 0).sum())
        sign_test = binomtest(improved, len(change), alternative="greater").pvalue
        measurements += [
            measurement("1", "sum", change.sum(), "%", metric=name),
            measurement("1", "mean", change, "%", metric=name),
            measurement("1", "median", change.median(), "%", metric=name),
            ratio("1", "ratio", 1 + change / 100, metric=name),
            measurement("4", "larger", (change > 0).sum(), "sequences", metric=name),
            measurement("41", "improved", improved, "sequences", metric=name),
            measurement("41", "sign", 100 * sign_test, "%", metric=name),
        ]
    best = pd.DataFrame(REPORTED["table_4_1"])
    factors, classes = 2000 / best["mean_keypoints"], REPORTED["training"]["classes"]
    measurements += [
        measurement("3", "reduction", 2000 / best["mean_keypoints"].mean(), "ratio"),
        ratio("3", "reduction of each", factors),
        measurement("3", "three", (factors >= 3).sum(), "sequences"),
        measurement("9", "categories", len(LABELS)),
        measurement("9", "outputs", classes),
        measurement(
            "9", "parameters", REPORTED["figure_a1_model_summary"]["rows"][-1]["params"] // classes
        ),
        measurement("35", "widths", best["dilation_width"].isin(WIDTHS).sum(), "sequences"),
        measurement("60", "keypoints", best["mean_keypoints"]),
        *(measurement(**constant) for constant in WORDS["arithmetic"]),
    ]
    return [{**measurement, "data": "the thesis's numbers"} for measurement in measurements]


def of_study(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows 2, 31, 35 and those that audit.json lists, from the runs of notebook 08."""
    masked, baseline = (compare.of_method(runs, method) for method in ("masked", "baseline"))
    best, stability = (
        thesis_tables.of_chosen_width(masked),
        thesis_tables.stability(masked, baseline),
    )
    by_width = masked.groupby(["sequence", "dilation_width"])[["rmse", "mae"]].mean()
    by_rmse, by_mae = (by_width[metric].groupby("sequence").idxmin() for metric in ("rmse", "mae"))
    rmse_ratios = by_width["rmse"].loc[by_mae].to_numpy() / by_width["rmse"].loc[by_rmse].to_numpy()
    widths = thesis_tables.best_widths(masked)["dilation_width"]
    measurements = [
        ratio("2", "best same", compare.ratios(best, baseline, "rmse"), metric="RMSE"),
        ratio("31", "mae chooses", rmse_ratios, metric="RMSE"),
        measurement("31", "other width", (by_rmse != by_mae).sum(), "sequences"),
        measurement("35", "widths", widths.isin(WIDTHS).sum(), "sequences"),
        ratio("2", "best other", stability["elsewhere"], metric="RMSE"),
        measurement("2", "same best", stability["same_best"], "%"),
    ]
    return _with_frames(measurements, runs) + measured(runs, "study")


def of_ablations(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows 14 and 39, and the rows that audit.json lists, from the runs of
    `ablations.measure`.
    """
    null = ablations.null_distribution(
        compare.of_method(runs, "baseline", "thesis"),
        pd.Series(REPORTED["table_4_2_rmse_percent_change"]),
    )
    spread = compare.shuffle_spread(runs[runs["estimator"].isin(compare.ESTIMATORS)])
    measurements = [
        *(
            ratio("14", "spread", factors, metric="RMSE", estimator=estimator)
            for estimator, factors in spread.groupby("estimator")["factor"]
        ),
        *(
            measurement(
                "39",
                f"null {name}",
                null.loc[name, "expected"],
                "%",
                metric="RMSE",
                low=null.loc[name, "low"],
                high=null.loc[name, "high"],
                n=ablations.STUDIES,
            )
            for name in ("mean", "median")
        ),
        measurement("39", "as low", null.loc["mean", "share_as_low"], "%", metric="RMSE"),
    ]
    return _with_frames(measurements, runs) + measured(runs, "ablations")
