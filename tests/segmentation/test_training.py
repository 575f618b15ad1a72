"""The training: its loss and batches, resuming, and its bits on any number of cores."""

import os
import sys
from pathlib import Path

import keras
import numpy as np
import pytest
import segmentation_models as sm
import small_training
import tensorflow as tf
from trials import succeed

from thesis_repro.errors import InputError
from thesis_repro.segmentation import augmentation, training

pytestmark = pytest.mark.slow

SIZE = 16
MODEL = "model.keras"  # of the network with the lowest validation loss


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


def prepared(sets=SETS, filters=2, rate=0.01, loss=None, falls=0):
    """Return a compiled model and its batches, as notebook 4 prepares them.

    falls: number of epochs over which the learning rate falls to zero; 0: it stays.
    """
    keras.utils.set_random_seed(0)
    model = network(filters)
    loss = training.fused_loss(loss or training.total_loss())
    augmented = augmentation.augment_set(*sets[:2], augmentation.training_augmenter(SIZE), 0)
    batches = training.Batches([sets[:2], augmented], 4, seed=0)
    if falls:
        rate = training.falling_rate(rate, falls, batches)
    model.compile(keras.optimizers.Adam(rate), loss, metrics=training.metrics())
    model.optimizer.build(model.trainable_variables)  # or TensorFlow compiles the step twice
    return model, batches, training.Batches([sets[2:]], 4)


def fit(folder, epochs=3, patience=5, interrupted=(), **options):
    """Return a function that runs the fit of notebook 4 and returns the history.

    interrupted: the numbers of batches, counted over all its calls, after which Ctrl-C follows.
    """
    model, batches, validation = prepared(**options)
    stop = keras.callbacks.EarlyStopping(patience=patience)
    best = keras.callbacks.ModelCheckpoint(folder / MODEL, save_best_only=True)
    resumable = training.ResumableTraining(folder, batches, [stop, best])
    seen = []

    def end_of_batch(batch, logs):
        seen.append(batch)
        if len(seen) in interrupted:
            raise KeyboardInterrupt

    wait = keras.callbacks.LambdaCallback(on_train_batch_end=end_of_batch)
    shown = {"validation_data": validation.dataset(), "verbose": 0, "shuffle": False}

    def run():
        callbacks = [stop, best, wait, resumable]
        model.fit(batches.dataset(), epochs=epochs, callbacks=callbacks, **shown)
        return resumable.history

    return run


def test_threads_are_set_before_tensorflow_computes():
    """Two lessons in one kernel: TensorFlow's own error has a traceback, and does not say why."""
    tf.zeros(1).numpy()
    for setting in (tf.config.threading.get_intra_op_parallelism_threads() + 1, 3):
        with pytest.raises(InputError, match="restart it"):
            training.fix_threads(setting)


def test_loss_is_the_sum_of_dice_and_focal_loss():
    random = np.random.default_rng(0)
    true = augmentation.one_hot(random.integers(0, 35, (2, 8, 8)).astype(np.uint8), 35)
    predicted = random.dirichlet(np.ones(35), (2, 8, 8)).astype(np.float32)
    tp = (true * predicted).sum((0, 1, 2))
    dice = (2 * tp + 1e-5) / (true.sum((0, 1, 2)) + predicted.sum((0, 1, 2)) + 1e-5)
    focal = -(true * 0.25 * (1 - predicted) ** 2 * np.log(predicted)).mean()
    expected = 1 - (training.CLASS_WEIGHTS * dice).mean() + focal
    assert float(training.total_loss()(true, predicted)) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("loss", [training.total_loss(), "categorical_crossentropy"])
def test_fused_loss_is_the_same_loss_with_the_same_gradient(loss):
    random = np.random.default_rng(0)
    true = tf.one_hot(random.integers(0, 35, (2, 16, 16)), 35)
    predicted = tf.constant(random.dirichlet(np.ones(35), (2, 16, 16)).astype(np.float32))
    values, gradients = [], []
    for function in (keras.losses.get(loss), training.fused_loss(loss)):
        with tf.GradientTape() as tape:
            tape.watch(predicted)
            value = tf.reduce_mean(3 * function(true, predicted))
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


def test_an_interrupted_training_goes_on_in_the_same_kernel(tmp_path):
    """It ends to the bit as one that was not: history and best model.

    An epoch has five batches: the first call stops in epoch 1, the second in epoch 3.
    """
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    fit(whole, falls=3)()
    run = fit(stopped, interrupted=(2, 14), falls=3)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            run()
    assert run()["epoch"].tolist() == [1, 2, 3]
    assert (stopped / "history.csv").read_text() == (whole / "history.csv").read_text()
    both = [training.load_model(each / MODEL).get_weights() for each in (whole, stopped)]
    assert all(map(np.array_equal, *both))


def test_early_stopping_keeps_the_best_and_stays_stopped(tmp_path):
    # a validation set that contradicts the training set gets worse as training goes on
    sets = (*SETS[:3], np.where(SETS[3] == 7, 11, 7).astype(np.uint8))
    options = {"sets": sets, "rate": 0.03}
    run = fit(tmp_path, 40, patience=2, **options)
    losses = run()["val_loss"]
    stopped = len(losses)
    assert stopped < 40 and losses.idxmin() == stopped - 3
    assert len(run()) == stopped
    # with more patience, the training resumes, here with another model, as in another kernel
    assert len(fit(tmp_path, 40, patience=3, **options)()) == stopped + 1


def test_a_falling_rate_falls_evenly_to_zero():
    batches = training.Batches([SETS[:2]], 4)
    rate = training.falling_rate(0.01, 5, batches)
    steps = np.linspace(0, 5 * len(batches), 3)
    assert [float(rate(step)) for step in steps] == pytest.approx([0.01, 0.005, 0])


def test_every_change_of_a_training_changes_its_record():
    changes = [{"rate": 0.02}, {"filters": 4}, {"loss": sm.losses.DiceLoss()}]
    changes += [{"falls": 3}, {"falls": 4}]
    records = [training.made_from(*prepared(**change)) for change in [{}, *changes]]
    assert len({str(record) for record in records}) == len(records)
    assert training.made_from(*prepared()) == records[0]


def with_id(label):
    labels = SETS[1].copy()
    labels[1, 3, 3] = label
    return labels


@pytest.mark.parametrize(
    "images, labels, size, said",
    [
        (SETS[0][:0], SETS[1][:0], 4, r"images \(0, 16"),
        (SETS[0], SETS[1][:, :8], 4, r"label maps \(9, 8, 16"),
        (SETS[0] / np.float32(255), SETS[1], 4, "float32"),  # after A.Normalize
        (SETS[0], with_id(35), 4, "label map 1: holds 35"),
        (SETS[0], SETS[1], 0, "size 0"),
    ],
)
def test_sets_that_cannot_be_trained_on_are_refused(images, labels, size, said):
    with pytest.raises(InputError, match=said):
        training.Batches([(images, labels)], size)


def test_nothing_may_be_labelled():
    assert len(training.Batches([(SETS[0], with_id(255))], 9)) == 1


@pytest.mark.torture
@pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="needs two cores and a system that can restrict a process to one",
)
def test_one_core_and_all_give_the_same_bits():
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
        "import small_training as small; print(small.digest(*small.prepared()))"
    )
    one_core = succeed([sys.executable, "-c", code], Path(__file__).parent)
    assert one_core.stdout.split()[-1] == small_training.digest(*small_training.prepared())


def test_a_training_stops_at_a_loss_that_is_not_finite(tmp_path):
    model, batches, validation = prepared()
    best = keras.callbacks.ModelCheckpoint(tmp_path / MODEL, save_best_only=True)
    resumable = training.ResumableTraining(tmp_path, batches, [best])

    def break_weights(epoch, logs):
        if epoch == broken:
            kernel = model.get_layer("classes").kernel
            kernel.assign(np.full(kernel.shape, np.nan))

    callbacks = [best, keras.callbacks.LambdaCallback(on_epoch_begin=break_weights), resumable]
    shown = {"validation_data": validation.dataset(), "verbose": 0}
    for broken in (0, 1):  # the second call begins anew
        with pytest.raises(InputError, match=f"the loss of epoch {broken + 1} is nan"):
            model.fit(batches.dataset(), epochs=3, callbacks=callbacks, **shown)
        assert len(resumable.history) == broken
        assert (tmp_path / MODEL).exists() == bool(broken)
    # the best network and the checkpoint are those of the first epoch
    kept = training.load_model(tmp_path / MODEL)
    callbacks[1:2] = []
    model.fit(batches.dataset(), epochs=1, verbose=0, callbacks=callbacks)
    assert all(map(np.array_equal, kept.get_weights(), model.get_weights()))
    with pytest.raises(InputError, match="trained already"):
        training.made_from(model, batches, validation)


def test_weights_that_are_not_finite_are_refused(tmp_path):
    model = network(2)
    model.get_layer("classes").bias.assign([np.nan, *[0] * 34])
    model.save(tmp_path / "broken.keras")
    with pytest.raises(InputError, match="broken.keras: has weights that are no finite"):
        training.load_model(tmp_path / "broken.keras")
