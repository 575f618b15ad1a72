"""Loss, metrics and the input of training (A.5), and what lets a long training go on after a stop."""

import io
import json
import os
import zipfile
import zlib
from contextlib import ExitStack, suppress
from functools import partial
from hashlib import sha256
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("TF_FORCE_GPU_ALLOW_GROWTH", "true")  # take of a GPU's memory what is needed, not all of it
os.environ.setdefault("SM_FRAMEWORK", "tf.keras")

import h5py
import keras
import numpy as np
import pandas as pd
import segmentation_models as sm
import tensorflow as tf

from thesis_repro import InputError, files, longrun, stages
from thesis_repro.cityscapes import CLASS_WEIGHTS, N_CLASSES
from thesis_repro.segmentation import augmentation

MODEL, HISTORY, STATE = "model.keras", "history.csv", "state.npz"


def total_loss():
    """The sum of weighted Dice and focal loss (Equation 3.8, weights of Table 3.2)."""
    return sm.losses.DiceLoss(class_weights=CLASS_WEIGHTS) + sm.losses.CategoricalFocalLoss()


def fused_loss(loss):
    """The same loss (true masks, probabilities), compiled together with its gradient.

    The library's loss is many operations, and each reads and writes 35 values a pixel. Compiled together they read and
    write these once. That saves time on a CPU; the sums round in another order. On a GPU nothing is compiled.
    """
    @tf.function(jit_compile=not tf.config.list_physical_devices("GPU"))
    def value_and_gradient(true, predicted):
        with tf.GradientTape() as tape:
            tape.watch(predicted)
            value = tf.reduce_mean(loss(true, predicted))  # of one value a pixel, as Keras does
        return value, tape.gradient(value, predicted)

    @tf.custom_gradient
    def compiled(true, predicted):
        value, gradient = value_and_gradient(true, predicted)
        return value, lambda upstream: (None, upstream * gradient)

    compiled.__name__ = getattr(loss, "__name__", None) or loss.name  # the library's losses and Keras' own
    return compiled


def metrics():
    """The library's IoU and F1 scores: means over all 35 classes of each batch, absent classes scoring 1."""
    return [sm.metrics.IOUScore(threshold=0.5), sm.metrics.FScore(threshold=0.5)]


def strategy():
    """Keras' way to share each batch between several GPUs; with one or none the plain way."""
    several = len(tf.config.list_logical_devices("GPU")) > 1
    return tf.distribute.MirroredStrategy() if several else tf.distribute.get_strategy()


class Batches:
    """The input of the network: sets of images and label maps, of which every epoch shows each image once.

    Images (n, size, size, channels) and label maps (n, size, size) stay uint8; an image becomes float and a label map
    one-hot in its batch. At 5950 images of 320x320 that is 1.3 GB instead of 85 GB. Unlike a `tf.data` shuffle, the
    order depends on (seed, epoch) alone, so that a resumed run sees what an undisturbed one sees.
    """

    def __init__(self, sets, batch_size, seed=None, augmenter=None):
        """`sets` are (images, label maps) pairs. Without a seed the order is that of the sets.

        With an augmenter the second set is ignored as it stands and drawn from the first anew in every epoch.
        Raises InputError for an empty set, images and label maps that do not match, and unknown label ids.
        """
        for images, labels in sets:
            if len(images) == 0 or images.ndim != 4 or images.shape[:3] != labels.shape:
                raise InputError(f"images {images.shape} and label maps {labels.shape}; expected (n, size, size, "
                                 "channels) and (n, size, size), n at least 1")
            highest = labels[labels != augmentation.NOTHING].max(initial=0)
            if highest >= N_CLASSES:
                raise InputError(f"label id {highest} is above {N_CLASSES - 1}; label maps must hold Cityscapes ids")
        self.sets, self.batch_size, self.seed, self.augmenter = sets, batch_size, seed, augmenter
        self.epoch = 0
        self._places = [(which, index) for which, (images, _) in enumerate(sets) for index in range(len(images))]

    def __len__(self):
        return -(-len(self._places) // self.batch_size)

    def __iter__(self):
        """The batches of the current epoch: uint8 images and uint8 label maps."""
        epoch, order = self.epoch, np.arange(len(self._places))
        if self.seed is not None:
            order = np.random.default_rng((self.seed, epoch)).permutation(len(order))
        for start in range(0, len(order), self.batch_size):
            pairs = [self._pair(*self._places[place], epoch) for place in order[start:start + self.batch_size]]
            yield tuple(map(np.stack, zip(*pairs)))

    def _pair(self, which, index, epoch):
        if which and self.augmenter:
            images, labels = self.sets[0]
            return self.augmenter(images[index], labels[index], augmentation.image_seed(self.seed, index, epoch))
        return tuple(array[index] for array in self.sets[which])

    def dataset(self):
        """The batches as a `tf.data.Dataset` of float images and one-hot masks, made while the network works."""
        shape = self.sets[0][0].shape[1:]
        signature = (tf.TensorSpec((None, *shape), tf.uint8), tf.TensorSpec((None, *shape[:2]), tf.uint8))
        batches = tf.data.Dataset.from_generator(lambda: iter(self), output_signature=signature).prefetch(2)
        # grey levels stay 0 to 255: the appendix imports `normalize` and never calls it; NOTHING becomes zeros
        batches = batches.map(lambda images, labels: (tf.cast(images, tf.float32), tf.one_hot(labels, N_CLASSES)))
        return batches.apply(tf.data.experimental.assert_cardinality(len(self)))


def made_from(model, batches, validation):
    """What the training of a compiled model on Batches depends on, for the stage of its results (JSON values).

    The network with its first weights, the optimizer, what the loss gives for a made-up batch, the images and the
    order in which they come; not the number of epochs, since a longer training begins as a shorter one does.
    """
    random = np.random.default_rng(0)
    true = augmentation.one_hot(random.integers(0, N_CLASSES, (2, 16, 16), np.uint8), N_CLASSES)
    predicted = random.dirichlet(np.ones(N_CLASSES), true.shape[:3]).astype(np.float32)
    return {
        "code": stages.code("segmentation/training"),
        "network": zlib.crc32(json.dumps(model.get_config(), default=str).encode()),
        "first_weights": weights_digest(model),
        "optimizer": model.optimizer.get_config() | {"name": ""},  # adam, adam_1
        "loss": float(np.asarray(model.loss(true, predicted)).mean()),
        "pixels": [zlib.crc32(np.ascontiguousarray(array)) for pair in (*batches.sets, *validation.sets)
                   for array in pair],
        "batch_size": batches.batch_size, "seed": batches.seed,
        "fresh_augmentation": batches.augmenter.to_dict() if batches.augmenter else None,
    }


def weights_digest(model):
    """A model's weights in twelve letters."""
    return sha256(b"".join(variable.numpy().tobytes() for variable in model.variables)).hexdigest()[:12]


class ResumableTraining(keras.callbacks.Callback):
    """A callback that resumes a killed training, which then ends with the weights of an undisturbed one.

    Keras' BackupAndRestore keeps weights and optimizer, but not what early stopping and the best model's checkpoint
    have counted. After every epoch this callback writes all of it, and the history, to one file of the folder. Give it
    last: a kill before that file is written repeats the epoch, which writes the same model again. It also tells the
    batches which epoch it is, and shows a progress bar.
    """

    COUNTERS = ("wait", "best", "best_epoch", "stopped_epoch")

    def __init__(self, folder, model, batches, others=()):
        """model: compiled, its optimizer built. others: EarlyStopping and ModelCheckpoint, as given to `fit`.

        Raises InputError where the folder holds the state of another network, or a damaged one.
        """
        super().__init__()
        self.folder, self.batches, self.others = Path(folder), batches, others
        self.rows, self._counters, self._open = [], [], ExitStack()
        self._variables = model.variables + model.optimizer.variables
        state = stages.resume(self.folder / STATE)
        if state is not None:
            (self.rows, self._counters), arrays = state
            if [value.shape for value in arrays.values()] != [tuple(variable.shape) for variable in self._variables]:
                raise InputError(f"{self.folder}: holds the training of another network; delete it or choose another")
            for variable, value in zip(self._variables, arrays.values()):
                variable.assign(value)

    @property
    def history(self):
        """A row for each epoch: loss, metrics, and the same for validation."""
        return pd.DataFrame(self.rows)

    def first_epoch(self, epochs):
        """The epoch to go on with; `epochs`, which leaves nothing to do, where early stopping has ended it."""
        stopped = any(counters.get("stopped_epoch") and counters["wait"] >= other.patience
                      for other, counters in zip(self.others, self._counters))
        return epochs if stopped else min(len(self.rows), epochs)

    def on_train_begin(self, logs=None):
        self._open.enter_context(longrun.claimed(self.folder))
        self.model.save = partial(_save_whole, self.model)  # Keras itself writes in place
        self._open.callback(delattr, self.model, "save")
        for other, counters in zip(self.others, self._counters):
            vars(other).update(counters)
        self._bar = self._open.enter_context(files.progress(
            description="training", total=self.params["epochs"] * len(self.batches), unit="batch",
            initial=len(self.rows) * len(self.batches)))

    def on_epoch_begin(self, epoch, logs=None):
        self.batches.epoch = epoch

    def on_train_batch_end(self, batch, logs=None):
        self._bar.update()

    def on_epoch_end(self, epoch, logs=None):
        self._bar.set_postfix_str(f"epoch {epoch + 1}, loss {logs['loss']:.3f}")
        self.rows.append({"epoch": epoch + 1} | {name: float(value) for name, value in logs.items()})
        self._counters = [{name: float(value) for name, value in vars(other).items()
                           if name in self.COUNTERS and value is not None} for other in self.others]
        files.write_text(self.folder / HISTORY, self.history.to_csv(index=False))
        stages.store(self.folder / STATE, [self.rows, self._counters],
                     {f"{index}": variable.numpy() for index, variable in enumerate(self._variables)})

    def on_train_end(self, logs=None):
        self._open.close()


def _save_whole(model, path, **options):
    with files.atomic(path) as temporary:
        type(model).save(model, temporary, **options)


def _check_unpacked(path):
    """Raise InputError where a model's file says that it holds far more than its bytes can, before it is unpacked."""
    most = 10 * Path(path).stat().st_size + 100 * 2**20
    sizes, source = [0], path
    with suppress(OSError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile):  # Keras says what is wrong
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                sizes = [part.file_size for part in archive.infolist()]
                source = io.BytesIO(archive.read("model.weights.h5") if sum(sizes) <= most else b"")
        with h5py.File(source, "r") as file:
            file.visititems(lambda _, item: sizes.append(item.nbytes if isinstance(item, h5py.Dataset) else 0))
    if sum(sizes) > most:
        raise InputError(f"{path}: would unpack to {sum(sizes) / 1e6:,.0f} MB, more than weights shrink; "
                         "name another model")


def load_model(path):
    """Read a model saved by Keras, `.keras` or HDF5, for prediction: without loss and metrics.

    Nothing that the file carries is executed: in its safe mode, Keras refuses code and what is not its own.
    Raises InputError for that, where the file is missing, truncated or no model, where it is no network from square
    images to the 35 classes, and where its weights are not finite.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such model; train one or name another file")
    _check_unpacked(path)
    try:
        model = keras.models.load_model(path, compile=False, safe_mode=True)
    except Exception as error:  # Keras, h5py and zipfile each raise their own
        reason = str(error).strip().partition("\n")[0][:200] or type(error).__name__
        raise InputError(f"{path}: not a model that Keras reads, a truncated one, or one that holds code ({reason}); "
                         "build it of Keras' own layers, or copy it again") from None
    inputs, outputs = getattr(model, "input_shape", ()), getattr(model, "output_shape", ())
    square = len(inputs) == 4 and inputs[1] is not None and inputs[1] == inputs[2] and inputs[3] in (1, 3)
    if not square or outputs != (*inputs[:3], N_CLASSES):
        raise InputError(f"{path}: a model from {inputs} to {outputs}; expected (None, size, size, 1 or 3) to "
                         f"(None, size, size, {N_CLASSES}), so name another model")
    if not all(np.isfinite(variable.numpy()).all() for variable in model.variables):
        raise InputError(f"{path}: holds weights that are not finite, of a training that failed; train anew")
    return model
