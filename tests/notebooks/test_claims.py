"""The rule for what became of the thesis's claims, on numbers whose word is known."""

import numpy as np
import pandas as pd
import pytest

from thesis import claims
from thesis.claims import CANNOT_TELL, NOT_REPRODUCED, REPRODUCED

SHAPE = np.linspace(-1, 1, 11)


def ratios(centre, spread=0.02, streets=11):
    """A ratio for each of some streets, around a centre."""
    return pd.Series(np.exp(np.log(centre) + spread * SHAPE[:streets]))


@pytest.mark.parametrize(
    "centre, spread, higher, lower, as_good",
    [
        (2, 0.02, REPRODUCED, NOT_REPRODUCED, NOT_REPRODUCED),
        (0.5, 0.02, NOT_REPRODUCED, REPRODUCED, REPRODUCED),
        # smaller than would matter
        (1, 0.02, NOT_REPRODUCED, NOT_REPRODUCED, REPRODUCED),
        # shown, though small
        (1.1, 0.02, REPRODUCED, NOT_REPRODUCED, NOT_REPRODUCED),
        (1, 2, CANNOT_TELL, CANNOT_TELL, CANNOT_TELL),
    ],
)
def test_errors_are_higher_lower_or_as_good(centre, spread, higher, lower, as_good):
    of_streets = ratios(centre, spread)
    assert claims.is_on_side(of_streets, 1) == higher
    assert claims.is_on_side(of_streets, -1) == lower
    assert claims.is_as_good(of_streets) == as_good


def test_five_streets_tell_nothing():
    few = ratios(3, streets=5)
    assert claims.is_on_side(few, 1) == claims.is_as_good(few) == CANNOT_TELL
    assert claims.is_within((3.5, 4.5), 3, 5, 5) == CANNOT_TELL
    assert claims.is_share(5, 5, 0.5) == claims.is_everywhere(5, 5) == CANNOT_TELL


@pytest.mark.parametrize(
    "interval, word",
    [
        ((3.2, 4.9), REPRODUCED),
        ((2.0, 2.9), NOT_REPRODUCED),
        ((5.1, 6.0), NOT_REPRODUCED),
        ((2.9, 3.1), CANNOT_TELL),
    ],
)
def test_a_number_lies_within_others(interval, word):
    assert claims.is_within(interval, 3, 5, 11) == word


@pytest.mark.parametrize(
    "count, word", [(0, NOT_REPRODUCED), (1, NOT_REPRODUCED), (3, CANNOT_TELL), (10, REPRODUCED)]
)
def test_more_than_half_of_eleven(count, word):
    assert claims.is_share(count, 11, 0.5) == word


def test_every_sequence_and_one():
    assert claims.is_everywhere(11, 11) == REPRODUCED
    assert claims.is_everywhere(10, 11) == NOT_REPRODUCED
    assert [claims.is_on_one(count, 5) for count in (2, 3)] == [NOT_REPRODUCED, REPRODUCED]
    assert [claims.can_happen(count, 1) for count in (0, 1, 2)] == [*[CANNOT_TELL] * 2, REPRODUCED]
    assert claims.are_apart((5, 6), (3, 4)) == REPRODUCED
    assert claims.are_apart((3, 4), (5, 6)) == NOT_REPRODUCED
    assert claims.are_apart((3, 5), (4, 6)) == CANNOT_TELL


def test_what_the_procedure_finds_without_masks_shows_nothing():
    by_chance = np.linspace(-25, -5, 1001)
    words = [claims.against_chance(found, by_chance) for found in (-30, -16, 0)]
    assert words == [REPRODUCED, CANNOT_TELL, NOT_REPRODUCED]


def test_the_rule_errs_as_seldom_as_its_intervals():
    """Streets that do not differ: "higher" is said of 2.5 % of studies, or less."""
    random = np.random.default_rng(0)
    studies = np.exp(random.normal(0, 0.5, (400, 11)))
    words = [claims.is_on_side(pd.Series(study), 1) for study in studies]
    assert 0 < words.count(REPRODUCED) <= 0.05 * len(studies)
    # so wide are 11 such streets that only some studies show that nothing matters
    assert 0 < words.count(NOT_REPRODUCED) < words.count(CANNOT_TELL)
