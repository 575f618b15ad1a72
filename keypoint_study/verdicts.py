"""What an outcome is called: the rules.

Texts and captions take the level, the margins and the words from here. The rules were fixed before
the runs that the tables show, with two exceptions that docs/reading-results.md names: the kind of
interval (`ratios.typical_interval`), and NO_WORSE.
"""

from collections.abc import Collection, Iterable

from keypoint_study.path_errors import ERRORS

LEVEL = 95  # percent, of intervals that show a difference
NARROW_LEVEL = 90  # percent, of intervals within a margin: two one-sided tests at 5 %
# With fewer sequences, all ratios lie on the same side of 1 by chance in more than 5 % of cases (2
# / 2**n).
MIN_SEQUENCES = 6

LOWER, HIGHER = "lower", "higher"
AS_GOOD, NO_WORSE, NEITHER = "as good", "no worse", "neither"
NO_CLEAR_DIFFERENCE = "no clear difference"
TOO_FEW = "too few sequences to tell"


def verdict(n: int, sides: Collection[int]) -> str:
    """Return the word for ratios of errors, or shares of failed runs, on n sequences.

    sides: of each quantity, where its interval of LEVEL lies: -1 below 1, 1 above, 0 around it. All
    together have to lie on one side.
    """
    if n < MIN_SEQUENCES:
        return TOO_FEW
    if set(sides) == {-1}:
        return LOWER
    if set(sides) == {1}:
        return HIGHER
    return NO_CLEAR_DIFFERENCE


def verdict_on_few(n: int, narrow: Iterable[tuple[str, float, float]], fails_more: bool) -> str:
    """Return the word for errors with few keypoints, which may be a little larger.

    narrow: (error, low, high) of the intervals of NARROW_LEVEL. AS_GOOD: all lie between 1 / margin
    and margin (`path_errors.ERRORS`). NO_WORSE: only their upper ends lie below it; this was added
    when the results were known, because AS_GOOD also refuses choices that are better. Neither is
    said of a choice that fails on more sequences than all keypoints (fails_more).
    """
    if n < MIN_SEQUENCES:
        return TOO_FEW
    margins = {name: error.margin for name, error in ERRORS.items()}
    ends = [(low * margins[name], high / margins[name]) for name, low, high in narrow]
    if fails_more or not all(high < 1 for _, high in ends):
        return NEITHER
    if all(low > 1 for low, _ in ends):
        return AS_GOOD
    return NO_WORSE
