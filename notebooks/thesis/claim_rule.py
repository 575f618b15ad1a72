"""The rule for what became of a claim of the thesis: each function gives one of five words.

Intervals and their levels are those of `verdicts` and `ratios`. An error matters from its margin on
(`path_errors.ERRORS`). What the words mean, and when the rule was written, stands in WORDS and
HISTORY, which the page of the claims shows.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm, rankdata, spearmanr

from keypoint_study import ratios, verdicts
from keypoint_study.path_errors import ERRORS

REPRODUCED, NOT_REPRODUCED = "reproduced", "not reproduced"
NO_EVIDENCE, UNDECIDED, NOT_TESTED = "no evidence", "undecided", "not tested"
MARGIN = ERRORS["se3"].margin  # of the RMSE, the MAE and times, too
WORDS = {
    REPRODUCED: "what it says is shown",
    NOT_REPRODUCED: "the opposite is shown, or that it is smaller than would matter",
    NO_EVIDENCE: "its procedure finds as much where masks do nothing",
    UNDECIDED: "neither; the cell says what these sequences would have shown in 80 % of studies, and "
    "how many would be needed",
    NOT_TESTED: "the cell says what is needed",
}
HISTORY = (
    "**When the rule was written.** 1.1.0 said that its rule was older than any table of claims. This "
    "was not so: a first table had 5 claims reproduced, 4 not, and 16 that could not be told, and then "
    "three words changed: a few hundred (999 keypoints in place of 500), a tenth lost (a rule for what "
    "can happen), large and small things. The rule here was written when all runs and all those words "
    "were known, and before any word by it. One choice came after: of keypoints without masks, the "
    "number is that of width 10; with that of the best widths, which stands beside, the word would be "
    "undecided."
)
STUDIES = 400  # that are drawn for the power of a test
POWER = 0.8
MOST = 3000  # sequences that are tried
EXACT = 50  # sequences, from which on the normal distribution is close enough

Error = tuple[pd.Series, float]  # a ratio for each sequence, and the margin of the error


def on_side(side: int, *errors: Error) -> str:
    """Return the word for a claim that errors are lower (side -1) or higher (1).

    All errors must show it, or the opposite. Smaller than would matter: of no error is it shown,
    and no interval of NARROW_LEVEL reaches the margin on the claimed side.
    """
    words = []
    for of_sequences, margin in errors:
        typical = ratios.typical_ratio(of_sequences)
        found = ratios.side_of_one(typical["low"], typical["high"])
        low, high = ratios.narrow_interval(of_sequences)
        reach = high if side > 0 else 1 / low
        is_small = not found and reach < margin
        words.append(_word(typical["n"], found == side, found == -side or is_small))
    return agreed(words)


def as_good(*errors: Error) -> str:
    """Return the word for a claim that errors are no larger.

    It is shown if each interval of NARROW_LEVEL ends below the margin, as for NO_WORSE; the
    opposite if those of LEVEL lie above 1.
    """
    words = []
    for of_sequences, margin in errors:
        typical = ratios.typical_ratio(of_sequences)
        is_larger = ratios.side_of_one(typical["low"], typical["high"]) == 1
        _, high = ratios.narrow_interval(of_sequences)
        words.append(_word(typical["n"], high < margin, is_larger))
    return agreed(words)


def in_range(value: float, low: float, high: float, least: float, most: float) -> str:
    """Return the word for a number that is said to be about `least` to `most`.

    low, high: its interval. About: MARGIN further at both ends. It is shown if the number lies in
    the range, and its interval in the wider one; the opposite if the interval misses that one.
    """
    wide = least / MARGIN, most * MARGIN
    is_inside = least <= value <= most and wide[0] <= low and high <= wide[1]
    return _word(verdicts.MIN_SEQUENCES, is_inside, high < wide[0] or low > wide[1])


def at_most(low: float, high: float, limit: float) -> str:
    """Return the word for a number that is said to be no larger than a limit, by its interval."""
    return _word(verdicts.MIN_SEQUENCES, high <= limit, low > limit)


def apart(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """Return the word for a mean that is said to be smaller than another; both have low, high."""
    is_smaller, is_larger = first["high"] < second["low"], first["low"] > second["high"]
    return _word(verdicts.MIN_SEQUENCES, is_smaller, is_larger)


def against_chance(found: float, by_chance: pd.Series) -> str:
    """Return the word for a reduction that the thesis's procedure finds.

    found: the median of its repetitions. by_chance: of simulated studies in which masks do nothing.
    Larger numbers are smaller reductions. What lies within the middle LEVEL percent is no evidence.
    """
    tail = (1 - verdicts.LEVEL / 100) / 2
    low, high = by_chance.quantile([tail, 1 - tail])
    if low <= found <= high:
        return NO_EVIDENCE
    return REPRODUCED if found < low else NOT_REPRODUCED


def in_all(holds: Sequence[bool] | np.ndarray) -> str:
    """Return the word for what is said of named sequences, or of a network: it holds in all."""
    if all(holds):
        return REPRODUCED
    return UNDECIDED if any(holds) else NOT_REPRODUCED


def can_happen(failing: int, failing_otherwise: int) -> str:
    """Return the word for what can happen. Sequences on which it does not never refute it."""
    return REPRODUCED if failing > failing_otherwise else UNDECIDED


def grows(first: pd.Series, second: pd.Series) -> str:
    """Return the word for a claim that one number of a sequence grows with another one."""
    found = spearmanr(first, second)
    is_clear = found.pvalue < 1 - verdicts.LEVEL / 100
    return _word(len(first), is_clear and found.statistic > 0, is_clear and found.statistic < 0)


def agreed(words: Sequence[str]) -> str:
    """Return the word of several measures of one claim: all must say the same."""
    return words[0] if len(set(words)) == 1 else UNDECIDED


def _word(n: int, shown: bool, opposite: bool) -> str:
    """Return the word; fewer than MIN_SEQUENCES sequences decide nothing."""
    if n < verdicts.MIN_SEQUENCES or not (shown or opposite):
        return UNDECIDED
    return NOT_REPRODUCED if opposite else REPRODUCED


# What sequences can show


def seen(of_sequences: pd.Series, side: int) -> float:
    """Return the factor that as many sequences, as different as these, show with POWER."""
    differences = _differences(of_sequences)
    least, most = 0.0, np.log(1000)
    for _ in range(12):
        middle = (least + most) / 2
        if _power(differences, side * middle, len(differences), verdicts.LEVEL) < POWER:
            least = middle
        else:
            most = middle
    return float(np.exp(side * most))


def needed(of_sequences: pd.Series, factor: float, level: float = verdicts.LEVEL) -> str:
    """Return how many sequences show a factor with POWER, if they are as different as these.

    As a text, to two digits: "more than 3000" if so many do not.
    """
    differences, shift = _differences(of_sequences), np.log(factor)
    least, most = verdicts.MIN_SEQUENCES, MOST
    if _power(differences, shift, most, level) < POWER:
        return f"more than {MOST}"
    while most > least + 1 and most > 1.02 * least:
        middle = round(np.sqrt(least * most))
        if _power(differences, shift, middle, level) < POWER:
            least = middle
        else:
            most = middle
    return f"{float(f'{most:.2g}'):.0f}"


def _differences(of_sequences: pd.Series) -> np.ndarray:
    """Return how the logarithms of the ratios differ from the typical one."""
    logarithms = np.log(of_sequences.to_numpy())
    return np.asarray(logarithms - ratios.typical_interval(logarithms)[0])


def _power(differences: np.ndarray, shift: float, n: int, level: float) -> float:
    """Return the share of studies of n sequences in which the signed rank shows a shift."""
    drawn = np.random.default_rng(0).choice(differences, (STUDIES, n)) + shift
    ranks = rankdata(np.abs(drawn), axis=1)
    against = (ranks * (drawn * np.sign(shift) < 0)).sum(axis=1)  # rank sums of the other side
    if n > EXACT:
        deviation = np.sqrt(n * (n + 1) * (2 * n + 1) / 24)
        critical = n * (n + 1) / 4 + deviation * norm.ppf((100 - level) / 200)
    else:
        critical = ratios.rejected_sums(n, level)
    return float((against < critical).mean())
