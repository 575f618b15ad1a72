"""The evidence of a KITTI folder: what is written, and that nothing is run twice."""

import shutil

import pandas as pd
import pytest

from thesis_repro import odometry
from thesis_repro.report import evidence
from thesis_repro.study import answer, jobs, results


@pytest.mark.slow
def test_a_folder_of_evidence_has_every_method_and_error_and_no_frame(small_world, small_labels, tmp_path, monkeypatch):
    def predict(root, names, labels, frames):
        if not labels.is_dir():
            shutil.copytree(small_labels, labels)

    monkeypatch.setattr(evidence, "_predict", predict)  # the network takes long and has tests of its own
    monkeypatch.setattr(evidence, "WIDTHS", (5, jobs.CONTROL_WIDTH))
    monkeypatch.setattr(evidence, "OTHER_WIDTHS", (5,))
    given = (small_world / "kitti", tmp_path / "out", tmp_path / "build")
    files = evidence.write(*given, frames=6, repetitions=1)
    assert {path.suffix for path in files} == {".csv", ".md", ".svg"}
    table = pd.read_csv(tmp_path / "out" / "answer.csv")
    assert set(table["keypoints"]) == set(answer.METHODS.values()) and len(table["estimator"].unique()) == 2
    runs = pd.read_csv(tmp_path / "out" / "runs.csv", dtype={"sequence": str})
    # six frames may be too short a way for the errors over stretches
    assert set(table["error"]) == {name for metric, name in answer.SHOWN.items() if runs[metric].notna().any()}
    assert {*results.ERRORS, *results.BESIDE} <= set(runs) and set(runs["sequence"]) == {"00", "01"}
    corrected = runs[runs["method"] == "corrected"]
    assert set(corrected["dilation_width"]) == {5, jobs.CONTROL_WIDTH} and set(corrected["estimator"]) == set(jobs.ESTIMATORS)
    assert "With all of the thesis's slips corrected" in (tmp_path / "out" / "README.md").read_text()
    before = {path.name: path.read_bytes() for path in files}
    monkeypatch.setattr(odometry, "run_many", None)  # nothing may run again
    assert {path.name: path.read_bytes() for path in evidence.write(*given, frames=6, repetitions=1)} == before
