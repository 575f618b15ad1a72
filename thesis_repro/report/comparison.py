"""The answer in a figure, a table and words: error against number of keypoints, by method (`study.answer`)."""

import numpy as np
import pandas as pd

from thesis_repro.report.findings import ENOUGH, UNAIDED
from thesis_repro.report.style import BASELINE, BLACK, GREEN, MASKED, ORANGE, PAGE_WIDTH, PINK, SKY, new_figure
from thesis_repro.study import answer, results

MARKERS = "oDsh^v<>PpX"
COLORS = (BASELINE, MASKED, GREEN, "#7fb800", ORANGE, PINK, SKY, BLACK, "#777777", "#8b5a2b",
          "#5d3a9b")  # in METHODS' order


def _style(method):
    index = list(answer.METHODS).index(method)
    return {"color": COLORS[index], "marker": MARKERS[index], "label": answer.METHODS[method]}


def figure_answer(summary, every=None):
    """Ratio of each method's error to that of all keypoints against its number of keypoints; log scales.

    One row of panels an estimator, one column a metric. Markers are geometric means over sequences at the tested width,
    bars their bootstrap intervals; lines lead through the other widths and limits of `every`, which holds `summary`.
    """
    every = summary if every is None else every
    poses = [estimator for estimator in results.ESTIMATORS if len(results.of_method(summary, "baseline", estimator))]
    figure, axes = new_figure(len(poses), len(answer.METRICS), height=1.0 + 2.5 * len(poses), squeeze=False)
    for row, estimator in zip(axes, poses, strict=True):
        for panel, (metric, name) in zip(row, answer.METRICS.items(), strict=True):
            for method, line in _lines(every, metric, estimator).groupby("method", sort=False):
                panel.plot(line["keypoints"], line["ratio"], color=_style(method)["color"], linewidth=0.9, alpha=0.6)
            for one in answer.compared(summary, metric, estimator).itertuples():
                if np.isfinite(one.low):
                    panel.plot([one.keypoints] * 2, [one.low, one.high], color=_style(one.method)["color"],
                               linewidth=1.6)
                panel.plot(one.keypoints, one.ratio, linestyle="none", markersize=6.5, markeredgecolor="white",
                           markeredgewidth=0.5, **_style(one.method))
            panel.axhline(1, color="black", linewidth=0.8)
            panel.set(xscale="log", yscale="log", title=f"{name}, {results.ESTIMATORS[estimator]}")
            panel.minorticks_off()
            _plain_ticks(panel)
        row[0].set_ylabel("times the error of all keypoints")
    for panel in axes[-1]:
        panel.set_xlabel("mean number of keypoints")
    figure.legend(*axes[-1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def figure_by_sequence(summary, metric):
    """The same errors themselves, one panel a sequence: bars from the lowest to the highest of the repetitions."""
    lines = answer.lines(summary, metric)
    names = list(dict.fromkeys(lines["sequence"]))
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    figure, axes = new_figure(rows, columns, height=PAGE_WIDTH / columns * rows * 0.9 + 0.8, squeeze=False)
    for panel in axes.flat[len(names):]:
        panel.set_axis_off()
    for panel, name in zip(axes.flat, names, strict=False):
        for method, line in lines[lines["sequence"] == name].groupby("method", sort=False):
            spread = [line["mean"] - line["lowest"], line["highest"] - line["mean"]]
            panel.errorbar(line["keypoints"], line["mean"], yerr=np.maximum(spread, 0), linewidth=0.9, elinewidth=0.9,
                           markersize=4, markeredgewidth=0, **_style(method))
        panel.set(xscale="log", yscale="log", title=name)
        panel.minorticks_off()
        _plain_ticks(panel)
        panel.tick_params(labelsize=7)
    for panel in axes[:, 0]:
        panel.set_ylabel({"rotation": "rotation error (degrees)"}.get(metric, "RMSE (m)"))
    for panel in axes.flat[max(0, len(names) - columns):len(names)]:
        panel.set_xlabel("mean number of keypoints", fontsize=8)
    handles = {}
    for panel in axes.flat[:len(names)]:
        handles |= dict(zip(*reversed(panel.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


def _lines(summary, metric, estimator):
    """Geometric means over sequences of the ratios to all keypoints, for methods run with several settings."""
    every = answer.logs(results.of_method(summary, "baseline", estimator), metric)
    found = answer.lines(summary, metric, estimator)
    found["setting"] = found.groupby(["sequence", "method"]).cumcount()
    counts = found.groupby("method")["setting"].transform("max")
    found = found[(counts > 0) & (found["method"] != "baseline")]
    found = found.assign(ratio=np.log(found["mean"]) - found["sequence"].map(every),
                         keypoints=np.log(found["keypoints"]))
    return np.exp(found.groupby(["method", "setting"], sort=False)[["keypoints", "ratio"]].mean()).reset_index()


def _plain_ticks(panel):
    """Few ticks at round numbers, however short or long a logarithmic axis is."""
    for axis, (low, high) in ((panel.xaxis, panel.get_xlim()), (panel.yaxis, panel.get_ylim())):
        for steps in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 5, 7), (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 4, 5, 6, 7, 8, 9),
                      np.arange(1, 10, 0.1), np.arange(1, 10, 0.02)):
            ticks = [step * 10.0**power for power in range(-6, 6) for step in steps]
            ticks = [tick for tick in ticks if low <= tick <= high]
            if len(ticks) >= 3:
                break
        ticks = ticks[::-(-len(ticks) // 6)]
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])


def table(summary):
    """Every method under both estimators and metrics: keypoints, ratios to all keypoints and of masks to it."""
    rows = []
    for estimator, estimator in results.ESTIMATORS.items():
        if not len(results.of_method(summary, "baseline", estimator)):
            continue
        for metric, name in answer.SHOWN.items():
            if summary[metric].isna().all():  # paths too short for it
                continue
            for one in answer.compared(summary, metric, estimator).itertuples():
                rows.append({"estimator": estimator, "error": name, "keypoints": answer.METHODS[one.method],
                             "mean number": round(one.keypoints), "sequences": one.sequences,
                             "times all keypoints": _number(one.ratio), "interval": _between(one.low, one.high),
                             "thesis's mean of percentages (%)": round(one.percent, 1),
                             "masks are times this": _number(one.masks),
                             "masks, interval": _between(one.masks_low, one.masks_high)})
    return pd.DataFrame(rows)


def _number(value):
    return float(f"{value:.3g}")


def _between(low, high):
    return pd.NA if np.isnan(low) else f"{low:.3g} to {high:.3g}"


def words(summary, data, quality=None):
    """The answer as one paragraph of Markdown, chosen by the numbers as `study.answer` has it.

    quality: of the label maps, for the verdict (`gap.quality`).
    """
    found = {metric: answer.compared(summary, metric).set_index("method") for metric in answer.METRICS}
    first = found["turned"]
    if "masked" not in first.index:
        return ""
    count = int(first.loc["masked", "sequences"])
    parts = [f"the {name} is {_ratio(found[metric].loc['masked'])} times that of all keypoints"
             for metric, name in answer.METRICS.items()]
    text = (f"**Do masks help?** Data: {data}. Refined estimator, width {results.tested_width(summary)}, "
            f"{first.loc['masked', 'keypoints']:.0f} keypoints instead of {first.loc['baseline', 'keypoints']:.0f}, "
            f"geometric means over {count} sequence{'s' * (count != 1)}: with masks {' and '.join(parts)}"
            f"{_beside(summary)}.")
    if "corrected" in first.index:
        text += " With all of the thesis's slips corrected: " + ", ".join(
            f"{name} {_ratio(found[metric].loc['corrected'])}" for metric, name in answer.METRICS.items()) + "."
    beaten, better, same = [], [], []
    for method in UNAIDED:
        signs = [_sign(found[metric].loc[method, "masks_low"], found[metric].loc[method, "masks_high"])
                 for metric in answer.METRICS if method in found[metric].index]
        if signs:
            (beaten if set(signs) == {-1} else better if set(signs) == {1} else same).append(answer.METHODS[method])
    for names, said in ((beaten, "worse than masks by both measures"), (better, "better than masks by both measures"),
                        (same, "not told apart from masks by both measures")):
        if names and count >= results.FEWEST:
            text += f" Of what knows no class of the frame, {said}: {', '.join(names)}."
    helps = {_sign(found[metric].loc["masked", "low"], found[metric].loc["masked", "high"]) for metric in found}
    if count < ENOUGH:
        return f"{text} **{count} sequences say nothing of sequences in general.**\n"
    masks = f"Masks{f' from label maps of {quality}' if quality else ''}"
    if helps == {-1}:
        return f"{text} **{masks} help here, " + ("and the segmentation matters.**\n" if not better and not same
                                                 else "but not for what the segmentation knows.**\n")
    return f"{text} **{masks} {'do worse than all keypoints' if helps == {1} else 'are not shown to help'} here.**\n"


def _beside(summary):
    said = []
    for metric, name in results.BESIDE.items():
        if summary[metric].notna().any():
            said.append(f"{name} {_ratio(answer.compared(summary, metric).set_index('method').loc['masked'])}")
    return f" (beside them, {', '.join(said)})" if said else ""


def _ratio(one):
    return f"{one['ratio']:.2f}" + ("" if np.isnan(one["low"]) else f" [{one['low']:.2f}, {one['high']:.2f}]")


def _sign(low, high):
    """-1 where an interval of ratios lies below 1, 1 where above, 0 where neither."""
    return -1 if high < 1 else 1 if low > 1 else 0
