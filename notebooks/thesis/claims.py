"""What became of the claims of the thesis: one word for each, by one rule.

**The rule.** A claim is tested in the thesis's own way: its estimator, its error, its procedure, on
the streets at hand. It is

- REPRODUCED if what it says is shown,
- NOT_REPRODUCED if the opposite is shown, or that what it says is smaller than would matter,
- CANNOT_TELL in all other cases: also if the data are not at hand, if there are too few streets,
  and if the procedure gives the same where nothing differs (`against_chance`).

Each function below is the rule for one kind of claim. Intervals and their levels are those of
`verdicts` and `ratios`; a difference matters from the MARGIN on. Better ways (another estimator,
other errors, a width that was fixed before) stand beside the word and do not change it: they have
verdicts of their own.

The rule was written when the tables of runs were known, and before any table of claims was made.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from keypoint_study import ratios, verdicts

REPRODUCED, NOT_REPRODUCED = "reproduced", "not reproduced"
CANNOT_TELL = "cannot be told"
MARGIN = verdicts.FEW_KEYPOINTS.margins["se3"]  # of the RMSE and the MAE, too: errors of a path


def is_on_side(of_streets: pd.Series, side: int) -> str:
    """Return the word for a claim that errors are lower (side -1) or higher (1).

    of_streets: a ratio of errors for each street. The opposite is shown by the interval of LEVEL on
    the other side of 1. What is smaller than would matter: no difference is shown, and the interval
    of NARROW_LEVEL does not reach MARGIN on the claimed side.
    """
    typical = ratios.typical_ratio(of_streets)
    found = ratios.side_of_one(typical["low"], typical["high"])
    low, high = ratios.narrow_interval(of_streets)
    reach = high if side > 0 else 1 / low
    return _word(typical["n"], found == side, found == -side or (not found and reach < MARGIN))


def is_as_good(of_streets: pd.Series) -> str:
    """Return the word for a claim that errors are no larger.

    It is shown if the interval of NARROW_LEVEL ends below MARGIN, as for NO_WORSE; the opposite if
    that of LEVEL lies above 1, which goes first.
    """
    typical = ratios.typical_ratio(of_streets)
    larger = ratios.side_of_one(typical["low"], typical["high"]) == 1
    _, high = ratios.narrow_interval(of_streets)
    return _word(typical["n"], high < MARGIN, larger)


def is_within(interval: tuple[float, float], least: float, most: float, n: int) -> str:
    """Return the word for a claim that a number lies between two others.

    interval: of LEVEL, of a mean over n streets. Inside: shown; wholly outside: the opposite.
    """
    low, high = interval
    return _word(n, least <= low and high <= most, high < least or low > most)


def is_share(count: int, n: int, least: float) -> str:
    """Return the word for a claim that something holds on more than a share of the sequences.

    count: of n streets, on which it holds. Its share has the exact interval of LEVEL (Clopper and
    Pearson).
    """
    low, high = binomtest(count, n).proportion_ci(verdicts.LEVEL / 100)
    return _word(n, low > least, high < least)


def is_everywhere(count: int, n: int) -> str:
    """Return the word for a claim about every sequence. One exception shows the opposite."""
    return _word(n, count == n, count < n)


def is_on_one(count: int, runs: int) -> str:
    """Return the word for a claim about one named sequence: it holds in half of the runs or more.

    Repetitions are no streets, so the word is about this sequence alone.
    """
    return REPRODUCED if count >= runs / 2 else NOT_REPRODUCED


def are_apart(larger: tuple[float, float], smaller: tuple[float, float]) -> str:
    """Return the word for a claim that one mean is larger than another, from their intervals.

    For tables without a value for each street. Intervals that overlap show nothing.
    """
    shown, opposite = larger[0] > smaller[1], larger[1] < smaller[0]
    return _word(verdicts.MIN_SEQUENCES, shown, opposite)


def against_chance(found: float, by_chance: Sequence[float] | np.ndarray) -> str:
    """Return the word for a claim that the thesis's procedure finds a reduction.

    found: what it finds here; by_chance: what it finds in simulated studies in which masks do
    nothing. Larger numbers are smaller reductions. Shown only by a number below the middle LEVEL
    percent of the simulated ones, the opposite by one above them.
    """
    tail = (1 - verdicts.LEVEL / 100) / 2
    low, high = np.quantile(by_chance, [tail, 1 - tail])
    return _word(verdicts.MIN_SEQUENCES, found < low, found > high)


def _word(n: int, shown: bool, opposite: bool) -> str:
    """Return the word; fewer than MIN_SEQUENCES streets tell nothing."""
    if n < verdicts.MIN_SEQUENCES:
        return CANNOT_TELL
    if opposite:
        return NOT_REPRODUCED
    return REPRODUCED if shown else CANNOT_TELL
