"""The evidence of a KITTI folder: what is written, and that nothing is run twice."""

import pandas as pd
import pytest

from thesis_repro import odometry
from thesis_repro.report import evidence
from thesis_repro.study import compare, jobs


@pytest.mark.slow
def test_a_folder_of_evidence_has_every_method_and_error_and_no_frame(small_world, tmp_path, monkeypatch):
    monkeypatch.setattr(evidence, "WIDTHS", (5, jobs.CONTROL_WIDTH))
    given = (small_world / "kitti", tmp_path / "out", tmp_path / "build")
    evidence.write(*given, frames=6, repetitions=1)
    files = list((tmp_path / "out").iterdir())
    assert {path.suffix for path in files} == {".csv", ".md", ".svg"}
    assert {path.stem for path in files} == {"README", "audit", "comparison", "failures", "runs", "switches", "widths"}
    failures = pd.read_csv(tmp_path / "out" / "failures.csv")
    of_sequences, of_numbers = failures[:2], failures[2:]
    assert list(of_sequences["steps"]) == ["00", "01"]
    assert of_sequences["number"].sum() == of_numbers["number"].sum() == 10
    assert (failures["tracked, masks"] < failures["tracked, all keypoints"]).all()
    assert (failures["agreeing, masks"] <= failures["tracked, masks"]).all()
    runs = pd.read_csv(tmp_path / "out" / "runs.csv", dtype={"sequence": str})
    assert set(runs["sequence"]) == {"00", "01"} and set(runs["frames"]) == {6}
    assert set(compare.METHODS) <= set(runs["method"]) and {*compare.JUDGING_METRICS, "rmse"} <= set(runs)
    corrected = runs[runs["method"] == "corrected"]
    assert set(corrected["dilation_width"]) == {jobs.CONTROL_WIDTH}
    assert set(corrected["estimator"]) == set(jobs.ESTIMATORS)
    before = {path.name: path.read_bytes() for path in files}
    monkeypatch.setattr(odometry, "run_many", None)  # nothing may run again
    evidence.write(*given, frames=6, repetitions=1)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
