"""The frame of these trials: it must notice what is unclear or lost."""

import pytest
from trials import Lost, Result, refused

GOOD = "error: a.png: truncated; copy it again\n"


@pytest.mark.short
def test_a_clear_line_passes_and_everything_else_does_not():
    refused(Result(1, "", GOOD, ["out", "out/log.txt"]), "a.png", left=["out", "out/*"])
    with pytest.raises(Lost):
        refused(Result(0, "", "", []), "a.png")
    for bad in (Result(-9, "", GOOD, []), Result(1, "", "", []), Result(1, "", 2 * GOOD, []),
                Result(1, "", GOOD + "Traceback (most recent call last)", []), Result(1, "", "error: failed", []),
                Result(1, "", GOOD, ["out"])):
        with pytest.raises(AssertionError):
            refused(bad, "a.png")
