"""Torture: kills, faults and bad input tried on purpose, by real commands run as processes (`make torture`).

A test here runs with `--torture` alone; one that is marked `short` runs among all others too.
"""

import sys
from pathlib import Path

import pytest
from trials import thesis

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
