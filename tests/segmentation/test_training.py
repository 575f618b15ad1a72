import signal
import subprocess
import sys
import time
from pathlib import Path

import keras
import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError
from thesis_repro.segmentation import augmentation, training
from thesis_repro.segmentation.unet import build_unet

ROOT = Path(__file__).parents[2]
SIZE = 32
SMALL = dict(base_filters=2, batch_size=4, epochs=3, learning_rate=0.01)


def street(count, seed):
    """Images whose grey level follows the label, so that there is something to learn."""
    random = np.random.default_rng(seed)
    labels = np.kron(random.choice([7, 11, 23], (count, 4, 4)), np.ones((1, 8, 8))).astype(np.uint8)
    images = (labels * 9 + random.integers(0, 20, labels.shape)).astype(np.uint8)[..., None]
    return images, labels


SETS = (*street(9, 0), *street(3, 1))


def weights_of(path):
    return [variable.numpy() for variable in training.load_model(path).variables]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    training.train(*SETS, folder, **SMALL)
    return folder


def test_history_and_best_model(trained):
    history = pd.read_csv(trained / "history.csv")

    assert history["epoch"].tolist() == [1, 2, 3]
    assert {"loss", "iou_score", "f1-score", "val_loss", "val_iou_score", "val_f1-score"} < set(history.columns)
    assert history["loss"].iloc[-1] < history["loss"].iloc[0]
    # the model in the folder is the one with the lowest validation loss
    augmented = augmentation.augment_set(SETS[2], SETS[3], augmentation.validation_augmenter(SIZE), 1)
    model = training.load_model(trained / "model.keras")
    loss = model.evaluate(training.Batches([SETS[2:], augmented], 4).dataset(), verbose=0, return_dict=True)["loss"]
    assert loss == pytest.approx(history["val_loss"].min(), abs=1e-5)


def test_loss_is_the_sum_of_the_librarys_two():
    random = np.random.default_rng(0)
    true = augmentation.one_hot(random.integers(0, 35, (2, 8, 8)).astype(np.uint8), 35)
    predicted = random.dirichlet(np.ones(35), (2, 8, 8)).astype(np.float32)
    weights = training.CLASS_WEIGHTS
    tp = (true * predicted).sum((0, 1, 2))
    dice = (2 * tp + 1e-5) / (true.sum((0, 1, 2)) + predicted.sum((0, 1, 2)) + 1e-5)
    focal = -(true * 0.25 * (1 - predicted) ** 2 * np.log(predicted)).mean()

    assert float(training.total_loss()(true, predicted)) == pytest.approx(1 - (weights * dice).mean() + focal, rel=1e-4)


def test_each_epoch_shows_each_image_once_in_an_order_of_its_own():
    second = (SETS[0][:5] // 2, SETS[1][:5])
    batches = training.Batches([SETS[:2], second], 4, seed=3)
    seen = {}
    for epoch in (0, 1):
        batches.epoch = epoch
        seen[epoch] = np.concatenate([images for images, _ in batches])
    again = np.concatenate([images for images, _ in batches])

    everything = np.concatenate([SETS[0], second[0]])
    for images in seen.values():
        assert sorted(image.tobytes() for image in images) == sorted(image.tobytes() for image in everything)
    assert not np.array_equal(seen[0], seen[1])
    assert np.array_equal(seen[1], again)


def test_the_network_gets_raw_grey_levels():
    (images, labels), *_ = training.Batches([SETS[:2]], 4).dataset()

    assert np.array_equal(images.numpy(), SETS[0][:4].astype(np.float32))
    assert np.array_equal(labels.numpy(), SETS[1][:4])


def test_label_maps_are_scored_as_their_one_hot_masks():
    labels = SETS[1][:4].copy()
    labels[0, 0] = augmentation.NOTHING
    predicted = np.random.default_rng(0).dirichlet(np.ones(35), labels.shape).astype(np.float32)
    for function in (training.total_loss(), *training.metrics()):
        scores = [float(training.OnLabelMaps(function)(true, predicted))
                  for true in (labels, augmentation.one_hot(labels, 35))]
        assert scores[0] == scores[1] == pytest.approx(float(function(augmentation.one_hot(labels, 35), predicted)))


def test_fresh_augmentation_differs_from_epoch_to_epoch():
    batches = training.Batches([SETS[:2]] * 2, 18, seed=0, augmenter=augmentation.training_augmenter(SIZE))
    first = next(iter(batches))[0]
    batches.epoch = 1
    second = next(iter(batches))[0]

    plain = {image.tobytes() for image in SETS[0]}
    changed = [{image.tobytes() for image in epoch} - plain for epoch in (first, second)]
    assert len(changed[0]) == len(changed[1]) == 9 and not changed[0] & changed[1]


def test_same_seed_same_model_and_callbacks_see_every_epoch(trained, tmp_path):
    seen = []
    callback = keras.callbacks.LambdaCallback(on_epoch_end=lambda epoch, logs: seen.append(logs["val_loss"]))
    training.train(*SETS, tmp_path, **SMALL, callbacks=[callback])

    assert seen == pytest.approx(pd.read_csv(tmp_path / "history.csv")["val_loss"].tolist())
    for a, b in zip(weights_of(tmp_path / "model.keras"), weights_of(trained / "model.keras"), strict=True):
        assert np.array_equal(a, b)


def test_a_killed_training_goes_on_and_ends_the_same(trained, tmp_path):
    code = ("import sys; sys.path.insert(0, 'tests'); import test_training as t; "
            f"t.training.train(*t.SETS, {str(tmp_path)!r}, **t.SMALL)")
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL,
                               cwd=ROOT)
    deadline = time.monotonic() + 120
    while not (tmp_path / "state.npz").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it ended before it could be killed"
    assert len(pd.read_csv(tmp_path / "history.csv")) < 3

    training.train(*SETS, tmp_path, **SMALL)

    assert (tmp_path / "history.csv").read_text() == (trained / "history.csv").read_text()
    for a, b in zip(weights_of(tmp_path / "model.keras"), weights_of(trained / "model.keras"), strict=True):
        assert np.array_equal(a, b)


def test_several_devices_share_each_batch(tmp_path):
    code = ("import sys; import tensorflow as tf; cpu, = tf.config.list_physical_devices('CPU'); "
            "tf.config.set_logical_device_configuration(cpu, [tf.config.LogicalDeviceConfiguration()] * 2); "
            "sys.path.insert(0, 'tests'); import test_training as t; "
            "t.training._strategy = lambda: tf.distribute.MirroredStrategy(['CPU:0', 'CPU:1']); "
            f"[t.training.train(*t.SETS, {str(tmp_path)!r}, **t.SMALL | dict(epochs=n)) for n in (1, 2)]")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300)

    assert done.returncode == 0, done.stderr[-2000:]
    history = pd.read_csv(tmp_path / "history.csv")  # the second epoch was resumed
    assert history["epoch"].tolist() == [1, 2] and history["loss"].iloc[1] < history["loss"].iloc[0]


def test_a_finished_training_is_loaded(trained):
    before = (trained / "model.keras").stat().st_mtime_ns
    training.train(*SETS, trained, **SMALL)

    assert (trained / "model.keras").stat().st_mtime_ns == before


def test_early_stopping_keeps_the_best(tmp_path):
    # a validation set that contradicts the training set gets worse as training goes on
    wrong = np.where(SETS[3] == 7, 11, 7).astype(np.uint8)
    training.train(*SETS[:3], wrong, tmp_path, **SMALL | dict(epochs=40, patience=2, learning_rate=0.03))
    losses = pd.read_csv(tmp_path / "history.csv")["val_loss"]

    assert len(losses) < 40
    assert losses.idxmin() == len(losses) - 3


def test_other_settings_or_data_in_the_same_folder(trained):
    with pytest.raises(InputError, match="base_filters=2, not 4"):
        training.train(*SETS, trained, **SMALL | dict(base_filters=4))
    with pytest.raises(InputError, match="data_checksum"):
        training.train(SETS[0] // 2, *SETS[1:], trained, **SMALL)


def test_a_damaged_state(trained, tmp_path):
    (tmp_path / "state.npz").write_bytes((trained / "state.npz").read_bytes()[:1000])
    with pytest.raises(InputError, match="damaged"):
        training.train(*SETS, tmp_path, **SMALL)


@pytest.mark.parametrize(("sets", "message"), [
    ((SETS[0][:0], SETS[1][:0], *SETS[2:]), "training set: empty"),
    ((*SETS[:2], SETS[2][:0], SETS[3][:0]), "validation set: empty"),
    ((SETS[0], np.full_like(SETS[1], 35), *SETS[2:]), "label id 35"),
    ((SETS[0], SETS[1][:, :16], *SETS[2:]), "do not match"),
    ((*SETS[:2], SETS[2][:, :16, :16], SETS[3][:, :16, :16]), "one size"),
])
def test_bad_sets(sets, message, tmp_path):
    with pytest.raises(InputError, match=message):
        training.train(*sets, tmp_path, **SMALL)


def test_the_appendixs_hdf5_loads(trained, tmp_path):
    model = training.load_model(trained / "model.keras")
    model.save(tmp_path / "model.hdf5")
    x, y = SETS[2].astype(np.float32), augmentation.one_hot(SETS[3], 35)

    # as in the appendix, loss and metrics included, and as everywhere else
    with_loss = keras.models.load_model(tmp_path / "model.hdf5", custom_objects=training.custom_objects())
    assert with_loss.evaluate(x, y, verbose=0) == pytest.approx(model.evaluate(x, y, verbose=0))
    assert np.array_equal(training.load_model(tmp_path / "model.hdf5")(x), model(x))


@pytest.mark.parametrize("suffix", [".keras", ".hdf5"])
def test_a_truncated_model(trained, tmp_path, suffix):
    training.load_model(trained / "model.keras").save(tmp_path / f"whole{suffix}")
    data = (tmp_path / f"whole{suffix}").read_bytes()
    (tmp_path / f"half{suffix}").write_bytes(data[:len(data) // 2])
    with pytest.raises(InputError, match="truncated"):
        training.load_model(tmp_path / f"half{suffix}")


def test_a_model_of_another_shape(tmp_path):
    build_unet((SIZE, SIZE, 1), 5, 2).save(tmp_path / "five.keras")
    with pytest.raises(InputError, match=r"\(None, 32, 32, 5\); expected"):
        training.load_model(tmp_path / "five.keras")
    with pytest.raises(InputError, match="no such model"):
        training.load_model(tmp_path / "none.keras")
