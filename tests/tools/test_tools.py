"""Each tool runs on tiny input, and the numbers behind its results are right."""

import shutil

import keras
import pandas as pd
import pytest
from executing import run_of

import bench
import evidence
import moving
import train_shipped
from keypoint_study import compare
from keypoint_study.sources import Source
from thesis.settings import read_settings
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError

pytestmark = pytest.mark.slow


def test_bench_compares_each_measurement_with_a_reference(small_world, monkeypatch):
    monkeypatch.setattr(bench, "REPEATS", 1)
    monkeypatch.setattr(bench, "WIDTHS", (5,))
    monkeypatch.setattr(bench, "FIRST_USE", "import numba")  # to compile takes 18 seconds
    table = bench.measure(Sequence(small_world / "kitti", "00").subset(5))
    assert table["ratio"].tolist() == pytest.approx(table["measured"] / table["reference"])
    assert (table["ratio"] > 0).all() and table["what"].str.contains(" the same bits").sum() == 1
    assert table.to_json(orient="records").count('"ratio"') == 5


@pytest.mark.torture
def test_the_training_writes_a_model_and_its_card(camvid_real, tmp_path, monkeypatch):
    for name, value in (
        ("COMMON", train_shipped.COMMON._replace(epochs=1)),
        ("LAST", train_shipped.LAST._replace(epochs=1)),
        ("EPOCH", 1),
    ):
        monkeypatch.setattr(train_shipped, name, value)
    kitti_semantic = camvid_real.parent / "kitti_semantic"
    arguments = [
        str(camvid_real),
        str(kitti_semantic),
        str(camvid_real.parent / "kitti_pseudo"),
        str(tmp_path),
    ]
    train_shipped.main(arguments)
    model = keras.models.load_model(tmp_path / "streets.keras", compile=False)
    assert (
        model.output_shape == (None, 320, 320, 35)
        and "20001" in (tmp_path / "README.md").read_text()
    )


def test_keypoints_on_movable_things_are_counted(small_world, small_labels, tmp_path, monkeypatch):
    monkeypatch.setattr(moving, "cores", lambda: 1)  # workers take longer to start than to run
    table = moving.table(small_world / "kitti", small_labels, tmp_path, repetitions=1, frames=5)
    kinds = table.set_index(["sequence", "keypoints on"])["share (%)"].unstack()
    assert list(kinds.index) == ["00", "01"]
    total = kinds["static things"] + kinds["movable things"]
    assert total.tolist() == pytest.approx([100, 100], abs=0.11)
    assert (kinds["movable things"] >= kinds["of these, people and bicycles"]).all()
    static = table[table["keypoints on"] == "static things"]
    assert (static["median distance (px)"] < 0.3).all()  # exact poses
    with pytest.raises(InputError, match="nowhere"):
        moving.table(small_world / "kitti", tmp_path / "nowhere", tmp_path)


def test_evidence_keeps_what_shows_no_frame_and_compares_label_maps(
    executed, small_labels, tmp_path, monkeypatch
):
    shutil.copytree(executed, tmp_path / "run", symlinks=True)
    settings = read_settings(run_of(tmp_path / "run"))
    (tmp_path / "exact").mkdir()
    (tmp_path / "exact/01").symlink_to(small_labels / "01")  # a further source for one sequence
    others = [Source(tmp_path / "exact", name="exact")]
    out = tmp_path / "out"
    monkeypatch.setattr(evidence.worth, "MAX_STEPS", 1)
    monkeypatch.setattr(evidence.worth, "SPLITS", 1)
    monkeypatch.setattr(evidence.few_keypoints, "TIMED_RUNS", 1)
    monkeypatch.setattr(evidence.few_keypoints, "REPETITIONS", 1)
    monkeypatch.setattr(evidence.few_keypoints, "NUMBERS", (50, 200))
    evidence.write(settings, out, others)
    names = {
        "README",
        "failures",
        "label_quality",
        "streets",
        "few_keypoints",
        "worth",
        "worth_runs",
        "choices",
        "reasons",
        "reasons_runs",
        "saturation",
        "refined_widths",
        "refined_widths_runs",
        "few_keypoints_runs",
        *evidence.KEPT,
        *evidence.RUNS,
    }
    assert {path.stem for path in out.iterdir()} == names
    failures = pd.read_csv(out / "failures.csv")
    assert list(failures["steps"][:2]) == ["00", "01"]
    assert failures["number"][:2].sum() == failures["number"][2:].sum() == 8
    assert (failures["tracked, masks"] < failures["tracked, all keypoints"]).all()
    assert (failures["agreeing, masks"] <= failures["tracked, masks"]).all()
    quality = pd.read_csv(out / "label_quality.csv")
    assert len(quality) == 6 and list(quality["sequences"][:4]) == ["00, 01", "01", "01", "01"]
    rotation = quality[compare.METRICS["rotation"]][:4].str.extract(r"^([\d.]+)")[0].astype(float)
    assert rotation[3] == pytest.approx(rotation[2] / rotation[1], abs=0.02)
    streets = pd.read_csv(out / "streets.csv")
    assert (streets["frames"] == 5).all() and (streets["metres"] > 0).all()
