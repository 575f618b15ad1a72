"""Each tool runs on tiny input, and the numbers behind its results are right."""

import keras
import numpy as np
import pandas as pd
import pytest

import bench
import evidence
import moving
import train_shipped
from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.study import compare, jobs
from thesis_repro.study.sources import Source

pytestmark = pytest.mark.slow


def test_bench_compares_each_measurement_with_a_reference(small_world, monkeypatch):
    monkeypatch.setattr(bench, "REPEATS", 1)
    monkeypatch.setattr(bench, "WIDTHS", (5,))
    table = bench.measure(Sequence(small_world / "kitti", "00").subset(5))
    assert table["ratio"].tolist() == pytest.approx(table["measured"] / table["reference"])
    assert (table["ratio"] > 0).all() and table["what"].str.contains(" the same bits").sum() == 1
    assert table.to_json(orient="records").count('"ratio"') == 5


def test_muon_treats_convolutions_as_matrices():
    kernel = keras.Variable(np.zeros((3, 3, 8, 4), np.float32))
    slope = np.random.default_rng(0).normal(size=kernel.shape)
    optimizer = train_shipped.Muon(1.0, weight_decay=None, adam_weight_decay=None)
    optimizer.build([kernel])
    optimizer.apply_gradients([(keras.ops.convert_to_tensor(slope, "float32"), kernel)])
    step = kernel.numpy().reshape(72, 4) / (0.2 * 72**0.5)
    assert np.linalg.svd(step, compute_uv=False) == pytest.approx(1, abs=0.35)  # nearly orthogonal


def test_a_view_looks_like_that_of_another_camera():
    label = np.zeros((188, 620), np.uint8)
    label[94 - 18 : 94 + 18, 310 - 18 : 310 + 18] = 1  # a square in KITTI's frame
    for look, (across, down) in train_shipped.LOOKS.items():
        shapes = []
        for seed in range(40):
            _, shown = train_shipped.view(
                label, label, "kitti", look, 320, np.random.default_rng(seed)
            )
            rows, columns = np.nonzero(shown)
            if len(rows) > 20 and not shown[[0, -1]].any() and not shown[:, [0, -1]].any():
                shapes.append(np.ptp(rows) / np.ptp(columns))
        assert np.median(shapes) == pytest.approx(down / across, rel=0.15)


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


def test_keypoints_on_movable_things_are_counted(small_world, small_labels, tmp_path):
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
