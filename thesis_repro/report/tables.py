"""Tables 4.1 to 4.3, the errors of every sequence, and the budget of a frame, for reading: few digits, units.

`runs` is the table of `runner.run`; Equation 4.1 and the choice of width are in `thesis_tables`.
"""

import numpy as np
import pandas as pd
from markupsafe import Markup

from thesis_repro.report.captions import REPORTED
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import ESTIMATORS


def table_4_1(runs, reported_as):
    """Best dilation width and mean number of keypoints of each sequence, the thesis's numbers beside them."""
    best = thesis_tables.best_widths(compare.of_method(runs, "masked"))
    reported = pd.DataFrame(REPORTED["table_4_1"]).set_index("sequence").reindex(best.index).astype("Int64")
    return pd.DataFrame({
        "frames": best["frames"], "dilation width (pixels)": best["dilation_width"],
        "mean keypoints": best["mean_keypoints"].round().astype(int),
        f"width, {reported_as}": reported["dilation_width"],
        f"mean keypoints, {reported_as}": reported["mean_keypoints"]}).reset_index()


def table_of_change(best, runs, metric, reported_as):
    """Tables 4.2 and 4.3: the metric (m) with all keypoints and with the best mask, and Equation 4.1 in percent.

    best: the rows of each sequence's best width (`thesis_tables.of_chosen_width`). The thesis's "aggregate" is the sum
    of the sequences' percentages; mean, its bootstrap interval and median stand below it.
    """
    reported = pd.Series(REPORTED[f"table_4_{2 if metric == 'rmse' else 3}_{metric}_percent_change"])
    changes = thesis_tables.changes(best, compare.of_method(runs, "baseline"), metric)
    rows = {f"{metric.upper()}, all keypoints (m)": compare.of_method(runs, "baseline"),
            f"{metric.upper()}, best mask (m)": best}
    table = pd.DataFrame({name: own.groupby("sequence")[metric].mean().map(lambda value: float(f"{value:.3g}"))
                          for name, own in rows.items()})
    theirs, interval, below = f"change (%), {reported_as}", f"mean, {compare.LEVEL} % CI over sequences", {}
    for name, values in (("change (%)", changes), (theirs, reported)):
        low, high = compare.mean_interval(values)
        below[name] = {"sum (the thesis's aggregate)": values.sum(min_count=1), "mean": values.mean(),
                       f"{interval}, from": low, f"{interval}, to": high, "median": values.median(),
                       "sequences improved": (values < 0).sum()}
    table = table.assign(**{"change (%)": changes, theirs: reported.reindex(table.index)})
    table = pd.concat([table, pd.DataFrame(below, dtype=float).reindex(columns=table.columns)])
    return table.round({"change (%)": 2, theirs: 2}).rename_axis("sequence").reset_index()


def table_errors(runs):
    """Every sequence by itself, all keypoints and masks: keypoints and errors, means over the repetitions."""
    rows = runs[runs["method"].isin(["baseline", "masked"])]
    metrics = [name for name in compare.METRICS if name in rows and rows[name].notna().any()]
    keys = ["sequence", "estimator", "method", "source", "dilation_width"]
    means = rows.groupby(keys, dropna=False)[["frames", "mean_keypoints", *metrics, "flagged"]].mean().reset_index()
    errors = {f"{compare.METRICS[name]} ({compare.UNITS[name]})": means[name].map(lambda value: float(f"{value:.3g}"))
              for name in metrics}
    return pd.DataFrame({
        "sequence": means["sequence"], "estimator": means["estimator"].map(ESTIMATORS),
        "keypoints": np.where(means["source"] == "", means["method"].map(compare.METHODS), means["source"]),
        "width (pixels)": means["dilation_width"].astype("Int64"), "frames": means["frames"].astype(int),
        "number": means["mean_keypoints"].round().astype(int), **errors, "flagged frames": means["flagged"].round(1)})


def table_budget(measured):
    """Milliseconds a frame of each stage, one column a method, and the frames a second that they allow.

    measured: method, stage and milliseconds, as `timing.measure` gives them.
    """
    table = measured.pivot(index="stage", columns="method", values="milliseconds")
    table = table.loc[measured["stage"].unique(), measured["method"].unique()]
    below = pd.DataFrame({"all stages (ms)": table.sum(), "frames a second": 1000 / table.sum()}).T
    table = pd.concat([table.round(2).rename(lambda stage: f"{stage} (ms)"), below.round(1)])
    return table.rename_axis("stage", axis=0).rename_axis(None, axis=1).reset_index()


# For the page


def read(path):
    """A CSV file as a table, whole numbers beside missing ones as such; an empty one where there is no file."""
    return pd.read_csv(path, dtype={"sequence": str}).convert_dtypes() if path.is_file() else pd.DataFrame()


def html(table):
    """A table as HTML, texts escaped; numbers of a column have equally many digits."""
    numeric = [pd.api.types.is_numeric_dtype(dtype) for dtype in table.dtypes]
    shown = pd.DataFrame({name: cells.astype(float) if cells.dtype == "Float64" else cells.astype(object).where(
        cells.notna(), "") for name, cells in table.items()})
    return Markup(shown.to_html(index=False, border=0, na_rep="", justify="unset",
                                 classes="numbers" if sum(numeric) > len(numeric) / 2 else "words"))


def beside_the_thesis(settings):
    """This run's numbers where the thesis reports some in words, {name: numbers}, from the files that there are."""
    numbers = {}
    history, chosen = read(settings.build / "model" / "history.csv"), read(settings.figures / "table_4_1.csv")
    seconds = read(settings.figures / "timings" / "seconds.csv")
    if len(history):
        numbers["figure_4_01"] = {"epochs": len(history), "best": history.loc[history["val_loss"].idxmin()].to_dict()}
    if "mean keypoints" in chosen:
        numbers["figure_4_07"] = {"keypoints": chosen["mean keypoints"].clip(lower=1)}
    if len(seconds):
        numbers["figure_4_17"] = {"saved": 0 - thesis_tables.time_savings(seconds)}
    return numbers
