import re
import subprocess
from dataclasses import replace

import cv2
import numpy as np
import pandas as pd
import pytest
import tensorflow as tf

from thesis_repro import InputError, cityscapes
from thesis_repro.segmentation import prediction, quality, shipped
from thesis_repro.segmentation.card import CAMVID_IDS
from thesis_repro.segmentation.shipped import Phase, Preset
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow

TINY = Preset(base_filters=2, phases=(Phase(32, 4, 2, (1e-2, 1e-2)), Phase(48, 2, 3, (1e-2, 1e-3))),
              last=Phase(48, 2, 2, (1e-3, 0)), world_images=1, held_out=(1, 1), save_every=2)


@pytest.fixture(scope="module")
def model():
    return prediction.load_shipped()


@pytest.fixture
def tiny_kitti_semantic(tmp_path):
    """Four pairs as wide as KITTI's, 64x20: sky, vegetation, terrain, road."""
    root = tmp_path / "kitti_semantic"
    for folder in ("train", "trainannot"):
        (root / folder).mkdir(parents=True)
    label = np.repeat(np.array([23, 21, 22, 7], np.uint8), 5)[:, None].repeat(64, axis=1)
    for index in range(4):
        cv2.imwrite(str(root / "trainannot" / f"{index}.png"), label)
        cv2.imwrite(str(root / "train" / f"{index}.png"), label * 10 + index)
    return root


def card():
    return (shipped.FOLDER / "README.md").read_text(encoding="utf-8")


def section(where):
    """The part of the card on one set: accuracy, mean IoU and the IoU of each class."""
    text = re.search(rf"\*\*Quality on {where}.*?What the largest", card(), re.DOTALL).group()
    accuracy, mean_iou = map(float, re.findall(r"\*\*([\d.]+)\*\*", text))
    rows = re.findall(r"\| (\d+) \| [\d.]+% \| ([\d.]+)", text)
    return accuracy, mean_iou, {int(number): float(iou) for number, iou in rows}


def test_it_is_the_thesiss_network_and_small(model):
    assert model.input_shape == (None, 320, 320, 1) and model.output_shape == (None, 320, 320, 35)
    assert "conv2d" not in {layer.name for layer in model.layers}  # the dead convolutions are dead here too
    assert model.get_layer("conv2d_1").filters == shipped.PRESET.base_filters
    assert sum(path.stat().st_size for path in shipped.FOLDER.iterdir()) <= 8e6


def test_the_card_tells_the_datas_terms_what_was_held_out_and_all_qualities():
    assert "CC BY-NC-SA 3.0" in card() and "research use" in card()
    assert "20001, 20002, 20003, 20004, 20026, 20027, 20028" in card()
    for where in ("CamVid", "KITTI"):
        accuracy, mean_iou, classes = section(where)
        assert mean_iou == pytest.approx(np.mean([classes[i] for i in CAMVID_IDS if i in classes]), abs=2e-3)
        assert 0.5 < accuracy < 1


@pytest.mark.real
def test_quality_on_camvids_validation_images_is_what_the_card_says(model, camvid_real):
    images, labels = cityscapes.load(cityscapes.pairs(camvid_real, "val"), 320)
    found = quality.quality(model, images, labels)
    accuracy, mean_iou, classes = section("CamVid")

    assert found.mean_iou >= 0.50 and found.accuracy >= 0.8
    assert (accuracy, mean_iou) == pytest.approx((found.accuracy, found.mean_iou), abs=2e-3)
    assert classes == pytest.approx(dict(zip(found.classes["id"], found.classes["iou"], strict=True)), abs=2e-3)
    assert set(np.unique(prediction.predict(model, images[:8]))) <= set(shipped.LEARNT)


@pytest.mark.real
@pytest.mark.parametrize("sequence", ["00", "06"])
def test_label_maps_of_kitti_frames_are_streets(model, kitti_real, tmp_path, sequence):
    frames = sorted((kitti_real / "sequences" / sequence / "image_0").glob("*.png"))[:200:10]
    prediction.write_label_maps(model, frames, tmp_path)
    maps = np.stack([cityscapes.read_label_map(tmp_path / path.name) for path in frames])

    # road is what lies in front of the car, and sky, trees or houses are what is at the top
    road = maps[:, 250:310, 120:200]
    assert (road == 7).mean() > 0.7
    assert np.isin(maps[:, :40], [11, 21, 23]).mean() > 0.8


def test_the_training_resumes_and_gives_the_same_weights(tiny_cityscapes, tiny_kitti_semantic, tmp_path, monkeypatch):
    whole = shipped.train_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path / "whole", TINY)

    class Killed(Exception):
        pass

    made = shipped.batch

    for at in (3, 6):  # in the second phase, and in the last of the twin; the states are those of steps 2 and 5
        def killing(sources, size, batch_size, step, preset, at=at):
            if step == at:
                raise Killed
            return made(sources, size, batch_size, step, preset)

        monkeypatch.setattr(shipped, "batch", killing)
        with pytest.raises(Killed):
            shipped.train_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path / "killed", TINY)
    monkeypatch.setattr(shipped, "batch", made)
    resumed = shipped.train_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path / "killed", TINY)

    for some, same in zip(whole, resumed, strict=True):  # the twin and the shipped model
        assert all(np.array_equal(a, b) for a, b in zip(some.get_weights(), same.get_weights(), strict=True))
    assert not np.array_equal(whole[0].get_weights()[0], whole[1].get_weights()[0])
    assert pd.read_csv(tmp_path / "killed" / "common" / "history.csv")["step"].tolist() == [2, 4, 5]
    with pytest.raises(InputError, match="another preset"):
        shipped.train_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path / "killed", replace(TINY, seed=1))
    (tmp_path / "killed" / "common" / "state.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="is damaged"):
        shipped.train_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path / "killed", TINY)


def test_the_twin_never_sees_what_is_held_out(tiny_cityscapes, tiny_kitti_semantic, tmp_path, monkeypatch):
    seen = {}

    def advance(run, sources, phases, first, start, folder, bar):
        seen[folder.name] = {int(image[0, 0]) - 230 for image, _ in sources["kitti"]}

    monkeypatch.setattr(shipped, "advance", advance)
    shipped.train_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path, TINY)

    assert seen == {"common": {1, 2}, "twin": {1, 2}, "shipped": {0, 1, 2, 3}}


def test_one_command_writes_model_and_card(tiny_cityscapes, tiny_kitti_semantic, tmp_path):
    shipped.write_shipped(tiny_cityscapes, tiny_kitti_semantic, tmp_path / "build", tmp_path / "out", TINY)
    text = (tmp_path / "out" / "README.md").read_text(encoding="utf-8")

    assert {path.name for path in (tmp_path / "out").iterdir()} == {"README.md", "streets.keras", "curves.png"}
    assert "pairs 0, 3" in text and "| 48 | 2 | 2 | 0.001 | 0 |" in text and "| terrain | 22 |" in text


@pytest.mark.parametrize("missing, message", [
    ("camvid", "CAMVID must name the folder"), ("kitti", "KITTI_SEMANTIC must name the folder"),
    ("pairs", "4 training pairs; more than the 7"), ("size", "must have one size")])
def test_faults_of_the_data_are_one_line(tiny_cityscapes, tiny_kitti_semantic, tmp_path, capsys, missing, message):
    camvid, kitti = tiny_cityscapes, tiny_kitti_semantic
    if missing == "camvid":
        camvid = tmp_path / "none"
    if missing == "kitti":
        kitti = tmp_path / "none"
    if missing == "size":
        for index in range(4, 9):
            for folder in ("train", "trainannot"):
                cv2.imwrite(str(kitti / folder / f"{index}.png"), np.zeros((9, 9 + (folder == "train")), np.uint8))
    status = shipped.main([str(camvid), str(kitti), str(tmp_path / "build"), "--output", str(tmp_path / "out")])
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert status == 1 and len(said) == 1 and message in said[0]


def test_make_wants_both_folders():
    root = shipped.FOLDER.parents[2]
    for given, wanted in (("CAMVID=x", "KITTI_SEMANTIC"), ("KITTI_SEMANTIC=x", "CAMVID")):
        done = subprocess.run(["make", "weights", given, "-o", "setup"], cwd=root, capture_output=True, text=True)
        assert done.returncode and done.stderr.startswith(f"{wanted} must name the folder")


def test_training_and_prediction_are_one_network():
    model = build_unet((None, None, 1), cityscapes.N_CLASSES, 4)
    images = np.random.default_rng(0).integers(0, 256, (2, 32, 48, 1)).astype(np.float32)
    scores, seen = shipped.forward(model, images, tf.float32)
    probabilities = model(images, training=True).numpy()[..., list(shipped.LEARNT)]

    expected = probabilities / probabilities.sum(-1, keepdims=True)
    np.testing.assert_allclose(tf.nn.softmax(scores), expected, atol=1e-5)
    assert len(seen) == 9


def test_a_view_is_the_look_of_another_camera():
    label = np.zeros((188, 620), np.uint8)
    label[94 - 18:94 + 18, 310 - 18:310 + 18] = 1  # a square in KITTI's frame
    shapes = {}
    for look in shipped.LOOKS:
        views = [shipped.view(label, label, "kitti", look, 320, np.random.default_rng(seed))[1] for seed in range(40)]
        whole = [view for view in views if view.sum() > 20 and not view[[0, -1]].any() and not view[:, [0, -1]].any()]
        shapes[look] = np.median([np.ptp(np.nonzero(view.any(1))[0]) / np.ptp(np.nonzero(view.any(0))[0])
                                 for view in whole])
    assert shapes["kitti"] == pytest.approx(611 / 185, rel=0.15)
    assert shapes["camvid"] == pytest.approx(385 / 289, rel=0.15)


def test_batches_are_mixed_by_shares_and_follow_from_the_step():
    sources = {name: [(np.full((40, 60), 100, np.uint8), np.full((40, 60), number, np.uint8))] * 3
               for name, number in (("camvid", 7), ("kitti", 22), ("world", 3))}
    made = [shipped.batch(sources, 32, 8, step, shipped.PRESET) for step in (5, 6, 5)]
    found = np.concatenate([shipped.batch(sources, 32, 8, step, shipped.PRESET)[1][:, 16, 16] for step in range(40)])

    assert all(np.array_equal(a, b) for a, b in zip(made[0], made[2], strict=True))
    assert not np.array_equal(made[0][0], made[1][0])
    shares = [np.mean(found == place) for place in
              (shipped.LEARNT.index(7), shipped.LEARNT.index(22), len(shipped.LEARNT))]  # 3 is not learnt
    assert shares == pytest.approx([share for _, share in shipped.PRESET.shares], abs=0.03)


def test_rare_classes_count_more_and_absent_ones_no_more_than_the_limit():
    label = np.full((100, 100), 7, np.uint8)
    label[:10, :10] = 17
    sources = {name: [(label, label)] for name in ("camvid", "kitti", "world")}
    weights = dict(zip(shipped.LEARNT, shipped.class_weights(sources, replace(TINY, weight_power=0.2)), strict=True))

    assert weights[7] == 1 and weights[17] == pytest.approx(99**0.2, rel=1e-3) and weights[24] == 4


def test_the_learning_rate_goes_along_half_a_cosine():
    phase = Phase(32, 1, 100, (2e-3, 1e-3))

    assert [phase.rate(step) for step in (0, 50, 100)] == pytest.approx([2e-3, 1.5e-3, 1e-3])
    assert shipped.PRESET.last.rate(shipped.PRESET.last.steps) == 0
    ends = [phase.rates for phase in (*shipped.PRESET.phases, shipped.PRESET.last)]
    assert all(before[1] == after[0] for before, after in zip(ends, ends[1:], strict=False))
