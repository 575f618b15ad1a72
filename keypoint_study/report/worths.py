"""Table and figure of what a keypoint of each choice is worth (keypoint_study/worth.py)."""

from collections.abc import Collection
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import ratios, worth_check
from keypoint_study.methods import DECIDING
from keypoint_study.report import style, texts
from keypoint_study.report.style import COLUMN_WIDTH, PAGE_WIDTH, Artefact
from keypoint_study.typical_worth import typical_worths
from keypoint_study.verdicts import LEVEL, MIN_SEQUENCES, NOT_JUDGED, TOO_FAR
from keypoint_study.worth import FIELD, SPLIT

SHOWN = ("direction", "rotation")
VERDICTS = ("a keypoint tells", "by one fit")  # columns of the table
REACH = 8  # of the figure's axis, from 1 / REACH to REACH; a street beyond it is drawn at the edge
DOT: dict[str, Any] = {"color": "#555555", "markersize": 4, "alpha": 0.45, "markeredgewidth": 0}


def table_of_worths(worths: pd.DataFrame, new: Collection[str] = ()) -> Artefact:
    """Return one row a choice and number, for readers: typical worths, intervals and the verdict.

    worths: of `typical_worth.worths_of`. new: sequences, see `typical_worth.typical_worths`.
    A cell says "0.51 (0.20-0.67), 7 of 8 below 1".
    """
    lines = []
    for row in typical_worths(worths, new).to_dict("records"):
        line = {
            "choice": row["choice"],
            "drawn": row["number"] or "all",
            "keypoints": f"{row['keypoints']:.0f}",
        }
        for split in SPLIT:
            for motion in SHOWN:
                line[f"{motion}, by {split}"] = cell(row, f"{motion}_{split}")
        line["factor off the truth"] = "" if np.isnan(row["off"]) else f"{row['off']:.2f}"
        verdicts = (row[name] for name in ("verdict", "verdict_of_fit") if name in row)
        line |= dict(zip(VERDICTS, verdicts))
        lines.append(line)
    return Artefact(
        "worth",
        "What a keypoint is worth, in numbers",
        f"Typical worth of the sequences, from {MIN_SEQUENCES} on with its {LEVEL} % interval, and "
        f"the number of sequences with less than random keypoints. By fields: squares of {FIELD} "
        "pixels go into one half as a whole, so what neighbours share counts once. By points: "
        "keypoint by keypoint. A keypoint tells less or more only if both splits say so, for "
        "direction and rotation. Factor off the truth: the largest in the embedded world, where the "
        "truth is known, for the choices that were checked; where it is too large, the row is not "
        "judged. By one fit: what the covariance of a single fit says, which decides "
        "nothing. worth_runs.csv has every sequence.",
        texts.without_untold(pd.DataFrame(lines), *VERDICTS),
    )


def table_of_checks() -> Artefact:
    """Return `worth_check.TABLE` for readers: worths beside the truth, and what stays unjudged."""
    lines = []
    for (choice, number), row in worth_check.checks().iterrows():
        off = worth_check.factor_off(choice, number)
        line = {"choice": choice, "keypoints": number}
        for motion, kind in product(SHOWN, (worth_check.TRUE, *SPLIT)):
            head = kind if kind == worth_check.TRUE else f"by {kind}"
            line[f"{motion}, {head}"] = f"{row[f'{motion}_{kind}']:.2f}"
        line["factor off"] = f"{off:.2f}"
        words = [word for word, limit in TOO_FAR.items() if off <= limit]
        line["words that may be said"] = ", ".join(words) or NOT_JUDGED
        lines.append(line)
    return Artefact(
        "worth_check",
        "The worth of a keypoint beside the truth",
        "Typical worths of rendered drives, where the motion of every step is exact: the true worth, "
        "and what halves of the keypoints say without a truth. Factor off: the largest of the four.",
        pd.DataFrame(lines),
    )


def for_paper(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of `table_of_worths` for a paper, without the counts of sequences."""
    numbers = [name for name in table if name.startswith(SHOWN)]
    short = table[numbers].apply(lambda cells: cells.str.partition(",")[0])
    return table[["choice"]].join(short).join(table.filter(VERDICTS[:1]))


def cell(row: dict, name: str) -> str:
    """Return a typical worth of `typical_worth.typical_worths` as text."""
    ends = {end: row[f"{name}_{end}"] for end in ("low", "high")}
    return (
        f"{texts.short({'ratio': row[name], **ends})}, {row[f'{name}_below']} of {row['n']} below 1"
    )


def figure_of_worths(
    worths: pd.DataFrame, number: int = DECIDING, width: float = PAGE_WIDTH
) -> Artefact:
    """Draw the worth of each choice on every sequence, by fields, and the typical worth.

    number: of keypoints, one of those in `worths`. width: inches; in one column the panels are
    below each other.
    """
    shown = worths[(worths["number"] == number) & (worths["split"] == "fields")]
    order = list(shown["choice"].unique())
    rows = 1 if width > COLUMN_WIDTH else len(SHOWN)
    height = rows * (0.9 + 0.28 * len(order))
    drawing, panels = style.new_figure(
        rows, len(SHOWN) // rows, height, width, sharex=True, sharey=True, squeeze=False
    )
    for panel, motion in zip(panels.flat, SHOWN, strict=True):
        for place, choice in enumerate(order):
            values = shown.loc[shown["choice"] == choice, motion]
            beyond = (values < 1 / REACH) | (values > REACH)
            for marker, part in (("o", values[~beyond]), ("D", values[beyond])):
                places = np.full(len(part), place - 0.1)
                panel.plot(part.clip(1 / REACH, REACH), places, marker, **DOT)
            estimate, *interval = np.exp(ratios.typical_interval(np.log(values)))
            if not np.isnan(interval).any():
                look = style.interval_style(style.MASKED)
                panel.plot(np.clip(interval, 1 / REACH, REACH), [place + 0.2] * 2, **look)
            panel.plot(estimate, place + 0.2, "D", color=style.MASKED, markersize=4)
        style.ratio_rows(panel, order, REACH)
        panel.set_title(f"{motion}, {number or 'all'} keypoints")
        panel.tick_params("y", labelsize=8)
    for panel in panels[-1]:
        panel.set_xlabel("worth of a keypoint (random: 1)", fontsize=8)
    return Artefact(
        "worth",
        "What a keypoint is worth",
        "How much a keypoint of each choice tells about the motion of a step, without ground truth. "
        "Keypoints are divided into two halves, and each half gives a motion: the less both differ, "
        "the more a keypoint tells. As many random keypoints have 1; a worth of 0.5 needs twice as "
        "many keypoints for the same precision. Grey dots are sequences, those drawn as diamonds lie "
        f"beyond the axis; the coloured mark is their typical worth, from {MIN_SEQUENCES} sequences "
        f"on with its {LEVEL} % interval. Refined estimator, {number or 'all'} keypoints, by fields.",
        drawing,
    )
