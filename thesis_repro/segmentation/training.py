"""Loss, metrics and input batches of the training (A.5), and its checkpoints.

A stopped training resumes from a checkpoint.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import h5py
import keras
import numpy as np
import pandas as pd
import segmentation_models as sm
import tensorflow as tf

from thesis_repro import segmentation
from thesis_repro.data.cityscapes import CLASS_WEIGHTS, N_CLASSES
from thesis_repro.errors import InputError
from thesis_repro.running import files, results
from thesis_repro.segmentation import augmentation
from thesis_repro.segmentation.exact import same_bits

MODEL, HISTORY, STATE = "model.keras", "history.csv", "state.npz"


def total_loss() -> Any:
    """Return the sum of weighted Dice loss and focal loss (Equation 3.8, weights of Table 3.2)."""
    return sm.losses.DiceLoss(class_weights=CLASS_WEIGHTS) + sm.losses.CategoricalFocalLoss()


def fused_loss(loss: Any) -> Callable:
    """Return the same loss (true masks, probabilities), compiled together with its gradient.

    The library's loss has many operations, and each reads and writes 35 values a pixel. The
    compiled loss reads and writes them once, which saves time on a CPU; its sums round differently.
    On a GPU it is not compiled.
    """

    @tf.function(jit_compile=not tf.config.list_physical_devices("GPU"))
    def value_and_gradient(true: tf.Tensor, predicted: tf.Tensor) -> tuple:
        with tf.GradientTape() as tape:
            tape.watch(predicted)
            value = tf.reduce_mean(loss(true, predicted))  # Keras' losses return one value a pixel
        return value, tape.gradient(value, predicted)

    @tf.custom_gradient
    def compiled(true: tf.Tensor, predicted: tf.Tensor) -> tuple:
        value, gradient = value_and_gradient(true, predicted)
        return value, lambda upstream: (None, upstream * gradient)

    compiled.__name__ = loss_name(loss)
    return compiled


def named_loss(loss: Any) -> Callable:
    """Return the same loss as a function that Keras can write into a file, by `loss_name`.

    Keras writes its own losses and plain functions, but no lambda, partial or other callable.
    """

    def by_name(true: tf.Tensor, predicted: tf.Tensor) -> tf.Tensor:
        return loss(true, predicted)

    by_name.__name__ = loss_name(loss)
    return by_name


def loss_name(loss: Any) -> str:
    """Return the name of a loss: one of the library's, one of Keras' own, or any callable."""
    name = getattr(loss, "__name__", None) or getattr(loss, "name", None) or type(loss).__name__
    return name.strip("<>")  # of a lambda


def metrics() -> list:
    """Return the library's IoU and F1 scores.

    They are means over all 35 classes of a batch; absent classes score 1.
    """
    return [sm.metrics.IOUScore(threshold=0.5), sm.metrics.FScore(threshold=0.5)]


def strategy() -> tf.distribute.Strategy:
    """Return a `tf.distribute` strategy that shares each batch between all GPUs.

    With fewer than two GPUs it is the default one.
    """
    if len(tf.config.list_logical_devices("GPU")) > 1:
        return tf.distribute.MirroredStrategy()
    return tf.distribute.get_strategy()


class Batches:
    """The input of the network: every epoch shows each image of the sets once.

    Images (n, size, size, channels) and label maps (n, size, size) stay uint8. They become floats
    and one-hot masks only in their batch, so 5950 images of 320x320 take 1.3 GB instead of 85 GB.
    Unlike a `tf.data` shuffle, the order depends only on (seed, epoch), so a resumed training sees
    the same batches.
    """

    def __init__(
        self,
        sets: list[tuple[np.ndarray, np.ndarray]],
        batch_size: int,
        seed: Any = None,
        augmenter: augmentation.Augmenter | None = None,
    ) -> None:
        """sets: (images, label maps) pairs; seed: None keeps their order.

        augmenter: if given, every epoch augments the first set again and uses the result instead of
        the second set.
        Raises InputError for an empty set, images and label maps that do not match, unknown label
        ids, and an augmenter without two sets of one length.
        """
        for images, labels in sets:
            if len(images) == 0 or images.ndim != 4 or images.shape[:3] != labels.shape:
                raise InputError(
                    f"images {images.shape} and label maps {labels.shape}; expected (n, size, size, "
                    "channels) and (n, size, size), n at least 1"
                )
            highest = labels[labels != augmentation.NOTHING].max(initial=0)
            if highest >= N_CLASSES:
                raise InputError(
                    f"label id {highest} is above {N_CLASSES - 1}; label maps must hold Cityscapes ids"
                )
        lengths = [len(images) for images, _ in sets]
        if augmenter and (len(lengths) != 2 or lengths[0] != lengths[1]):
            raise InputError(
                f"augmenter: with sets of {lengths} images; give two sets of one length, whose second "
                "one it replaces"
            )
        self.sets, self.batch_size, self.seed, self.augmenter = sets, batch_size, seed, augmenter
        self.epoch = 0
        self._places = [
            (number, index)
            for number, (images, _) in enumerate(sets)
            for index in range(len(images))
        ]

    def __len__(self) -> int:
        return -(-len(self._places) // self.batch_size)

    def __iter__(self) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield the batches of the current epoch: uint8 images and uint8 label maps."""
        epoch, order = self.epoch, np.arange(len(self._places))
        if self.seed is not None:
            order = np.random.default_rng((self.seed, epoch)).permutation(len(order))
        for start in range(0, len(order), self.batch_size):
            pairs = [
                self._pair(epoch, *self._places[place])
                for place in order[start : start + self.batch_size]
            ]
            yield tuple(map(np.stack, zip(*pairs)))

    def _pair(self, epoch: int, number: int, index: int) -> tuple[np.ndarray, ...]:
        if number and self.augmenter:
            images, labels = self.sets[0]
            return self.augmenter(
                images[index], labels[index], augmentation.image_seed(self.seed, index, epoch)
            )
        return tuple(array[index] for array in self.sets[number])

    def dataset(self) -> tf.data.Dataset:
        """Return the batches as a `tf.data.Dataset` of float images and one-hot masks.

        They are prefetched during training.
        """
        shape = self.sets[0][0].shape[1:]
        signature = (
            tf.TensorSpec((None, *shape), tf.uint8),
            tf.TensorSpec((None, *shape[:2]), tf.uint8),
        )
        batches = tf.data.Dataset.from_generator(
            lambda: iter(self), output_signature=signature
        ).prefetch(2)
        # grey levels stay 0 to 255, because the appendix imports `normalize` but never calls it
        batches = batches.map(
            lambda images, labels: (tf.cast(images, tf.float32), tf.one_hot(labels, N_CLASSES))
        )
        return batches.apply(tf.data.experimental.assert_cardinality(len(self)))


def made_from(model: Any, batches: Batches, validation: Batches) -> dict[str, Any]:
    """Return all that the training of a compiled model on Batches depends on, as JSON values.

    It is the record of the training's stage. The number of epochs is not part of it, because a
    longer training begins like a shorter one. The loss is described by its value for a made-up
    batch.
    """
    random = np.random.default_rng(0)
    true = augmentation.one_hot(random.integers(0, N_CLASSES, (2, 16, 16), np.uint8), N_CLASSES)
    predicted = random.dirichlet(np.ones(N_CLASSES), true.shape[:3]).astype(np.float32)
    pixels = []
    for pair in (*batches.sets, *validation.sets):
        pixels += [zlib.crc32(np.ascontiguousarray(array).data) for array in pair]
    fresh_augmentation = None
    if batches.augmenter:
        fresh_augmentation = batches.augmenter.to_dict()
    return {
        "code": results.digest_of_code("thesis_repro.segmentation.training"),
        "arithmetic": segmentation.arithmetic(),
        "network": zlib.crc32(json.dumps(model.get_config(), default=str).encode()),
        "first_weights": weights_digest(model),
        # Keras numbers the names: adam, adam_1
        "optimizer": model.optimizer.get_config() | {"name": ""},
        "loss": float(np.asarray(model.loss(true, predicted)).mean()),
        "pixels": pixels,
        "batch_size": batches.batch_size,
        "seed": batches.seed,
        "fresh_augmentation": fresh_augmentation,
    }


def weights_digest(model: Any) -> str:
    """Return a digest of a model's weights, twelve letters."""
    digest = sha256()
    for variable in model.variables:
        digest.update(variable.numpy().tobytes())
    return digest.hexdigest()[:12]


class ResumableTraining(keras.callbacks.Callback):
    """A callback that resumes a killed training; the resumed training ends with the same weights.

    Keras' BackupAndRestore keeps weights and optimizer, but not the counters of EarlyStopping and
    ModelCheckpoint. After every epoch this callback writes all of them, with the history, to one
    checkpoint file. It must be the last callback: if the process is killed before the file is
    written, the epoch is repeated and writes the same model again. The callback also sets the epoch
    of the batches and shows a progress bar.
    """

    COUNTERS = ("wait", "best", "best_epoch", "stopped_epoch")

    def __init__(
        self, folder: str | Path, model: Any, batches: Batches, others: Collection = ()
    ) -> None:
        """Continue the training of a checkpoint in the folder, if there is one.

        model: compiled, with a built optimizer. others: EarlyStopping and ModelCheckpoint, as given
        to `fit`.
        Raises InputError if the folder holds a damaged checkpoint or that of another network.
        """
        super().__init__()
        self.folder, self.batches, self.others = Path(folder), batches, others
        self.rows, self._counters, self._open = [], [], ExitStack()
        self._variables = model.variables + model.optimizer.variables
        state = results.resume(self.folder / STATE)
        if state is not None:
            (self.rows, self._counters), arrays = state
            if [value.shape for value in arrays.values()] != [
                tuple(variable.shape) for variable in self._variables
            ]:
                raise InputError(
                    f"{self.folder}: holds the training of another network; delete the folder or choose "
                    "another one"
                )
            for variable, value in zip(self._variables, arrays.values()):
                variable.assign(value)

    @property
    def history(self) -> pd.DataFrame:
        """A row for each epoch: loss, metrics, and both on the validation set."""
        return pd.DataFrame(self.rows)

    def first_epoch(self, epochs: int) -> int:
        """Return the epoch to resume with, for `fit`.

        It is `epochs` if early stopping has ended the training.
        """
        for other, counters in zip(self.others, self._counters):
            if counters.get("stopped_epoch") and counters["wait"] >= other.patience:
                return epochs
        return min(len(self.rows), epochs)

    def on_train_begin(self, logs: Any = None) -> None:
        """Lock the folder, restore the counters of the other callbacks, and show the bar."""
        self._open.enter_context(results.claimed(self.folder))
        # ModelCheckpoint itself writes in place
        self.model.save = partial(_save_atomically, self.model)
        self._open.callback(delattr, self.model, "save")
        for other, counters in zip(self.others, self._counters):
            vars(other).update(counters)
        self._bar = self._open.enter_context(
            files.progress(
                description="training",
                total=self.params["epochs"] * len(self.batches),
                unit="batch",
                initial=len(self.rows) * len(self.batches),
            )
        )

    def on_epoch_begin(self, epoch: int, logs: Any = None) -> None:
        """Tell the batches which epoch they belong to."""
        self.batches.epoch = epoch

    def on_train_batch_end(self, batch: int, logs: Any = None) -> None:
        """Move the progress bar."""
        self._bar.update()

    def on_epoch_end(self, epoch: int, logs: Any = None) -> None:
        """Write the history and the checkpoint."""
        self._bar.set_postfix_str(f"epoch {epoch + 1}, loss {logs['loss']:.3f}")
        self.rows.append(
            {"epoch": epoch + 1} | {name: float(value) for name, value in logs.items()}
        )
        self._counters = [self._counters_of(other) for other in self.others]
        files.write_text(self.folder / HISTORY, self.history.to_csv(index=False))
        results.store(
            self.folder / STATE,
            [self.rows, self._counters],
            {f"{index}": variable.numpy() for index, variable in enumerate(self._variables)},
        )

    def _counters_of(self, callback: Any) -> dict[str, float]:
        values = {name: vars(callback).get(name) for name in self.COUNTERS}
        return {name: float(value) for name, value in values.items() if value is not None}

    def on_train_end(self, logs: Any = None) -> None:
        """Close the progress bar and give the folder back."""
        self._open.close()


def _save_atomically(model: Any, path: str | Path, **options: Any) -> None:
    with files.atomic(path) as temporary:
        type(model).save(model, temporary, **options)


def _check_unpacked_size(path: Any) -> None:
    """Raise ValueError if a model file would unpack to more bytes than weights can be packed to."""
    most = 10 * Path(path).stat().st_size + 100 * 2**20
    sizes: list[int] = []
    weights = path
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            sizes += [member.file_size for member in archive.infolist()]
            if sum(sizes) <= most:
                weights = io.BytesIO(archive.read("model.weights.h5"))
    if sum(sizes) <= most:
        with h5py.File(weights, "r") as file:  # its arrays may be compressed as well
            file.visititems(lambda _, item: sizes.append(getattr(item, "nbytes", 0)))
    if sum(sizes) > most:
        raise ValueError(f"it would unpack to {sum(sizes) / 1e6:,.0f} MB")


def load_model(path: str | Path) -> Any:
    """Load a model saved by Keras, `.keras` or HDF5, for prediction: without loss and metrics.

    Code in the file is never executed: Keras' safe mode refuses it, and all layers that are not
    Keras' own.
    Raises InputError if the file is missing, truncated, no model, or holds code; if the network
    does not map square images to the 35 classes; and if its weights are not finite.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such model; train one or name another file")
    try:
        _check_unpacked_size(path)
        model = keras.models.load_model(path, compile=False, safe_mode=True)
    except Exception as error:  # Keras, h5py and zipfile raise many kinds
        reason = str(error).strip().partition("\n")[0][:200] or type(error).__name__
        raise InputError(
            f"{path}: not a Keras model, truncated, or holds code ({reason}); build it from Keras' own "
            "layers, or copy it again"
        ) from None
    inputs: tuple = getattr(model, "input_shape", ())
    outputs = getattr(model, "output_shape", ())
    square = (
        len(inputs) == 4
        and inputs[1] is not None
        and inputs[1] == inputs[2]
        and inputs[3] in (1, 3)
    )
    if not square or outputs != (*inputs[:3], N_CLASSES):
        raise InputError(
            f"{path}: a model from {inputs} to {outputs}; expected (None, size, size, 1 or 3) to "
            f"(None, size, size, {N_CLASSES}), so name another model"
        )
    if not all(np.isfinite(variable.numpy()).all() for variable in model.variables):
        raise InputError(
            f"{path}: holds weights that are not finite, from a failed training; train again"
        )
    return same_bits(model)
