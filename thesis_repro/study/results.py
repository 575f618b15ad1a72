"""What the odometry runs of chapter 4 amount to: tables in, tables out.

`summary` is the table that `runner.run` returns: one row a run, with sequence, method, dilation_width, estimator,
repetition, the errors of `metrics.errors`, mean_keypoints. A change is always Equation 4.1, in percent, of means over
the repetitions, from all keypoints under the same estimator; negative is better. Where masks come from several sources, all
but the last functions take the runs `of_source`.
"""

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from thesis_repro import InputError
from thesis_repro.odometry.metrics import RELATIVE_LENGTH, percent_change
from thesis_repro.study.controls import MASKS
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS

CONTROLS = {  # what the runs at one width are called, in the order in which they are shown
    "masked": "segmentation mask",
    "exact-boundaries": "exact class boundaries",
    "corrected": "corrected mask",
    "true-labels": "true label maps",
    "other-frame": "mask of another frame",
    "mirrored": "mirrored mask",
    "random-lines": "random lines",
    "image-edges": "edges of the image",
    "fewer": "fewer keypoints",
    "spread": "keypoints spread out",
}
ERRORS = ("rmse", "mae")  # that the thesis reports
BESIDE = {"se3": "aligned ATE",  # and others, which no constant angle between camera and truth moves
          "translation_percent": f"translation over {RELATIVE_LENGTH:g} m",
          "rotation_deg_per_m": f"rotation over {RELATIVE_LENGTH:g} m"}
DIGITS = dict.fromkeys((*ERRORS, *BESIDE), 6) | {"mean_keypoints": 1}  # of a table of runs
FEWEST = 3  # sequences for an interval
LEVEL = 95  # percent
DRAWS = 10_000


def main_estimator(summary: pd.DataFrame) -> str:
    """The estimator that widths are judged under: the thesis's where it was run, else the refined one."""
    return next((estimator for estimator in ESTIMATORS if (summary["estimator"] == estimator).any()), next(iter(ESTIMATORS)))


def of_method(summary: pd.DataFrame, method: str, estimator: str | None = None, width: int | None = None) -> pd.DataFrame:
    """The rows of one method under one estimator (`main_estimator` for None), of one dilation width where it is given."""
    rows = summary[(summary["method"] == method) & (summary["estimator"] == (estimator or main_estimator(summary)))]
    return rows if width is None else rows[rows["dilation_width"] == width]


def of_best_width(summary: pd.DataFrame) -> pd.DataFrame:
    """The thesis's masked runs: the rows of each sequence's best width (`best_widths`)."""
    rows = of_method(summary, "masked")
    best = best_widths(summary)["dilation_width"]
    return rows[rows["dilation_width"] == rows["sequence"].map(best)]


def over_orders(rows: pd.DataFrame, column: str, by: str = "sequence") -> pd.DataFrame:
    """Mean, lowest and highest of a column over the repetitions: a table with one row for each value of `by`."""
    return rows.groupby(by)[column].agg(["mean", "min", "max"]).set_axis(["mean", "lowest", "highest"], axis=1)


def interval(changes: ArrayLike) -> tuple[float, float]:
    """Bootstrap interval (low, high) of the mean of one value a sequence, whole sequences being drawn anew.

    The values are changes or differences within a sequence, so the comparison is paired. NaN values are left out.
    (NaN, NaN) for fewer than three sequences, where drawing anew says nothing.
    """
    values = np.asarray(changes, float)
    values = values[~np.isnan(values)]
    if len(values) < FEWEST:
        return np.nan, np.nan
    drawn = np.random.default_rng(0).integers(0, len(values), (DRAWS, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), [(100 - LEVEL) / 2, (100 + LEVEL) / 2])
    return float(low), float(high)


# The choice of width


def best_widths(summary: pd.DataFrame) -> pd.DataFrame:
    """The width with the lowest RMSE of each sequence (Section 4.2, Table 4.1), and its means.

    One row a sequence: dilation_width, frames, rmse, mae, mean_keypoints, means over the repetitions.
    The thesis says "the lowest RMSE and/or MAE" (audit row 31), which leaves open which of the two decides.
    The width is chosen by its error on the very sequence it is then judged on: a best of 15, not a test.
    """
    masked = of_method(summary, "masked")
    means = masked.groupby(["sequence", "dilation_width"])[["frames", "rmse", "mae", "mean_keypoints"]].mean()
    best = means.loc[means.groupby("sequence")["rmse"].idxmin()].reset_index("dilation_width")
    return best.astype({"dilation_width": int, "frames": int}).sort_index()


def width_changes(summary: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Change of the metric (%) with masks: one row a sequence, one column a dilation width."""
    masked = of_method(summary, "masked").groupby(["sequence", "dilation_width"])[metric].mean().unstack()
    return percent_change(masked.T, _baseline(summary, metric)).T.reindex(masked.index)


def _baseline(summary: pd.DataFrame, metric: str, estimator: str | None = None) -> pd.Series:
    return of_method(summary, "baseline", estimator).groupby("sequence")[metric].mean()


def chosen_widths(summary: pd.DataFrame) -> pd.DataFrame:
    """The dilation width of each sequence, chosen in three ways, always by RMSE.

    best: the lowest error on the sequence itself (`best_widths`). fixed: the lowest mean change over all sequences.
    left_out: the lowest mean change over the other sequences, so that no sequence judges a width that it chose;
    missing where there is no other. The choices hang together, so that `interval` of what they give is too narrow:
    where masks do nothing, it excludes zero in one of three studies of eleven sequences and fifteen widths.
    """
    changes = width_changes(summary, "rmse")
    return pd.DataFrame({
        "best": best_widths(summary)["dilation_width"].reindex(changes.index),
        "left_out": [_lowest(changes.drop(index=name)) for name in changes.index],
        "fixed": _lowest(changes),
    }, index=changes.index).astype("Int64")


def _lowest(changes: pd.DataFrame) -> Any:
    """The width with the lowest mean change; only widths that every sequence has are compared."""
    changes = changes.dropna(how="all").dropna(axis=1)
    return changes.mean().idxmin() if changes.size else pd.NA


def widths(summary: pd.DataFrame) -> pd.DataFrame:
    """What each choice of width gives: one row a sequence.

    Columns best, left_out, fixed (widths); the changes of all errors at each, such as left_out_rmse; and how far
    the best width is chance (`stability`): same_best, elsewhere.
    """
    chosen = chosen_widths(summary)
    table = chosen.copy()
    for metric in (*ERRORS, *BESIDE):
        changes = width_changes(summary, metric)
        for choice in chosen:
            table[f"{choice}_{metric}"] = [np.nan if pd.isna(width) else changes.loc[name, width]
                                           for name, width in chosen[choice].items()]
    return table.join(stability(summary))


def stability(summary: pd.DataFrame) -> pd.DataFrame:
    """Whether the width that is best in one repetition is so in another: one row a sequence.

    same_best: percent of the pairs of repetitions that agree on the best width.
    elsewhere: the change of RMSE (%) in the other repetitions with the width that is best in one, on average.
    NaN with one repetition.
    """
    baseline, rows = _baseline(summary, "rmse"), {}
    for name, runs in of_method(summary, "masked").groupby("sequence"):
        errors = runs.pivot(index="repetition", columns="dilation_width", values="rmse").dropna(axis=1)
        count = len(errors)
        if count < 2 or errors.empty:
            rows[name] = (np.nan, np.nan)
            continue
        best = errors.to_numpy().argmin(axis=1)
        agreeing = (best[:, None] == best).sum() - count
        others = ((errors.sum() - errors) / (count - 1)).to_numpy()
        rows[name] = (agreeing / (count * (count - 1)) * 100,
                      percent_change(others[np.arange(count), best].mean(), baseline.get(name, np.nan)))
    return pd.DataFrame.from_dict(rows, orient="index", columns=["same_best", "elsewhere"])


# The controls


def tested_width(summary: pd.DataFrame) -> int | None:
    """The width at which masks are put to the test: that of the controls, or the only one that there is.

    CONTROL_WIDTH where neither says it; None for masks that came ready made. Raises InputError where the controls have
    several widths.
    """
    masked = summary.loc[summary["method"] == "masked", "dilation_width"]
    if len(masked) and masked.isna().all():
        return None
    found = summary.loc[summary["method"].isin(MASKS), "dilation_width"].unique()
    if len(found) > 1:
        raise InputError(f"controls of the widths {', '.join(f'{width:g}' for width in sorted(found))}; masks are put "
                         "to the test at one width, so list the controls of one")
    if not len(found) and masked.nunique() == 1:
        found = masked.unique()
    return int(found[0]) if len(found) else CONTROL_WIDTH


def control_names(summary: pd.DataFrame) -> dict[str, str]:
    """CONTROLS, the masks with their width."""
    width = tested_width(summary)
    return CONTROLS if width is None else CONTROLS | {"masked": f"{CONTROLS['masked']}, width {width}"}


def keypoints_left(summary: pd.DataFrame) -> pd.Series:
    """The mean number of keypoints that masks of the tested width leave, by sequence."""
    width, rows = tested_width(summary), summary[summary["method"] == "masked"]
    if width is not None:
        rows = rows[rows["dilation_width"] == width]
    return rows.groupby("sequence")["mean_keypoints"].mean()


def of_control(summary: pd.DataFrame, method: str, estimator: str | None = None) -> pd.DataFrame:
    """The rows of one method of the comparison: masked runs of the tested width, all rows of any other."""
    return of_method(summary, method, estimator, tested_width(summary) if method == "masked" else None)


def control_changes(summary: pd.DataFrame, metric: str, estimator: str | None = None) -> pd.DataFrame:
    """Change of the metric (%) with masks of the tested width and with each control that was run.

    One row a sequence, one column a method in the order of CONTROLS.
    """
    baseline = _baseline(summary, metric, estimator)
    columns = {}
    for method in CONTROLS:
        rows = of_control(summary, method, estimator)
        if len(rows):
            columns[method] = percent_change(rows.groupby("sequence")[metric].mean(), baseline)
    return pd.DataFrame(columns, index=baseline.index, dtype=float).dropna(axis=1, how="all")


def controls(summary: pd.DataFrame) -> pd.DataFrame:
    """One row for each estimator and method, all keypoints first: means over sequences of the changes (%).

    Columns estimator, method, sequences, keypoints; rmse, rmse_low, rmse_high (mean and interval); rmse_improved (number
    of sequences); rmse_lowest, rmse_highest (of the repetitions, each a mean over sequences); rmse_minus,
    rmse_minus_low, rmse_minus_high (the change with masks minus that of the method, in percentage points, and its
    interval); the same for mae and those of BESIDE.
    """
    rows = []
    for estimator in ESTIMATORS:
        changes = {metric: control_changes(summary, metric, estimator) for metric in (*ERRORS, *BESIDE)}
        for method in ("baseline", *changes["rmse"]):
            runs = of_control(summary, method, estimator)
            if not len(runs):
                continue
            row = {"estimator": estimator, "method": method, "sequences": runs["sequence"].nunique(),
                   "keypoints": runs.groupby("sequence")["mean_keypoints"].mean().mean()}
            for metric, table in changes.items():
                row |= _row(runs, metric, table, method, _baseline(summary, metric, estimator))
            rows.append(row)
    return pd.DataFrame(rows)


def _row(runs: pd.DataFrame, metric: str, changes: pd.DataFrame, method: str, baseline: pd.Series
         ) -> dict[str, float]:
    repeated = runs.assign(change=percent_change(runs[metric], runs["sequence"].map(baseline)))
    repeated = repeated.groupby("repetition")["change"].mean()
    row = {f"{metric}_lowest": repeated.min(), f"{metric}_highest": repeated.max()}
    own = changes[method] if method in changes else pd.Series(0.0 if method == "baseline" else np.nan, changes.index)
    row[metric] = own.mean()
    if method != "baseline":
        row[f"{metric}_low"], row[f"{metric}_high"] = interval(own)
        row[f"{metric}_improved"] = int((own < 0).sum())
    if method != "masked" and "masked" in changes:
        minus = changes["masked"] - own
        row[f"{metric}_minus"] = minus.mean()
        row[f"{metric}_minus_low"], row[f"{metric}_minus_high"] = interval(minus)
    return row


# Several sources of masks


def of_source(summary: pd.DataFrame, source: str) -> pd.DataFrame:
    """The runs of one source, and those with all keypoints, which belong to every one."""
    return summary[summary["source"].isin([source, ""])]


def sources(summary: pd.DataFrame) -> list[str]:
    """The names of the sources, in the order of their runs."""
    return [name for name in summary["source"].unique() if name]


def errors(summary: pd.DataFrame) -> pd.DataFrame:
    """What the repetitions of each run amount to: one row for each estimator, source, width and sequence.

    Columns estimator, source, dilation_width, sequence, frames, repetitions, mean_keypoints, kept (percent of all
    keypoints); rmse, rmse_lowest, rmse_highest, rmse_change (percent), the same for mae and those of BESIDE; flagged
    (mean number of frames). All keypoints come first, with the source "".
    """
    keys = ["estimator", "source", "dilation_width", "sequence"]
    runs = summary[summary["method"].isin(["baseline", "masked"])].groupby(keys, dropna=False, sort=False)
    table = pd.DataFrame({"frames": runs["frames"].first(), "repetitions": runs["repetition"].nunique(),
                          "mean_keypoints": runs["mean_keypoints"].mean(), "flagged": runs["flagged"].mean(),
                          **{f"{metric}{name}": getattr(runs[metric], how)() for metric in (*ERRORS, *BESIDE)
                             for name, how in (("", "mean"), ("_lowest", "min"), ("_highest", "max"))}}).reset_index()
    every = table[table["source"] == ""].set_index(["estimator", "sequence"])
    own = every.reindex(pd.MultiIndex.from_frame(table[["estimator", "sequence"]]))
    table["kept"] = 100 * table["mean_keypoints"] / own["mean_keypoints"].to_numpy()
    for metric in (*ERRORS, *BESIDE):
        table[f"{metric}_change"] = percent_change(table[metric], own[metric].to_numpy())
    order = {value: place for place, value in enumerate([*ESTIMATORS, "", *sources(summary)])}
    return table.sort_values(keys, key=lambda column: column.map(order) if column.name in ("estimator", "source")
                             else column, kind="stable", na_position="first", ignore_index=True)


def side_by_side(summary: pd.DataFrame) -> pd.DataFrame:
    """Means over sequences: one row for each estimator, source and width, all keypoints first under each estimator.

    Columns estimator, source, dilation_width, sequences, mean_keypoints, kept; rmse_change, rmse_low, rmse_high (mean and
    interval), rmse_improved (number of sequences), the same for mae and those of BESIDE.
    """
    rows = []
    for (estimator, source, width), of_row in errors(summary).groupby(["estimator", "source", "dilation_width"], dropna=False,
                                                                 sort=False):
        row = {"estimator": estimator, "source": source, "dilation_width": width, "sequences": len(of_row),
               "mean_keypoints": of_row["mean_keypoints"].mean(), "kept": of_row["kept"].mean()}
        for metric in (*ERRORS, *BESIDE) if source else ():
            changes = of_row[f"{metric}_change"]
            row[f"{metric}_change"] = changes.mean()
            row[f"{metric}_low"], row[f"{metric}_high"] = interval(changes)
            row[f"{metric}_improved"] = int((changes < 0).sum())
        rows.append(row)
    return pd.DataFrame(rows)


# Time


def time_savings(seconds: pd.DataFrame) -> pd.Series:
    """Equation 4.2 for each dilation width: percent by which the time of all keypoints changes, negative where saved.

    seconds: the table of `budget.time_runs`; its timed frames of all sequences are added up. The making of masks is
    included, prediction is not, as in the thesis.
    """
    baseline = seconds[seconds["method"] == "baseline"]["seconds"].sum()
    masked = seconds[seconds["method"] == "masked"].groupby("dilation_width")["seconds"].sum()
    return percent_change(masked, baseline)
