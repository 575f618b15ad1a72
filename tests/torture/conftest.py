"""Torture: kills, faults and bad input tried on purpose, by real commands run as processes (`make torture`).

A test here runs with `--torture` alone; one that is marked `short` runs among all others too. Each trial is entered in
the ledger, whose counts are printed at the end.
"""

from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from subprocess import TimeoutExpired

import pytest
from trials import KINDS, OUTCOMES, Lost

HERE = Path(__file__).parent


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
    """`with ledger(kind, what, times=1):` is so many trials; "lost" where it raises `Lost` or hangs, else "unclear"
    where it raises, else "clear"."""
    @contextmanager
    def trial(kind, what, times=1):
        outcome = "unclear"
        try:
            yield
            outcome = "clear"
        except pytest.skip.Exception:
            times = 0
            raise
        except (Lost, TimeoutExpired):
            outcome = "lost"
            raise
        finally:
            request.node.user_properties += [("trial", (kind, what, outcome))] * times

    return trial


@pytest.fixture(scope="session")
def small_model(tmp_path_factory):
    """The thesis's network at 64x64 with 4 filters, untrained, as a file."""
    from thesis_repro.cityscapes import N_CLASSES
    from thesis_repro.segmentation.unet import build_unet

    path = tmp_path_factory.mktemp("model") / "model.keras"
    build_unet((64, 64, 1), N_CLASSES, 4).save(path)
    return path


def pytest_terminal_summary(terminalreporter):
    reports = [report for reports in terminalreporter.stats.values() for report in reports
               if getattr(report, "when", None) == "call"]
    trials = [tuple(value) for report in reports for name, value in report.user_properties if name == "trial"]
    if not trials:
        return
    counts = Counter((kind, outcome) for kind, _, outcome in trials)
    terminalreporter.section("torture")
    terminalreporter.write_line(f"{'':12}" + "".join(f"{outcome:>9}" for outcome in OUTCOMES))
    for kind in KINDS:
        terminalreporter.write_line(f"{kind:12}" + "".join(f"{counts[kind, outcome]:9}" for outcome in OUTCOMES))
    for kind, what, outcome in trials:
        if outcome != "clear":
            terminalreporter.write_line(f"{outcome}: {kind}: {what}")
