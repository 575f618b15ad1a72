"""What an outcome is called: one table of rules, and the one function that reads it.

Texts and captions take the level, the margins and the words from here. The rules were fixed before
the runs that the tables show, with two exceptions that docs/reading-results.md names: the kind of
interval (`ratios.typical_interval`), and NO_WORSE. What factor is TOO_FAR was fixed before the
table of the check (`worth_check`), but when a trial of it was known.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

LEVEL = 95  # percent, of intervals that show a difference
NARROW_LEVEL = 90  # percent, of intervals within a margin: two one-sided tests at 5 %
# With fewer sequences, all ratios lie on the same side of 1 by chance in more than 5 % of cases (2
# / 2**n).
MIN_SEQUENCES = 6
DISAGREEING = 2  # new sequences on the other side of 1 than the others, of any quantity

LOWER, HIGHER = "lower", "higher"
LESS, MORE, AS_MUCH = "less", "more", "as much"
AS_GOOD, NO_WORSE, NEITHER = "as good", "no worse", "neither"
NO_CLEAR_DIFFERENCE = "no clear difference"
NOT_JUDGED = "not judged"
TOO_FEW = "too few sequences to tell"


class Rule(NamedTuple):
    """The words for the outcomes of one comparison of ratios.

    below, above: the whole intervals of LEVEL lie on this side of 1, for all quantities together.
    within: the intervals of NARROW_LEVEL lie between 1 / margin and margin. under: only their upper
    ends lie below it. Neither is said of a choice that fails on more sequences. otherwise: none of
    these. margins: of the quantities. too_far: by word, the factor by which a check against the
    truth may find the measure wrong before the word is NOT_JUDGED.
    """

    below: str = NO_CLEAR_DIFFERENCE
    above: str = NO_CLEAR_DIFFERENCE
    within: str = NO_CLEAR_DIFFERENCE
    under: str = NO_CLEAR_DIFFERENCE
    otherwise: str = NO_CLEAR_DIFFERENCE
    margins: Mapping[str, float] = {}
    too_far: Mapping[str, float] = {}


# of errors, divided by those with all keypoints or with other masks
ERROR = Rule(LOWER, HIGHER)
# of shares of failed runs, by the sign test
FAILURES = Rule(LOWER, HIGHER)
# A word about a side can be right where a size is not, so it stands up to a factor of 1.5; AS_MUCH
# is about a size, so its margin is the limit.
TOO_FAR = {LESS: 1.5, MORE: 1.5, NO_CLEAR_DIFFERENCE: 1.5, AS_MUCH: 1.25}
# of what a keypoint is worth, compared with random ones
WORTH = Rule(LESS, MORE, AS_MUCH, margins={"rotation": 1.25, "direction": 1.25}, too_far=TOO_FAR)
# of errors with few keypoints, which may be a little larger. NO_WORSE was added when the results
# were known, because AS_GOOD also refuses choices that are better.
FEW_KEYPOINTS = Rule(
    within=AS_GOOD,
    under=NO_WORSE,
    otherwise=NEITHER,
    margins={"se3": 1.25, "rotation": 1.1},
)


def verdict(
    rule: Rule,
    n: int,
    sides: Iterable[int] = (),
    narrow: Iterable[tuple[str, float, float]] = (),
    fails_more: bool = False,
    new_disagree: bool = False,
    off: float = 1,
) -> str:
    """Return the word of a rule for an outcome on n sequences; TOO_FEW for fewer than six.

    sides: of each quantity, where its interval of LEVEL lies: -1 below 1, 1 above, 0 around it.
    narrow: (quantity, low, high) of the intervals of NARROW_LEVEL. fails_more: whether it fails on
    more sequences than what it is compared with. new_disagree: whether new sequences do (see
    `disagree`), so that no side is told. off: the largest factor by which a check against the truth
    found a quantity wrong; NaN without a check.
    """
    word = _word(rule, n, set(sides), list(narrow), fails_more, new_disagree)
    return NOT_JUDGED if off > rule.too_far.get(word, np.inf) else word


def _word(
    rule: Rule,
    n: int,
    sides: set[int],
    narrow: list[tuple[str, float, float]],
    fails_more: bool,
    new_disagree: bool,
) -> str:
    """Return the word before any check of the measure."""
    if n < MIN_SEQUENCES:
        return TOO_FEW
    if new_disagree and sides in ({-1}, {1}):
        return rule.otherwise
    if sides == {-1}:
        return rule.below
    if sides == {1}:
        return rule.above
    ends = [(low * rule.margins[name], high / rule.margins[name]) for name, low, high in narrow]
    if not ends or fails_more or not all(high < 1 for _, high in ends):
        return rule.otherwise
    if all(low > 1 for low, _ in ends):
        return rule.within
    return rule.under


def disagree(typical: float, new: Iterable[float]) -> bool:
    """Return whether new sequences, on which nothing was chosen, disagree with the others.

    typical: the typical logarithm of the others. new: the logarithms of the new ones.
    """
    return sum(each * typical < 0 for each in new) >= DISAGREEING
