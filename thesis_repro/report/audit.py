"""The audit: where the thesis contradicts itself, its code or its libraries, and what each of these does, in numbers.

All words are in audit.json: the rows, the wording of each quantity, and the list of comparisons. The functions here
turn tables into measurements, one dictionary each; `table` joins them to the rows. Ratios are those of
`study.compare`; intervals are bootstrap intervals over what `n` counts.
"""

import json
from math import comb
from pathlib import Path

import numpy as np
import pandas as pd

from thesis_repro.cityscapes import LABELS
from thesis_repro.kitti import FRAME_COUNTS
from thesis_repro.report.captions import REPORTED
from thesis_repro.study import ablations, compare, thesis_tables

WORDS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))
WIDTHS = range(9, 12)  # that the thesis calls best
NUMBERS = ["quantity", "metric", "estimator", "value", "unit", "low", "high", "n", "frames", "data"]


def measurement(row, quantity, values, unit="", **more):
    """One measurement of a row: the mean of one value or several, their interval and number.

    quantity: of audit.json's "quantities". more: further columns (metric, estimator, frames, data).
    """
    values = np.asarray(values, float).ravel()
    values = values[~np.isnan(values)]
    low, high = compare.mean_interval(values)
    return {"row": row, "quantity": WORDS["quantities"][quantity], "value": values.mean() if len(values) else np.nan,
            "unit": unit, "low": low, "high": high, "n": len(values), **more}


def ratio(row, quantity, ratios, **more):
    """One measurement of a row: the geometric mean of one ratio a sequence."""
    result = compare.geometric_mean(ratios)
    return {"row": row, "quantity": WORDS["quantities"].get(quantity, quantity), "value": result["ratio"],
            "unit": "ratio", "low": result["low"], "high": result["high"], "n": result["n"], **more}


def table(measurements, data="this run"):
    """The audit for reading: the words of each row, then one line a measurement; words stand on the first line only.

    data: where measured numbers come from. Numbers are rounded, but never to 1 what is not 1: an
    interval that excludes 1 shows it. Raises ValueError for a measurement of no row.
    """
    by_row = {}
    for each in measurements:
        by_row.setdefault(each["row"], []).append(each)
    unknown = by_row.keys() - {row["row"] for row in WORDS["rows"]}
    if unknown:
        raise ValueError(f"measurements of no row of audit.json: {', '.join(sorted(unknown))}")
    lines = []
    for row in WORDS["rows"]:
        words = {"row": row["row"], "where": row["where"], "the thesis or its code": row["does"],
                 "what would be right": row["right"], "switch": row["switch"]}
        for index, each in enumerate(by_row.get(row["row"], [{}])):
            numbers = {"data": data, **each} if each else {}
            numbers |= {key: rounded(numbers[key]) for key in ("value", "low", "high") if key in numbers}
            lines.append((words if not index else dict.fromkeys(words, "") | {"row": row["row"]}) | {
                name: numbers.get(name, "" if name in ("quantity", "metric", "estimator", "unit", "data") else np.nan)
                for name in NUMBERS})
    return pd.DataFrame(lines).astype({"n": "Int64", "frames": "Int64"})


def rounded(value):
    """A number to four significant digits, or more where it would become 1."""
    digits = 4
    while digits < 9 and float(f"{value:.{digits}g}") == 1 != value:
        digits += 1
    return float(f"{value:.{digits}g}")


def missing(audit):
    """Rows of a table that could be measured and have no measurement."""
    of_words = {row["row"] for row in WORDS["rows"] if row["switch"].startswith(("none, a description", "not "))}
    return [row for row in audit.loc[audit["quantity"] == "", "row"] if row not in of_words]


def comparisons(runs, kind):
    """The comparisons of audit.json between parts of a table of runs.

    kind: "ablations" (`ablations.measure`), "study" (`runner.run`) or "tracks" (`ablations.tracks`).
    """
    measurements = []
    for spec in WORDS["comparisons"]:
        if spec["runs"] != kind:
            continue
        own, other = (_arm(runs, spec[key], spec.get(widths)) for key, widths in
                      (("method", "widths"), ("reference", "reference_widths")))
        pairs = [spec["estimators"]] if "estimators" in spec else [(name, name) for name in compare.ESTIMATORS]
        for metric in spec["metrics"]:
            for estimators in pairs if metric != "mean_keypoints" and kind != "tracks" else [(None, None)]:
                rows, reference = (table if name is None else table[table["estimator"] == name]
                                   for table, name in zip((own, other), estimators, strict=True))
                ratios = compare.ratios(rows, reference, metric) if metric in runs else []
                if len(ratios):
                    measurements.append(ratio(spec["row"], spec["quantity"], ratios, estimator=estimators[0] or "",
                                              metric=WORDS["metrics"][metric]))
    return measurements


def _arm(runs, method, widths):
    rows = runs[runs["method"] == method]
    if widths == "best":
        return thesis_tables.of_chosen_width(runs)
    if widths == "tested":
        widths = [compare.tested_width(runs)]
    return rows if widths is None else rows[rows["dilation_width"].isin(widths)]


def of_tables():
    """Rows 1, 3, 4, 9, 18, 35, 41, 45, 60, 66 and 69: arithmetic on the thesis's own numbers."""
    measurements = []
    for name, key in (("RMSE", "table_4_2_rmse_percent_change"), ("MAE", "table_4_3_mae_percent_change")):
        change = pd.Series(REPORTED[key])
        improved, count = int((change < 0).sum()), len(change)
        as_many = sum(comb(count, k) for k in range(improved, count + 1)) / 2**count
        measurements += [measurement("1", "sum", change.sum(), "%", metric=name),
                         measurement("1", "mean", change, "%", metric=name),
                         measurement("1", "median", change.median(), "%", metric=name),
                         ratio("1", "ratio", 1 + change / 100, metric=name),
                         measurement("4", "larger", (change > 0).sum(), "sequences", metric=name),
                         measurement("41", "improved", improved, "sequences", metric=name),
                         measurement("41", "sign", 100 * as_many, "%", metric=name)]
    best = pd.DataFrame(REPORTED["table_4_1"])
    parameters = REPORTED["figure_a1_model_summary"]["rows"][-1]["params"]
    measurements += [
        measurement("3", "reduction", 2000 / best["mean_keypoints"].mean(), "ratio"),
        measurement("3", "reduction of each", 2000 / best["mean_keypoints"], "ratio"),
        measurement("3", "three", (2000 / best["mean_keypoints"] >= 3).sum(), "sequences"),
        measurement("9", "categories", len(LABELS)), measurement("9", "outputs", REPORTED["training"]["classes"]),
        measurement("9", "parameters", parameters // REPORTED["training"]["classes"]),
        measurement("18", "frames 02", FRAME_COUNTS["02"] - 4560, "frames"),
        measurement("18", "frames 07", FRAME_COUNTS["07"] - 1100, "frames"),
        measurement("35", "widths", best["dilation_width"].isin(WIDTHS).sum(), "sequences"),
        measurement("45", "draws", 1), measurement("60", "keypoints", best["mean_keypoints"]),
        measurement("66", "iou train", 0.46 - 0.5), measurement("66", "iou validation", 0.35 - 0.5),
        measurement("69", "other size", 4, "sequences")]  # 00 to 03
    return [{**each, "data": "the thesis's numbers"} for each in measurements]


def of_study(runs):
    """Rows 2, 11, 26, 31 to 33, 35 and 38, from the runs of notebook 08."""
    best, stability = thesis_tables.of_chosen_width(runs), thesis_tables.stability(runs).dropna()
    by_width = compare.of_method(runs, "masked").groupby(["sequence", "dilation_width"])[["rmse", "mae"]].mean()
    chosen = {metric: by_width[metric].groupby("sequence").idxmin() for metric in ("rmse", "mae")}
    errors = {metric: by_width["rmse"].loc[keys].to_numpy() for metric, keys in chosen.items()}
    widths = chosen["rmse"].map(lambda key: key[1])
    of_best = compare.ratios(best, compare.of_method(runs, "baseline"), "rmse")
    measurements = [
        ratio("31", "mae chooses", errors["mae"] / errors["rmse"], metric="RMSE"),
        measurement("31", "other width", (chosen["rmse"] != chosen["mae"]).sum(), "sequences"),
        measurement("35", "widths", widths.isin(WIDTHS).sum(), "sequences")]
    if len(stability):
        measurements += [ratio("2", "best same", of_best, metric="RMSE"),
                         ratio("2", "best other", stability["elsewhere"], metric="RMSE"),
                         measurement("2", "same best", stability["same_best"], "%")]
    frames = round(runs.groupby("sequence")["frames"].first().mean())
    return [{"frames": frames, **each} for each in [*measurements, *comparisons(runs, "study")]]


def of_ablations(runs):
    """Rows 10, 12 to 15, 28 to 30, 34, 36, 37, 39, 40, 42, 48, 50, 59 and 70, from `ablations.measure`."""
    measurements = comparisons(runs, "ablations")
    for estimator in compare.ESTIMATORS:
        spread = compare.shuffle_spread(runs[runs["estimator"] == estimator])
        measurements.append(ratio("14", "spread", spread["factor"], metric="RMSE", estimator=estimator))
        for row, quantity, method in (("29", "failed all", "baseline"), ("29", "failed masks", "masked"),
                                      ("34", "failed few", "strongest-100")):
            failed = compare.of_method(runs, method, estimator).groupby("sequence")["failed"].mean()
            measurements.append(measurement(row, quantity, failed, "%", estimator=estimator))
    errors = compare.of_method(runs, "baseline", "refined").groupby("sequence")[
        ["rmse", "se3", "sim3", "across", "down"]].mean()
    for quantity, column in (("aligned", "se3"), ("scaled", "sim3")):
        measurements.append(ratio("15", quantity, errors[column] / errors["rmse"], metric="RMSE", estimator="refined"))
    measurements += [measurement("30", column, errors[column], "degrees", estimator="refined")
                     for column in ("across", "down")]
    reported = pd.Series(REPORTED["table_4_2_rmse_percent_change"])
    null = ablations.null_distribution(compare.of_method(runs, "baseline", "thesis"), reported)
    measurements += [{**measurement("39", f"null {name}", null.loc[name, "expected"], "%", metric="RMSE"),
                      "low": null.loc[name, "low"], "high": null.loc[name, "high"], "n": ablations.STUDIES}
                     for name in ("mean", "median")]
    measurements.append(measurement("39", "as low", null.loc["mean", "share_as_low"], "%", metric="RMSE"))
    frames = round(runs.groupby("sequence")["frames"].first().mean())
    return [{"frames": frames, **each} for each in measurements]


def of_boresight(explained):
    """Row 30: the mounting angle, and the RMSE with it removed over the raw one (`boresight.explained`)."""
    return [*(measurement("30", angle, explained[angle], "degrees", estimator="refined")
              for angle in ("pitch", "yaw")),
            *(ratio("30", quantity, explained[column] / explained["rmse"], metric="RMSE", estimator="refined")
              for quantity, column in (("own angle", "rmse_own"), ("day angle", "rmse_others")))]


def of_boundaries(shares):
    """Rows 10 and 11, from a table of `ablations.boundaries`, one row a label map."""
    return [measurement("10", "invented", shares["invented"], "%"), measurement("11", "lost", shares["lost"], "%"),
            *(measurement("11", f"lost {name}", shares[name], "%") for name in shares
              if "/" in name and shares[name].notna().any())]


def of_time(seconds, measured):
    """Rows 16, 47 and 49, from the tables of `timing.time_runs` and `timing.measure`."""
    savings = thesis_tables.time_savings(seconds)
    near = savings[savings.index.isin(WIDTHS)]
    stages = measured.pivot(index="stage", columns="method", values="milliseconds").fillna(0)
    plain, masked = sorted(stages, key=lambda name: name.startswith("masked"))
    return [measurement("47", "saved", near if len(near) else savings, "%"),
            measurement("16", "whole frame", stages[masked].sum() / stages[plain].sum(), "ratio"),
            *(measurement("49", "stage", value, "ms", metric=stage) for stage, value in stages[masked].items())]


def of_trials(trials):
    """Rows 5, 21, 22 and 27, from the table of `ablations_training.trials`; n counts seeds."""
    rows = {"corrected blocks": "5", "divided by 255": "21", "noise of today": "22", "person weight 1": "27"}
    scores = trials.pivot(index="seed", columns="method", values="mean_iou")
    return [measurement(row, "trial", scores[method] - scores["thesis"], "IoU", metric=method)
            for method, row in rows.items()]
