"""Every outcome of every rule, and both sides of each limit."""

import numpy as np
import pandas as pd
import pytest

from keypoint_study import ratios, verdicts
from keypoint_study.verdicts import ERROR, FAILURES, FEW_KEYPOINTS, verdict

INSIDE = [("se3", 0.81, 1.24), ("rotation", 0.92, 1.09)]
BETTER = [("se3", 0.5, 1.24), ("rotation", 0.92, 0.95)]


@pytest.mark.parametrize(
    "rule, outcome, word",
    [
        (ERROR, {"sides": [-1, -1]}, "lower"),
        (ERROR, {"sides": [1]}, "higher"),
        (ERROR, {"sides": [1, -1]}, "no clear difference"),
        (ERROR, {"sides": [-1, 0]}, "no clear difference"),
        (FAILURES, {"sides": [1]}, "higher"),
        (FEW_KEYPOINTS, {"narrow": INSIDE}, "as good"),
        (FEW_KEYPOINTS, {"narrow": INSIDE, "fails_more": True}, "neither"),
        (FEW_KEYPOINTS, {"narrow": BETTER}, "no worse"),
        (FEW_KEYPOINTS, {"narrow": [*BETTER, ("rotation", 1, 1.11)]}, "neither"),
        (FEW_KEYPOINTS, {"narrow": [("se3", 1, float("nan"))]}, "neither"),
    ],
)
def test_the_word_is_that_of_the_rule_and_five_sequences_have_none(rule, outcome, word):
    assert verdict(rule, 6, **outcome) == word
    assert verdict(rule, 5, **outcome) == verdicts.TOO_FEW


MARGINS = [
    (FEW_KEYPOINTS, "se3", 1.25, "as good", "no worse", "neither"),
    (FEW_KEYPOINTS, "rotation", 1.1, "as good", "no worse", "neither"),
]


@pytest.mark.parametrize("rule, name, margin, within, under, otherwise", MARGINS)
def test_an_interval_is_within_its_margin_or_a_thousandth_outside(
    rule, name, margin, within, under, otherwise
):
    others = [(each, 1, 1) for each in rule.margins if each != name]
    for low, high, word in (
        (1 / margin + 0.001, margin - 0.001, within),
        (1 / margin - 0.001, margin - 0.001, under),
        (1 / margin + 0.001, margin + 0.001, otherwise),
        (1 / margin + 0.001, margin, otherwise),
    ):
        assert verdict(rule, 6, narrow=[*others, (name, low, high)]) == word


@pytest.mark.parametrize(
    "function, arguments, value",
    [
        (ratios.side_of_one, (1.001, 2), 1),
        (ratios.side_of_one, (1, 2), 0),
        (ratios.side_of_one, (0.5, 0.999), -1),
        (ratios.side_of_one, (0.5, 1), 0),
        (ratios.side_of_one, (np.nan, np.nan), 0),
        # the chance of each, on both sides: 3, 6, 4 and 7 %
        (ratios.side_of_counts, (6, 0), 1),
        (ratios.side_of_counts, (0, 5), 0),
        (ratios.side_of_counts, (1, 8), -1),
        (ratios.side_of_counts, (7, 1), 0),
        (ratios.far_off, (pd.Series([1, 1, 2.999, 1 / 2.999]),), []),
        (ratios.far_off, (pd.Series([1, 1, 1, 3.001, 1 / 3.001]),), [3, 4]),
        (ratios.far_off, (pd.Series([1, 1, 9.0]),), [2]),
        (ratios.failing_sequences, (pd.Series([1, 1, 0, 1, 0, 0], [0, 0, 1, 1, 2, 2]),), 2),
        (ratios.failing_sequences, (pd.Series([1, 0, 0], [0, 0, 0]),), 0),
    ],
)
def test_limits_of_ratios_and_counts(function, arguments, value):
    assert function(*arguments) == value


def test_how_much_shuffles_change_an_error():
    runs = pd.DataFrame({"method": ["baseline", "baseline", "masked"], "rmse": [1.0, 4.0, 9.0]})
    table = ratios.range_of_shuffles(runs.assign(sequence="00", estimator="thesis"))
    (row,) = table.to_dict("records")
    assert [row[name] for name in ("mean", "lowest", "highest", "factor")] == [2.5, 1, 4, 4]
