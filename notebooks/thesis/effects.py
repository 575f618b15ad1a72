"""The figure of notebook 9: errors that a slip or a claim of the thesis changes clearly."""

import textwrap

import matplotlib.pyplot as plt
import pandas as pd

from thesis_repro.report import style

ESTIMATORS = {"thesis": style.BASELINE, "refined": style.MASKED}
NO_ESTIMATOR = "#555555"


def figure_effects(effects: pd.DataFrame) -> plt.Figure:
    """Draw ratios with their intervals, one line for each row of the audit and error.

    effects: lines of `audit.table`, at least one.
    """
    labels = "row " + effects["row"] + ": " + effects["quantity"] + ", " + effects["metric"]
    order = list(labels.unique())
    figure, axes = style.new_figure(height=0.9 + 0.3 * len(order))
    for label, effect in zip(labels, effects.itertuples(), strict=True):
        color = ESTIMATORS.get(effect.estimator, NO_ESTIMATOR)
        y = order.index(label) + 0.25 * (effect.estimator == "refined")
        axes.plot([effect.low, effect.high], [y, y], color=color, linewidth=2)
        axes.plot(effect.value, y, "D", color=color, markersize=4)
    for name, color in {**ESTIMATORS, "no": NO_ESTIMATOR}.items():
        axes.plot([], [], color=color, label=f"{name} estimator")
    style.legend_below(figure, [axes], 3)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set_yticks(range(len(order)), [textwrap.fill(label, 60) for label in order], fontsize=7)
    axes.set_ylim(len(order) - 0.4, -0.6)
    style.ratio_axis(axes.xaxis, effects[["low", "high"]])
    axes.set_xlabel("ratio of errors, with its interval (left of 1: lower)")
    return figure
