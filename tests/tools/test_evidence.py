"""The evidence of a KITTI folder: its files, and that nothing is run twice."""

import sys
from pathlib import Path

import pandas as pd
import pytest

from thesis_repro import odometry
from thesis_repro.study import compare, jobs
from thesis_repro.study.sources import Source

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))

import evidence  # noqa: E402


@pytest.mark.slow
def test_evidence_has_every_method_and_error_and_no_frames(
    small_world, small_labels, tmp_path, monkeypatch
):
    monkeypatch.setattr(evidence, "WIDTHS", (5, jobs.CONTROL_WIDTH))
    arguments = (small_world / "kitti", tmp_path / "out", tmp_path / "build")
    (tmp_path / "exact").mkdir()
    (tmp_path / "exact/01").symlink_to(small_labels / "01")  # a further source for one sequence
    options = {"frames": 6, "repetitions": 1, "others": [Source(tmp_path / "exact", name="exact")]}
    evidence.write(*arguments, **options)
    files = list((tmp_path / "out").iterdir())
    assert {path.stem for path in files} == {
        "README",
        "audit",
        "comparison",
        "failures",
        "label_quality",
        "runs",
        "streets",
        "switches",
        "widths",
    }
    failures = pd.read_csv(tmp_path / "out" / "failures.csv")
    assert list(failures["steps"][:2]) == ["00", "01"]
    assert failures["number"][:2].sum() == failures["number"][2:].sum() == 10
    assert (failures["tracked, masks"] < failures["tracked, all keypoints"]).all()
    assert (failures["agreeing, masks"] <= failures["tracked, masks"]).all()
    runs = pd.read_csv(tmp_path / "out" / "runs.csv", dtype={"sequence": str})
    assert set(runs["sequence"]) == {"00", "01"} and set(runs["frames"]) == {6}
    assert set(compare.METHODS) <= set(runs["method"]) and {
        *compare.JUDGING_METRICS,
        "rmse",
    } <= set(runs)
    corrected = runs[runs["method"] == "corrected"]
    assert set(corrected["dilation_width"]) == {jobs.CONTROL_WIDTH}
    assert set(corrected["estimator"]) == set(jobs.ESTIMATORS)
    before = {path.name: path.read_bytes() for path in files}
    quality = pd.read_csv(tmp_path / "out" / "label_quality.csv")
    assert set(runs["source"].dropna()) == set() and len(quality) == 6
    assert list(quality["sequences"][:4]) == ["00, 01", "01", "01", "01"]
    rotation = quality[compare.METRICS["rotation"]][:4].str.extract(r"^([\d.]+)")[0].astype(float)
    assert rotation[3] == pytest.approx(rotation[2] / rotation[1], abs=0.02)
    streets = pd.read_csv(tmp_path / "out" / "streets.csv")
    assert (streets["frames"] == 6).all() and (streets["metres"] > 0).all()
    monkeypatch.setattr(odometry, "run_many", None)  # would fail
    evidence.write(*arguments, **options)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
