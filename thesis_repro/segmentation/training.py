"""Loss, metrics and input batches of the training (A.5), and its checkpoints.

A stopped training resumes from a checkpoint.
"""

import json
import re
import zlib
from collections.abc import Callable, Collection, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import keras
import numpy as np
import pandas as pd
import segmentation_models as sm
import tensorflow as tf

from thesis_repro import segmentation
from thesis_repro.data.cityscapes import CLASS_WEIGHTS, N_CLASSES
from thesis_repro.errors import InputError
from thesis_repro.running import files, program, provenance
from thesis_repro.segmentation import augmentation
from thesis_repro.segmentation.exact import same_bits

HISTORY, STATE = "history.csv", "state.npz"  # files of a training; it resumes from the second
OTHER_FRAMEWORKS = (".onnx", ".tflite", ".pt", ".pth", ".pb", ".engine")  # endings of networks
LFS_POINTER = b"version https://git-lfs"  # in place of a large file that was not fetched
# the way out for a file that Keras 3 does not read
REBUILD = (
    "build the network (the thesis's: tr.build_unet), load_weights('old.hdf5'), save('new.keras')"
)


def total_loss() -> Any:
    """Return the sum of weighted Dice loss and focal loss (Equation 3.8, weights of Table 3.2)."""
    return sm.losses.DiceLoss(class_weights=CLASS_WEIGHTS) + sm.losses.CategoricalFocalLoss()


def fused_loss(loss: Any) -> Callable:
    """Return the same loss (true masks, probabilities), compiled together with its gradient.

    The library's loss has many operations, and each reads and writes 35 values a pixel. The
    compiled loss reads and writes them once, which saves time on a CPU; its sums round differently.
    On a GPU it is not compiled.
    loss: of segmentation-models or Keras, the name of one of Keras', or any function.
    """
    loss = keras.losses.get(loss)

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

    return compiled


def metrics() -> list:
    """Return the library's IoU and F1 scores.

    They are means over all 35 classes of a batch; absent classes score 1.
    """
    return [sm.metrics.IOUScore(threshold=0.5), sm.metrics.FScore(threshold=0.5)]


def falling_rate(rate: float, epochs: int, batches: "Batches") -> Any:
    """Return a learning rate for Keras that falls evenly to zero over the epochs.

    It gets further in few epochs than a rate that stays.
    """
    return keras.optimizers.schedules.PolynomialDecay(rate, epochs * len(batches), 0.0)


def check_images(images: np.ndarray, shape: tuple) -> None:
    """Raise InputError unless images are uint8 and of a model's input shape (None, h, w, c)."""
    if images.dtype != np.uint8 or images.shape[1:] != shape[1:]:
        raise InputError(
            f"images: {images.dtype} of {images.shape[1:]}; give uint8 images, gray levels 0 to 255, of "
            f"{shape[1:]}"
        )


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
    ) -> None:
        """sets: (images, label maps) pairs; seed: None keeps their order.

        Raises InputError for an empty set, images that are not uint8, images and label maps that do
        not match, ids above 34 and a batch size below 1.
        """
        if batch_size < 1:
            raise InputError(f"batch size {batch_size}: must be 1 or more")
        for images, labels in sets:
            is_uint8 = images.ndim == 4 and images.dtype == np.uint8
            if not is_uint8 or len(images) == 0 or images.shape[:3] != labels.shape:
                raise InputError(
                    f"images {images.shape} {images.dtype} and label maps {labels.shape}; expected (n, "
                    "size, size, channels) uint8 and (n, size, size), n at least 1"
                )
            for number, label_map in enumerate(labels):
                unknown = label_map[(label_map >= N_CLASSES) & (label_map != augmentation.NOTHING)]
                if len(unknown):
                    raise InputError(
                        f"label map {number}: holds {unknown[0]}; must hold Cityscapes label ids, 0 to "
                        f"{N_CLASSES - 1}, or {augmentation.NOTHING} for no class"
                    )
        self.sets, self.batch_size, self.seed = sets, batch_size, seed
        self.epoch = 0
        self._pairs = [pair for images, labels in sets for pair in zip(images, labels)]

    def __len__(self) -> int:
        return -(-len(self._pairs) // self.batch_size)

    def __iter__(self) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield the batches of the current epoch: uint8 images and uint8 label maps."""
        order = np.arange(len(self._pairs))
        if self.seed is not None:
            order = np.random.default_rng((self.seed, self.epoch)).permutation(len(order))
        for start in range(0, len(order), self.batch_size):
            pairs = [self._pairs[index] for index in order[start : start + self.batch_size]]
            yield tuple(map(np.stack, zip(*pairs)))

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


def fix_threads(count: int) -> None:
    """Set the number of TensorFlow's threads, which decides how sums are rounded.

    Raises InputError if this process has computed with another one.
    """
    try:
        tf.config.threading.set_intra_op_parallelism_threads(count)
        tf.config.threading.set_inter_op_parallelism_threads(count)
    except RuntimeError:
        raise InputError(
            f"TensorFlow: has computed with other than {count} threads in this kernel; restart it, because "
            "this lesson sets them first"
        ) from None


def made_from(model: Any, batches: Batches, validation: Batches) -> dict[str, Any]:
    """Return all that the training of a compiled model on Batches depends on, as JSON values.

    It is the record of the training's stage. The number of epochs is not part of it, because a
    longer training begins like a shorter one (unless the learning rate falls, which the optimizer's
    settings tell). The loss is described by its value for a made-up batch.
    Raises InputError if the model is not fresh. (`ResumableTraining` makes a stopped one so.)
    """
    if int(model.optimizer.iterations):
        raise InputError(
            "model: has been trained already; build or load it again, and compile it, before its training"
        )
    random = np.random.default_rng(0)
    true = augmentation.one_hot(random.integers(0, N_CLASSES, (2, 16, 16), np.uint8), N_CLASSES)
    predicted = random.dirichlet(np.ones(N_CLASSES), true.shape[:3]).astype(np.float32)
    arrays = [array for pair in (*batches.sets, *validation.sets) for array in pair]
    return {
        "code": provenance.digest_of_code(*segmentation.CODE),
        **provenance.versions("tensorflow", "keras", "albumentations"),
        "arithmetic": segmentation.arithmetic(),
        "network": zlib.crc32(json.dumps(model.get_config(), default=str).encode()),
        "first_weights": weights_digest(model),
        # Keras numbers the names: adam, adam_1
        "optimizer": model.optimizer.get_config() | {"name": ""},
        "loss": float(np.asarray(model.loss(true, predicted)).mean()),
        "pixels": [zlib.crc32(np.ascontiguousarray(array).data) for array in arrays],
        "batch_size": batches.batch_size,
        "seed": batches.seed,
    }


def weights_digest(model: Any) -> str:
    """Return a digest of a model's weights, twelve letters."""
    values = b"".join(variable.numpy().tobytes() for variable in model.variables)
    return sha256(values).hexdigest()[:12]


class ResumableTraining(keras.callbacks.Callback):
    """A callback that resumes a stopped training; the resumed training ends with the same weights.

    Keras' BackupAndRestore does not: it forgets the waiting of EarlyStopping and the best loss of
    ModelCheckpoint, so the first epoch after the stop replaces the best model; and it writes
    weights and epoch in place, one after the other. This callback writes weights, optimizer, both
    counters and the history to one file, before the first epoch and after each. An epoch that was
    stopped is repeated, also in the process in which it was stopped. The callback must be the last
    one. It also sets the epoch of the batches and shows a progress bar.
    """

    COUNTERS = ("wait", "best", "best_epoch", "stopped_epoch")

    def __init__(self, folder: str | Path, batches: Batches, others: Collection = ()) -> None:
        """folder: of the checkpoint. others: EarlyStopping and ModelCheckpoint, as in `fit`."""
        super().__init__()
        self.folder, self.batches, self.others = Path(folder), batches, others
        self.rows: list[dict[str, float]] = []

    @property
    def history(self) -> pd.DataFrame:
        """A row for each epoch, also those before a stop: loss, metrics, both in validation."""
        return pd.DataFrame(self.rows)

    def on_train_begin(self, logs: Any = None) -> None:
        """Continue the training of the folder's checkpoint, or write the first one."""
        program.keep_freed_memory()
        self.model.optimizer.build(self.model.trainable_variables)
        self._variables = self.model.variables + self.model.optimizer.variables
        if (self.folder / STATE).exists():
            self._restore()
        else:
            self._save()
        # where fit begins; Keras' BackupAndRestore sets it, too
        self.model._initial_epoch = len(self.rows)
        for other in self.others:
            # early stopping has ended the training
            if getattr(other, "stopped_epoch", 0) and other.wait >= other.patience:
                self.model._initial_epoch = self.params["epochs"]
        self._bar = files.progress(
            description="training",
            total=self.params["epochs"] * len(self.batches),
            unit="batch",
            initial=len(self.rows) * len(self.batches),
        )

    def on_epoch_begin(self, epoch: int, logs: Any = None) -> None:
        """Tell the batches which epoch they belong to."""
        self.batches.epoch = epoch

    def on_train_batch_end(self, batch: int, logs: Any = None) -> None:
        """Move the progress bar."""
        self._bar.update()

    def on_test_end(self, logs: Any = None) -> None:
        """Stop if the validation loss is not finite, before anything of the epoch is written.

        Raises InputError.
        """
        loss = float((logs or {}).get("loss", 0))
        if not np.isfinite(loss):
            self._bar.close()
            kept = "no network was written"
            if self.rows:
                kept = f"the best network of the {len(self.rows)} epochs before is kept"
            raise InputError(
                f"{self.folder}: the loss of epoch {self.batches.epoch + 1} is {loss:g}, so the training has "
                f"stopped, and {kept}; try a smaller learning rate or another loss"
            )

    def on_epoch_end(self, epoch: int, logs: Any = None) -> None:
        """Write the history and the checkpoint."""
        self.rows.append({"epoch": epoch + 1} | {name: float(logs[name]) for name in logs})
        files.write_text(self.folder / HISTORY, self.history.to_csv(index=False))
        self._save()

    def on_train_end(self, logs: Any = None) -> None:
        """Close the progress bar."""
        self._bar.close()

    def _save(self) -> None:
        counters = [
            {name: getattr(other, name, None) for name in self.COUNTERS} for other in self.others
        ]
        arrays = {f"{index}": value.numpy() for index, value in enumerate(self._variables)}
        job = json.dumps([self.rows, counters], default=float)
        with files.atomic(self.folder / STATE) as temporary, open(temporary, "wb") as file:
            np.savez(file, job=job, **arrays)

    def _restore(self) -> None:
        with np.load(self.folder / STATE) as state:
            self.rows, counters = json.loads(str(state["job"]))
            for index, variable in enumerate(self._variables):
                variable.assign(state[f"{index}"])
        for other, values in zip(self.others, counters, strict=True):
            vars(other).update(values)


def load_model(path: str | Path) -> Any:
    """Load a model saved by Keras, `.keras` or HDF5, without loss and metrics.

    A network of 16 bits, as trained with a mixed policy, computes in 32 here.
    Code in the file is never executed: Keras' safe mode refuses it, and all layers that are not
    Keras' own. The classes may be any up to 256; those of the thesis's network are Cityscapes' ids.
    Raises InputError if the file is missing, truncated, no model, or holds code, if its weights are
    not finite, and if the network does not map images of one size to a class for each pixel.
    """
    if Path(path).is_dir():
        raise InputError(
            f"{path}: is a folder, such as a SavedModel; load it with the Keras that wrote it, and save it "
            "as one file, model.save('model.hdf5')"
        )
    if not Path(path).is_file():
        raise InputError(f"{path}: no such model; train one or name another file")
    if Path(path).suffix.lower() in OTHER_FRAMEWORKS:
        raise InputError(
            f"{path}: not of Keras; predict label maps where it runs, and give their folder, --labels DIR"
        )
    with open(path, "rb") as file:
        if file.read(len(LFS_POINTER)) == LFS_POINTER:
            raise InputError(f"{path}: a Git LFS pointer, not the model; git lfs pull fetches it")
    try:
        model = keras.models.load_model(path, compile=False, safe_mode=True)
    except Exception as error:  # Keras, h5py and zipfile raise many kinds
        raise InputError(f"{path}: {_refusal(error)}") from None
    shapes: Any = [getattr(model, name, ()) for name in ("input_shape", "output_shape")]
    inputs, outputs = shapes
    is_fixed = len(inputs) == 4 and None not in inputs[1:] and inputs[3] in (1, 3)
    if not is_fixed or outputs[:-1] != inputs[:3] or not 2 <= outputs[-1] <= 256:
        raise InputError(
            f"{path}: a model from {inputs} to {outputs}; expected (None, height, width, 1 or 3) to "
            "(None, height, width, classes), so name another model"
        )
    if not all(np.isfinite(weights).all() for weights in model.get_weights()):
        raise InputError(
            f"{path}: has weights that are no finite numbers, because its training broke; train it again, "
            "or name another model"
        )
    if any(layer.compute_dtype in ("float16", "bfloat16") for layer in model._flatten_layers()):
        # processors may lack convolutions of 16 bits
        weights = model.get_weights()
        model = keras.models.clone_model(model, clone_function=_in_32_bits, recursive=True)
        model.set_weights(weights)
    return same_bits(model)


def _in_32_bits(layer: Any) -> Any:
    """Return a fresh copy of a layer that computes in 32 bits."""
    return type(layer).from_config(layer.get_config() | {"dtype": "float32"})


def _refusal(error: Exception) -> str:
    """Return why Keras reads no network, in its words, and what to do."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    cause = next((line for line in lines if line.startswith("Exception encountered: ")), lines[0])
    cause = cause.removeprefix("Exception encountered: ")[:200]
    if layer := re.match(r"Error when deserializing class '(\w+)'", lines[0]):
        return f"Keras 3 does not read its layer {layer[1]} ({cause}); {REBUILD}"
    return (
        f"not a Keras model, truncated, or holds code ({cause}); copy it again, or build it from Keras' own "
        f"layers; of Keras 2, or weights alone: {REBUILD}"
    )
