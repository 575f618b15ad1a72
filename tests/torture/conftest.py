"""Torture: faults and bad input tried on purpose, by real commands run as processes (`make torture`).

A test here runs with `--torture` alone; one that is marked `short` runs among all others too. Each trial is entered in
the ledger, whose counts are printed at the end:

    def test_a_truncated_frame(ledger, command, tiny_kitti):
        ...
        with ledger("bad inputs", "a truncated frame"):
            clear(command("odometry", "--kitti", tiny_kitti, "--sequence", "00"), "000003.png", "copy")
"""

from pathlib import Path

import pytest
import trials

HERE = Path(__file__).parent
LEDGER = pytest.StashKey[trials.Ledger]()


def pytest_collection_modifyitems(config, items):
    ours = [item for item in items if item.path.is_relative_to(HERE)]
    for item in ours:
        item.add_marker(pytest.mark.torture)
        item.add_marker(pytest.mark.slow)
    left_out = [] if config.getoption("--torture") else [item for item in ours if not item.get_closest_marker("short")]
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)


@pytest.fixture
def ledger(request):
    """The session's `trials.Ledger`: `with ledger(kind, what):` is a trial of "kills", "faults" or "bad inputs"."""
    return request.config.stash.setdefault(LEDGER, trials.Ledger())


@pytest.fixture
def command(tmp_path):
    """Runs the real command line in `tmp_path`: command(*words, **environment) returns a `trials.Result`.

    before: a function that the new process calls first; timeout: seconds, of a command that may take longer.
    """

    def run(*words, before=None, timeout=trials.TIMEOUT, **environment):
        seen = trials.snapshot(tmp_path)
        return trials.finish(trials.start(*words, where=tmp_path, before=before, **environment), tmp_path, seen,
                             timeout)

    return run


def pytest_terminal_summary(terminalreporter, config):
    ledger = config.stash.get(LEDGER, None)
    if ledger and ledger.rows:
        terminalreporter.section("torture")
        terminalreporter.write_line(ledger.text())
