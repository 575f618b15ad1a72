"""Every outcome of every rule."""

import pytest

from keypoint_study import verdicts
from keypoint_study.verdicts import ERRORS, FAILURES, FEW_KEYPOINTS, WORTH, verdict

INSIDE = [("se3", 0.81, 1.24), ("rotation", 0.92, 1.09)]
BETTER = [("se3", 0.5, 1.24), ("rotation", 0.92, 0.95)]
ALIKE = [("rotation", 0.81, 1.24), ("direction", 0.9, 1.1)]


@pytest.mark.parametrize(
    "rule, outcome, word",
    [
        (ERRORS, {"sides": [-1, -1]}, "lower"),
        (ERRORS, {"sides": [1]}, "higher"),
        (ERRORS, {"sides": [1, -1]}, "no clear difference"),
        (ERRORS, {"sides": [-1, 0]}, "no clear difference"),
        (FAILURES, {"sides": [1]}, "higher"),
        (WORTH, {"sides": [-1] * 4, "narrow": ALIKE}, "less"),
        (WORTH, {"sides": [1] * 4}, "more"),
        (WORTH, {"sides": [0, 1], "narrow": ALIKE}, "as much"),
        (WORTH, {"sides": [0], "narrow": [*ALIKE, ("direction", 0.79, 1)]}, "no clear difference"),
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
