"""Choices of keypoints at an equal number, and what each verdict hangs on.

A mask leaves fewer keypoints than the detector finds. Here as many are compared, from the runs of
`few_keypoints`. A verdict on both deciding errors (`verdicts.verdict`) is then asked again: without
each street, each two and each day, without the streets on which something was chosen, and with
Student's t in place of the signed rank. One that stays everywhere hangs on none of them.
"""

from collections.abc import Callable, Collection
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from keypoint_study import comparisons, ratios
from keypoint_study.path_errors import ERRORS
from keypoint_study.report import style, texts
from keypoint_study.verdicts import verdict

DECIDING = comparisons.JUDGING_METRICS
SHOWN = {"thesis": "thesis's estimator", "refined": "refined estimator"}
MASKS, EVERY = "all on the mask", "all keypoints"  # the comparison of the main study
# {title: choice and number of keypoints, 0 for no limit}; the first six are drawn
CHOICES = {
    "200 spread": ("spread", 200),
    "200 random ones": ("random", 200),
    "200 strongest": ("strongest", 200),
    "200 strongest on the mask": ("mask", 200),
    "the mask": ("mask", 0),
    "the mask, filled": ("filled", 0),
    "200 random ones on the mask": ("random-on", 200),
    "100 strongest on the mask": ("mask", 100),
    "100 random ones": ("random", 100),
    "800 random ones": ("random", 800),  # about as many as masks leave
}
DRAWN = 6
CALLED = {"200 spread": "200 spread over the frame", "the mask": MASKS}  # in the figure
# titles of CHOICES, the second being what the first is compared with; or (MASKS, EVERY)
PAIRS = (
    ("200 strongest on the mask", "200 random ones"),
    ("200 random ones on the mask", "200 random ones"),
    ("100 strongest on the mask", "100 random ones"),
    ("200 strongest on the mask", "200 strongest"),
    ("200 strongest", "200 random ones"),
    ("200 spread", "200 random ones"),
    ("200 spread", "200 strongest"),
    ("the mask, filled", "the mask"),
    ("the mask", "800 random ones"),
    (MASKS, EVERY),
)
REACH = 8  # of the figure's axis, from 1 / REACH to REACH
# on which the streets were recorded (KITTI's raw data; its odometry kit names the drives)
DAYS = {
    "2011-09-26": ("03", "drive0005", "drive0009", "drive0095"),
    "2011-09-30": ("04", "05", "06", "07"),
    "2011-10-03": ("00", "01", "02"),
}
NEW = ("03", "04", "drive0009")  # streets on which nothing was chosen
HARD = ("01", "05", "07")  # streets whose hard cases the refined estimator was developed on


def over(chosen: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios of the deciding errors of some runs to those of others, a row a street."""
    return pd.DataFrame({name: ratios.ratios_of(chosen, reference, name) for name in DECIDING})


def of_pair(
    few: pd.DataFrame, runs: pd.DataFrame, pair: tuple[str, str], estimator: str
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the runs of both sides of one of PAIRS.

    few: of `few_keypoints.run_few`. runs: of notebook 8, whose masks have one tested width.
    """
    few, runs = (table[table["estimator"] == estimator] for table in (few, runs))
    if pair == (MASKS, EVERY):
        width = comparisons.tested_width(runs)
        masks = runs[(runs["method"] == "masked") & (runs["dilation_width"] == width)]
        return masks, runs[runs["method"] == "baseline"]
    first, second = (of_choice(few, title) for title in pair)
    return first, second


def of_choice(few: pd.DataFrame, title: str) -> pd.DataFrame:
    """Return the runs of one of CHOICES."""
    choice, number = CHOICES[title]
    return few[(few["choice"] == choice) & (few["number"] == number)]


def word(of_streets: pd.DataFrame, ends: tuple[str, str] = ("low", "high")) -> str:
    """Return the verdict on both errors. ends: of the interval, in `ratios.typical_ratio`."""
    typical = [ratios.typical_ratio(of_streets[name]) for name in DECIDING]
    sides = [ratios.side_of_one(*(each[end] for end in ends)) for each in typical]
    return verdict(len(of_streets), sides)


def hangs_on(of_streets: pd.DataFrame) -> str:
    """Return without what the verdict on both errors is another one: "two sequences (1 of 55)".

    of_streets: of `over`. "nothing" if it stays everywhere.
    """
    told, found = word(of_streets), []
    streets = list(of_streets.index)
    cases: dict[str, list[Collection[str]]] = {
        "one sequence": [[street] for street in streets],
        "two sequences": [*combinations(streets, 2)],
        "a day": [*DAYS.values()],
        "the new sequences": [NEW],
        ", ".join(HARD): [HARD],
    }
    for name, left_out in cases.items():
        words = [word(of_streets.drop([*case], errors="ignore")) for case in left_out]
        others = len(words) - words.count(told)
        if others:
            found.append(f"{name} ({others} of {len(words)})" if len(words) > 1 else name)
    if word(of_streets, ("mean_low", "mean_high")) != told:
        found.append("the signed rank")
    return "; ".join(found) or "nothing"


def failing(runs: pd.DataFrame) -> str:
    """Return on how many streets half of the runs or more have failed: "1 of 11"."""
    failed = ratios.has_failed(runs) if "lost" in runs else runs["failed"] > 0
    return ratios.count_failing(failed.set_axis(runs["sequence"]))


def table_of_pairs(few: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row a pair and estimator, for readers."""
    lines = []
    for pair in PAIRS:
        for estimator, title in SHOWN.items():
            sides = of_pair(few, runs, pair, estimator)
            of_streets = over(*sides)
            line = {"keypoints": pair[0], "over": pair[1], "estimator": title}
            for name, error in DECIDING.items():
                typical = ratios.typical_ratio(of_streets[name])
                line[error] = (
                    f"{texts.short(typical)}, {typical['above']} of {typical['n']} above 1"
                )
            line["both errors"] = word(of_streets)
            line["hangs on"] = hangs_on(of_streets)
            line["streets that fail"] = ", ".join(map(failing, sides))
            lines.append(line)
    return pd.DataFrame(lines)


def share_of_days(of_streets: pd.Series) -> float:
    """Return the share of the variance of ratios (logarithms) that the day of recording explains.

    It is the intraclass correlation of one-way random effects; below 0 it is 0.
    """
    logarithms = np.log(of_streets)
    groups = [logarithms.reindex(names).dropna() for names in DAYS.values()]
    sizes = np.array([len(group) for group in groups])
    n, days = sizes.sum(), len(groups)
    means = np.array([group.mean() for group in groups])
    between = (sizes * (means - logarithms.mean()) ** 2).sum() / (days - 1)
    within = sum(((group - group.mean()) ** 2).sum() for group in groups) / (n - days)
    size = (n - (sizes**2).sum() / n) / (days - 1)
    return float(max((between - within) / (between + (size - 1) * within), 0))


def figure_of_choices(few: pd.DataFrame) -> Figure:
    """Draw the errors of six choices of keypoints, over those of all, with both estimators."""
    drawing, panels = style.new_figure(1, len(DECIDING), 2.6, sharex=True, sharey=True)
    drawn = list(CHOICES)[:DRAWN]
    looks = {"thesis": (style.BLUE, -0.15), "refined": (style.RED, 0.15)}
    for panel, error in zip(panels, DECIDING, strict=True):
        for estimator, (color, aside) in looks.items():
            runs = few[few["estimator"] == estimator]
            every = runs[runs["choice"] == "all"]
            for place, title in enumerate(drawn):
                chosen = of_choice(runs, title)
                typical = ratios.typical_ratio(ratios.ratios_of(chosen, every, error))
                ends = np.clip([typical["low"], typical["high"]], 1 / REACH, REACH)
                look = style.interval_style(color)
                panel.plot(ends, [place + aside] * 2, **look)
                label = SHOWN[estimator] if not place else None
                mark = {"color": color, "markersize": 4, "label": label}
                panel.plot(typical["ratio"], place + aside, "D", **mark)
        style.ratio_rows(panel, [CALLED.get(title, title) for title in drawn], REACH)
        panel.set_title(ERRORS[error].plainly)
        panel.set_xlabel("divided by that of all keypoints", fontsize=8)
    style.legend_below(drawing, panels[:1], 2)
    return drawing


def write(read: Callable[[str], pd.DataFrame], folder: Any, note: str) -> None:
    """Write the table and the figure into a folder. read: of a table in it, by name."""
    few, runs = read("few_keypoints_runs"), read("runs")
    style.save_table(table_of_pairs(few, runs), folder, "equal_number", note)
    with style.applied():
        style.save_figure(figure_of_choices(few), folder, "equal_number", note)
