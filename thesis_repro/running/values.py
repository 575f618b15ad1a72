"""Values that people write as texts, for options and settings.

Each function raises ValueError for a text of another kind, and its name says in messages which kind
is wanted.
"""

import math


def positive_whole_number(text: str) -> int:
    """Return the whole number from 1 on in a text."""
    if int(text) < 1:
        raise ValueError
    return int(text)


def positive_factor(text: str) -> float:
    """Return the number above zero in a text, such as "0.5" or "1/255"."""
    above, _, below = text.partition("/") if "/" in text else (text, "", "1")
    factor = float(above) / (float(below) or math.nan)
    if not 0 < factor < math.inf:
        raise ValueError
    return factor


def number_of_frames(text: str) -> int | None:
    """Return the number of frames in a text, or None for "all"."""
    if text == "all":
        return None
    return positive_whole_number(text)


def list_of_widths(text: str) -> tuple[int, ...]:
    """Return the dilation widths, pixels, in a text such as "1-3,10", sorted."""
    chosen: set[int] = set()
    for word in text.split(","):
        first, _, last = word.partition("-")
        chosen.update(range(positive_whole_number(first), positive_whole_number(last or first) + 1))
    if not chosen:  # such as 5-1
        raise ValueError
    return tuple(sorted(chosen))
