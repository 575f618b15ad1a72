"""Ablations of the training: what each slip of the appendix's training code does alone, in short trainings.

So few steps show how a slip changes the beginning of a training, not where a whole one ends.
"""

import os
from contextlib import suppress
from functools import partial
from typing import Any

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("SM_FRAMEWORK", "tf.keras")

import albumentations as A
import joblib
import keras
import numpy as np
import pandas as pd
import segmentation_models as sm
import tensorflow as tf

from thesis_repro import files
from thesis_repro.cityscapes import CLASS_WEIGHTS, ID, N_CLASSES
from thesis_repro.segmentation import augmentation, quality
from thesis_repro.segmentation.unet import build_unet

Pairs = tuple[np.ndarray, np.ndarray]  # images (n, size, size, 1) and label maps (n, size, size), uint8
NOISE_OF_TODAY = (0.2, 0.44)  # standard deviation of A.GaussNoise's defaults, as shares of 255
RATE = 3e-3  # of Adam
BASE_FILTERS, BATCH_SIZE = 8, 8


def trials(train: Pairs, validation: Pairs, *, steps: int, seeds: int, threads: int = 1, processes: int = 1
           ) -> pd.DataFrame:
    """Train the thesis's network and four that differ in one slip for a few steps: one row a method and seed.

    threads: inside an operation, part of the bits; without effect where TensorFlow has begun. processes: at once.
    Columns: method, seed, steps; mean_iou and accuracy as Cityscapes measures them.
    """
    person = CLASS_WEIGHTS.copy()
    person[ID["person"]] = 1
    networks = ((False, CLASS_WEIGHTS, ("thesis", "divided by 255", "noise of today")),
                (False, person, ("person weight 1",)), (True, CLASS_WEIGHTS, ("corrected blocks",)))
    work = joblib.Parallel(n_jobs=processes, return_as="generator")(
        joblib.delayed(_trials)(train, validation, steps, seeds, threads, *network) for network in networks)
    tables = files.progress(work, "short trainings", total=len(networks), unit="network")
    return pd.DataFrame([row for rows in tables for row in rows])


def _trials(train: Pairs, validation: Pairs, steps: int, seeds: int, threads: int, corrected: bool,
            weights: np.ndarray, methods: tuple[str, ...]) -> list[dict[str, Any]]:
    """The trainings of one network with one loss: compiled once for all of them, since that takes longest."""
    with suppress(RuntimeError):  # TensorFlow has begun in this process
        tf.config.threading.set_intra_op_parallelism_threads(threads)
    fresh = partial(build_unet, train[0].shape[1:], N_CLASSES, BASE_FILTERS, corrected_blocks=corrected)
    model = fresh()
    model.compile(keras.optimizers.Adam(RATE),
                  sm.losses.DiceLoss(class_weights=weights) + sm.losses.CategoricalFocalLoss(),
                  jit_compile=False)  # compiling takes longer than these few steps
    rows = []
    for method in methods:
        for seed in range(seeds):
            keras.utils.set_random_seed(seed)
            model.set_weights(fresh().get_weights())
            for variable in model.optimizer.variables:
                if variable.name != "learning_rate":
                    variable.assign(np.zeros(variable.shape))
            scores = _train(model, train, validation, method, seed, steps)
            rows.append({"method": method, "seed": seed, "steps": steps} | scores)
    return rows


def _train(model: Any, train: Pairs, validation: Pairs, method: str, seed: int, steps: int) -> dict[str, float]:
    transforms = augmentation.transform_list(train[0].shape[1])
    if method == "noise of today":
        transforms = [A.GaussNoise(std_range=NOISE_OF_TODAY, p=transform.p)
                      if isinstance(transform, A.GaussNoise) else transform for transform in transforms]
    augmented = augmentation.augment_set(*train, augmentation.Augmenter(transforms), seed)
    images, labels = (np.concatenate(pair) for pair in zip(train, augmented, strict=True))
    scale = 255 if method == "divided by 255" else 1
    chosen = np.random.default_rng(seed).integers(0, len(images), steps * BATCH_SIZE)
    model.fit(images[chosen].astype(np.float32) / scale, augmentation.one_hot(labels[chosen], N_CLASSES),
              batch_size=BATCH_SIZE, epochs=1, shuffle=False, verbose=0)
    predicted = model.predict(validation[0].astype(np.float32) / scale, verbose=0).argmax(axis=-1)
    mean_iou, accuracy, _ = quality.cityscapes_scores(quality.confusion_matrix(validation[1], predicted))
    return {"mean_iou": mean_iou, "accuracy": accuracy}
