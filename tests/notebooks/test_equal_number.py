"""What a verdict hangs on, with made-up streets of which one, two or a day decide."""

import numpy as np
import pandas as pd
import pytest

from keypoint_study import ratios, verdicts
from thesis import equal_number

STREETS = sorted(street for streets in equal_number.DAYS.values() for street in streets)


def table(of_street):
    """Ratios of both deciding errors: those given, and 1.2 (1.21, ...) on all other streets."""
    usual = {street: 1.2 + 0.01 * place for place, street in enumerate(STREETS)}
    return pd.DataFrame({name: usual | of_street for name in equal_number.DECIDING})


def test_a_verdict_of_all_streets_hangs_on_none():
    of_streets = table({})
    assert equal_number.word(of_streets) == verdicts.HIGHER
    assert equal_number.hangs_on(of_streets) == "nothing"


def test_a_verdict_that_hangs_on_streets_says_so():
    """Two streets of one day hold against all others, so one pair and one day decide."""
    of_streets = table({"05": 0.5, "06": 0.55})
    assert equal_number.word(of_streets) == verdicts.NO_CLEAR_DIFFERENCE
    assert equal_number.hangs_on(of_streets) == "two sequences (1 of 55); a day (1 of 3)"
    new = table(dict.fromkeys(equal_number.NEW, 0.5))
    assert "the new sequences" in equal_number.hangs_on(new)
    one_far_off = table({street: 1.01 for street in STREETS} | {"01": 99.0})
    assert equal_number.hangs_on(one_far_off) == "the signed rank"


def test_fewer_than_six_streets_tell_nothing():
    assert equal_number.word(table({}).iloc[:5]) == verdicts.TOO_FEW
    assert equal_number.hangs_on(table({}).iloc[:6]).startswith("one sequence (6 of 6); ")


def test_half_of_the_runs_make_a_street_fail():
    runs = pd.DataFrame({"sequence": list("aabbcc"), "failed": [1, 0, 0, 0, 1, 1]})
    assert equal_number.failing(runs) == "2 of 3"


def test_the_share_of_days_is_found():
    random = np.random.default_rng(0)
    found = [
        np.mean([equal_number.share_of_days(np.exp(_errors(random, share))) for _ in range(100)])
        for share in (0, 0.5, 0.99)
    ]
    # never below 0, so its mean is above 0 where days do not differ
    assert found == pytest.approx([0.1, 0.45, 0.97], abs=0.1)


@pytest.mark.torture
def test_how_often_streets_of_one_day_mislead(capsys):
    """Prints percent of studies without a difference whose interval excludes 1, or whose two do.

    The verdict of two is that of both deciding errors, which are correlated.
    """
    random, rates, of_two = np.random.default_rng(0), {}, {}
    for share in (0, 0.4):
        intervals = [ratios.typical_interval(_errors(random, share))[1:] for _ in range(2000)]
        sides = [ratios.side_of_one(*np.exp(ends)) for ends in intervals]
        rates[share] = np.count_nonzero(sides) / 20
        for correlation in (0.5, 0.8):
            words = [equal_number.word(_both(random, share, correlation)) for _ in range(2000)]
            wrong = len(words) - words.count(verdicts.NO_CLEAR_DIFFERENCE)
            of_two[share, correlation] = wrong / 20
    with capsys.disabled():
        print(f"\nan interval errs (%), by the share of variance of a day: {rates}")
        print(f"two err together (%), by this share and the errors' correlation: {of_two}")
    assert rates[0] < 6 < rates[0.4]
    assert of_two[0, 0.8] < 3 < of_two[0.4, 0.5] < of_two[0.4, 0.8] < rates[0.4]


def _both(random, share, correlation):
    """Ratios of both deciding errors, without a difference."""
    first, other = (_errors(random, share) for _ in range(2))
    second = correlation * first + np.sqrt(1 - correlation**2) * other
    return np.exp(pd.DataFrame(dict(zip(equal_number.DECIDING, (first, second), strict=True))))


def _errors(random, share):
    """Logarithms of ratios without a difference; a day has a share of their variance."""
    days = [street for streets in equal_number.DAYS.values() for street in streets]
    of_days = np.repeat(
        random.normal(0, np.sqrt(share), len(equal_number.DAYS)),
        [len(streets) for streets in equal_number.DAYS.values()],
    )
    return pd.Series(of_days + random.normal(0, np.sqrt(1 - share), len(days)), days)
