"""Every outcome of every rule, and both sides of each limit."""

import numpy as np
import pandas as pd
import pytest

from keypoint_study import ratios, verdicts
from keypoint_study.path_errors import ERRORS
from keypoint_study.verdicts import verdict, verdict_on_few

INSIDE = [("se3", 0.81, 1.24), ("rotation", 0.92, 1.09)]
BETTER = [("se3", 0.5, 1.24), ("rotation", 0.92, 0.95)]


@pytest.mark.parametrize(
    "sides, word",
    [
        ([-1, -1], "lower"),
        ([1], "higher"),
        ([1, -1], "no clear difference"),
        ([-1, 0], "no clear difference"),
        ([], "no clear difference"),
    ],
)
def test_all_intervals_have_to_lie_on_one_side(sides, word):
    assert verdict(6, sides) == word and verdict(5, sides) == verdicts.TOO_FEW


@pytest.mark.parametrize(
    "narrow, fails_more, word",
    [
        (INSIDE, False, "as good"),
        (INSIDE, True, "neither"),
        (BETTER, False, "no worse"),
        (BETTER, True, "neither"),
        ([*BETTER, ("rotation", 1, 1.11)], False, "neither"),
        ([("se3", 1, float("nan"))], False, "neither"),
    ],
)
def test_few_keypoints_are_as_good_no_worse_or_neither(narrow, fails_more, word):
    assert verdict_on_few(6, narrow, fails_more) == word
    assert verdict_on_few(5, narrow, fails_more) == verdicts.TOO_FEW


MARGINS = {name: error.margin for name, error in ERRORS.items() if error.decides}


@pytest.mark.parametrize("name", MARGINS)
def test_an_interval_is_within_its_margin_or_a_thousandth_outside(name):
    margin = MARGINS[name]
    others = [(each, 1, 1) for each in MARGINS if each != name]
    for low, high, word in (
        (1 / margin + 0.001, margin - 0.001, "as good"),
        (1 / margin - 0.001, margin - 0.001, "no worse"),
        (1 / margin + 0.001, margin + 0.001, "neither"),
        (1 / margin + 0.001, margin, "neither"),
    ):
        assert verdict_on_few(6, [*others, (name, low, high)], False) == word


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
        (ratios.far_off, (pd.Series([1, 90.0]),), []),  # which of the two?
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
