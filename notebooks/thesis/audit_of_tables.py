"""What is measured for each row of the audit, from the thesis's numbers and from tables of runs.

Each function takes one table. A call in its list is one or more measurements for a row: its number,
what is measured, and the rows of the table that are compared.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from keypoint_study import comparisons, ratios
from thesis import section_4_2
from thesis.audit import CALLED, measurement, ratio, share
from thesis.reported import REPORTED
from thesis_repro.data.cityscapes import CLASS_WEIGHTS, ID, LABELS

# the thesis's changes in percent, one row a sequence
CHANGES = pd.DataFrame(
    {
        "RMSE": REPORTED["table_4_2_rmse_percent_change"],
        "MAE": REPORTED["table_4_3_mae_percent_change"],
    }
)
WIDTHS_TRIED = 15  # dilation widths of the thesis, of which the best is reported
WIDTHS = range(9, 12)  # the dilation widths that the thesis calls best
MANY = 500  # keypoints; more are not "a few hundred"
# row 47
TIME_TOGETHER = "change of the time of the odometry, all sequences together (Equation 4.2), mean of widths 9 to 11"
TIME_TYPICAL = "time of the odometry with masks over that with all keypoints, widths 9 to 11"
TIME_OF_NARROW = "time of the odometry with masks of the smallest width over that of the largest"
COMPARED = ("thesis", "refined")
JUDGED = ("se3", "rotation")
BOTH = ("rmse", "mean_keypoints")


def over(
    row: str,
    quantity: str,
    runs: pd.DataFrame,
    reference: pd.DataFrame,
    metrics: Iterable[str] = ("rmse",),
    estimators: Iterable[str] = COMPARED,
) -> list[dict[str, Any]]:
    """Return the ratios of runs to reference runs, one for each metric and estimator.

    The number of keypoints hardly depends on the estimator, so it has one ratio. estimators: [""]
    for a table without them.
    """
    lines = []
    for metric in (each for each in metrics if each in runs):
        for estimator in [""] if metric == "mean_keypoints" else estimators:
            by_sequence = ratios.ratios_of(of(runs, estimator), of(reference, estimator), metric)
            lines.append(
                ratio(row, quantity, by_sequence, metric=CALLED[metric], estimator=estimator)
            )
    return lines


def over_thesis(row: str, quantity: str, runs: pd.DataFrame, estimator: str) -> dict[str, Any]:
    """Return the ratio of an estimator's RMSE to that of the thesis's estimator."""
    by_street = ratios.ratios_of(of(runs, estimator), of(runs, "thesis"), "rmse")
    return ratio(row, quantity, by_street, metric=CALLED["rmse"], estimator=estimator)


def over_raw(quantity: str, runs: pd.DataFrame, metric: str) -> dict[str, Any]:
    """Return row 15's ratio of an error after an alignment to the RMSE of the same runs."""
    refined = of(runs, "refined")
    by_street = ratios.ratios_of(refined.assign(rmse=refined[metric]), refined, "rmse")
    return ratio("15", quantity, by_street, metric=CALLED["rmse"], estimator="refined")


def mean(
    row: str, quantity: str, runs: pd.DataFrame, column: str, unit: str, estimator: str
) -> dict[str, Any]:
    """Return the mean of a column over the sequences, for one estimator."""
    values = of(runs, estimator).groupby("sequence")[column].mean()
    if unit == "%":
        return share(row, quantity, values, metric="", estimator=estimator)
    return measurement(row, quantity, values, unit, metric="", estimator=estimator)


def of(runs: pd.DataFrame, estimator: str) -> pd.DataFrame:
    """Return the runs of an estimator; all for ""."""
    return runs[runs["estimator"] == estimator] if estimator else runs


def of_method(runs: pd.DataFrame, name: str, widths: Iterable[int | None] = ()) -> pd.DataFrame:
    """Return the runs of a method, and of some widths."""
    rows = runs[runs["method"] == name]
    return rows[rows["dilation_width"].isin(widths)] if widths else rows


def with_frames(measurements: list[dict[str, Any]], table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the measurements that have values, with the table's mean number of frames."""
    sequences = table.groupby("sequence")
    frames = sequences["frames"].first() if "frames" in table else sequences["frame"].nunique()
    mean = round(frames.mean())
    return [{**measurement, "frames": mean} for measurement in measurements if measurement["n"]]


def of_reported() -> list[dict[str, Any]]:
    """Return the rows that are arithmetic on numbers that the thesis reports."""
    best = pd.DataFrame(REPORTED["table_4_1"])
    keypoints = best["mean_keypoints"]
    factors = 2000 / keypoints
    classes = REPORTED["training"]["classes"]
    parameters = REPORTED["figure_a1_model_summary"]["rows"][-1]["params"]
    layers = pd.DataFrame(REPORTED["figure_a1_model_summary"]["rows"])
    normalisation = layers.loc[layers["layer"].str.startswith("batch_norm"), "params"].sum()
    best_widths = best["dilation_width"].isin(WIDTHS).sum()
    reduction = "reduction factor of keypoints"
    beyond = "images said to be augmented, beyond those of the training split"
    measurements = [
        *_of_changes("RMSE"),
        *_of_changes("MAE"),
        measurement("3", f"{reduction}, mean of Table 4.1", 2000 / keypoints.mean(), "ratio"),
        ratio("3", f"{reduction}, geometric mean over sequences", factors, geometric_mean=True),
        measurement(
            "3", "sequences with keypoints reduced 3 times or more", sum(factors >= 3), "sequences"
        ),
        measurement("9", "categories listed", len(LABELS)),
        measurement("9", "outputs of the network", classes),
        measurement("9", "parameters of one more output", parameters // classes),
        measurement("35", "sequences with a best width of 9 to 11", best_widths, "sequences"),
        measurement("60", "keypoints, means of Table 4.1", keypoints),
        measurement(
            "60", f"sequences with more than {MANY} keypoints", sum(keypoints > MANY), "sequences"
        ),
        measurement("18", "frames of 02 too few", 4661 - 4560, "frames"),
        measurement("18", "frames of 07 too few", 1101 - 1100, "frames"),
        measurement("45", "draws that end in an error, of 2381 (A.2.3)", 1),
        measurement("45", "draws that end in an error, of 501 (A.7.1)", 1),
        measurement("66", "IoU of the training above 0.5", -0.04),
        measurement("66", "IoU of the validation above 0.5", -0.15),
        measurement("69", "sequences of another size than 1226x370", 4, "sequences"),
        measurement("76", "parameters of batch normalisation in Figure A.1", normalisation),
        measurement("78", beyond, 5000 - 2975, "images"),
        measurement("89", "change of the MAE of 00", CHANGES["MAE"]["00"], "%"),
        measurement(
            "97", "largest change of the RMSE, up or down", _factor(CHANGES["RMSE"]), "ratio"
        ),
        measurement("101", "change of the MAE of 06", CHANGES["MAE"]["06"], "%"),
        measurement("101", "change of the RMSE of 06", CHANGES["RMSE"]["06"], "%"),
        *(
            measurement("103", f"weight of {name}", CLASS_WEIGHTS[ID[name]])
            for name in ("sidewalk", "sky")
        ),
        measurement("108", "images held out", 2975 - 2380, "images"),
        measurement("109", "distortion parameters that are not 0", 0),
    ]
    return [{**measurement, "data": "the thesis's numbers"} for measurement in measurements]


def _factor(changes: pd.Series) -> float:
    """Return the largest of some changes (%), up or down, as a factor above 1."""
    return float(np.exp(np.log1p(changes / 100).abs().max()))


def _of_changes(metric: str) -> list[dict[str, Any]]:
    """Return rows 1, 4 and 41 for one metric."""
    change = CHANGES[metric]
    by_sequence = 1 + change / 100
    larger, improved = (change > 0).sum(), (change < 0).sum()
    # the best of as many widths as there are is better by chance nearly always
    by_chance = WIDTHS_TRIED / (WIDTHS_TRIED + 1)
    sign_test = binomtest(int(improved), len(change), by_chance, alternative="less")
    on_average = "sequences improved on average if masks did nothing"
    probability = (
        "probability of no more improved sequences if masks did nothing, 15 independent widths"
    )
    of_ratios = ratio(
        "1", "geometric mean of the error ratios", by_sequence, geometric_mean=True, metric=metric
    )
    return [
        measurement("1", "sum of eleven percentages", change.sum(), "%", metric=metric),
        measurement("1", "mean of the percentages", change, "%", metric=metric),
        measurement("1", "median of the percentages", change.median(), "%", metric=metric),
        of_ratios,
        measurement("4", "sequences with a larger error", larger, "sequences", metric=metric),
        measurement("41", "sequences improved", improved, "sequences", metric=metric),
        measurement("41", on_average, len(change) * by_chance, "sequences", metric=metric),
        measurement("41", probability, 100 * sign_test.pvalue, "%", metric=metric),
    ]


def of_study(runs: pd.DataFrame, shuffled: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows that follow from the runs of notebook 08.

    shuffled: its repetitions of all keypoints, see `section_4_2.null_distribution`.
    """
    run = partial(of_method, runs)
    every, masks = run("baseline"), run("masked", [comparisons.tested_width(runs)])
    best = section_4_2.of_chosen_width(comparisons.of_method(runs, "masked"))
    nine_to_11, other_widths = run("masked", WIDTHS), run("masked", [*range(1, 9), *range(12, 16)])
    static, static_boundaries = run("static"), run("static-boundaries")
    few, corrected, true_maps = run("fewer"), run("corrected"), run("true-labels")
    over_20_m = ("translation_percent", "rotation_deg_per_100m")
    steps = ("in_turns", "on_straights")
    no_movable = "no keypoints on or near what can move, over all keypoints"
    steady = "label maps that do not fluctuate over predicted ones"
    measurements = [
        *_of_best_widths(runs, best, shuffled),
        *over(
            "15", "masks over all keypoints", masks, every, ("rmse", "se3", *over_20_m, "rotation")
        ),
        *over("36", "masks over all keypoints", masks, every, steps),
        *over("37", no_movable, static, every, BOTH),
        *over(
            "37", "boundaries of static classes alone, over masks", static_boundaries, masks, BOTH
        ),
        *over("50", "corrected masks over the thesis's", corrected, masks, BOTH),
        *over("50", "corrected masks over all keypoints", corrected, every, BOTH),
        *over("11", "exact boundaries over the thesis's masks", run("exact-boundaries"), masks),
        *over("26", "width 5 over width 10", run("masked", [5]), run("masked", [10]), BOTH),
        *over("33", "plainly reduced over all keypoints", run("reduced"), every),
        *over("33", "plainly reduced over masks of the best width", run("reduced"), best),
        *over("33", "as few of the strongest over masks", few, masks),
        *over("33", "as few spread out over masks", run("spread"), masks),
        *over("35", "widths 9 to 11 over the other widths", nine_to_11, other_widths),
        *over("38", steady, true_maps, masks),
    ]
    return with_frames(measurements, runs)


def _of_best_widths(
    runs: pd.DataFrame, best: pd.DataFrame, shuffled: pd.DataFrame
) -> list[dict[str, Any]]:
    """Return rows 2, 35 and 39. best: the runs with masks of each sequence's best width."""
    masked, every = comparisons.of_method(runs, "masked"), comparisons.of_method(runs, "baseline")
    stability = section_4_2.stability(masked, every)
    nine = section_4_2.best_widths(masked)["dilation_width"].isin(WIDTHS).sum()
    best_of = "masks of the best width over all keypoints"
    return [
        ratio("2", f"{best_of}, same runs", ratios.ratios_of(best, every, "rmse"), metric="RMSE"),
        measurement("35", "sequences with a best width of 9 to 11", nine, "sequences"),
        ratio("2", f"{best_of}, other repetitions", stability["elsewhere"], metric="RMSE"),
        share("2", "pairs of repetitions with the same best width", stability["same_best"]),
        *_of_null_distribution(shuffled, masked["dilation_width"].nunique()),
    ]


def _of_null_distribution(shuffled: pd.DataFrame, widths: int) -> list[dict[str, Any]]:
    """Return row 39."""
    studies = section_4_2.null_distribution(shuffled, widths, "rmse")
    measurements = []
    for name in ("mean", "median"):
        values = studies.agg(name, axis=1)
        low, high = section_4_2.middle(values)
        quantity = f"{name} change that the procedure reports if masks do nothing"
        row = measurement("39", quantity, values.mean(), "%", metric="RMSE")
        measurements.append({**row, "low": low, "high": high, "n": len(studies)})
    return measurements


def of_ablations(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows that follow from the runs of `audit_runs.run_ablations`."""
    run = partial(of_method, runs)
    every, masks, half = run("baseline"), run("masked"), run("turned-into")
    no_trees = "no keypoints on vegetation and terrain, over all keypoints"
    measurements = [
        *_of_shuffles(runs),
        *over("12", "symmetric dilation over the thesis's", run("symmetric"), masks, BOTH),
        over_thesis("13", "inliers vote over all points vote, all keypoints", every, "inliers"),
        over_thesis("13", "inliers vote over all points vote, masks", masks, "inliers"),
        over_raw("all keypoints, aligned over raw", every, "se3"),
        over_raw("all keypoints, aligned and scaled over raw", every, "sim3"),
        over_thesis("29", "refined over thesis's estimator, all keypoints", every, "refined"),
        over_thesis("29", "refined over thesis's estimator, masks", masks, "refined"),
        *(
            mean("29", "failed steps, all keypoints", every, "failed", "%", name)
            for name in COMPARED
        ),
        *(mean("29", "failed steps, masks", masks, "failed", "%", name) for name in COMPARED),
        *over("42", "dropped afterwards over detected inside the mask", run("filter"), masks, BOTH),
        *over("48", "ORB over Shi-Tomasi", run("orb"), every, BOTH),
        *over("55", "half turned into over all keypoints", half, every, ["in_turns"]),
        *over("55", "half turned into over the other half", half, run("turned-from"), ["in_turns"]),
        *_of_parallax("far keypoints left out (parallax below 1 pixel)", "parallax-1", runs),
        *_of_parallax("far keypoints left out (parallax below 3 pixels)", "parallax-3", runs),
        *_of_parallax(
            "near keypoints left out (parallax of 20 pixels or more)", "parallax-20", runs
        ),
        *over("59", "nine tenths of the keypoints over all", run("dropout"), every, BOTH),
        *over("70", no_trees, run("no-vegetation"), every, BOTH),
    ]
    return with_frames(measurements, runs)


def _of_shuffles(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows 14 and 97. Without a repetition there is no shuffled run."""
    if runs["repetition"].nunique() < 2:
        return []
    spread = ratios.range_of_shuffles(runs[runs["estimator"].isin(COMPARED)])
    text = "highest over lowest error of all keypoints, shuffled"
    lines = []
    for estimator, factors in spread.groupby("estimator")["factor"]:
        named = {"metric": "RMSE", "estimator": estimator}
        lines.append(ratio("14", text, factors, **named))
        lines.append(measurement("97", f"{text}, largest", factors.max(), "ratio", **named))
    return lines


def _of_parallax(text: str, name: str, runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return row 56 for the keypoints that one limit of the parallax leaves."""
    left, every = of_method(runs, name), of_method(runs, "baseline")
    as_many = of_method(runs, f"as many as {name}")
    return [
        *over("56", f"{text}, over all", left, every, ("mean_keypoints", *JUDGED)),
        *over("56", f"{text}, over as many at random", left, as_many, JUDGED),
    ]


SHARES = {  # column of a table: row of the audit, what is measured
    "lost": ("11", "boundary pixels lost"),
    "rim": ("65", "accuracy within a tenth of the frame's edges"),
    "inside": ("65", "accuracy further inside"),
    "thin 5/15": ("87", "boundary pixels of poles and signs with an edge, thresholds 5 and 15"),
    "thin 20/60": ("87", "boundary pixels of poles and signs with an edge, thresholds 20 and 60"),
    "thin 40/120": ("87", "boundary pixels of poles and signs with an edge, thresholds 40 and 120"),
    "small": ("86", "accuracy on poles, lights, signs and people"),
    "large": ("86", "accuracy on all other classes"),
    "dark": ("86", "accuracy on the road in shadow"),
    "lit": ("86", "accuracy on the rest of the road"),
}


def of_shares(shares: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows that are means of shares (%) of pixels, from a table with one row a frame."""
    if shares.empty:  # real frames have no exact label maps
        return []
    measurements = [
        mean(row, quantity, shares, column, "%", "")
        for column, (row, quantity) in SHARES.items()
        if column in shares
    ]
    return with_frames(measurements, shares)
