"""Loss, metrics, input pipeline and training of appendix A.5."""

import json
import os
import zipfile
import zlib
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("SM_FRAMEWORK", "tf.keras")

import keras
import numpy as np
import pandas as pd
import segmentation_models as sm
import tensorflow as tf

from thesis_repro import InputError, files
from thesis_repro.cityscapes import CLASS_WEIGHTS, N_CLASSES
from thesis_repro.segmentation import augmentation, memory
from thesis_repro.segmentation.unet import build_unet

MODEL, HISTORY, STATE = "model.keras", "history.csv", "state.npz"


def total_loss():
    """The sum of weighted Dice and focal loss (Equation 3.8, weights of Table 3.2)."""
    return sm.losses.DiceLoss(class_weights=CLASS_WEIGHTS) + sm.losses.CategoricalFocalLoss()


def metrics():
    """The library's IoU and F1 scores: means over all 35 classes of each batch, absent classes scoring 1."""
    return [sm.metrics.IOUScore(threshold=0.5), sm.metrics.FScore(threshold=0.5)]


class OnLabelMaps:
    """A loss or metric of the library, which compares one-hot masks, for label maps as well.

    The encoding then happens inside the compiled step: a one-hot batch is 140 times as large as its label maps.
    """

    def __init__(self, function):
        self.function, self.name, self.__name__ = function, function.name, function.name

    def __call__(self, true, predicted):
        if len(true.shape) < len(predicted.shape):
            true = tf.one_hot(tf.cast(true, tf.uint8), N_CLASSES)  # NOTHING becomes zeros
        return self.function(true, predicted)


def compile_model(model, learning_rate=0.001):
    """Give a model the thesis's loss, metrics and optimizer (A.5), for label maps or one-hot masks as targets."""
    model.compile(keras.optimizers.Adam(learning_rate), OnLabelMaps(total_loss()),
                  metrics=[OnLabelMaps(metric) for metric in metrics()])


def custom_objects():
    """What `keras.models.load_model` needs to load the loss and the metrics of the appendix's HDF5 file as well."""
    loss = OnLabelMaps(total_loss())
    return {loss.name: loss, "dice_loss_plus_1focal_loss": loss} | {
        metric.name: OnLabelMaps(metric) for metric in metrics()}


class Batches:
    """The input of the network: sets of images and label maps, of which every epoch shows each image once.

    Images (n, height, width, channels) and label maps (n, height, width) stay uint8, and the sets stay separate
    arrays; an image becomes float in its batch, and a label map one-hot in the compiled step. At 5950 images of
    320x320 that is 1.3 GB instead of 85 GB. Unlike a `tf.data` shuffle, the order depends on (seed, epoch) alone, so
    that a resumed run sees what an undisturbed one sees.
    """

    def __init__(self, sets, batch_size, seed=None, augmenter=None):
        """`sets` are (images, label maps) pairs. Without a seed the order is that of the sets.

        With an augmenter the second set is ignored as it stands and drawn from the first anew in every epoch.
        """
        self.sets, self.batch_size, self.seed, self.augmenter = sets, batch_size, seed, augmenter
        self.epoch = 0
        self._ends = np.cumsum([len(labels) for _, labels in sets])

    def __len__(self):
        return -(-int(self._ends[-1]) // self.batch_size)

    def __iter__(self):
        """The batches of the current epoch: uint8 images and uint8 label maps."""
        count, epoch = self._ends[-1], self.epoch
        order = np.arange(count) if self.seed is None else np.random.default_rng((self.seed, epoch)).permutation(count)
        shape = self.sets[0][0].shape[1:]
        for start in range(0, count, self.batch_size):
            chosen = order[start:start + self.batch_size]
            images = np.empty((len(chosen), *shape), np.uint8)
            labels = np.empty((len(chosen), *shape[:2]), np.uint8)
            for position, index in enumerate(chosen):
                images[position], labels[position] = self._pair(int(index), epoch)
            yield images, labels

    def _pair(self, index, epoch):
        which = int(np.searchsorted(self._ends, index, side="right"))
        within = index - (int(self._ends[which - 1]) if which else 0)
        images, labels = self.sets[which]
        if which and self.augmenter:
            return self.augmenter(images[within], labels[within], augmentation.image_seed(self.seed, within, epoch))
        return images[within], labels[within]

    def dataset(self):
        """The batches as a `tf.data.Dataset` of float images and uint8 label maps, made while the network works."""
        shape = self.sets[0][0].shape[1:]
        signature = (tf.TensorSpec((None, *shape), tf.uint8), tf.TensorSpec((None, *shape[:2]), tf.uint8))
        batches = tf.data.Dataset.from_generator(lambda: iter(self), output_signature=signature).prefetch(2)
        # grey levels stay 0 to 255: the appendix imports `normalize` and never calls it
        batches = batches.map(lambda images, labels: (tf.cast(images, tf.float32), labels))
        return batches.apply(tf.data.experimental.assert_cardinality(len(self)))


def train(train_images, train_labels, validation_images, validation_labels, folder, *, base_filters=64, batch_size=16,
          epochs=100, patience=5, learning_rate=0.001, seed=0, corrected_blocks=False,
          full_validation_augmentation=False, fresh_augmentation=False, build=None, callbacks=()):
    """Train the U-Net as in A.5 and return the model with the lowest validation loss.

    Images (n, size, size, channels) and label maps (n, size, size), uint8. Each set is doubled by one augmented copy
    of every image (A.3), made once. Training stops after `patience` epochs without a lower validation loss.

    In `folder`: `model.keras`, the best model so far; `history.csv`, a row for each epoch; `state.npz`, where
    training stands. Called again with the same folder, it goes on in the epoch in which it was killed, and ends
    with what an undisturbed run ends with; a finished training is loaded.

    Switches, off as in the thesis: `corrected_blocks` (see unet), `full_validation_augmentation` (see
    augmentation.validation_augmenter), `fresh_augmentation` (another augmented copy in every epoch). `build` is a
    function of (input_shape, n_classes) for another network than the thesis's. Several GPUs share each batch.

    Raises InputError for an empty set, images and label maps of different sizes, unknown label ids, a folder with a
    training of other settings, and a batch that does not fit into memory.
    """
    size = _check(train_images, train_labels, "training")
    if _check(validation_images, validation_labels, "validation") != size:
        raise InputError(f"validation images of {validation_images.shape[1:]}: training images have "
                         f"{train_images.shape[1:]}; read both at one size")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    data = zlib.crc32(b"".join(zlib.crc32(np.ascontiguousarray(array)).to_bytes(4, "big") for array in (
        train_images, train_labels, validation_images, validation_labels)))
    settings = {"images": list(train_images.shape), "validation_images": list(validation_images.shape),
                "data_checksum": data, "base_filters": base_filters, "batch_size": batch_size,
                "learning_rate": learning_rate, "seed": seed,
                "corrected_blocks": corrected_blocks, "full_validation_augmentation": full_validation_augmentation,
                "fresh_augmentation": fresh_augmentation}
    keras.utils.set_random_seed(seed)
    with _strategy().scope():
        model = (build or _thesis_network(base_filters, corrected_blocks))(train_images.shape[1:], N_CLASSES)
        compile_model(model, learning_rate)
        model.optimizer.build(model.trainable_variables)
    memory.require(model, batch_size, training=True)
    memory.keep_freed()
    record = _Record(model, folder, settings, patience)
    if not record.finished(epochs):
        augmenter = augmentation.training_augmenter(size)
        train_sets = [(train_images, train_labels)] * 2
        if not fresh_augmentation:
            train_sets[1] = augmentation.augment_set(*train_sets[0], augmenter, seed, "augmenting")
        validation_sets = [(validation_images, validation_labels), augmentation.augment_set(
            validation_images, validation_labels,
            augmentation.validation_augmenter(size, full_validation_augmentation), seed + 1, "augmenting")]
        batches = Batches(train_sets, batch_size, seed, augmenter if fresh_augmentation else None)
        validation = Batches(validation_sets, batch_size)
        with files.progress(description="training", total=epochs * len(batches), unit="batch",
                            initial=record.epoch * len(batches)) as bar:
            model.fit(batches.dataset(), validation_data=validation.dataset(), epochs=epochs,
                      initial_epoch=record.epoch, verbose=0, shuffle=False,
                      callbacks=[_Epochs(batches, bar), *callbacks, record])
    return load_model(folder / MODEL)


def _check(images, labels, name):
    if len(images) == 0:
        raise InputError(f"{name} set: empty; it needs at least one image with its label map")
    if images.ndim != 4 or images.shape[:3] != labels.shape or images.shape[1] != images.shape[2]:
        raise InputError(f"{name} set: images {images.shape} and label maps {labels.shape} do not match; expected "
                         "(n, size, size, channels) and (n, size, size)")
    known = labels[labels != augmentation.NOTHING]
    if known.size and known.max() >= N_CLASSES:
        raise InputError(f"{name} set: label id {known.max()} is above {N_CLASSES - 1}; label maps must hold "
                         "Cityscapes label ids")
    return images.shape[1]


def _thesis_network(base_filters, corrected_blocks):
    return lambda input_shape, n_classes: build_unet(input_shape, n_classes, base_filters, corrected_blocks)


def _strategy():
    several = len(tf.config.list_logical_devices("GPU")) > 1
    return tf.distribute.MirroredStrategy() if several else tf.distribute.get_strategy()


class _Epochs(keras.callbacks.Callback):
    """Tells the batches which epoch it is, and the progress bar how far it is."""

    def __init__(self, batches, bar):
        super().__init__()
        self.batches, self.bar = batches, bar

    def on_epoch_begin(self, epoch, logs=None):
        self.batches.epoch = epoch

    def on_train_batch_end(self, batch, logs=None):
        self.bar.update()

    def on_epoch_end(self, epoch, logs=None):
        self.bar.set_postfix_str(f"epoch {epoch + 1}, validation loss {logs['val_loss']:.3f}")


class _Record(keras.callbacks.Callback):
    """Early stopping, the best model, the history and the state to resume from: Keras' own forget when killed.

    The state is one file, written last: a kill before that repeats the epoch, and writes the same model again.
    """

    def __init__(self, model, folder, settings, patience):
        super().__init__()
        self.folder, self.settings, self.patience = folder, settings, patience
        self.rows = []
        self.variables = model.variables + model.optimizer.variables
        if (folder / STATE).is_file():
            self._resume()

    def _resume(self):
        where = self.folder / STATE
        try:
            with np.load(where) as state:
                record = json.loads(str(state["record"]))
                values = [state[f"{index}"] for index in range(len(state.files) - 1)]
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            raise InputError(f"{where}: damaged; delete {self.folder} to train from the start") from None
        for name, value in self.settings.items():
            if record["settings"].get(name) != value:
                raise InputError(f"{self.folder}: holds a training with {name}={record['settings'].get(name)}, not "
                                 f"{value}; delete the folder or choose another one")
        if [value.shape for value in values] != [tuple(variable.shape) for variable in self.variables]:
            raise InputError(f"{self.folder}: holds the training of another network; delete it or choose another one")
        for variable, value in zip(self.variables, values, strict=True):
            variable.assign(value)
        self.rows = record["rows"]

    @property
    def epoch(self):
        return len(self.rows)

    def _waited(self):
        losses = [row["val_loss"] for row in self.rows]
        return len(losses) - 1 - int(np.argmin(losses)) if losses else 0

    def finished(self, epochs):
        return self.epoch >= epochs or self._waited() >= self.patience

    def on_epoch_end(self, epoch, logs=None):
        self.rows.append({"epoch": epoch + 1} | {name: float(value) for name, value in logs.items()})
        if self._waited() == 0:
            with files.atomic(self.folder / MODEL) as temporary:
                self.model.save(temporary)
        files.write_text(self.folder / HISTORY, pd.DataFrame(self.rows).to_csv(index=False))
        record = json.dumps({"settings": self.settings, "rows": self.rows})
        values = {f"{index}": variable.numpy() for index, variable in enumerate(self.variables)}
        with files.atomic(self.folder / STATE) as temporary:
            np.savez(temporary, record=record, **values)
        if self._waited() >= self.patience:
            self.model.stop_training = True


def load_model(path):
    """Read a model saved by Keras, `.keras` or HDF5, with the thesis's loss and metrics.

    Raises InputError where the file is missing, truncated or no model, or where it is no network from square images
    to the 35 classes.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such model; train one or name another file")
    try:
        model = keras.models.load_model(path, compile=False)
    except Exception as error:  # Keras, h5py and zipfile each raise their own
        reason = str(error).strip().split("\n")[0][:200]
        raise InputError(f"{path}: not a model that Keras can read, or a truncated one ({reason}); "
                         "copy it again or train anew") from None
    check_shape(model, path)
    # Keras cannot read the library's loss back from a .keras file, so it is given anew
    compile_model(model)
    return model


def check_shape(model, name):
    """Raise InputError unless a model takes square images and gives 35 probabilities for each of their pixels."""
    taken, given = model.input_shape, model.output_shape
    if len(taken) != 4 or taken[1] is None or taken[1] != taken[2] or given != (*taken[:3], N_CLASSES):
        raise InputError(f"{name}: a model from {taken} to {given}; expected (None, size, size, channels) to "
                         f"(None, size, size, {N_CLASSES})")
