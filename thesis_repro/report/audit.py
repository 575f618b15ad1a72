"""The audit: where the thesis contradicts itself, its code or its libraries, and what each of these does.

The rows' texts are in audit.json; the numbers of the thesis's own tables in reported.json. Each function here turns
tables of measurements into `Effect`s; `table` joins them to the rows. Ratios are geometric means over sequences of what
the switch alone does within a sequence, brackets their bootstrap interval (`answer.mean_ratio`).
"""

import json
from dataclasses import dataclass
from math import comb
from pathlib import Path

import numpy as np
import pandas as pd

from thesis_repro.cityscapes import LABELS
from thesis_repro.kitti import FRAME_COUNTS
from thesis_repro.report.captions import REPORTED
from thesis_repro.study import answer, chance, results

ROWS = json.loads((Path(__file__).parent / "audit.json").read_text(encoding="utf-8"))
REAL_ONLY = "not measured in this run"
UNTRIED = "not tried"
WIDTHS = range(9, 12)  # that the thesis calls best
ESTIMATORS = {"thesis": "thesis's estimator", "refined": "refined"}


@dataclass(frozen=True)
class Effect:
    """What a row's switch alone does: a number in words, and how far it spreads."""

    row: str
    effect: str
    spread: str = ""


def table(effects, data):
    """All rows as a table for reading: row, where, the thesis, right, switch, effect, spread, data.

    effects: Effects in any order, several a row where several things were measured. data: one line that says where
    measured numbers come from; rows of arithmetic say so instead.
    """
    found = {}
    for one in effects:
        found.setdefault(one.row, []).append(one)
    unknown = found.keys() - {row["row"] for row in ROWS}
    if unknown:
        raise ValueError(f"effects of no row of audit.json: {', '.join(sorted(unknown))}")
    rows = []
    for row in ROWS:
        own, untried = found.get(row["row"], []), row["switch"] == UNTRIED
        rows.append({
            "row": row["row"], "where": row["where"], "the thesis or its code": row["does"],
            "what would be right": row["right"], "switch": row["switch"],
            "effect of the switch alone": "; ".join(one.effect for one in own) or (UNTRIED if untried else REAL_ONLY),
            "spread": "; ".join(one.spread for one in own if one.spread),
            "data": "the thesis's tables" if row["switch"] == "none, arithmetic" else data if own else ""})
    return pd.DataFrame(rows)


def missing(audit):
    """Rows of a table that had something to measure and have no effect."""
    return audit.loc[audit["effect of the switch alone"] == REAL_ONLY, "row"].tolist()


# Arithmetic on the thesis's own numbers


def arithmetic():
    """Rows 1, 3, 4, 9, 17, 18, 41 and 45, from the thesis's tables."""
    changes = {name: pd.Series(REPORTED[key]) for name, key in (("RMSE", "table_4_2_rmse_percent_change"),
                                                               ("MAE", "table_4_3_mae_percent_change"))}
    effects = []
    for name, change in changes.items():
        low, high = results.interval(change)
        ratio = answer.mean_ratio(1 + change / 100)
        effects.append(Effect("1", f"{name}: sum {change.sum():.2f}, mean {change.mean():.2f}, median "
                                   f"{change.median():.2f} %, geometric mean of the ratios {ratio[0]:.2f}",
                              f"mean {low:+.1f} to {high:+.1f} %, ratio {ratio[1]:.2f} to {ratio[2]:.2f}"))
        better, count = int((change < 0).sum()), len(change)
        chance_of = sum(comb(count, k) for k in range(better, count + 1)) / 2**count
        effects.append(Effect("41", f"{name} smaller in {better} of {count}; lots would do as well in "
                                    f"{100 * chance_of:.0f} of 100 cases"))
    factors = 2000 / pd.DataFrame(REPORTED["table_4_1"])["mean_keypoints"]
    mean = pd.DataFrame(REPORTED["table_4_1"])["mean_keypoints"].mean()
    effects.append(Effect("3", f"{2000 / mean:.2f} times fewer for the mean number, 3 or more in "
                               f"{(factors >= 3).sum()} of {len(factors)} sequences",
                          f"{factors.min():.2f} to {factors.max():.2f}"))
    worse = {name: ", ".join(change.index[change > 0]) for name, change in changes.items()}
    effects.append(Effect("4", "; ".join(f"{name} is larger in {names}" for name, names in worse.items())))
    widths = pd.DataFrame(REPORTED["table_4_1"])["dilation_width"]
    effects.append(Effect("35", f"thesis's Table 4.1: 9 to 11 in {widths.isin(WIDTHS).sum()} of {len(widths)}",
                          f"{widths.min()} to {widths.max()}"))
    listed, outputs = len(LABELS), REPORTED["training"]["classes"]  # Tables 3.1 and 3.2
    last = REPORTED["figure_a1_model_summary"]["rows"][-1]["params"]
    effects.append(Effect("9", f"{listed} categories, {outputs} outputs; a further output would be {last // outputs} "
                               "parameters"))
    effects.append(Effect("17", "a name; no number changes"))
    for name, said in (("02", 4560), ("07", 1100)):
        effects.append(Effect("18", f"{name}: {said - FRAME_COUNTS[name]:+d} frames"))
    effects.append(Effect("45", "an error in one draw of 501"))
    return effects


# Runs


def _ratio(values, digits=2):
    """(how many times, spread) of one ratio a sequence, in words."""
    values = np.asarray(values, float)
    values = values[~np.isnan(values)]
    if not len(values):
        return None
    mean, low, high = answer.mean_ratio(values)
    if np.isnan(low):
        low, high = values.min(), values.max()
    return f"{mean:.{digits}f} times", f"{low:.{digits}f} to {high:.{digits}f}, {len(values)} sequences"


def _compare(row, what, runs, reference, metric="rmse"):
    """Effects of one method against another under each estimator that both have. runs, reference: rows of runs."""
    said = []
    for estimator, name in ESTIMATORS.items():
        one, other = (some[some["estimator"] == estimator] for some in (runs, reference))
        found = _ratio(answer.ratios(one, other, metric)) if len(one) and len(other) else None
        if found:
            said.append((f"{found[0]} ({name})", found[1]))
    label = {"rmse": "RMSE"}.get(metric, metric)
    return [Effect(row, f"{label} {what}: {', '.join(text for text, _ in said)}",
                   "; ".join(spread for _, spread in said))] if said else []


def _keypoints(row, runs, reference):
    times, spread = _ratio(answer.ratios(runs, reference, "mean_keypoints"))
    return Effect(row, f"keypoints {times}", spread)


def of_runs(summary):
    """Rows 2, 11, 26, 31, 32, 33, 35, 38 and 40, from the runs of notebook 08."""
    effects = []
    stability = results.stability(summary).dropna()
    if len(stability):
        best = _ratio(1 + results.widths(summary)["best_rmse"].loc[stability.index].astype(float) / 100)
        fair = _ratio(1 + stability["elsewhere"] / 100)
        effects.append(Effect("2", f"RMSE of the best width over all keypoints {best[0]} judged by the runs that chose "
                                   f"it, {fair[0]} by other orders; the same width is best in "
                                   f"{stability['same_best'].mean():.0f} of 100 pairs of orders",
                              f"{best[1]}; {fair[1]}"))
    masked, everything = (results.of_method(summary, name) for name in ("masked", "baseline"))
    widths = set(masked["dilation_width"])
    if {5, 10} <= widths:
        five, ten = (masked[masked["dilation_width"] == width] for width in (5, 10))
        effects += [*_compare("26", "with 5 over 10", five, ten), _keypoints("26", five, ten)]
    by_metric = masked.groupby(["sequence", "dilation_width"])[["rmse", "mae"]].mean()
    chosen = {metric: by_metric[metric].groupby("sequence").idxmin().map(lambda key: key[1])
              for metric in ("rmse", "mae")}
    differs = chosen["rmse"] != chosen["mae"]
    moved = {metric: by_metric["rmse"].loc[list(zip(widths.index, widths, strict=True))].to_numpy()
             for metric, widths in chosen.items()}
    moved = _ratio(moved["mae"] / moved["rmse"])
    effects.append(Effect("31", f"another width in {differs.sum()} of {len(differs)} sequences; RMSE {moved[0]} if MAE "
                                "chooses", moved[1]))
    logs = np.log(by_metric["rmse"]).groupby("dilation_width").mean()
    best = chosen["rmse"]
    within = masked["dilation_width"].isin(WIDTHS)
    if within.any():
        effects += _compare("35", "with 9 to 11 over the other widths", masked[within], masked[~within])
    effects.append(Effect("35", f"lowest over all sequences at {logs.idxmin():.0f}, best of a sequence 9 to 11 in "
                                f"{best.isin(WIDTHS).sum()} of {len(best)}", f"{best.min():.0f} to {best.max():.0f}"))
    reduced = results.of_method(summary, "reduced")
    effects += _compare("33", "plainly reduced over all keypoints", reduced, everything)
    effects += _compare("33", "plainly reduced over masks of the best width", reduced, results.of_best_width(summary))
    both = summary[summary["estimator"].isin(ESTIMATORS)]
    of = {name: both[(both["method"] == name)] for name in ("exact-boundaries", "true-labels", "fewer", "spread",
                                                            "baseline")}
    tested = both[(both["method"] == "masked") & (both["dilation_width"] == results.tested_width(summary))]
    effects += _compare("11", "with exact boundaries over the thesis's", of["exact-boundaries"], tested)
    if len(of["true-labels"]):
        effects += _compare("32", "with true label maps over predicted ones", of["true-labels"], tested)
        effects += _compare("38", "with label maps that do not fluctuate over predicted ones", of["true-labels"],
                            tested)
    effects += _compare("33", "as few of the strongest over masks", of["fewer"], tested)
    effects += _compare("33", "as few spread out over masks", of["spread"], tested)
    return effects


def of_switches(runs):
    """Rows 10, 12 to 15, 28 to 30, 34, 36, 37, 40, 42, 48 and 50, from the first table of `effects.measure`."""
    def of(method, estimator=None):
        rows = runs[runs["method"] == method]
        return rows if estimator is None else rows[rows["estimator"] == estimator]

    effects = []
    for row, what, method, reference in (
            ("10", "enlarged by nearest neighbours over bilinearly", "nearest", "masks"),
            ("12", "dilated symmetrically over the thesis's way", "symmetric", "masks"),
            ("28", "drawn by lot over the strongest", "any", "strongest"),
            ("37", "without keypoints on movable classes over all keypoints", "no movable", "all"),
            ("37", "with masks without movable classes over masks", "masks, no movable", "masks"),
            ("42", "keypoints outside dropped over detected inside", "filter", "masks"),
            ("48", "with ORB over Shi-Tomasi", "orb", "all"),
            ("50", "with corrected masks over the thesis's", "corrected", "masks"),
            ("50", "with corrected masks over all keypoints", "corrected", "all")):
        effects += _compare(row, what, of(method), of(reference))
        effects.append(_keypoints(row, of(method), of(reference)))
    for method, what in (("all", "all keypoints"), ("masks", "masks")):
        for estimator, row in (("inliers", "13"), ("refined", "29")):
            found = _ratio(answer.ratios(of(method, estimator), of(method, "thesis"), "rmse"))
            effects.append(Effect(row, f"RMSE {found[0]} ({what})", found[1]))
    for estimator, name in ESTIMATORS.items():
        errors = of("all", estimator).groupby("sequence")["rmse"].agg(["min", "max"])
        spread = errors["max"] / errors["min"]
        orders = of("all", estimator)["repetition"].nunique()
        effects.append(Effect("14", f"highest over lowest RMSE of {orders} orders: {spread.median():.2f} times "
                                    f"({name}, median over sequences)", f"{spread.min():.2f} to {spread.max():.2f}"))
        failed = [of(method, estimator).groupby("sequence")["failed"].mean() for method in ("all", "masks")]
        effects.append(Effect("29", f"steps that turn wrong by 2 degrees or go backwards ({name}): "
                                    f"{failed[0].mean():.2f} % with all keypoints, {failed[1].mean():.2f} % with masks",
                              "sequences {:.2f} to {:.2f} %, {:.2f} to {:.2f} %".format(
                                  *(end for some in failed for end in (some.min(), some.max())))))
    every = of("all", "refined").groupby("sequence")[["rmse", "se3", "sim3", "rotation", "across", "down"]].mean()
    for kind in ("se3", "sim3"):
        found = _ratio(every[kind] / every["rmse"])
        if found:
            effects.append(Effect("15", f"RMSE after {kind} alignment over raw {found[0]} (refined)", found[1]))
    masks_over = {name: _ratio(answer.ratios(of("masks", "refined"), of("all", "refined"), metric)) for metric, name in
                  {"rmse": "raw RMSE", **results.BESIDE, "rotation": "rotation error a frame"}.items()}
    masks_over = {name: found for name, found in masks_over.items() if found}
    said = ", ".join(f"{name} {found[0]}" for name, found in masks_over.items())
    effects.append(Effect("15", f"masks over all keypoints by {said}",
                          "; ".join(found[1] for found in masks_over.values())))
    angle = every[["across", "down"]]
    effects.append(Effect("30", "direction of motion off by {:+.2f} degrees to the right and {:+.2f} down (refined, "
                                "medians)".format(*angle.median()),
                          "{:+.2f} to {:+.2f} and {:+.2f} to {:+.2f}, {} sequences".format(
                              *(end for name in angle for end in (angle[name].min(), angle[name].max())), len(angle))))
    for few in sorted(name for name in runs["method"].unique() if name.endswith(" keypoints")):
        effects += _compare("34", f"with {few} over all", of(few), of("all"))
    effects += _compare("40", "with as few of the strongest as masks leave over all", of("strongest"), of("all"))
    effects.append(_keypoints("40", of("strongest"), of("all")))
    few = of("100 keypoints", "refined")
    if len(few):
        effects.append(Effect("34", f"failed steps with 100 keypoints {few['failed'].mean():.1f} % (refined)"))
    rotation = {place: _ratio(_with(of("masks", "refined"), of("all", "refined"), place))
                for place in ("in_turns", "on_straights")}
    for place, words in (("in_turns", "in turns"), ("on_straights", "on straights")):
        if rotation[place]:
            effects.append(Effect("36", f"rotation error a step with masks over all keypoints {rotation[place][0]} "
                                        f"{words} (refined)", rotation[place][1]))
        else:
            effects.append(Effect("36", f"no step of these frames lies {words}"))
    return effects


def of_boresight(explained):
    """Row 30: the constant angle between camera and truth, and what taking it out does (`boresight.explained`)."""
    effects = [Effect("30", ", ".join(f"{angle} {explained[angle].median():+.2f} degrees" for angle in ("pitch", "yaw")
                                      if explained[angle].notna().any()) or "no angle is determined on these frames",
                      "; ".join(f"{explained[angle].min():+.2f} to {explained[angle].max():+.2f}"
                                for angle in ("pitch", "yaw") if explained[angle].notna().any()))]
    for column, whose in (("rmse_own", "its own angle"), ("rmse_others", "the angle of others of the same day")):
        found = _ratio(explained[column] / explained["rmse"])
        if found:
            effects.append(Effect("30", f"RMSE with {whose} taken out over raw: {found[0]} (refined)", found[1]))
    return effects


def _with(runs, reference, metric):
    """Ratios of those sequences that have the metric: not all of them turn."""
    keep = [some[some[metric] > 0] for some in (runs, reference)]
    return answer.ratios(*keep, metric) if all(map(len, keep)) else []


def of_chance(prefixes):
    """Row 39: what the thesis's procedure would report if masks did nothing (`chance`)."""
    reported = pd.Series(REPORTED["table_4_2_rmse_percent_change"])
    lengths = chance.by_length(prefixes)
    effects = []
    for place in sorted({0, len(lengths) // 2, len(lengths) - 1}):
        one = lengths.iloc[place]
        effects.append(Effect("39", f"over {one['metres']:.0f} m (one deviation between orders {one['spread']:.2f} "
                                    f"times): mean {one['mean']:+.0f} %, median {one['median']:+.0f} %",
                              f"mean {one['mean, low']:+.0f} to {one['mean, high']:+.0f} %, median "
                              f"{one['median, low']:+.0f} to {one['median, high']:+.0f} %"))
    whole = prefixes[prefixes["frames"] == prefixes.groupby("sequence")["frames"].transform("max")]
    as_low = chance.share_as_low(whole, reported.mean(), reported.median())
    effects.append(Effect("39", f"the thesis reports mean {reported.mean():+.1f} %, median {reported.median():+.1f} %; "
                                f"with the spread of the longest stretch {100 * as_low[0]:.0f} and "
                                f"{100 * as_low[1]:.0f} of 100 studies of masks that do nothing would report as low a "
                                "number"))
    return effects


# Label maps, keypoints, time


def of_boundaries(measured):
    """Rows 10 and 11, from a table of `effects.boundaries`, one row a label map."""
    effects = [Effect("10", f"{measured['invented'].mean():.2f} % of the pixels have an id of no class within 2 pixels",
                      _range(measured["invented"], " % of the label maps"))]
    named = [f"{name} {measured[name].mean():.0f}" for name in measured
             if "/" in name and measured[name].notna().any()]
    lost = f"{measured['lost'].mean():.0f} % of the boundary pixels are lost"
    return [*effects, Effect("11", f"{lost}{'; of ' if named else ''}{', '.join(named)}",
                             _range(measured["lost"], " % of the label maps"))]


def _range(values, unit=""):
    return f"{values.quantile(0.025):.2g} to {values.quantile(0.975):.2g}{unit}"


def of_tracks(measured):
    """Rows 32, 37 and 38: why masks, and even true label maps, do worse, from the table of `effects.tracks`."""
    means = measured.groupby(["keypoints of", "sequence"])[["keypoints", "residual", "off", "cells", "heading"]].mean()
    effects = []
    for name in means.index.unique(0):
        one = means.loc[name]
        reference = means.loc["all keypoints"].reindex(one.index)
        found = {column: _ratio(one[column] / reference[column]) for column in ("residual", "cells", "heading")}
        if name != "all keypoints" and found["heading"]:
            effects.append(Effect("32", f"{name}: tracks off by {found['residual'][0]} as much as with all, in "
                                        f"{found['cells'][0]} as many parts of the frame, heading known "
                                        f"{found['heading'][0]} as badly", found["heading"][1]))
    return effects


def of_time(seconds, measured):
    """Rows 16, 47 and 49, from the tables of `budget.time_runs` and `budget.measure`."""
    savings = results.time_savings(seconds)
    near = savings[savings.index.isin(WIDTHS)] if savings.index.isin(WIDTHS).any() else savings
    stages = measured.pivot(index="stage", columns="method", values="milliseconds").fillna(0)
    plain, masked = (stages[name].sum() for name in sorted(stages, key=lambda name: name.startswith("masked")))
    parts = stages[max(stages, key=lambda name: name.startswith("masked"))]
    return [
        Effect("47", f"time of the odometry {near.mean():+.0f} % with widths {near.index.min():.0f} to "
                     f"{near.index.max():.0f}", f"all widths {savings.min():+.0f} to {savings.max():+.0f} %"),
        Effect("16", f"a whole frame with masks and network takes {masked / plain:.1f} times as long as with all "
                     f"keypoints ({masked:.0f} and {plain:.0f} ms)"),
        Effect("49", ", ".join(f"{stage} {value:.0f} ms" for stage, value in parts.items()))]


# Training


def of_trials(trials):
    """Rows 5, 21, 22 and 27, from the table of `slips.trials`: method, seed, mean_iou, accuracy, person."""
    rows = {"corrected blocks": "5", "divided by 255": "21", "noise of today": "22", "person weight 1": "27"}
    plain, effects = trials[trials["method"] == "thesis"].set_index("seed"), []
    for method, row in rows.items():
        own = trials[trials["method"] == method].set_index("seed")
        difference = own["mean_iou"] - plain["mean_iou"]
        effects.append(Effect(row, f"mean IoU {difference.mean():+.3f} from {plain['mean_iou'].mean():.3f} after "
                                   f"{own['steps'].iloc[0]} steps", f"{difference.min():+.3f} to "
                                                                   f"{difference.max():+.3f}, {len(own)} seeds"))
    return effects
