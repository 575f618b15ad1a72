"""A run is told whether its network is the recorded one."""

from types import SimpleNamespace

import pytest

from thesis_repro import results
from thesis_repro.report import trainings

RECORDED = trainings.read()["network"].iloc[0]


@pytest.mark.parametrize(
    "network, in_git, named",
    [
        (RECORDED, True, [RECORDED]),
        ("0" * 12, True, [RECORDED, "0" * 12, "trainings.csv"]),
        ("0" * 12, False, []),
        (None, True, []),
    ],
)
def test_the_networks_are_compared(tmp_path, network, in_git, named):
    if network:
        results.stage(tmp_path / "labels" / "00", model=network)
    note = trainings.network_note(SimpleNamespace(build=tmp_path, figures_in_git=in_git))
    assert bool(note) == bool(named) and all(name in note for name in named)
    assert ("XLA_FLAGS" in note) == (len(named) > 1)


def test_the_summary_spans_all_trainings():
    for training in trainings.summary():
        rows = trainings.read().query("estimator == @training['estimator']")
        low, high = training["ranges"]["se3_ratio"]
        assert len(training["verdicts"]) == len(rows) > 1
        assert (rows["se3_low"] <= high).all() and rows["se3_ratio"].between(low, high).all()
