"""Tables 4.1 to 4.3, the errors of all sequences and the time of a frame.

They have units and few digits. `runs` is the table of `runner.run_jobs`. Equation 4.1 and the
choice of a width are in `thesis_tables`.
"""

from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from thesis_repro.report.captions import REPORTED
from thesis_repro.running.settings import Settings
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import ESTIMATORS


def table_4_1(runs: pd.DataFrame, reported_as: str) -> pd.DataFrame:
    """Table 4.1: each sequence's best dilation width and mean number of keypoints.

    The last columns have the thesis's numbers; reported_as: how to name them.
    """
    masked = compare.of_method(runs, "masked")
    best = thesis_tables.best_widths(masked)
    reported = pd.DataFrame(REPORTED["table_4_1"]).set_index("sequence")
    reported = reported.reindex(best.index).astype("Int64")
    table = pd.DataFrame(index=best.index)
    table["frames"] = best["frames"]
    table["dilation width (pixels)"] = best["dilation_width"]
    table["mean keypoints"] = best["mean_keypoints"].round().astype(int)
    table["lost runs"] = _lost_of(thesis_tables.of_chosen_width(masked))
    table[f"width, {reported_as}"] = reported["dilation_width"]
    table[f"mean keypoints, {reported_as}"] = reported["mean_keypoints"]
    return table.reset_index()


REPORTED_CHANGES = {
    "rmse": "table_4_2_rmse_percent_change",
    "mae": "table_4_3_mae_percent_change",
}


def table_of_change(
    runs: pd.DataFrame, shuffled: pd.DataFrame, metric: str, reported_as: str
) -> pd.DataFrame:
    """Tables 4.2 and 4.3: a metric with all keypoints and with the best mask, and Equation 4.1.

    The metric ("rmse" or "mae") is in metres, Equation 4.1 in percent. The column "one run each"
    has the thesis's literal procedure: one run of all keypoints and of each width (repetition 0),
    also for the choice of the width. Beside it stands what this procedure gives if masks do nothing
    (`thesis_tables.changes_if_masks_did_nothing`), simulated from `shuffled`: runs with all
    keypoints, many repetitions.
    The last rows have the sum of the percentages (the thesis's "aggregate"), their mean with
    Student's t interval, and their median. A lost run counts as not improved.
    """
    masked, baseline = compare.of_method(runs, "masked"), compare.of_method(runs, "baseline")
    best = thesis_tables.of_chosen_width(masked)
    single = masked[masked["repetition"] == 0]
    first_best = thesis_tables.of_chosen_width(single)
    widths = masked["dilation_width"].nunique()
    studies = thesis_tables.changes_if_masks_did_nothing(shuffled, widths, metric)
    columns = {
        "change (%)": thesis_tables.changes(best, baseline, metric),
        SINGLE: thesis_tables.changes_of_repetition(masked, baseline, metric),
        NULL: studies.mean(),
        f"change (%), {reported_as}": pd.Series(REPORTED[REPORTED_CHANGES[metric]]),
    }
    table = pd.DataFrame(index=sorted(baseline["sequence"].unique()))
    for method, rows in {"all keypoints": baseline, "best mask": best}.items():
        mean = rows.groupby("sequence")[metric].mean()
        table[f"{metric.upper()}, {method} (m)"] = mean.map(_three_digits)
        table[f"lost runs, {method}"] = _lost_of(rows)
    judged = {"change (%)": best, SINGLE: first_best}
    summary = {}
    for name, changes in columns.items():
        table[name] = changes.reindex(table.index)
        summary[name] = _summary(changes, judged.get(name))
    if len(studies.columns):
        summary[NULL] = _summary_of_studies(studies)
    else:
        del summary[NULL], table[NULL]
    last_rows = pd.DataFrame(summary, dtype=float).reindex(columns=table.columns)
    table = pd.concat([table.astype(object), last_rows.astype(object)])
    table[list(summary)] = table[list(summary)].astype(float).round(2)
    errors = [name for name in table if name.endswith("(m)")]
    table[errors] = table[errors].astype(float)
    return table.rename_axis("sequence").reset_index()


IMPROVED = "sequences improved"  # a row of counts, and of a mean of counts
SINGLE = "change (%), one run each"
NULL = "change (%), one run each, if masks did nothing"


def _lost_of(runs: pd.DataFrame) -> pd.Series:
    """Return the lost runs of each sequence as a text, "2 of 5"."""
    lost = {name: compare.lost(rows) for name, rows in runs.groupby("sequence")}
    return pd.Series(lost, dtype=str)


CI = f"mean, {compare.LEVEL} % CI over sequences"


def _summary(changes: pd.Series, runs: pd.DataFrame | None = None) -> dict[str, float]:
    """Return the last rows of Tables 4.2 and 4.3 for one column of changes (%).

    runs: those with masks behind the changes; None if only the changes are known.
    """
    low, high = compare.mean_interval(changes)
    improved = (changes < 0).sum()
    if runs is not None:
        improved = thesis_tables.improved(changes, runs)
    return {
        "sum (the thesis's aggregate)": changes.sum(min_count=1),
        "mean": changes.mean(),
        f"{CI}, from": low,
        f"{CI}, to": high,
        "median": changes.median(),
        IMPROVED: improved,
    }


def _summary_of_studies(studies: pd.DataFrame) -> dict[str, float]:
    """Return the last rows for simulated studies (%), one row a study: means over the studies."""
    means = studies.mean(axis=1)
    low, high = thesis_tables.middle(means)
    middle = f"mean, middle {compare.LEVEL} % of {len(studies)} simulated studies"
    return {
        "sum (the thesis's aggregate)": studies.sum(axis=1).mean(),
        "mean": means.mean(),
        f"{middle}, from": low,
        f"{middle}, to": high,
        "median": studies.median(axis=1).mean(),
        IMPROVED: (studies < 0).sum(axis=1).mean(),
    }


def _three_digits(value: float) -> float:
    return float(f"{value:.3g}")


def table_errors(runs: pd.DataFrame) -> pd.DataFrame:
    """Return keypoints and errors with all keypoints and with masks, by sequence.

    They are means over the repetitions.
    """
    rows = runs[runs["method"].isin(["baseline", "masked"])]
    metrics = [name for name in compare.METRICS if name in rows and rows[name].notna().any()]
    keys = ["sequence", "estimator", "method", "source", "dilation_width"]
    numbers = ["frames", "mean_keypoints", *metrics, "flagged"]
    means = rows.groupby(keys, dropna=False)[numbers].mean().reset_index()
    has_no_source = means["source"] == ""
    table = pd.DataFrame()
    table["sequence"] = means["sequence"]
    table["estimator"] = means["estimator"].map(ESTIMATORS)
    table["keypoints"] = means["source"].mask(has_no_source, means["method"].map(compare.METHODS))
    table["width (pixels)"] = means["dilation_width"].astype("Int64")
    table["frames"] = means["frames"].astype(int)
    table["number"] = means["mean_keypoints"].round().astype(int)
    for name in metrics:
        label = f"{compare.METRICS[name]} ({compare.UNITS[name]})"
        table[label] = means[name].map(_three_digits)
    table["flagged frames"] = means["flagged"].round(1)
    groups = rows.groupby(keys, dropna=False)
    table["lost runs"] = [compare.lost(runs_of_row) for _, runs_of_row in groups]
    return table


def table_budget(measured: pd.DataFrame) -> pd.DataFrame:
    """Return the milliseconds of each stage for one frame, one column a method.

    The last rows have their sum and the frames a second. measured: method, stage and milliseconds,
    from `timing.measure`.
    """
    table = measured.pivot(index="stage", columns="method", values="milliseconds")
    table = table.loc[measured["stage"].unique(), measured["method"].unique()]
    total = table.sum()
    summary = pd.DataFrame({"all stages (ms)": total, "frames a second": 1000 / total}).T
    stages = table.round(2).rename("{} (ms)".format)
    table = pd.concat([stages, summary.round(1)])
    return table.rename_axis("stage", axis=0).rename_axis(None, axis=1).reset_index()


# For the page


def read(path: Path) -> pd.DataFrame:
    """Read a CSV file as a table with nullable integers.

    Returns an empty table if the file does not exist.
    """
    if not path.is_file():
        return pd.DataFrame()
    # a name may look like a number or a missing value
    texts = dict.fromkeys(("sequence", "masks", "source"), str)
    table = pd.read_csv(path, dtype=texts, keep_default_na=False, na_values=[""])
    return table.convert_dtypes()


def html(table: pd.DataFrame) -> Markup:
    """Return a table as HTML with escaped texts.

    The numbers of a column have the same number of digits. Where most numbers of a row are whole,
    and in the row IMPROVED, whole numbers are counts and stay whole.
    """
    floats = table.select_dtypes("Float64").astype(float)
    is_whole = floats.eq(floats.round())
    has_counts = is_whole.sum(axis=1) > floats.notna().sum(axis=1) / 2
    has_counts |= table.iloc[:, 0].astype(str).eq(IMPROVED)
    shown = {}
    numeric = 0
    for name, cells in table.items():
        numeric += pd.api.types.is_numeric_dtype(cells.dtype)
        if name in floats:
            shown[name] = _equal_digits(floats[name], has_counts & is_whole[name])
        else:
            shown[name] = cells.astype(object).where(cells.notna(), "")
    style = "words"
    if numeric > len(shown) / 2:
        style = "numbers"
    text = pd.DataFrame(shown).to_html(
        index=False, border=0, na_rep="", justify="unset", classes=style
    )
    return Markup(text)


def _equal_digits(numbers: pd.Series, is_count: pd.Series) -> pd.Series:
    """Return numbers as texts with as many digits after the point as most fractions have.

    Counts have none. A number that was written with more digits keeps them (at most six), so that
    0.9971 does not become 1.00. Missing numbers are empty.
    """
    decimals = numbers.map(lambda number: len(f"{number:.6f}".rstrip("0").partition(".")[2]))
    common = decimals[decimals > 0].mode().max()
    decimals = decimals.clip(lower=common).mask(is_count, 0)
    shown = [f"{number:.{places}f}" for number, places in zip(numbers, decimals, strict=True)]
    return pd.Series(shown, numbers.index).mask(numbers.isna(), "")


def beside_the_thesis(settings: Settings) -> dict[str, Any]:
    """Return this run's numbers for artefacts whose numbers the thesis reports in its text.

    Their form is {name of the artefact: numbers}. A name is missing if its file was not written.
    """
    numbers: dict[str, Any] = {}
    history = read(settings.build / "model" / "history.csv")
    if len(history):
        best = history.loc[history["val_loss"].idxmin()]
        last = history.iloc[-1]
        numbers["figure_4_01"] = {
            "epochs": len(history),
            "best": best.to_dict(),
            "last": last.to_dict(),
        }
    chosen = read(settings.figures / "table_4_1.csv")
    if "mean keypoints" in chosen:
        numbers["figure_4_07"] = {"keypoints": chosen["mean keypoints"].clip(lower=1)}
    seconds = read(settings.figures / "timings" / "seconds.csv")
    if len(seconds):
        numbers["figure_4_17"] = {"saved": 0 - thesis_tables.time_savings(seconds)}
    return numbers
