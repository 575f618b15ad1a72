"""What an outcome is called: one table of rules, and the one function that reads it.

Texts and captions take the level, the margins and the words from here. The rules were fixed before
the runs that the tables show, with two exceptions that docs/reading-results.md names: the kind of
interval (`ratios.typical_interval`), and NO_WORSE.
"""

from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

LEVEL = 95  # percent, of intervals that show a difference
NARROW_LEVEL = 90  # percent, of intervals within a margin: two one-sided tests at 5 %
# With fewer sequences, all ratios lie on the same side of 1 by chance in more than 5 % of cases (2
# / 2**n).
MIN_SEQUENCES = 6

LOWER, HIGHER = "lower", "higher"
AS_GOOD, NO_WORSE, NEITHER = "as good", "no worse", "neither"
NO_CLEAR_DIFFERENCE = "no clear difference"
TOO_FEW = "too few sequences to tell"


class Rule(NamedTuple):
    """The words for the outcomes of one comparison of ratios.

    below, above: the whole intervals of LEVEL lie on this side of 1, for all quantities together.
    within: the intervals of NARROW_LEVEL lie between 1 / margin and margin. under: only their upper
    ends lie below it. Neither is said of a choice that fails on more sequences. otherwise: none of
    these. margins: of the quantities.
    """

    below: str = NO_CLEAR_DIFFERENCE
    above: str = NO_CLEAR_DIFFERENCE
    within: str = NO_CLEAR_DIFFERENCE
    under: str = NO_CLEAR_DIFFERENCE
    otherwise: str = NO_CLEAR_DIFFERENCE
    margins: Mapping[str, float] = {}


# of errors, divided by those with all keypoints or with other masks
ERROR = Rule(LOWER, HIGHER)
# of shares of failed runs, by the sign test
FAILURES = Rule(LOWER, HIGHER)
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
    sides: Collection[int] = (),
    narrow: Iterable[tuple[str, float, float]] = (),
    fails_more: bool = False,
) -> str:
    """Return the word of a rule for an outcome on n sequences; TOO_FEW for fewer than six.

    sides: of each quantity, where its interval of LEVEL lies: -1 below 1, 1 above, 0 around it.
    narrow: (quantity, low, high) of the intervals of NARROW_LEVEL. fails_more: whether it fails on
    more sequences than what it is compared with.
    """
    if n < MIN_SEQUENCES:
        return TOO_FEW
    if set(sides) == {-1}:
        return rule.below
    if set(sides) == {1}:
        return rule.above
    ends = [(low * rule.margins[name], high / rule.margins[name]) for name, low, high in narrow]
    if not ends or fails_more or not all(high < 1 for _, high in ends):
        return rule.otherwise
    if all(low > 1 for low, _ in ends):
        return rule.within
    return rule.under
