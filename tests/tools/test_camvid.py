"""The training of the thesis's network, at tiny size, here and by the program for elsewhere."""

import json
import time

import numpy as np
import pandas as pd
import pytest
import tensorflow as tf

import camvid
import camvid_jax
from thesis.settings import read_settings
from thesis_repro.data.cityscapes import CLASS_WEIGHTS, N_CLASSES
from thesis_repro.segmentation import augmentation, training

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def tiny(tiny_cityscapes, tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROFILE", "smoke")
    monkeypatch.setenv("THESIS_REPRO_BUILD", str(tmp_path))
    monkeypatch.setenv("THESIS_REPRO_KITTI_SEMANTIC", str(tiny_cityscapes))
    monkeypatch.setattr(camvid.tf.config.threading, "set_intra_op_parallelism_threads", int)
    monkeypatch.setattr(camvid.tf.config.threading, "set_inter_op_parallelism_threads", int)


@pytest.mark.torture
def test_a_longer_training_goes_on_and_writes_curves_and_scores(
    tiny_cityscapes, tmp_path, monkeypatch
):
    histories = []
    for epochs in ("1", "2"):
        monkeypatch.setenv("THESIS_REPRO_EPOCHS", epochs)
        camvid.main(str(tiny_cityscapes))
        (folder,) = tmp_path.glob("camvid/*/figures")
        histories.append(pd.read_csv(folder / "figure_4_01.csv"))
    first, both = histories
    assert both["epoch"].tolist() == [1, 2] and (both["seconds"] > 0).all()
    assert both[:1].equals(first)  # the first epoch was not repeated
    facts = pd.read_csv(folder / "training.csv", index_col="training")["CamVid, seed 0"]
    assert facts["epochs"] == "2" and facts["ended by early stopping"].startswith("no")
    scores = pd.read_csv(folder / "scores.csv")
    assert len(scores.columns) == 3 and (folder / "figure_4_03.webp").is_file()


def test_another_backend_has_the_loss_the_scores_and_the_order_of_the_batches():
    random = np.random.default_rng(0)
    labels = random.integers(0, N_CLASSES, (3, 16, 16)).astype(np.uint8)
    labels[0, :3] = augmentation.NOTHING
    predicted = random.dirichlet(np.full(N_CLASSES, 0.05), labels.shape).astype(np.float32)
    true = augmentation.one_hot(labels, N_CLASSES)
    theirs = [
        training.total_loss()(true, predicted),
        *(m(true, predicted) for m in training.metrics()),
    ]
    ours = [
        function(tf.constant(labels), tf.constant(predicted))
        for function in (
            camvid_jax.loss_of(CLASS_WEIGHTS),
            camvid_jax.iou_score,
            camvid_jax.f1_score,
        )
    ]
    assert np.allclose([np.mean(value) for value in theirs], ours, rtol=1e-6)
    images = np.arange(3 * 16 * 16, dtype=np.uint8).reshape(3, 16, 16, 1)
    batches = training.Batches([(images, labels)], 2, seed=5)
    other = camvid_jax.Shuffled(images, labels, 2, seed=5)
    for epoch in range(3):
        batches.epoch = epoch
        for (image, label), (other_image, other_label) in zip(
            batches, map(other.__getitem__, range(2))
        ):
            assert (image == other_image).all() and (label == other_label).all()
        other.on_epoch_end()


def test_a_job_is_trained_elsewhere_and_its_networks_are_read(
    tiny_cityscapes, tmp_path, monkeypatch
):
    monkeypatch.setenv("THESIS_REPRO_EPOCHS", "1")
    job, out = tmp_path / "job", tmp_path / "trained"
    out.mkdir()
    camvid.main(str(tiny_cityscapes), job=str(job))
    settings = read_settings()
    sets = {split: camvid_jax.read_images(job, split) for split in ("train", "val")}
    batches = camvid.batches_of(tiny_cityscapes, settings.sizes, settings.seed)[0]
    for written, given in zip(sets["train"], batches.sets[0], strict=True):
        assert (written == given).all()
    told = json.loads((job / "job.json").read_text())
    camvid_jax.train(told, sets, out, 3, time.monotonic() + 600)
    (out / "machine.txt").write_text("another machine")
    camvid.main(str(tiny_cityscapes), trained=str(out))
    (figures,) = tmp_path.glob("camvid/*/figures")
    history = json.loads((out / "seed_3.json").read_text())
    row = pd.read_csv(figures / "figure_4_01.csv").iloc[0]
    assert row["val_loss"] == history[0]["val_loss"] and row["seed"] == 3
    assert "another machine" in (figures / "training.md").read_text()
    (network, _), *_ = camvid.read_trained(out, settings.sizes)[0].values()
    for weights, value in zip(
        network.get_weights(), np.load(out / "seed_3.npz").values(), strict=True
    ):
        assert (weights == value).all()
