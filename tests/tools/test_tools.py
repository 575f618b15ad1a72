"""Each tool runs on tiny input, and the numbers behind its results are right."""

import shutil
from dataclasses import replace

import keras
import made_up
import pandas as pd
import pytest
from executing import run_of

import bench
import evidence
import train_shipped
from keypoint_study import jobs, runner
from keypoint_study.sources import Source
from thesis import claim_rule
from thesis.run_settings import read_settings
from thesis_repro.data.sequence import Sequence
from thesis_repro.segmentation import prediction

pytestmark = pytest.mark.slow


def test_bench_compares_calls_and_runs_with_opencvs(small_world, monkeypatch):
    small = {"KEYPOINTS": (100,), "LENGTHS": (5, 7), "TOGETHER": (1, 2), "FRAMES": 4}
    for name, value in small.items():
        monkeypatch.setattr(bench, name, value)
    table = bench.bench(Sequence(small_world / "kitti", "00").subset(4))
    assert len(table) == 3 + 2 + 2 and (table["ratio"] > 0).all()
    assert table["ratio"].tolist() == pytest.approx(table["measured"] / table["reference"])
    assert (table["against"] == "OpenCV's").sum() == 3 + 2


@pytest.mark.torture
def test_the_training_writes_a_model_and_its_card(camvid_real, tmp_path, monkeypatch):
    for name in ("COMMON", "LAST"):
        options = getattr(train_shipped, name)
        monkeypatch.setattr(train_shipped, name, options._replace(epochs=1))
    monkeypatch.setattr(train_shipped, "EPOCH", 1)
    data = camvid_real.parent
    folders = camvid_real, data / "kitti_semantic", data / "kitti_pseudo", tmp_path
    train_shipped.main([str(folder) for folder in folders])
    model = keras.models.load_model(tmp_path / "streets.keras", compile=False)
    assert model.output_shape == (None, 320, 320, 35)
    assert "20001" in (tmp_path / "README.md").read_text()


def test_evidence_keeps_what_shows_no_frame(executed, tmp_path, monkeypatch):
    shutil.copytree(executed, tmp_path / "run", symlinks=True)
    # as if on real frames, which are timed beside their figures
    settings = replace(read_settings(run_of(tmp_path / "run")), kitti_is_embedded=False)
    out = tmp_path / "out"
    monkeypatch.setattr(evidence.few_keypoints, "TIMED_RUNS", 1)
    monkeypatch.setattr(evidence.few_keypoints, "REPETITIONS", 1)
    monkeypatch.setattr(evidence.few_keypoints, "NUMBERS", (50, 200))
    monkeypatch.setattr(evidence, "PAIRS", 2)
    monkeypatch.setattr(claim_rule, "STUDIES", 20)
    evidence.write(settings, out)
    names = {
        "README",
        "streets",
        "few_keypoints",
        "every_second",
        "every_second_runs",
        "refined_widths",
        "refined_widths_runs",
        "few_keypoints_runs",
        "found_again",
        "ends",
        "equal_number",
        "claims",
        *evidence.KEPT,
        *evidence.RUNS,
    }
    assert {path.stem for path in out.iterdir()} == names
    streets = pd.read_csv(out / "streets.csv")
    assert (streets["frames"] == 5).all() and (streets["metres"] > 0).all()


@pytest.mark.torture
@pytest.mark.parametrize("street", ["04"])
def test_a_street_gives_the_evidence_in_git(kitti_real, tmp_path, street):
    """From its frames: label maps, runs of both estimators."""
    sequence = Sequence(kitti_real, street)
    folder = tmp_path / "labels" / street
    prediction.write_label_maps(prediction.load_shipped(), sequence.frame_paths, folder, 16)
    source = Source(folder.parent)
    planned = [
        jobs.Job(street, method, width, estimator=estimator, repetition=repetition)
        for method, width in (("baseline", None), ("masked", 10))
        for estimator in ("thesis", "refined")
        for repetition in (0, 1)
    ]
    runs = runner.run_all(jobs.runs_of(planned, [sequence], [source]), tmp_path / "runs").table
    text = runs.to_csv(index=False, lineterminator="\n", float_format="%.6g")
    whole = (evidence.FOLDER / "runs.csv").read_text(encoding="utf-8").splitlines()
    head, *rows = text.splitlines()
    assert head == whole[0] and len(rows) >= 6 and set(rows) <= set(whole)


def test_a_sweep_has_one_row_a_width():
    streets = [f"{number:02d}" for number in range(8)]
    runs = made_up.runs(
        streets,
        lambda _, __, width: 1.2 if width == 1 else 1.0,
        {"baseline": [None], "masked": [1, 10]},
        repetitions=1,
    )
    runs.loc[(runs["dilation_width"] == 1) & (runs["sequence"] == "03"), "lost"] = 1
    table = evidence.table_of_widths(runs).set_index("dilation width (pixels)")
    ratio, failed = table.loc[1, ["rotational RPE, 1 frame", "streets that fail"]]
    assert ratio == "1.20 (1.20-1.20) ↑, 8 of 8 above 1" and failed == "1 of 8"
    assert table.loc[10, "rotational RPE, 1 frame"].endswith("0 of 8 above 1")
