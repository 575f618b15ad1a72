"""The failure list: what counts as a failure, and that a stopped series goes on."""

import numpy as np
import pandas as pd
import pytest

from thesis_repro import odometry
from thesis_repro.bench import reliability


def row(order, rmse, **steps):
    return {"sequence": "05", "method": "all", "keypoints": 300, "order": order, "rmse": rmse,
            **dict.fromkeys(("steps", "largest", "wrong", "unflagged", "ambiguous", "not_determined"), 0), **steps}


def test_a_run_fails_beside_its_own_orders_alone():
    trials = pd.DataFrame([row(0, 1.0), row(1, 1.1, wrong=2, unflagged=1), row(2, 1.7),
                           {**row(0, 9.0), "method": "masked-5"}])
    table = reliability.failures(trials).set_index("method")
    assert table.loc["all", ["runs", "over", "wrong", "unflagged"]].tolist() == [3, 1, 2, 1]
    assert table.loc["masked-5", "over"] == 0


class Line:
    """A sequence of six frames along a line, 0.3 m apart."""

    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 2, 3] = 0.3 * np.arange(6)


def test_a_wrong_turn_counts_once_and_as_flagged_where_it_is():
    turned = Line.poses.copy()
    turned[2:, :3, :3] = [[0.999, 0, 0.0447], [0, 1, 0], [-0.0447, 0, 0.999]]  # 2.6 degrees, once
    for flag, unflagged in (("", 1), ("ambiguous motion", 0)):
        frames = pd.DataFrame({"flag": ["", "", flag, "", "motion not determined", ""]})
        found = reliability._steps(odometry.Result(turned, frames), Line, np.arange(6) > 0)
        assert (found["steps"], found["wrong"], found["unflagged"]) == (5, 1, unflagged)
        assert found["largest"] == pytest.approx(2.56, abs=0.01) and found["not_determined"] == 1


def test_a_series_goes_on_where_it_was(tmp_path, monkeypatch):
    made = []

    def trial(sequence, settings, masks, keypoints, orders):
        made.append(settings)
        return pd.DataFrame([row(0, 1.0)]).drop(columns=["sequence", "method"])

    class Known(Line):
        def __init__(self, root, name):
            self.name = name

        def subset(self, frames):
            return self

    monkeypatch.setattr(reliability, "trial", trial)
    monkeypatch.setattr(reliability, "Sequence", Known)
    arguments = ["--kitti", str(tmp_path), "--sequences", "00", "05", "--output", str(tmp_path / "out")]
    for _ in range(2):
        assert reliability.main(arguments) == 0
    assert len(made) == 4  # all and spread, on two sequences, once
    table = pd.read_csv(tmp_path / "out" / "failures.csv", dtype={"sequence": str})
    assert table["sequence"].tolist() == ["00", "00", "05", "05"]
    assert reliability.main([*arguments, "--methods", "masked-5"]) == 1
