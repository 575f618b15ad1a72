"""The training of the thesis's network, at tiny size: its loss, its order, stops, tables."""

import numpy as np
import pandas as pd
import pytest
import tensorflow as tf
from small_network import small_network

import camvid
from thesis.run_settings import PROFILES
from thesis_repro.data import cityscapes
from thesis_repro.data.cityscapes import ID, N_CLASSES
from thesis_repro.errors import InputError
from thesis_repro.segmentation import augmentation, training

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setattr(camvid, "SIZES", PROFILES["smoke"])


def test_any_backend_has_the_loss_the_scores_and_the_order_of_the_batches():
    random = np.random.default_rng(0)
    labels = random.integers(0, N_CLASSES, (5, 16, 16)).astype(np.uint8)
    labels[0, :3] = augmentation.NOTHING
    predicted = random.dirichlet(np.full(N_CLASSES, 0.05), labels.shape).astype(np.float32)
    true = augmentation.one_hot(labels, N_CLASSES)
    functions = [training.total_loss(), *training.metrics()]
    theirs = [function(true, predicted) for function in functions]
    given = tf.constant(labels), tf.constant(predicted)
    ours = [function(*given) for function in camvid.loss_and_scores()]
    assert np.allclose([np.mean(value) for value in theirs], ours, rtol=1e-6)
    images = np.arange(5 * 16 * 16).reshape(5, 16, 16, 1).astype(np.uint8)
    batches = training.Batches([(images, labels)], 4, seed=5)
    for batches.epoch in range(3):
        other = camvid.batches_of(images, labels, seed=5, epoch=batches.epoch)
        for pair, other_pair in zip(batches, other, strict=True):
            assert all(map(np.array_equal, pair, other_pair))


def trained(camvid_root, folder, epochs, *more):
    """Train in a folder, and return the table of the curves, without times."""
    figures = folder / "figures"
    where = [str(camvid_root), f"--folder={folder}", f"--figures={figures}"]
    camvid.main([*where, f"--epochs={epochs}", *more])
    table = pd.read_csv(figures / "figure_4_01.csv")
    assert (table.pop("seconds") > 0).all()
    return table


def test_it_writes_curves_scores_and_what_the_thesis_reports(
    tiny_cityscapes, tmp_path, monkeypatch
):
    """With a network that compiles soon; the test below, of a stopped training, takes the U-Net."""
    assert camvid.build().output_shape == (None, 64, 64, N_CLASSES)
    monkeypatch.setattr(camvid, "build", lambda: small_network(64))
    table = trained(tiny_cityscapes, tmp_path, 1, f"--kitti-semantic={tiny_cityscapes}")
    assert table["epoch"].tolist() == [1] and table["seed"].tolist() == [0]
    facts = pd.read_csv(tmp_path / "figures/training.csv", index_col="training")
    assert list(facts) == ["CamVid, seed 0", "Cityscapes, thesis"]
    assert facts.loc["ended by early stopping", "CamVid, seed 0"].startswith("no")
    scores = pd.read_csv(tmp_path / "figures/scores.csv")
    assert len(scores.columns) == 3 and (tmp_path / "figures/figure_4_03.webp").is_file()


def test_parts_of_images_and_pixels_are_counted(tiny_cityscapes, tmp_path):
    camvid.main([str(tiny_cityscapes), f"--figures={tmp_path}", "--areas"])
    areas = pd.read_csv(tmp_path / "areas.csv", index_col="measure")["mean (%)"]
    assert {"rim", "inside", "invented 5/15"} <= {*areas.index} and areas.between(0, 100).all()
    pixels = pd.read_csv(tmp_path / "pixels.csv").iloc[0]
    pairs = cityscapes.pairs(tiny_cityscapes, "train")
    labels = np.concatenate([cityscapes.read_label_map(pair.label).ravel() for pair in pairs])
    over_road = (labels == ID["person"]).sum() / (labels == ID["road"]).sum()
    assert pixels["persons over road"] == pytest.approx(over_road, abs=1e-4)
    assert pixels["pixels without a class (%)"] == pytest.approx(
        100 * (labels == 0).mean(), abs=1e-4
    )


@pytest.mark.torture
def test_a_stopped_training_goes_on_after_its_last_epoch(tiny_cityscapes, tmp_path):
    whole = trained(tiny_cityscapes, tmp_path / "whole", 2, "--seeds", "0", "1")
    assert whole["epoch"].tolist() == [1, 2] * 2 and whole["seed"].tolist() == [0, 0, 1, 1]
    whole = whole[whole["seed"] == 0]
    first = trained(tiny_cityscapes, tmp_path / "stopped", 1)
    assert first.equals(whole[:1])
    state = tmp_path / "stopped/seed_0/state.npz"
    before = state.read_bytes()
    assert trained(tiny_cityscapes, tmp_path / "stopped", 2).equals(whole)
    state.write_bytes(before)  # as if it was stopped before this file was written
    assert trained(tiny_cityscapes, tmp_path / "stopped", 3)[:2].equals(whole)


def test_a_training_ends_if_its_validation_loss_no_longer_falls():
    rows = [{"val_loss": loss} for loss in (3, 2, 2.5, 2.4, 2.3, 2.2)]
    assert not camvid.is_done(rows, 100) and not camvid.is_done([], 100)
    assert camvid.is_done([*rows, {"val_loss": 2.1}], 100)
    assert camvid.is_done(rows, 6) and not camvid.is_done([*rows, {"val_loss": 1}], 100)


def test_a_folder_that_is_missing_ends_at_once(tmp_path):
    with pytest.raises(InputError, match="nowhere: must be a folder"):
        camvid.main([str(tmp_path / "nowhere")])
