"""All choices of keypoints by one standard: their worth, failures, errors and rule 5, in one table.

The rule is in study/worth.py (9). Errors are those of runs that exist: of masks and controls
(width 10), and of the curve of few keypoints.
"""

from itertools import product

import numpy as np
import pandas as pd

from keypoint_study import compare, methods
from keypoint_study.jobs import CONTROL_WIDTH, ESTIMATORS
from keypoint_study.report import texts
from keypoint_study.report.worth import cell
from keypoint_study.worth import DECIDING, NUMBERS, SPLIT, typical
from thesis import few_keypoints
from thesis_repro.odometry.estimators import COMPARED

LEFT_OUT = "01"  # the street without which everything is said a second time
# choices of the curve of few keypoints, as few_keypoints names them
FEW = {
    "random keypoints": "random",
    "spread keypoints": "spread",
    "strongest keypoints": "strongest",
    "strongest on the masks": "mask",
}
# choices that decide how many keypoints there are, as few_keypoints and methods name them
ALL_OF_THEM = {"masks, filled": ("filled", 0)}
ALL_OF_THEM |= {methods.METHODS[name].title: name for name in ("masked", *methods.MASK_CONTROLS)}


def table_of_choices(
    runs: pd.DataFrame, few_runs: pd.DataFrame, worths: pd.DataFrame
) -> pd.DataFrame:
    """Return one row a choice and number of keypoints, with all streets and without LEFT_OUT.

    runs: of a study. few_runs: of `few_keypoints.run_few`. worths: of `worth.measure`. Masks and
    controls have all their keypoints in the runs, and DECIDING of them have the worth. Where it was
    not measured, its cells are empty.
    """
    parts = []
    everywhere = sorted(runs["sequence"].unique())
    for streets in (everywhere, [name for name in everywhere if name != LEFT_OUT]):
        tables = (each[each["sequence"].isin(streets)] for each in (runs, few_runs, worths))
        part = _of_streets(*tables)
        part.insert(0, "streets", f"all {len(streets)}")
        if LEFT_OUT not in streets:
            part["streets"] = f"{len(streets)}, without {LEFT_OUT}"
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def _of_streets(runs: pd.DataFrame, few_runs: pd.DataFrame, worths: pd.DataFrame) -> pd.DataFrame:
    runs = runs.assign(failed=_failed(runs))
    few_runs = few_runs.assign(failed=few_runs["failed"] > 0)
    everything = few_runs[few_runs["choice"] == "all"]
    of_choices = [(choice, DECIDING, name) for choice, name in ALL_OF_THEM.items()]
    of_choices += [
        (choice, number, (name, number)) for number in NUMBERS[::-1] for choice, name in FEW.items()
    ]
    typical_worths = {
        (row["choice"], row["number"]): row for row in typical(worths).to_dict("records")
    }
    rows = []
    for choice, number, name in of_choices:
        if isinstance(name, tuple):
            chosen, reference = _few(few_runs, *name), everything
        else:
            chosen = runs[(runs["method"] == name) & (runs["dilation_width"] == CONTROL_WIDTH)]
            chosen = chosen.assign(keypoints=chosen["mean_keypoints"])
            reference = runs[runs["method"] == "baseline"]
        if chosen.empty:
            continue
        row = {"choice": choice, "keypoints": f"{chosen['keypoints'].mean():.0f}"}
        worth = typical_worths.get((choice, number))
        row["a keypoint tells"] = worth["verdict"] if worth else ""
        for split, motion in product(SPLIT, ("direction", "rotation")):
            text = cell(worth, f"{motion}_{split}") if worth else ""
            row[f"worth, {motion}, by {split}"] = text
        rows.append(row | _errors(chosen, reference))
    return pd.DataFrame(rows)


def _few(few_runs: pd.DataFrame, choice: str, number: int) -> pd.DataFrame:
    return few_runs[(few_runs["choice"] == choice) & (few_runs["number"] == number)]


def _failed(runs: pd.DataFrame) -> pd.Series:
    """Whether a run has failed: it has a failed step or is lost."""
    return (runs["failed"] > 0) | (runs["lost"] > 0)


def _errors(chosen: pd.DataFrame, reference: pd.DataFrame) -> dict:
    """Return failures, ratios of errors to all keypoints, and rule 5, for each estimator."""
    row, no_worse = {}, []
    for estimator in COMPARED:
        title = ESTIMATORS[estimator]
        of_choice = chosen[chosen["estimator"] == estimator]
        of_all = reference[reference["estimator"] == estimator]
        failing, failing_of_all = map(_failing_streets, (of_choice, of_all))
        row[f"streets on which it fails, {title}"] = f"{failing} (all keypoints: {failing_of_all})"
        passes = failing <= failing_of_all
        for error, margin in few_keypoints.MARGINS.items():
            ratios = compare.ratios(of_choice, of_all, error)
            row[f"{compare.METRICS[error]}, {title}"] = ratio_text(ratios)
            passes &= few_keypoints.within(ratios, margin)["no_worse"]
        row[f"no worse (rule 5), {title}"] = "yes" if passes else ""
        no_worse.append(passes)
    row["no worse (rule 5)"] = "yes" if all(no_worse) else ""
    return row


def ratio_text(ratios: pd.Series) -> str:
    """Return the typical ratio of streets as text, such as "1.09 (0.98-1.32), 6 of 8 above 1"."""
    numbers = compare.typical_ratio(ratios)
    ratio, low, high = (texts.number(numbers[name]) for name in ("ratio", "low", "high"))
    interval = "" if np.isnan(numbers["low"]) else f" ({low}-{high})"
    return f"{ratio}{interval}, {numbers['above']} of {numbers['n']} above 1"


def _failing_streets(runs: pd.DataFrame) -> int:
    """Return the number of streets on which half of the runs or more have failed.

    Shuffles of one street are no units, so they count as one.
    """
    return int((runs.groupby("sequence")["failed"].mean() >= 0.5).sum())
