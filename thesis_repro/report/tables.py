"""Tables 4.1 to 4.3 and those of the choice of width, the controls and the budget, for reading: few digits, units.

`summary` is the table that `runner.run` returns; what is computed from it is in results.py.
"""

import numpy as np
import pandas as pd

from thesis_repro.report.captions import REPORTED
from thesis_repro.study import results

SHORT = {"exact-boundaries": "exact", "corrected": "corrected", "true-labels": "true", "other-frame": "other frame",
         "mirrored": "mirrored", "random-lines": "random lines", "image-edges": "image edges", "fewer": "fewer",
         "spread": "spread out"}  # the controls as columns
UNITS = {"se3": "m", "translation_percent": "%", "rotation_deg_per_m": "degrees a metre"}
INTERVAL = f"mean, {results.LEVEL} % interval"


def table_4_1(summary, reported_as):
    """Best dilation width and mean number of keypoints of each sequence, the thesis's numbers beside them."""
    best = results.best_widths(summary)
    reported = {row["sequence"]: row for row in REPORTED["table_4_1"]}
    return pd.DataFrame({
        "sequence": best.index,
        "frames": best["frames"].to_numpy(),
        "dilation width (pixels)": best["dilation_width"].astype(int).to_numpy(),
        "mean keypoints": best["mean_keypoints"].round().astype(int).to_numpy(),
        f"width, {reported_as}": [_reported(reported, name, "dilation_width") for name in best.index],
        f"mean keypoints, {reported_as}": [_reported(reported, name, "mean_keypoints") for name in best.index],
    })


def _reported(reported, name, key):
    return pd.NA if name not in reported else reported[name][key]


def table_of_change(summary, metric, reported_as):
    """Tables 4.2 and 4.3: percent change (Equation 4.1) of the metric from all keypoints to the best mask.

    Beside the thesis's choice of width: one width for all, the width chosen on the other sequences, and the controls;
    for RMSE also what other errors say of the thesis's choice (`results.BESIDE`).
    The thesis's "aggregate" is the sum of the sequences' percentages; mean, its interval and median stand beside it.
    """
    baseline = results.over_orders(results.of_method(summary, "baseline"), metric)
    masked = results.over_orders(results.of_best_width(summary), metric).reindex(baseline.index)
    chosen = results.widths(summary).reindex(baseline.index)
    key = {"rmse": "table_4_2_rmse_percent_change", "mae": "table_4_3_mae_percent_change"}[metric]
    reported = pd.Series(REPORTED[key])
    theirs = f"change (%), {reported_as}"
    short = {"masked": f"width {results.tested_width(summary)}", **SHORT}
    changes = pd.DataFrame({
        "change (%)": chosen[f"best_{metric}"],
        theirs: reported.reindex(baseline.index),
        **{f"{name} (%)": chosen[f"best_{other}"] for other, name in results.BESIDE.items() if metric == "rmse"},
        "one width for all (%)": chosen[f"fixed_{metric}"],
        "left-out width (%)": chosen[f"left_out_{metric}"],
        **{f"{short[method]} (%)": change
           for method, change in results.control_changes(summary, metric).items()},
    })
    label = metric.upper()
    errors = pd.DataFrame({
        f"{label}, all keypoints (m)": baseline["mean"].map(_significant),
        "all keypoints, range": _ranges(baseline),
        f"{label}, best mask (m)": masked["mean"].map(_significant),
        "best mask, range": _ranges(masked),
    }, index=baseline.index)
    below = _below(changes.assign(**{theirs: np.nan}))
    below[theirs] = _below(reported.to_frame()).to_numpy()[:, 0]  # of all that the thesis reports
    table = pd.concat([errors.join(changes), below])[[*errors.columns, *changes.columns]]
    digits = {name: 2 if name in ("change (%)", theirs) else 1 for name in changes}  # the thesis prints two
    return table.round(digits).rename_axis("sequence").reset_index()


def _below(changes):
    """What stands below columns of percent changes, one row a sequence."""
    few = "" if len(changes) >= results.FEWEST else " (too few sequences)"
    intervals = [results.interval(changes[name]) for name in changes]
    rows = {"sum (the thesis's aggregate)": changes.sum(min_count=1), "mean": changes.mean(),
            f"{INTERVAL}, from{few}": [low for low, _ in intervals],
            f"{INTERVAL}, to{few}": [high for _, high in intervals],
            "median": changes.median(), "sequences improved": (changes < 0).sum().where(changes.notna().any())}
    return pd.DataFrame({row: np.asarray(values, float) for row, values in rows.items()}, index=changes.columns).T


def _significant(value):
    return value if not np.isfinite(value) else float(f"{value:.3g}")


def _ranges(table):
    return [pd.NA if np.isnan(row.lowest) else f"{row.lowest:.3g} to {row.highest:.3g}" for row in table.itertuples()]


def table_widths(summary):
    """What the best, the left-out and the fixed width give, and how far the best is chance (`results.widths`)."""
    table = results.widths(summary)
    count = results.of_method(summary, "masked")["dilation_width"].nunique()
    names = {}
    for choice, name in (("best", f"best of {count}"), ("left_out", "left-out"), ("fixed", "one for all")):
        names |= {choice: f"{name}: width", f"{choice}_rmse": f"{name}: RMSE (%)", f"{choice}_mae": f"{name}: MAE (%)"}
    names |= {"elsewhere": "best of one repetition, in the others: RMSE (%)",
              "same_best": "best of one repetition is best in another (%)"}
    table = table[list(names)].rename(columns=names)
    changes = table.drop(columns=[names[choice] for choice in ("best", "left_out", "fixed")])
    below = _below(changes).drop("sum (the thesis's aggregate)")
    below.loc[below.index != "mean", names["same_best"]] = np.nan  # not a change
    return pd.concat([table.astype(float), below])[list(table)].round(1).rename_axis("sequence").reset_index()


def table_controls(summary):
    """Masks of one width and every control under both estimators: mean changes from all keypoints, with intervals."""
    table = results.controls(summary)
    names = {"baseline": "all keypoints", **results.control_names(summary)}
    shown = pd.DataFrame({"estimator": table["estimator"].map(results.ESTIMATORS), "keypoints": table["method"].map(names),
                          "mean number": table["keypoints"].round().astype(int), "sequences": table["sequences"]})
    for metric in results.ERRORS:
        label = metric.upper()
        shown[f"{label} (%)"] = table[metric].round(1)
        shown[f"{label}, {results.LEVEL} % interval"] = _between(table, f"{metric}_low", f"{metric}_high")
        shown[f"{label}, repetitions"] = _between(table, f"{metric}_lowest", f"{metric}_highest")
        shown[f"{label} improved"] = table[f"{metric}_improved"].astype("Int64")
    shown = shown.assign(**_beside(table))
    shown["mask minus this, RMSE (points)"] = table["rmse_minus"].round(1)
    shown["points, interval"] = _between(table, "rmse_minus_low", "rmse_minus_high")
    return shown


def _between(table, low, high):
    return [pd.NA if np.isnan(one) else f"{one:+.1f} to {other:+.1f}" for one, other in zip(table[low], table[high])]


def _beside(table, change=""):
    """Columns of the other errors (`results.BESIDE`): mean changes (%) with their intervals, in one cell each."""
    found = {}
    for metric, name in results.BESIDE.items():
        between = _between(table, f"{metric}_low", f"{metric}_high")
        found[f"{name} (%)"] = [pd.NA if np.isnan(mean) else f"{mean:+.1f}{'' if pd.isna(span) else f' ({span})'}"
                                for mean, span in zip(table[f"{metric}{change}"], between, strict=True)]
    return found


def table_sources(summary):
    """Every source of masks and width side by side: mean changes from all keypoints, with intervals."""
    table = results.side_by_side(summary)
    shown = _source_columns(table).assign(sequences=table["sequences"])
    shown["mean keypoints"] = table["mean_keypoints"].round().astype(int)
    shown["kept (%)"] = table["kept"].round(1)
    for metric in results.ERRORS:
        label = metric.upper()
        shown[f"{label} (%)"] = table[f"{metric}_change"].round(1)
        shown[f"{label}, {results.LEVEL} % interval"] = _between(table, f"{metric}_low", f"{metric}_high")
        shown[f"{label} improved"] = table[f"{metric}_improved"].astype("Int64")
    return shown.assign(**_beside(table, "_change"))


def table_errors(summary):
    """Every sequence by itself: errors, mean and range of the repetitions, and keypoints."""
    table = results.errors(summary)
    shown = pd.concat([table["sequence"], _source_columns(table)], axis=1).assign(frames=table["frames"])
    shown["mean keypoints"] = table["mean_keypoints"].round().astype(int)
    for metric in results.ERRORS:
        label = metric.upper()
        spread = table[[f"{metric}_lowest", f"{metric}_highest"]].set_axis(["lowest", "highest"], axis=1)
        shown[f"{label} (m)"] = table[metric].map(_significant)
        shown[f"{label}, range"] = _ranges(spread)
        shown[f"{label} (%)"] = table[f"{metric}_change"].where(table["source"] != "").round(1)
    for metric, name in results.BESIDE.items():
        shown[f"{name} ({UNITS[metric]})"] = table[metric].map(_significant)
        shown[f"{name}, change (%)"] = table[f"{metric}_change"].where(table["source"] != "").round(1)
    shown["flagged frames"] = table["flagged"].round(1)
    return shown.sort_values("sequence", kind="stable", ignore_index=True)


def _source_columns(table):
    return pd.DataFrame({"estimator": table["estimator"].map(results.ESTIMATORS),
                         "masks": table["source"].where(table["source"] != "", "all keypoints"),
                         "width (pixels)": table["dilation_width"].astype("Int64")})


def table_budget(measured, overlapped):
    """Milliseconds a frame of each stage, one column a method, and the frames a second that they allow.

    measured: method, stage and milliseconds (`budget.measure`). overlapped: method and milliseconds between frames
    where the next frame is read and segmented beside the odometry of this one (`budget.measure_overlapped`).
    """
    table = measured.pivot(index="stage", columns="method", values="milliseconds")
    table = table.loc[measured["stage"].unique(), measured["method"].unique()]
    total, between = table.sum(), overlapped.set_index("method")["milliseconds"].reindex(table.columns)
    below = pd.DataFrame({"all stages (ms)": total, "frames a second": 1000 / total,
                          "between frames, overlapped (ms)": between, "frames a second, overlapped": 1000 / between}).T
    table = pd.concat([table.round(2).rename(lambda stage: f"{stage} (ms)"), below.round(1)])
    return table.rename_axis("stage", axis=0).rename_axis(None, axis=1).reset_index()
