"""The frame of these trials: it must notice what is unclear or lost."""

import subprocess

import pytest
from trials import Ledger, Lost, Result, clear

pytestmark = pytest.mark.short

GOOD = Result(1, "", "error: a.png: truncated; copy it again\n", [])


def test_a_clear_line_passes_and_everything_else_does_not():
    clear(GOOD, "a.png", "copy")
    clear(Result(1, "", GOOD.stderr, ["out", "out/log.txt"]), left=["out", "out/*"])
    with pytest.raises(Lost, match="taken for good"):
        clear(Result(0, "", "", []))
    for bad in (Result(-9, "", GOOD.stderr, []), Result(1, "", "", []), Result(1, "", GOOD.stderr + "and more\n", []),
                Result(1, "", "Traceback (most recent call last)", []), Result(1, "", "error: failed", []),
                Result(1, "", GOOD.stderr, ["out"])):
        with pytest.raises(AssertionError):
            clear(bad, "a.png")


def test_the_ledger_counts_by_kind_and_names_what_is_not_clear():
    ledger = Ledger()
    with ledger("kills", "training", times=3):
        pass
    for error in (AssertionError, Lost, subprocess.TimeoutExpired("a", 1)):
        with pytest.raises((AssertionError, subprocess.TimeoutExpired)), ledger("faults", str(error)):
            raise error
    counts = [line.split()[-4:] for line in ledger.text().splitlines()[1:4]]
    assert counts == [["3", "3", "0", "0"], ["3", "0", "1", "2"], ["0", "0", "0", "0"]]
    assert len(ledger.text().splitlines()) == 7 and "unclear: faults: <class 'AssertionError'>" in ledger.text()


def test_what_a_command_leaves_is_seen(command, ledger, tiny_kitti):
    with ledger("bad inputs", "a sequence that is not there"):
        result = command("odometry", "--kitti", tiny_kitti, "--sequence", "07")
        clear(result, "sequences/07/image_0")
    result = command("odometry", "--kitti", tiny_kitti, "--sequence", "00", "--output", "out/poses.txt")
    assert result.returncode == 0 and result.left == ["out", "out/poses.txt"]
