"""The numbers of the audit that notebook 09 does not show live.

They come from what the thesis reports, from the runs of notebook 08, from ablations, from label
maps and from tables of earlier notebooks. Ratios are those of `keypoint_study.ratios`.
"""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from keypoint_study import comparisons, ratios
from keypoint_study.jobs import Job, repeated, runs_of
from keypoint_study.methods import ABLATION, of_group
from keypoint_study.runner import run_all, run_poses
from keypoint_study.sources import Source
from thesis import REPORTED, artefacts, audit, map_quality, tables, timing
from thesis.audit import CHANGES, WIDTHS, measurement, ratio, share
from thesis.run_settings import Settings
from thesis_repro.data.cityscapes import CLASS_WEIGHTS, ID, LABELS
from thesis_repro.data.sequence import Sequence
from thesis_repro.odometry import metrics

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
WIDTHS_TRIED = 15  # dilation widths of the thesis, of which the best is reported
COMPARED = ("thesis", "refined")
BOTH = ("rmse", "mean_keypoints")
UNMASKED = "all keypoints"  # in the table of times


def over(
    row: str,
    key: str,
    runs: pd.DataFrame,
    reference: pd.DataFrame,
    errors: Iterable[str] = ("rmse",),
) -> list[dict[str, Any]]:
    """Return the ratios of runs to reference runs, one for each error and estimator.

    The number of keypoints hardly depends on the estimator, so it has one ratio.
    """
    lines = []
    for error in errors:
        if error not in runs:
            continue
        for estimator in [""] if error == "mean_keypoints" else COMPARED:
            chosen, other = of_estimator(runs, estimator), of_estimator(reference, estimator)
            by_sequence = ratios.ratios_of(chosen, other, error)
            line = ratio(row, key, by_sequence, metric=CALLED[error], estimator=estimator)
            lines.append(line)
    return lines


def over_thesis(row: str, key: str, runs: pd.DataFrame, estimator: str) -> dict[str, Any]:
    """Return the ratio of an estimator's RMSE to that of the thesis's estimator."""
    thesis, other = of_estimator(runs, "thesis"), of_estimator(runs, estimator)
    by_sequence = ratios.ratios_of(other, thesis, "rmse")
    return ratio(row, key, by_sequence, metric="RMSE", estimator=estimator)


def mean_share(
    row: str, key: str, table: pd.DataFrame, column: str, estimator: str
) -> dict[str, Any]:
    """Return the mean of a column of shares (%) over the sequences, for one estimator."""
    values = of_estimator(table, estimator).groupby("sequence")[column].mean()
    return share(row, key, values, metric="", estimator=estimator)


def of_estimator(runs: pd.DataFrame, estimator: str) -> pd.DataFrame:
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
    return [{**each, "frames": mean} for each in measurements if each["n"]]


# Arithmetic on what the thesis reports


def of_the_thesis() -> list[dict[str, Any]]:
    """Return the rows that are arithmetic on numbers that the thesis reports."""
    best = pd.DataFrame(REPORTED["table_4_1"])
    keypoints = best["mean_keypoints"]
    factors = 2000 / keypoints
    classes = REPORTED["training"]["classes"]
    layers = pd.DataFrame(REPORTED["figure_a1_model_summary"]["rows"])
    one_more = layers["params"].iloc[-1] // classes
    normalisation = layers.loc[layers["layer"].str.startswith("batch_norm"), "params"].sum()
    best_widths = best["dilation_width"].isin(WIDTHS).sum()
    largest_change = np.exp(np.log1p(CHANGES["RMSE"] / 100).abs().max())
    measurements = [
        *_of_changes("RMSE"),
        *_of_changes("MAE"),
        measurement("3", "of the mean", 2000 / keypoints.mean(), "ratio"),
        ratio("3", "ratio", factors, geometric_mean=True),
        measurement("3", "three times", sum(factors >= 3), "sequences"),
        measurement("9", "listed", len(LABELS)),
        measurement("9", "outputs", classes),
        measurement("9", "one more", one_more),
        measurement("35", "best", best_widths, "sequences"),
        measurement("60", "keypoints", keypoints),
        measurement("60", "many", sum(keypoints > 500), "sequences"),
        measurement("18", "02", 4661 - 4560, "frames"),
        measurement("18", "07", 1101 - 1100, "frames"),
        measurement("45", "2381", 1),
        measurement("45", "501", 1),
        measurement("66", "training", -0.04),
        measurement("66", "validation", -0.15),
        measurement("69", "sizes", 4, "sequences"),
        measurement("76", "normalisation", normalisation),
        measurement("78", "beyond", 5000 - 2975, "images"),
        measurement("89", "00", CHANGES["MAE"]["00"], "%"),
        measurement("97", "change", largest_change, "ratio"),
        measurement("101", "MAE", CHANGES["MAE"]["06"], "%"),
        measurement("101", "RMSE", CHANGES["RMSE"]["06"], "%"),
        measurement("103", "sidewalk", CLASS_WEIGHTS[ID["sidewalk"]]),
        measurement("103", "sky", CLASS_WEIGHTS[ID["sky"]]),
        measurement("108", "held out", 2975 - 2380, "images"),
        measurement("109", "not 0", 0),
    ]
    return [{**each, "data": "the thesis's numbers"} for each in measurements]


def _of_changes(metric: str) -> list[dict[str, Any]]:
    """Return rows 1, 4 and 41 for one metric."""
    change = CHANGES[metric]
    larger, improved = (change > 0).sum(), (change < 0).sum()
    # the best of as many widths as there are is better by chance nearly always
    by_chance = WIDTHS_TRIED / (WIDTHS_TRIED + 1)
    sign_test = binomtest(int(improved), len(change), by_chance, alternative="less")
    return [
        measurement("1", "sum", change.sum(), "%", metric=metric),
        measurement("1", "mean", change, "%", metric=metric),
        measurement("1", "median", change.median(), "%", metric=metric),
        ratio("1", "ratio", 1 + change / 100, geometric_mean=True, metric=metric),
        measurement("4", "larger", larger, "sequences", metric=metric),
        measurement("41", "improved", improved, "sequences", metric=metric),
        measurement("41", "by chance", len(change) * by_chance, "sequences", metric=metric),
        measurement("41", "probability", 100 * sign_test.pvalue, "%", metric=metric),
    ]


# The runs of notebook 08


def of_study(runs: pd.DataFrame, shuffled: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows that follow from the runs of notebook 08.

    shuffled: its repetitions of all keypoints, see `tables.null_distribution`.
    """
    run = partial(of_method, runs)
    every, masks = run("baseline"), run("masked", [comparisons.tested_width(runs)])
    best = tables.of_chosen_width(comparisons.of_method(runs, "masked"))
    other_widths = [*range(1, 9), *range(12, 16)]
    corrected = run("corrected")
    over_20_m = ("translation_percent", "rotation_deg_per_100m")
    measurements = [
        *_of_best_widths(runs, best, shuffled),
        *over("15", "masks", masks, every, ("rmse", "se3", *over_20_m, "rotation")),
        *over("36", "masks", masks, every, ("in_turns", "on_straights")),
        *over("37", "static", run("static"), every, BOTH),
        *over("37", "boundaries", run("static-boundaries"), masks, BOTH),
        *over("50", "over masks", corrected, masks, BOTH),
        *over("50", "over all", corrected, every, BOTH),
        *over("11", "exact", run("exact-boundaries"), masks),
        *over("26", "narrow", run("masked", [5]), run("masked", [10]), BOTH),
        *over("33", "reduced", run("reduced"), every),
        *over("33", "over best", run("reduced"), best),
        *over("33", "strongest", run("fewer"), masks),
        *over("33", "spread", run("spread"), masks),
        *over("35", "9 to 11", run("masked", WIDTHS), run("masked", other_widths)),
        *over("38", "steady", run("true-labels"), masks),
    ]
    return with_frames(measurements, runs)


def _of_best_widths(
    runs: pd.DataFrame, best: pd.DataFrame, shuffled: pd.DataFrame
) -> list[dict[str, Any]]:
    """Return rows 2, 35 and 39. best: the runs with masks of each sequence's best width."""
    masked, every = comparisons.of_method(runs, "masked"), comparisons.of_method(runs, "baseline")
    stability = tables.stability(masked, every)
    nine_to_11 = tables.best_widths(masked)["dilation_width"].isin(WIDTHS).sum()
    lines = [
        ratio("2", "same runs", ratios.ratios_of(best, every, "rmse"), metric="RMSE"),
        measurement("35", "best", nine_to_11, "sequences"),
        ratio("2", "other repetitions", stability["elsewhere"], metric="RMSE"),
        share("2", "same best", stability["same_best"]),
    ]
    studies = tables.null_distribution(shuffled, masked["dilation_width"].nunique(), "rmse")
    for name in ("mean", "median"):
        values = studies.agg(name, axis=1)
        low, high = tables.middle(values)
        line = measurement("39", name, values.mean(), "%", metric="RMSE")
        lines.append({**line, "low": low, "high": high, "n": len(studies)})
    return lines


# Ablations: every run differs from a reference run in one setting


def run_ablations(
    sequences: list[Sequence], labels: Path, folder: Path, repetitions: int = 1, processes: int = 1
) -> pd.DataFrame:
    """Run the ablations of `methods.METHODS` on every sequence.

    labels: a folder with one folder of label maps a sequence. folder: for the results. The
    estimator "inliers" is run for all keypoints and masks alone.
    Columns: sequence, method, estimator, repetition, those of `runner.run_all`, and sim3 (RMSE in
    metres after an alignment with scale).
    """
    methods = ["baseline", "masked", *of_group(ABLATION)]
    named = [Job(sequence.name, method) for sequence in sequences for method in methods]
    jobs = [
        job
        for job in repeated(named, ("thesis", "inliers", "refined"), repetitions)
        if job.estimator != "inliers" or job.method in ("baseline", "masked")
    ]
    table = run_all(runs_of(jobs, sequences, [Source(labels)]), folder, processes=processes).table
    poses = run_poses(table, folder)
    true = {sequence.name: sequence.poses for sequence in sequences}
    pairs = zip(table["sequence"], table["run"])
    table["sim3"] = [metrics.ate(poses[name, run], true[name], "sim3") for name, run in pairs]
    return table


def of_ablations(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows that follow from the runs of `run_ablations`."""
    run = partial(of_method, runs)
    every, masks, half = run("baseline"), run("masked"), run("turned-into")
    measurements = [
        *_of_shuffles(runs),
        *over("12", "symmetric", run("symmetric"), masks, BOTH),
        over_thesis("13", "all", every, "inliers"),
        over_thesis("13", "masks", masks, "inliers"),
        _over_raw("aligned", every, "se3"),
        _over_raw("scaled", every, "sim3"),
        over_thesis("29", "all", every, "refined"),
        over_thesis("29", "masks", masks, "refined"),
        *(mean_share("29", "failed, all", every, "failed", each) for each in COMPARED),
        *(mean_share("29", "failed, masks", masks, "failed", each) for each in COMPARED),
        *over("42", "filtered", run("filter"), masks, BOTH),
        *over("48", "orb", run("orb"), every, BOTH),
        *over("55", "over all", half, every, ["in_turns"]),
        *over("55", "over other", half, run("turned-from"), ["in_turns"]),
        *over("59", "dropout", run("dropout"), every, BOTH),
        *over("70", "vegetation", run("no-vegetation"), every, BOTH),
    ]
    for name in ("parallax-1", "parallax-3", "parallax-20"):
        left, drawn = run(name), run(f"as many as {name}")
        measurements += over("56", name, left, every, ("mean_keypoints", "se3", "rotation"))
        measurements += over("56", f"as many as {name}", left, drawn, ("se3", "rotation"))
    return with_frames(measurements, runs)


def _over_raw(key: str, runs: pd.DataFrame, error: str) -> dict[str, Any]:
    """Return row 15's ratio of an error after an alignment to the RMSE of the same runs."""
    refined = of_estimator(runs, "refined")
    by_sequence = ratios.ratios_of(refined.assign(rmse=refined[error]), refined, "rmse")
    return ratio("15", key, by_sequence, metric="RMSE", estimator="refined")


def _of_shuffles(runs: pd.DataFrame) -> list[dict[str, Any]]:
    """Return rows 14 and 97. Without a repetition there is no shuffled run."""
    if runs["repetition"].nunique() < 2:
        return []
    spread = ratios.range_of_shuffles(runs[runs["estimator"].isin(COMPARED)])
    lines = []
    for estimator, factors in spread.groupby("estimator")["factor"]:
        named = {"metric": "RMSE", "estimator": estimator}
        lines.append(ratio("14", "shuffled", factors, **named))
        lines.append(measurement("97", "shuffled", factors.max(), "ratio", **named))
    return lines


# All that notebook 09 does not measure live


def measurements_of_run(
    settings: Settings, sequences: list[Sequence], repetitions: int, frames: int
) -> list[dict[str, Any]]:
    """Return the measurements of all rows that are not live, for `audit_table`.

    sequences: of the ablations. repetitions: of each ablation. frames: of each sequence,
    whose boundaries are measured. Writes ablations.csv. Rows of notebooks that were not run have no
    numbers.
    """
    labels = artefacts.label_maps()
    ablated = run_ablations(sequences, labels, settings.build / "audit", repetitions, settings.jobs)
    artefacts.write_text("ablations.csv", ablated.to_csv(index=False))
    return [
        *of_shares(map_quality.boundaries(sequences, labels, frames)),
        *of_ablations(ablated),
        *of_shares(map_quality.right_pixels(settings, sequences, labels)),
        *of_earlier_notebooks(settings, len(sequences)),
    ]


SHARES = {  # column of the tables of `map_quality`, and key: row of the audit
    "lost": "11",
    "rim": "65",
    "inside": "65",
    "thin 5/15": "87",
    "thin 20/60": "87",
    "thin 40/120": "87",
    "small": "86",
    "large": "86",
    "dark": "86",
    "lit": "86",
}


def of_shares(shares: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows that are means of shares (%) of pixels, from a table with one row a frame."""
    if shares.empty:  # real frames have no exact label maps
        return []
    columns = [column for column in SHARES if column in shares]
    lines = [mean_share(SHARES[column], column, shares, column, "") for column in columns]
    return with_frames(lines, shares)


def of_earlier_notebooks(settings: Settings, count: int) -> list[dict[str, Any]]:
    """Return the rows of the tables that notebooks 05, 06 and 08 wrote. count: of the sequences.

    Says which rows have no numbers because a notebook was not run.
    """
    measurements: list[dict[str, Any]] = []
    if (settings.build / "shuffled_runs.csv").is_file():
        measurements += of_study(*artefacts.results()[:2])
        measurements += of_times(settings)
    else:
        print("notebook 8 was not run, so rows that need its runs have no number")
    path = settings.build / "found_again.csv"
    found_again = pd.read_csv(path) if path.is_file() else pd.DataFrame()
    for _, kind, _, lost in found_again.itertuples():
        measurements.append(measurement("73", "lost", lost, "%", metric=kind))
    quality = map_quality.label_map_quality(settings.build)
    for row in (
        quality[quality["domain"] == map_quality.DRIVES].itertuples() if len(quality) else ()
    ):
        recall, frames = 100 * row.sky_recall, round(row.images / count)
        measurements.append(measurement("46", "sky", recall, "%", frames=frames))
    return measurements


def of_times(settings: Settings) -> list[dict[str, Any]]:
    """Return rows 16 and 47, from the times that notebook 08 shows."""
    seconds, stages = (timing.times(settings, name) for name in ("seconds", "budget"))
    timed_on: dict[str, Any] = {"data": timing.told(seconds)}
    measurements = []
    for threads, timed in seconds.groupby("threads"):
        saved = timing.time_savings(timed).squeeze(axis=1)  # one row a width
        of_each = {name: timing.time_savings(rows) for name, rows in timed.groupby("sequence")}
        over_all = 1 + pd.concat(of_each, axis=1) / 100
        narrow = over_all.iloc[0] / over_all.iloc[-1]
        typical = over_all.reindex(WIDTHS).mean()
        lines = [
            measurement("47", "together", saved.reindex(WIDTHS).mean(), "%", **timed_on),
            ratio("47", "typical", typical, **timed_on),
            ratio("47", "narrow", narrow, **timed_on),
        ]
        for line in lines:
            line["quantity"] = audit.on(line["quantity"], threads)
        measurements += lines
    totals = stages.groupby("method")["milliseconds"].sum()
    whole = totals.drop(UNMASKED) / totals[UNMASKED]
    timed_on = {"data": timing.told(stages)}
    return [*measurements, measurement("16", "network", whole, "ratio", **timed_on)]
