"""Torture: kills, faults and bad input tried on purpose, by real commands run as processes (`make torture`).

A test here runs with `--torture` alone; one that is marked `short` runs among all others too. Each trial is entered in
the ledger, whose counts are printed at the end.
"""

import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path
from subprocess import TimeoutExpired

import pytest
from trials import KINDS, OUTCOMES, Lost, thesis

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


@pytest.fixture
def words(small_world, small_labels, small_model):
    """words(name, output): a command that writes into `output`. "odometry.png" writes a plot there, and so on."""
    kitti = ["--kitti", small_world / "kitti"]
    frames = [*kitti, "--sequence", "00"]

    def command(name, output="out"):
        options = {".txt": "--output", ".tum": "--tum", ".svg": "--plot", ".png": "--plot", ".mp4": "--video"}
        if name.startswith("odometry"):
            return thesis("odometry", *frames, options[name[-4:]], f"{output}{name[-4:]}")
        return {
            "synthesize": thesis("synthesize", output, "--profile", "smoke"),
            "training": [sys.executable, HERE / "small_training.py", output, 3],
            "predict": thesis("predict", "--images", small_world / "kitti/sequences/00", "--model", small_model,
                              "--output", output),
            "masks": thesis("masks", *frames, "--labels", small_labels / "00", "--dilation", 5, "--output", output),
            "study": thesis("study", *kitti, "--labels", small_labels, "--widths", 5, "--repetitions", 1, "--jobs", 2,
                            "--output", output)}[name]

    return command


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
