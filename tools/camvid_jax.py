"""Train a network of `tools/camvid.py` with Keras on JAX, where there is no TensorFlow.

`make camvid CAMVID=... JOB=folder` writes the job: the network without weights, its settings and
the images, augmented. On a machine with a GPU, Keras 3, JAX and OpenCV,

    KERAS_BACKEND=jax python camvid_jax.py JOB OUT [SECONDS [SEED ...]]

trains one network a seed, and begins no epoch after SECONDS. OUT gets the history of each seed and
the weights with the lowest validation loss, kernels as half floats: 31 MB at the thesis's size. The
loss and the scores are those of segmentation-models, written once more in Keras' operations; a test
compares them.
"""

import json
import sys
import time
from pathlib import Path

import cv2
import keras
import numpy as np
from keras import ops

SMOOTH = 1e-5  # of segmentation-models: an absent class scores 1
EPSILON = 1e-7  # of Keras, where the library clips probabilities


def one_hot(labels, n_classes):
    """Return one-hot masks of label maps; 255 becomes zeros."""
    return ops.one_hot(ops.cast(labels, "int32"), n_classes, dtype="float32")


def dice(true, predicted):
    """Return the F1 score of each class over a batch."""
    overlap = ops.sum(true * predicted, axis=(0, 1, 2))
    sizes = ops.sum(true + predicted, axis=(0, 1, 2))
    return (2 * overlap + SMOOTH) / (sizes + SMOOTH)


def loss_of(class_weights):
    """Return weighted Dice plus focal loss (Equation 3.8) of label maps and probabilities."""
    weights = np.asarray(class_weights, np.float32)

    def loss(labels, predicted):
        true = one_hot(labels, len(weights))
        clipped = ops.clip(predicted, EPSILON, 1 - EPSILON)
        focal = -true * 0.25 * (1 - clipped) ** 2 * ops.log(clipped)
        return 1 - ops.mean(dice(true, predicted) * weights) + ops.mean(focal)

    return loss


def iou_score(labels, predicted):
    """Return the mean IoU of the classes of a batch at a probability of 0.5."""
    true = one_hot(labels, predicted.shape[-1])
    chosen = ops.cast(predicted > 0.5, "float32")
    overlap = ops.sum(true * chosen, axis=(0, 1, 2))
    union = ops.sum(true + chosen, axis=(0, 1, 2)) - overlap
    return ops.mean((overlap + SMOOTH) / (union + SMOOTH))


def f1_score(labels, predicted):
    """Return the mean F1 score of the classes of a batch at a probability of 0.5."""
    true = one_hot(labels, predicted.shape[-1])
    return ops.mean(dice(true, ops.cast(predicted > 0.5, "float32")))


class Shuffled(keras.utils.PyDataset):
    """Batches in the order of `training.Batches`, which depends on the seed and the epoch alone."""

    def __init__(self, images, labels, batch_size, seed=None):
        super().__init__()
        self.images, self.labels, self.batch_size, self.seed = images, labels, batch_size, seed
        self.epoch = -1
        self.on_epoch_end()

    def __len__(self):
        return -(-len(self.images) // self.batch_size)

    def __getitem__(self, index):
        chosen = self.order[index * self.batch_size : (index + 1) * self.batch_size]
        return self.images[chosen].astype(np.float32), self.labels[chosen]

    def on_epoch_end(self):
        """Draw the next epoch's order."""
        self.epoch += 1
        self.order = np.arange(len(self.images))
        if self.seed is not None:
            self.order = np.random.default_rng((self.seed, self.epoch)).permutation(self.order)


class Clock(keras.callbacks.Callback):
    """Adds an epoch's seconds to its row, writes the history, and ends the training in time."""

    def __init__(self, path, end):
        super().__init__()
        self.path, self.end, self.rows = path, end, []

    def on_epoch_begin(self, epoch, logs=None):
        """Start the clock."""
        self.began = time.monotonic()

    def on_epoch_end(self, epoch, logs=None):
        """Write the history, a row an epoch."""
        self.rows.append({"epoch": epoch + 1, **logs, "seconds": time.monotonic() - self.began})
        self.path.write_text(json.dumps(self.rows, default=float))
        self.model.stop_training |= time.monotonic() > self.end


def read_images(folder, split):
    """Return the images and label maps of a split of the job."""
    kinds = []
    for kind in ("images", "labels"):
        paths = sorted((folder / f"{split}_{kind}").iterdir())
        kinds.append(np.stack([cv2.imread(f"{path}", cv2.IMREAD_GRAYSCALE) for path in paths]))
    return kinds[0][..., None], kinds[1]


def train(job, sets, out, seed, end):
    """Train one network, and write its history and its weights at the lowest validation loss."""
    keras.utils.set_random_seed(seed)
    model = keras.models.model_from_json(json.dumps(job["network"]))
    model.compile(
        keras.optimizers.Adam(job["learning_rate"]),
        loss_of(job["class_weights"]),
        metrics=[iou_score, f1_score],
    )
    best = out / "best.weights.h5"
    clock = Clock(out / f"seed_{seed}.json", end)
    model.fit(
        Shuffled(*sets["train"], job["batch_size"], seed),
        validation_data=Shuffled(*sets["val"], job["batch_size"]),
        epochs=job["epochs"],
        verbose=2,
        callbacks=[
            keras.callbacks.EarlyStopping(monitor="val_loss", patience=job["patience"]),
            keras.callbacks.ModelCheckpoint(
                best, monitor="val_loss", save_best_only=True, save_weights_only=True
            ),
            clock,
        ],
    )
    model.load_weights(best)
    best.unlink()
    halves = [w.astype(np.float16 if w.ndim > 1 else np.float32) for w in model.get_weights()]
    np.savez(out / f"seed_{seed}.npz", *halves)


def main(folder, out, seconds="inf", *seeds):
    """Train one network a seed."""
    import jax  # the functions above run with any backend of Keras

    end = time.monotonic() + float(seconds)
    folder, out = Path(folder), Path(out)
    out.mkdir(parents=True, exist_ok=True)
    job = json.loads((folder / "job.json").read_text())
    machine = f"Keras {keras.__version__} on JAX {jax.__version__}, {jax.devices()[0].device_kind}"
    (out / "machine.txt").write_text(f"{machine}\n")
    sets = {split: read_images(folder, split) for split in ("train", "val")}
    for seed in map(int, seeds or [job["seed"]]):
        if time.monotonic() < end:
            train(job, sets, out, seed, end)


if __name__ == "__main__":
    main(*sys.argv[1:])
