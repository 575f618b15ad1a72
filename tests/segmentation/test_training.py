"""The training: its loss and batches, resuming, its bits on any number of cores, its memory."""

import json
import os
import platform
import subprocess
import sys
import time
from copy import copy
from pathlib import Path

import keras
import numpy as np
import pandas as pd
import pytest
import segmentation_models as sm
import tensorflow as tf

import emulated
from thesis_repro.errors import InputError
from thesis_repro.segmentation import augmentation, memory, training
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow

SIZE = 16
# where another process finds this file and what it imports
FOLDERS = [str(Path(__file__).parent), str(Path(emulated.__file__).parent)]


def street(count, seed):
    """Images whose grey level follows the label, so that there is something to learn."""
    random = np.random.default_rng(seed)
    labels = np.kron(random.choice([7, 11, 23], (count, 4, 4)), np.ones((1, 4, 4))).astype(np.uint8)
    images = (labels * 9 + random.integers(0, 20, labels.shape)).astype(np.uint8)[..., None]
    return images, labels


SETS = (*street(9, 0), *street(4, 1))


def network(filters):
    """Return a small network with the U-Net's kinds of layers.

    The U-Net takes ten times as long to compile.
    """
    layers = [
        keras.Input((SIZE, SIZE, 1), name="image"),
        keras.layers.Conv2D(4 * filters, 3, padding="same", activation="relu", name="features"),
        keras.layers.BatchNormalization(name="normalized"),
        keras.layers.Conv2D(35, 1, activation="softmax", name="classes"),
    ]
    return keras.Sequential(layers, name="small")


def prepared(sets=SETS, filters=2, rate=0.01, loss=None, strategy=None):
    """Return a compiled model and its batches, as notebook 4 prepares them."""
    keras.utils.set_random_seed(0)
    with (strategy or training.strategy()).scope():
        model = network(filters)
        model.compile(
            keras.optimizers.Adam(rate),
            loss or training.fused_loss(training.total_loss()),
            metrics=training.metrics(),
        )
        model.optimizer.build(model.trainable_variables)
    augmented = augmentation.augment_set(*sets[:2], augmentation.training_augmenter(SIZE), 0)
    return (
        model,
        training.Batches([sets[:2], augmented], 4, seed=0),
        training.Batches([sets[2:]], 4),
    )


def train(folder, epochs=3, patience=5, pause=0, **options):
    """Run the fit of notebook 4.

    pause: seconds after each batch, which leave time to kill the process.
    """
    model, batches, validation = prepared(**options)
    stop = keras.callbacks.EarlyStopping(patience=patience)
    best = keras.callbacks.ModelCheckpoint(folder / training.MODEL, save_best_only=True)
    resumable = training.ResumableTraining(folder, model, batches, [stop, best])
    wait = keras.callbacks.LambdaCallback(on_train_batch_end=lambda batch, logs: time.sleep(pause))
    model.fit(
        batches.dataset(),
        validation_data=validation.dataset(),
        epochs=epochs,
        shuffle=False,
        verbose=0,
        initial_epoch=resumable.first_epoch(epochs),
        callbacks=[stop, best, resumable, wait],
    )
    return resumable


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train(folder)
    return folder


def test_history_and_best_model(trained):
    history = pd.read_csv(trained / "history.csv")

    assert history["epoch"].tolist() == [1, 2, 3]
    assert {"loss", "iou_score", "f1-score", "val_loss", "val_iou_score", "val_f1-score"} < set(
        history.columns
    )
    assert history["loss"].iloc[-1] < history["loss"].iloc[0]
    # the model in the folder is the one with the lowest validation loss
    _, _, validation = prepared()
    model = training.load_model(trained / "model.keras")
    model.compile("adam", training.total_loss())
    assert model.evaluate(validation.dataset(), verbose=0) == pytest.approx(
        history["val_loss"].min(), abs=1e-5
    )


def test_loss_is_the_sum_of_dice_and_focal_loss():
    random = np.random.default_rng(0)
    true = augmentation.one_hot(random.integers(0, 35, (2, 8, 8)).astype(np.uint8), 35)
    predicted = random.dirichlet(np.ones(35), (2, 8, 8)).astype(np.float32)
    weights = training.CLASS_WEIGHTS
    tp = (true * predicted).sum((0, 1, 2))
    dice = (2 * tp + 1e-5) / (true.sum((0, 1, 2)) + predicted.sum((0, 1, 2)) + 1e-5)
    focal = -(true * 0.25 * (1 - predicted) ** 2 * np.log(predicted)).mean()

    assert float(training.total_loss()(true, predicted)) == pytest.approx(
        1 - (weights * dice).mean() + focal, rel=1e-4
    )


def test_fused_loss_is_the_same_loss_with_the_same_gradient():
    random = np.random.default_rng(0)
    true = tf.one_hot(random.integers(0, 35, (2, 16, 16)), 35)
    predicted = tf.constant(random.dirichlet(np.ones(35), (2, 16, 16)).astype(np.float32))
    values, gradients = [], []
    for loss in (training.total_loss(), training.fused_loss(training.total_loss())):
        with tf.GradientTape() as tape:
            tape.watch(predicted)
            value = 3 * loss(true, predicted)
        values.append(value.numpy())
        gradients.append(tape.gradient(value, predicted).numpy())

    assert values[1] == pytest.approx(values[0], rel=1e-6)
    assert np.abs(gradients[1] - gradients[0]).max() < 1e-5 * np.abs(gradients[0]).max()


def test_each_epoch_shows_each_image_once_in_another_order():
    second = (SETS[0][:5] // 2, SETS[1][:5])
    batches, seen = training.Batches([SETS[:2], second], 4, seed=3), []
    for batches.epoch in (0, 1, 1):
        seen.append([image.tobytes() for images, _ in batches for image in images])
    once = sorted(image.tobytes() for image in (*SETS[0], *second[0]))
    assert sorted(seen[0]) == sorted(seen[1]) == once
    assert seen[0] != seen[1] == seen[2]


def test_the_network_gets_raw_grey_levels_and_one_hot_masks():
    labels = SETS[1].copy()
    labels[0, 0] = augmentation.NOTHING
    (images, masks), *_ = training.Batches([(SETS[0], labels)], 4).dataset()
    assert np.array_equal(images.numpy(), SETS[0][:4].astype(np.float32))
    assert (
        np.array_equal(masks.numpy(), augmentation.one_hot(labels[:4], 35))
        and not masks.numpy()[0, 0].any()
    )


def test_fresh_augmentation_replaces_the_second_set_in_every_epoch():
    sets, augmenter = (
        [SETS[:2], (np.zeros_like(SETS[0]), SETS[1])],
        augmentation.training_augmenter(SIZE),
    )
    batches, changed = training.Batches(sets, 18, seed=0, augmenter=augmenter), []
    for batches.epoch in (0, 1):
        images = {image.tobytes() for image in next(iter(batches))[0]}
        changed.append(images - {image.tobytes() for image in SETS[0]})
    assert len(changed[0]) == len(changed[1]) == 9 and not changed[0] & changed[1]
    fresh, _ = augmenter(SETS[0][3], SETS[1][3], augmentation.image_seed(0, 3, epoch=1))
    assert fresh.tobytes() in changed[1]


def test_a_killed_training_resumes_and_ends_the_same(trained, tmp_path, kill_when):
    code = (
        f"import sys; sys.path[:0] = {FOLDERS}; "
        "from thesis_repro import segmentation; import test_training as t; "
        f"t.train(t.Path({str(tmp_path)!r}), pause=0.1)"
    )
    kill_when([sys.executable, "-c", code], (tmp_path / "state.npz").exists)
    assert len(pd.read_csv(tmp_path / "history.csv")) < 3

    assert train(tmp_path).history["epoch"].tolist() == [1, 2, 3]
    assert (tmp_path / "history.csv").read_text() == (trained / "history.csv").read_text()
    resumed, undisturbed = (
        training.load_model(folder / training.MODEL).get_weights() for folder in (tmp_path, trained)
    )
    assert all(map(np.array_equal, resumed, undisturbed))


def test_several_devices_share_each_batch(tmp_path):
    code = (
        f"import sys; sys.path[:0] = {FOLDERS}; "
        "import tensorflow as tf; cpu, = tf.config.list_physical_devices('CPU'); "
        "tf.config.set_logical_device_configuration(cpu, [tf.config.LogicalDeviceConfiguration()] * 2); "
        "import test_training as t; "
        f"folder, two = t.Path({str(tmp_path)!r}), tf.distribute.MirroredStrategy(['CPU:0', 'CPU:1']); "
        "t.train(folder, 2, strategy=two); "
        "assert t.training.ResumableTraining(folder, *t.prepared(strategy=two)[:2]).first_epoch(3) == 2"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    history = pd.read_csv(tmp_path / "history.csv")
    assert history["epoch"].tolist() == [1, 2] and history["loss"].iloc[1] < history["loss"].iloc[0]


def test_checkpoints_that_are_damaged_or_of_another_network_are_refused(trained, tmp_path):
    model, batches, _ = prepared(filters=4)
    (tmp_path / "state.npz").write_bytes((trained / "state.npz").read_bytes()[:1000])
    for folder in (trained, tmp_path):
        with pytest.raises(InputError, match=str(folder)):
            training.ResumableTraining(folder, model, batches)


@pytest.mark.parametrize(
    ("images", "labels"),
    [(SETS[0][:0], SETS[1][:0]), (SETS[0], np.full_like(SETS[1], 35)), (SETS[0], SETS[1][:, :8])],
)
def test_sets_that_cannot_be_trained_on_are_refused(images, labels):
    with pytest.raises(InputError):
        training.Batches([(images, labels)], 4)


@pytest.mark.parametrize("counts", [(18,), (9, 8), (6, 6, 6)])
def test_an_augmenter_needs_two_sets_of_one_length(counts):
    sets = [(SETS[0][:1].repeat(count, 0), SETS[1][:1].repeat(count, 0)) for count in counts]
    with pytest.raises(InputError, match="augmenter"):
        training.Batches(sets, 4, seed=0, augmenter=augmentation.training_augmenter(SIZE))


def test_early_stopping_keeps_the_best_and_stays_stopped(tmp_path):
    # a validation set that contradicts the training set gets worse as training goes on
    sets = (*SETS[:3], np.where(SETS[3] == 7, 11, 7).astype(np.uint8))
    losses = train(tmp_path, 40, 2, sets=sets, rate=0.03).history["val_loss"]
    assert len(losses) < 40 and losses.idxmin() == len(losses) - 3
    for patience, first in ((2, 40), (3, len(losses))):  # with more patience, the training resumes
        stop = [keras.callbacks.EarlyStopping(patience=patience)]
        assert training.ResumableTraining(tmp_path, *prepared()[:2], stop).first_epoch(40) == first


def test_every_change_of_a_training_changes_its_record():
    _, batches, validation = prepared()
    models = [
        prepared()[0],
        prepared(rate=0.02)[0],
        prepared(filters=4)[0],
        prepared(loss=sm.losses.DiceLoss())[0],
    ]
    records = [training.made_from(model, batches, validation) for model in models]
    for name, value in (
        ("seed", 1),
        ("batch_size", 5),
        ("augmenter", augmentation.training_augmenter(SIZE)),
        ("sets", [(SETS[0] // 2, SETS[1])]),
    ):
        changed = copy(batches)
        setattr(changed, name, value)
        records.append(training.made_from(models[0], changed, validation))
    assert len({json.dumps(record, default=str) for record in records}) == len(records)
    assert training.made_from(*prepared()) == records[0]


def test_the_appendixs_hdf5_loads(trained, tmp_path):
    model = training.load_model(trained / "model.keras")
    loss, scores = training.total_loss(), training.metrics()
    model.compile("adam", loss, metrics=scores)
    model.save(tmp_path / "model.hdf5")
    x, y = SETS[2].astype(np.float32), augmentation.one_hot(SETS[3], 35)

    # with loss and metrics, as in the appendix
    with_loss = keras.models.load_model(
        tmp_path / "model.hdf5",
        custom_objects={loss.name: loss, **{score.name: score for score in scores}},
    )
    assert with_loss.evaluate(x, y, verbose=0) == pytest.approx(model.evaluate(x, y, verbose=0))
    assert np.array_equal(training.load_model(tmp_path / "model.hdf5")(x), model(x))


# equal on AMD Zen 3, on an Intel Xeon with AVX-512 and in QEMU
RECORDED = "9d39effb0706"


@pytest.fixture(scope="module")
def digest():
    """The bits of a training in this process."""
    return emulated.digest()


@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="needs two cores and a system that can restrict a process to one",
)
def test_one_core_and_all_give_the_same_bits(digest):
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
        "import emulated; print(emulated.digest())"
    )
    one_core = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(emulated.__file__).parent,
        check=True,
    )
    assert one_core.stdout.split()[-1] == digest


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="recorded on x86_64")
def test_the_training_gives_the_recorded_bits(digest):
    assert digest == RECORDED


def test_a_batch_that_cannot_fit_is_refused(monkeypatch):
    model = build_unet((64, 64, 1), 35, 4)
    monkeypatch.setattr(memory, "available", lambda: memory.needed(model, 3) - 1)
    memory.require(model, 2)
    with pytest.raises(InputError, match="batch_size=3:"):
        memory.require(model, 3)


def test_a_containers_limit_is_read(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "CGROUP", tmp_path)
    free = memory.available()
    (tmp_path / "memory.current").write_text(f"{2**20}\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.available() > free / 2
    (tmp_path / "memory.max").write_text(f"{2**27}\n")
    assert memory.available() == 2**27 - 2**20


def test_memory_needed_by_the_thesiss_batch():
    # 600 channels at full size are kept for the gradients
    row = 16 * 320 * 320 * 4  # bytes of one channel at full size in a batch of 16
    assert 600 * row < memory.needed(build_unet((320, 320, 1), 35), 16) < 20e9
