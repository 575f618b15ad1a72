"""The audit: where the thesis contradicts itself, its code or its libraries, and what each of these does, in numbers.

audit.json has the rows, and lists what is measured of which table; `table` joins measurements to the rows. Ratios are
those of `study.compare`; intervals are bootstrap intervals over what `n` counts: sequences, unless said otherwise.
"""

import json
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from thesis_repro.cityscapes import LABELS
from thesis_repro.report.captions import REPORTED
from thesis_repro.study import ablations, compare, thesis_tables

WORDS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))
WIDTHS = range(9, 12)  # that the thesis calls best
TEXTS = ["quantity", "metric", "estimator", "unit", "data"]
NUMBERS = ["quantity", "metric", "estimator", "value", "unit", "low", "high", "n", "frames", "data"]


def measurement(row, quantity, values, unit="", **more):
    """One measurement of a row: the mean of one value or several, their interval and number.

    quantity: words, or their name in audit.json. more: further columns (metric, estimator, frames, data).
    """
    values = np.asarray(values, float).ravel()
    values = values[~np.isnan(values)]
    low, high = compare.mean_interval(values)
    return {"row": row, "quantity": WORDS["quantities"].get(quantity, quantity), "unit": unit,
            "value": values.mean() if len(values) else np.nan, "low": low, "high": high, "n": len(values), **more}


def ratio(row, quantity, ratios, **more):
    """One measurement of a row: the geometric mean of one ratio a sequence."""
    mean = compare.geometric_mean(ratios)
    return measurement(row, quantity, [], "ratio", value=mean["ratio"], low=mean["low"], high=mean["high"],
                       n=mean["n"], **more)


def table(measurements, data="this run"):
    """The audit for reading: the words of each row, then one line a measurement; words stand on the first line only.

    data: where measured numbers come from. Numbers are rounded, but never to 1 what is not 1: an
    interval that excludes 1 shows it. Raises ValueError for a measurement of no row.
    """
    words = pd.DataFrame(WORDS["rows"]).rename(columns={"does": "the thesis or its code",
                                                        "right": "what would be right"})
    numbers = pd.DataFrame(measurements).reindex(columns=["row", *NUMBERS]).astype(dict.fromkeys(TEXTS, object))
    unknown = set(numbers["row"]) - set(words["row"])
    if unknown:
        raise ValueError(f"measurements of no row of audit.json: {', '.join(sorted(unknown))}")
    lines = words.merge(numbers.fillna({"data": data}), on="row", how="left").fillna(dict.fromkeys(TEXTS, ""))
    lines.loc[lines["row"].duplicated(), words.columns.drop("row")] = ""
    lines[["value", "low", "high"]] = lines[["value", "low", "high"]].map(rounded)
    return lines.astype({"n": "Int64", "frames": "Int64"})


def rounded(value):
    """A number to four significant digits, or more where it would become 1."""
    return float(f"{value:.{8 if abs(value - 1) < 5e-4 else 4}g}")


def measured(table, kind):
    """The measurements that audit.json lists for one kind of table: means over sequences where it gives a unit, else
    ratios to the reference, or to another column ("over") of the same rows.

    kind: "ablations" (`ablations.measure`), "study" (`runner.run`), "tracks" and "boundaries" (those of `ablations`),
    "shares" (of pixels, a row a frame), "boresight" (`boresight.explained`).
    """
    measurements = []
    specs = [spec for spec in WORDS["measured"] if spec["runs"] == kind]
    for spec, metric in [(each, name) for each in specs for name in each["metrics"] if name in table]:
        of_each = "estimator" in table and metric != "mean_keypoints"
        pairs = [(name, name) for name in compare.ESTIMATORS] if of_each else [("", "")]
        for estimator, other in spec.get("estimators", pairs):
            rows = _arm(table, estimator, spec.get("method"), spec.get("widths"))
            which = {"metric": spec.get("label", WORDS["metrics"].get(metric, "")), "estimator": estimator}
            if "unit" in spec:
                means = rows.groupby("sequence")[metric].mean()
                measurements.append(measurement(spec["row"], spec["quantity"], means, spec["unit"], **which))
            else:
                reference = (rows.assign(**{metric: rows[spec["over"]]}) if "over" in spec else
                             _arm(table, other, spec.get("reference"), spec.get("reference_widths")))
                ratios = compare.ratios(rows, reference, metric)
                measurements.append(ratio(spec["row"], spec["quantity"], ratios, **which))
    return _with_frames(measurements, table)


def _arm(table, estimator, method, widths):
    """The rows of a method under an estimator, of some widths; what is empty or None chooses nothing."""
    if estimator and "estimator" in table:
        table = table[table["estimator"] == estimator]
    if widths == "best":
        return thesis_tables.of_chosen_width(compare.of_method(table, "masked"))
    if widths is not None:
        widths = [compare.tested_width(table)] if widths == "tested" else widths
        table = table[table["dilation_width"].isin(widths)]
    return table if method is None else table[table["method"] == method]


def _with_frames(measurements, table):
    """What could be measured, with how many frames of a sequence the table has on average, where it says so."""
    sequences, frames = table.groupby("sequence"), np.nan
    if "frames" in table:
        frames = round(sequences["frames"].first().mean())
    elif "frame" in table:
        frames = round(sequences["frame"].nunique().mean())
    return [{**each, "frames": frames} for each in measurements if each["n"]]


def of_tables():
    """Rows 1, 3, 4, 9, 18, 35, 41, 45, 60, 66 and 69: arithmetic on the thesis's own numbers."""
    measurements = []
    for name, key in (("RMSE", "table_4_2_rmse_percent_change"), ("MAE", "table_4_3_mae_percent_change")):
        change = pd.Series(REPORTED[key])
        improved = int((change < 0).sum())
        as_many = binomtest(improved, len(change), alternative="greater").pvalue
        measurements += [measurement("1", "sum", change.sum(), "%", metric=name),
                         measurement("1", "mean", change, "%", metric=name),
                         measurement("1", "median", change.median(), "%", metric=name),
                         ratio("1", "ratio", 1 + change / 100, metric=name),
                         measurement("4", "larger", (change > 0).sum(), "sequences", metric=name),
                         measurement("41", "improved", improved, "sequences", metric=name),
                         measurement("41", "sign", 100 * as_many, "%", metric=name)]
    best = pd.DataFrame(REPORTED["table_4_1"])
    factors, classes = 2000 / best["mean_keypoints"], REPORTED["training"]["classes"]
    measurements += [
        measurement("3", "reduction", 2000 / best["mean_keypoints"].mean(), "ratio"),
        measurement("3", "reduction of each", factors, "ratio"),
        measurement("3", "three", (factors >= 3).sum(), "sequences"),
        measurement("9", "categories", len(LABELS)), measurement("9", "outputs", classes),
        measurement("9", "parameters", REPORTED["figure_a1_model_summary"]["rows"][-1]["params"] // classes),
        measurement("35", "widths", best["dilation_width"].isin(WIDTHS).sum(), "sequences"),
        measurement("60", "keypoints", best["mean_keypoints"]),
        *(measurement(**each) for each in WORDS["arithmetic"])]
    return [{**each, "data": "the thesis's numbers"} for each in measurements]


def of_study(runs):
    """Rows 2, 11, 26, 31 to 33, 35 and 38, from the runs of notebook 08."""
    masked, baseline = (compare.of_method(runs, method) for method in ("masked", "baseline"))
    best, stability = thesis_tables.of_chosen_width(masked), thesis_tables.stability(masked, baseline)
    by_width = masked.groupby(["sequence", "dilation_width"])[["rmse", "mae"]].mean()
    by_rmse, by_mae = (by_width[metric].groupby("sequence").idxmin() for metric in ("rmse", "mae"))
    dearer = by_width["rmse"].loc[by_mae].to_numpy() / by_width["rmse"].loc[by_rmse].to_numpy()
    widths = thesis_tables.best_widths(masked)["dilation_width"]
    measurements = [
        ratio("2", "best same", compare.ratios(best, baseline, "rmse"), metric="RMSE"),
        ratio("31", "mae chooses", dearer, metric="RMSE"),
        measurement("31", "other width", (by_rmse != by_mae).sum(), "sequences"),
        measurement("35", "widths", widths.isin(WIDTHS).sum(), "sequences"),
        ratio("2", "best other", stability["elsewhere"], metric="RMSE"),
        measurement("2", "same best", stability["same_best"], "%")]
    return _with_frames(measurements, runs) + measured(runs, "study")


def of_ablations(runs):
    """Rows 14 and 39, and what audit.json lists, from `ablations.measure`."""
    null = ablations.null_distribution(compare.of_method(runs, "baseline", "thesis"),
                                       pd.Series(REPORTED["table_4_2_rmse_percent_change"]))
    spread = compare.shuffle_spread(runs[runs["estimator"].isin(compare.ESTIMATORS)])
    measurements = [
        *(ratio("14", "spread", factors, metric="RMSE", estimator=estimator)
          for estimator, factors in spread.groupby("estimator")["factor"]),
        *(measurement("39", f"null {name}", null.loc[name, "expected"], "%", metric="RMSE",
                      low=null.loc[name, "low"], high=null.loc[name, "high"], n=ablations.STUDIES)
          for name in ("mean", "median")),
        measurement("39", "as low", null.loc["mean", "share_as_low"], "%", metric="RMSE")]
    return _with_frames(measurements, runs) + measured(runs, "ablations")
