"""Table and figure of what a keypoint of each choice is worth (study/worth.py)."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from keypoint_study import compare
from keypoint_study.report import style, texts
from keypoint_study.worth import DECIDING, SPLIT, typical

SHOWN = ("direction", "rotation")
REACH = 8  # of the figure's axis, from 1 / REACH to REACH; a street beyond it is drawn at the edge

DOT: dict[str, Any] = {"color": "#555555", "markersize": 4, "alpha": 0.45, "markeredgewidth": 0}


def table(worths: pd.DataFrame) -> pd.DataFrame:
    """Return one row a choice and number, for readers: typical worths, intervals and the verdict.

    worths: of `worth.worth`, of several sequences. A cell says "0.51 (0.20-0.67), 7 of 8 below 1".
    """
    rows = typical(worths)
    return table_of(rows, cell).assign(**{"a keypoint tells": rows["verdict"]})


def table_of(rows: pd.DataFrame, text: Callable[[dict, str], str], title: str = "") -> pd.DataFrame:
    """Return the rows of `worth.typical` for readers, with a text for each motion and split.

    text: from a row and the name of a number, such as rotation_fields. title: before its column's.
    """
    lines = []
    for row in rows.to_dict("records"):
        line = {
            "choice": row["choice"],
            "drawn": row["number"] or "all",
            "keypoints": f"{row['keypoints']:.0f}",
        }
        for split in SPLIT:
            for motion in SHOWN:
                line[f"{title}{motion}, by {split}"] = text(row, f"{motion}_{split}")
        lines.append(line)
    return pd.DataFrame(lines)


def cell(row: dict, name: str) -> str:
    """Return a typical worth of `worth.typical` as text."""
    ends = {end: row[f"{name}_{end}"] for end in ("low", "high")}
    return (
        f"{texts.short({'ratio': row[name], **ends})}, {row[f'{name}_below']} of {row['n']} below 1"
    )


def figure(worths: pd.DataFrame, number: int = DECIDING) -> Figure:
    """Draw the worth of each choice on every sequence, by fields, and the typical worth.

    number: of keypoints, one of those in `worths`.
    """
    shown = worths[(worths["number"] == number) & (worths["split"] == "fields")]
    order = list(shown["choice"].unique())
    drawing, panels = style.new_figure(1, len(SHOWN), sharey=True, height=0.9 + 0.28 * len(order))
    for panel, motion in zip(panels, SHOWN, strict=True):
        style.ratio_axis(panel.xaxis, [1 / REACH, REACH])
        for place, choice in enumerate(order):
            values = shown.loc[shown["choice"] == choice, motion]
            beyond = (values < 1 / REACH) | (values > REACH)
            for marker, part in (("o", values[~beyond]), ("D", values[beyond])):
                places = np.full(len(part), place - 0.1)
                panel.plot(part.clip(1 / REACH, REACH), places, marker, **DOT)
            estimate, *interval = np.exp(compare.typical_interval(np.log(values)))
            if not np.isnan(interval).any():
                look = style.interval_style(style.MASKED, "|")
                panel.plot(np.clip(interval, 1 / REACH, REACH), [place + 0.2] * 2, **look)
            panel.plot(estimate, place + 0.2, "D", color=style.MASKED, markersize=4)
        panel.axvline(1, color="black", linewidth=0.8)
        panel.grid(axis="y", visible=False)
        panel.set_title(f"{motion}, {number or 'all'} keypoints")
        panel.set_xlabel("worth of a keypoint (random: 1)", fontsize=8)
    panels[0].set_yticks(range(len(order)), order, fontsize=8)
    panels[0].set_ylim(len(order) - 0.5, -0.7)
    return drawing
