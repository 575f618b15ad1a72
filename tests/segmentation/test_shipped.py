import re

import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError, cityscapes
from thesis_repro.segmentation import prediction, quality, shipped
from thesis_repro.segmentation.shipped import Phase, Preset

pytestmark = pytest.mark.slow

TINY = Preset(base_filters=2, phases=(Phase(32, 2, 2, 1e-2, 6), Phase(48, 1, 1, 1e-3, 4)))


@pytest.fixture(scope="module")
def model():
    return prediction.load_shipped()


def test_it_is_the_thesiss_network_and_small(model):
    assert model.input_shape == (None, 320, 320, 1) and model.output_shape == (None, 320, 320, 35)
    assert "conv2d" not in {layer.name for layer in model.layers}  # the dead convolutions are dead here too
    assert model.get_layer("conv2d_1").filters == shipped.PRESET.base_filters
    assert sum(path.stat().st_size for path in shipped.FOLDER.iterdir()) <= 8e6


@pytest.mark.real
def test_quality_on_camvids_validation_images_is_what_the_card_says(model, camvid_real):
    images, labels = cityscapes.load(cityscapes.pairs(camvid_real, "val"), 320)
    found = quality.quality(model, images, labels)
    card = (shipped.FOLDER / "README.md").read_text(encoding="utf-8")

    assert len(found.classes) == 11
    assert found.mean_iou >= 0.50
    assert float(re.search(r"mean IoU \*\*([\d.]+)\*\*", card).group(1)) == pytest.approx(found.mean_iou, abs=2e-3)
    for name, row in found.classes.iterrows():
        assert re.search(rf"\| {name} \| {int(row['id'])} \|", card), name
    predicted = prediction.predict(model, images[:8])
    assert found.accuracy > 0.8 and set(np.unique(predicted)) <= {0, 7, 8, 11, 13, 17, 20, 21, 23, 24, 25, 26}


@pytest.mark.real
@pytest.mark.parametrize("sequence", ["00", "06"])
def test_label_maps_of_kitti_frames_are_streets(model, kitti_real, tmp_path, sequence):
    frames = sorted((kitti_real / "sequences" / sequence / "image_0").glob("*.png"))[:200:10]
    prediction.write_label_maps(model, frames, tmp_path)
    maps = np.stack([cityscapes.read_label_map(tmp_path / path.name) for path in frames])

    # road is what lies in front of the car, and sky, trees or houses are what is at the top
    assert np.bincount(maps[:, 250:310, 120:200].ravel()).argmax() == 7
    assert np.isin(maps[:, :40], [11, 21, 23]).mean() > 0.6


def test_the_training_resumes_and_gives_the_same_weights(tiny_cityscapes, tmp_path, monkeypatch):
    whole = shipped.train_shipped(tiny_cityscapes, tmp_path / "whole", TINY)

    class Killed(Exception):
        pass

    made = shipped._batches

    def killing(images, labels, phase, epoch, preset):
        for number, batch in enumerate(made(images, labels, phase, epoch, preset)):
            if epoch == 3 and number == 2:
                raise Killed
            yield batch

    monkeypatch.setattr(shipped, "_batches", killing)
    with pytest.raises(Killed):
        shipped.train_shipped(tiny_cityscapes, tmp_path / "killed", TINY)
    monkeypatch.setattr(shipped, "_batches", made)
    resumed = shipped.train_shipped(tiny_cityscapes, tmp_path / "killed", TINY)

    for a, b in zip(whole.get_weights(), resumed.get_weights(), strict=True):
        assert np.array_equal(a, b)
    assert pd.read_csv(tmp_path / "killed" / "history.csv")["size"].tolist() == [32, 32, 48]
    with pytest.raises(InputError, match="another preset"):
        shipped.train_shipped(tiny_cityscapes, tmp_path / "killed", Preset(base_filters=4, phases=TINY.phases))


def test_each_epoch_shows_each_image_once_anew():
    images = np.repeat(np.arange(1, 9, dtype=np.uint8) * 25, 40 * 40).reshape(8, 40, 40, 1)
    labels = np.repeat(np.arange(8, dtype=np.uint8), 40 * 40).reshape(8, 40, 40)
    phase = Phase(32, 4, 1, 1e-3, 1)
    epochs = [list(shipped._batches(images, labels, phase, epoch, TINY)) for epoch in (1, 2, 1)]

    for batches in epochs:
        assert [batch[0].shape for batch in batches] == [(4, 32, 32, 1)] * 2
        seen = [label[label < 8].max() for _, batch in batches for label in batch]
        assert sorted(seen) == list(range(8))
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(epochs[0], epochs[2], strict=True))
    assert not all(np.array_equal(a[0], b[0]) for a, b in zip(epochs[0], epochs[1], strict=True))


def test_the_learning_rate_falls_to_nothing():
    phase = shipped.PRESET.phases[-1]
    steps = 367 // phase.batch_size * phase.epochs

    assert phase.rate(0) == phase.learning_rate
    assert phase.rate(steps) == pytest.approx(0, abs=1e-9)
    assert phase.rate(steps // 2) == pytest.approx(phase.learning_rate / 2, rel=0.01)
