"""How much do n keypoints tell? Neighbours share pixels, so twice as many tell less than twice.

Two halves of n keypoints give motions that differ by an angle whose square grows with the variance
of the motion (study/worth.py). So n keypoints of a choice tell as much as REFERENCE random ones
times (median angle of those / median angle)^2. This is the **equivalent number**: of random
keypoints each of which tells as much as one of REFERENCE. It is formed on each street, for each
split and motion; streets are the units. The reference is the number that decides the worth, and not
a smaller one: halves of 100 keypoints have 50 each, to which RANSAC adds errors of its own. By
fields, halves of a choice that lies in few fields have unequal numbers, which makes its equivalent
number too small.
"""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from keypoint_study.report import style
from keypoint_study.report.worth import SHOWN, table_of
from keypoint_study.worth import DECIDING, MOTIONS, SPLIT, typical

REFERENCE = DECIDING  # random keypoints
CURVES = {
    "random keypoints": style.BASELINE,
    "spread keypoints": style.REDUCED,
    "masks": style.MASKED,
}


def equivalent(worths) -> pd.DataFrame:
    """Return the rows of CURVES with equivalent numbers as rotation and direction.

    worths: of `worth.measure`, with several numbers of keypoints.
    """
    is_reference = (worths["choice"] == "random keypoints") & (worths["number"] == REFERENCE)
    street = ["sequence", "split"]
    angles = [f"{motion}_deg" for motion in MOTIONS]
    rows = worths[worths["choice"].isin(list(CURVES))]
    both = rows.merge(
        worths.loc[is_reference, street + angles], on=street, suffixes=("", "_of_reference")
    )
    for motion in MOTIONS:
        angle = both[f"{motion}_deg"]
        both[motion] = REFERENCE * (both[f"{motion}_deg_of_reference"] / angle) ** 2
    return both[[*street, "choice", "number", "keypoints", *MOTIONS]]


def table(worths) -> pd.DataFrame:
    """Return one row a choice and number: typical equivalent numbers and their 95 % intervals."""
    return table_of(_typical(worths), _cell, "tell as much as, ")


def _cell(row, name) -> str:
    if np.isnan(row[f"{name}_low"]):
        return f"{row[name]:.0f}"
    return f"{row[name]:.0f} ({row[f'{name}_low']:.0f}-{row[f'{name}_high']:.0f})"


def _typical(worths) -> pd.DataFrame:
    rows = typical(equivalent(worths))
    rows["choice"] = pd.Categorical(rows["choice"], list(CURVES))
    return rows.sort_values(["choice", "keypoints"]).astype({"choice": str})


def figure(worths) -> Figure:
    """Draw the equivalent number of keypoints against their number, for direction and rotation."""
    rows = _typical(worths)
    drawing, panels = style.new_figure(1, 2, sharey=True, height=3.8)
    for panel, motion in zip(panels, SHOWN, strict=True):
        ends = rows["keypoints"].min(), rows["keypoints"].max()
        panel.plot(
            ends, ends, color=style.GRAY, linewidth=0.8, label=f"each as much as one of {REFERENCE}"
        )
        for choice, color in CURVES.items():
            of_choice = rows[rows["choice"] == choice]
            for split, dash in zip(SPLIT, ("o-", "o:"), strict=True):
                name, more = f"{motion}_{split}", {"color": color, "markersize": 3}
                label = f"{choice}, by {split}"
                panel.plot(of_choice["keypoints"], of_choice[name], dash, label=label, **more)
            low, high = (of_choice[f"{motion}_fields_{end}"] for end in ("low", "high"))
            panel.vlines(of_choice["keypoints"], low, high, color=color, linewidth=0.9)
        panel.set(xscale="log", yscale="log", title=motion, xlabel="keypoints")
        ticks = [100, 200, 400, 800, 1900]
        panel.set_xticks(ticks, list(map(str, ticks)))
        panel.minorticks_off()
    ticks = [6, 12, 25, 50, 100, 200, 400, 800, 1600]
    panels[0].set_yticks(ticks, list(map(str, ticks)))
    panels[0].set_ylabel("equivalent number of random ones")
    style.legend_below(drawing, panels[:1], 3)
    return drawing
