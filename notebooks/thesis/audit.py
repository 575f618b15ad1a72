"""The audit: where the thesis contradicts itself, its code or its libraries, and what that does.

audit.json holds the rows and lists which columns are measured for them. Notebook 09 and
`audit_rest` measure; `table` joins the measurements to the rows. Ratios come from `study.compare`.
Intervals of other means are those of Student's t over `n` values: sequences unless said otherwise.
"""

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from thesis import thesis_tables
from thesis.captions import REPORTED
from thesis_repro.data.cityscapes import LABELS
from thesis_repro.study import compare

WORDS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))
CHANGES = {  # in percent, in reported.json
    "RMSE": "table_4_2_rmse_percent_change",
    "MAE": "table_4_3_mae_percent_change",
}
WIDTHS_TRIED = 15  # dilation widths of the thesis, of which the best is reported
WIDTHS = range(9, 12)  # the dilation widths that the thesis calls best
EVERY_ROW = "index >= 0"  # as a query
TEXTS = ["quantity", "metric", "estimator", "unit", "data"]
NUMBERS = ["quantity", "metric", "estimator", "value", "unit", "low", "high", "n", "frames", "data"]


def measurement(
    row: str, quantity: str, values: Any, unit: str = "", **more: Any
) -> dict[str, Any]:
    """Return one measurement for a row of the audit: a mean, its interval and number of values.

    quantity: a text, or the key of one in audit.json. more: further columns (metric, estimator,
    frames, data).
    """
    numbers = np.asarray(values, float).ravel()
    numbers = numbers[~np.isnan(numbers)]
    mean = np.nan
    if len(numbers):
        mean = numbers.mean()
    low, high = compare.mean_interval(numbers)
    return {
        "row": row,
        "quantity": WORDS["quantities"].get(quantity, quantity),
        "unit": unit,
        "value": mean,
        "low": low,
        "high": high,
        "n": len(numbers),
        **more,
    }


def share(row: str, quantity: str, percentages: Any, **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the mean of shares in percent.

    The interval is cut at 0 and 100, which no share exceeds. A transform that needs no cut (the
    logit) is not defined for shares of exactly 0 or 100, which occur.
    """
    mean = measurement(row, quantity, percentages, "%", **more)
    low, high = np.clip([mean["low"], mean["high"]], 0, 100).tolist()
    return {**mean, "low": low, "high": high}


def ratio(row: str, quantity: str, ratios: Any, **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the ratio over one ratio a sequence."""
    typical = compare.typical_ratio(ratios)
    interval = {"low": typical["low"], "high": typical["high"], "n": typical["n"]}
    return measurement(row, quantity, [], "ratio", value=typical["ratio"], **interval, **more)


def geometric_mean(row: str, quantity: str, ratios: Any, **more: Any) -> dict[str, Any]:
    """Return one measurement for a row of the audit: the geometric mean of one ratio a sequence."""
    mean = compare.typical_ratio(ratios)
    interval = {"low": mean["mean_low"], "high": mean["mean_high"], "n": mean["n"]}
    return measurement(row, quantity, [], "ratio", value=mean["mean"], **interval, **more)


def table(measurements: list[dict[str, Any]], data: str = "this run") -> pd.DataFrame:
    """Return the audit as a table with one line a measurement.

    The first line of each row has the row's texts. data: the origin of measurements that name none.
    Numbers are rounded (see `rounded`).
    """
    headings = {"does": "the thesis or its code", "right": "what would be right"}
    words = pd.DataFrame(WORDS["rows"]).rename(columns=headings)
    numbers = pd.DataFrame(measurements).reindex(columns=["row", *NUMBERS])
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
    digits = 4
    if abs(value - 1) < 5e-4:
        digits = 8
    return float(f"{value:.{digits}g}")


def clear_effects(table: pd.DataFrame) -> pd.DataFrame:
    """Return the lines of the table with a ratio of errors whose interval excludes 1.

    Row 14, a largest over a smallest error, cannot be below 1 and is left out.
    """
    no_errors = ["", "keypoints", WORDS["metrics"]["fields"]]
    ratios = table[(table["unit"] == "ratio") & ~table["metric"].isin(no_errors)]
    return ratios[((ratios["low"] > 1) | (ratios["high"] < 1)) & (ratios["row"] != "14")]


def measured(table: pd.DataFrame, kind: str, **names: Any) -> list[dict[str, Any]]:
    """Return the measurements that audit.json lists for one kind of table.

    Each entry of audit.json selects rows, and reference rows, by a query of pandas. Where it gives
    a unit, the measurements are means over sequences; "%" is a share. Otherwise they are ratios to
    the reference, or to another column ("over") of the same rows.
    kind: "ablations" (`ablations.measure`), "study" (`runner.run_jobs`), "tracks", "boundaries" or
    "shares" (as in `audit_rest`). names: values that the queries use.
    """
    measurements: list[dict[str, Any]] = []
    if table.empty:  # real frames have no exact label maps
        return measurements
    for spec in WORDS["measured"]:
        if spec["runs"] != kind:
            continue
        for metric, estimator in product(spec["metrics"], spec.get("estimators", [""])):
            if metric in table:
                names["estimator"] = estimator
                measurements.append(_measure(spec, table, metric, names))
    return _with_frames(measurements, table)


def _measure(
    spec: dict[str, Any], table: pd.DataFrame, metric: str, names: dict[str, Any]
) -> dict[str, Any]:
    """Return the measurement of one metric and estimator that an entry of audit.json describes."""
    rows = table.query(spec.get("rows", EVERY_ROW), local_dict=names)
    label = spec.get("label", WORDS["metrics"].get(metric, ""))
    texts = {"metric": label, "estimator": names["estimator"]}
    if "unit" in spec:
        means = rows.groupby("sequence")[metric].mean()
        if spec["unit"] == "%":
            return share(spec["row"], spec["quantity"], means, **texts)
        return measurement(spec["row"], spec["quantity"], means, spec["unit"], **texts)
    if "over" in spec:
        reference = rows.assign(**{metric: rows[spec["over"]]})
    else:
        reference = table.query(spec["reference"], local_dict=names)
    ratios = compare.ratios(rows, reference, metric)
    return ratio(spec["row"], spec["quantity"], ratios, **texts)


def _with_frames(measurements: list[dict[str, Any]], table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the measurements that have values, with the table's mean number of frames."""
    sequences = table.groupby("sequence")
    if "frames" in table:
        frames = round(sequences["frames"].first().mean())
    else:
        frames = round(sequences["frame"].nunique().mean())
    return [{**measurement, "frames": frames} for measurement in measurements if measurement["n"]]


def of_tables() -> list[dict[str, Any]]:
    """Return the rows that are arithmetic on numbers that the thesis reports.

    They are rows 1, 3, 4, 9, 18, 35, 41, 45, 60, 66, 69, 78, 89, 97 and 101.
    """
    measurements = _of_changes("RMSE") + _of_changes("MAE")
    best = pd.DataFrame(REPORTED["table_4_1"])
    keypoints = best["mean_keypoints"]
    factors = 2000 / keypoints
    classes = REPORTED["training"]["classes"]
    parameters = REPORTED["figure_a1_model_summary"]["rows"][-1]["params"]
    best_widths = best["dilation_width"].isin(WIDTHS).sum()
    measurements += [
        measurement("3", "reduction", 2000 / keypoints.mean(), "ratio"),
        geometric_mean("3", "reduction of each", factors),
        measurement("3", "three", (factors >= 3).sum(), "sequences"),
        measurement("9", "categories", len(LABELS)),
        measurement("9", "outputs", classes),
        measurement("9", "parameters", parameters // classes),
        measurement("35", "widths", best_widths, "sequences"),
        measurement("60", "keypoints", keypoints),
    ]
    measurements += [measurement(**constant) for constant in WORDS["arithmetic"]]
    return [{**measurement, "data": "the thesis's numbers"} for measurement in measurements]


def _of_changes(metric: str) -> list[dict[str, Any]]:
    """Return rows 1, 4 and 41 for one metric."""
    change = pd.Series(REPORTED[CHANGES[metric]])
    improved = int((change < 0).sum())
    # the best of as many widths as there are is better by chance nearly always
    by_chance = WIDTHS_TRIED / (WIDTHS_TRIED + 1)
    larger = (change > 0).sum()
    return [
        measurement("1", "sum", change.sum(), "%", metric=metric),
        measurement("1", "mean", change, "%", metric=metric),
        measurement("1", "median", change.median(), "%", metric=metric),
        geometric_mean("1", "ratio", 1 + change / 100, metric=metric),
        measurement("4", "larger", larger, "sequences", metric=metric),
        measurement("41", "improved", improved, "sequences", metric=metric),
        measurement("41", "by chance", len(change) * by_chance, "sequences", metric=metric),
        measurement("41", "sign", 100 * _sign_test(metric, WIDTHS_TRIED), "%", metric=metric),
    ]


def _sign_test(metric: str, widths: float) -> float:
    """Return how probable it is that the best of some widths improves no more sequences.

    They are those of the thesis, for masks that do nothing and independent widths.
    """
    change = pd.Series(REPORTED[CHANGES[metric]])
    improved, by_chance = int((change < 0).sum()), widths / (widths + 1)
    return float(binomtest(improved, len(change), by_chance, alternative="less").pvalue)


def of_study(runs: pd.DataFrame, shuffled: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows 2, 31, 35, 39, 41 and those that audit.json lists, from the runs of notebook 08.

    shuffled: its repetitions of all keypoints, see `thesis_tables.null_distribution`.
    """
    masked = compare.of_method(runs, "masked")
    baseline = compare.of_method(runs, "baseline")
    best = thesis_tables.of_chosen_width(masked)
    best_ratios = compare.ratios(best, baseline, "rmse")
    stability = thesis_tables.stability(masked, baseline)
    by_width = masked.groupby(["sequence", "dilation_width"])[["rmse", "mae"]].mean()
    by_rmse = by_width["rmse"].groupby("sequence").idxmin()
    by_mae = by_width["mae"].groupby("sequence").idxmin()
    rmse_ratios = by_width["rmse"][by_mae].to_numpy() / by_width["rmse"][by_rmse].to_numpy()
    widths = thesis_tables.best_widths(masked)["dilation_width"]
    measurements = [
        ratio("2", "best same", best_ratios, metric="RMSE"),
        ratio("31", "mae chooses", rmse_ratios, metric="RMSE"),
        measurement("31", "other width", (by_rmse != by_mae).sum(), "sequences"),
        measurement("35", "widths", widths.isin(WIDTHS).sum(), "sequences"),
        ratio("2", "best other", stability["elsewhere"], metric="RMSE"),
        share("2", "same best", stability["same_best"]),
        *_of_null_distribution(shuffled, masked["dilation_width"].nunique()),
        *_of_alike_widths(masked, shuffled),
    ]
    tested = compare.tested_width(runs)
    listed = measured(runs, "study", tested=tested, best=best.index)
    return _with_frames(measurements, runs) + listed


def _of_null_distribution(shuffled: pd.DataFrame, widths: int) -> list[dict[str, Any]]:
    """Return row 39."""
    studies = thesis_tables.null_distribution(shuffled, widths, "rmse")
    measurements = []
    for name in ("mean", "median"):
        values = studies.agg(name, axis=1)
        low, high = thesis_tables.middle(values)
        row = measurement("39", f"null {name}", values.mean(), "%", metric="RMSE")
        measurements.append({**row, "low": low, "high": high, "n": len(studies)})
    reported = pd.Series(REPORTED[CHANGES["RMSE"]]).mean()
    as_low = 100 * (studies.mean(axis=1) <= reported).mean()
    return [*measurements, measurement("39", "as low", as_low, "%", metric="RMSE")]


def _of_alike_widths(masked: pd.DataFrame, shuffled: pd.DataFrame) -> list[dict[str, Any]]:
    """Return row 41: how many widths count as independent, and what this does to its test."""
    correlation, widths = thesis_tables.independent_widths(masked, shuffled, "rmse")
    chance = 100 * _sign_test("RMSE", widths)
    return [
        measurement("41", "widths alike", correlation, metric="RMSE"),
        measurement("41", "independent widths", widths, "widths", metric="RMSE"),
        measurement("41", "sign, alike", chance, "%", metric="RMSE"),
    ]


def of_ablations(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return row 14 and those that audit.json lists, from the runs of `ablations.measure`."""
    spread = compare.shuffle_spread(runs[runs["estimator"].isin(compare.ESTIMATORS)])
    measurements = [
        ratio("14", "spread", factors, metric="RMSE", estimator=estimator)
        for estimator, factors in spread.groupby("estimator")["factor"]
    ]
    return _with_frames(measurements, runs) + measured(runs, "ablations")
