"""What the slips of the appendix's training code do, each alone: short trainings that differ in one thing (audit)."""

import os
from functools import partial

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
from thesis_repro.segmentation import augmentation, quality, training
from thesis_repro.segmentation.unet import build_unet

NOISE_OF_TODAY = (0.2, 0.44)  # standard deviation of A.GaussNoise's defaults, as shares of 255


def trials(images, labels, validation, *, steps, seeds, base_filters=8, batch_size=8, rate=3e-3, threads=1,
           processes=1):
    """Train the thesis's network and four that differ in one slip for a few steps: a row for each method and seed.

    images (n, size, size, 1) and labels (n, size, size), uint8, and the same of `validation`. What can be seen after so
    few steps is how a slip changes the beginning of a training, not where a whole one ends. Columns method, seed,
    steps, mean_iou and accuracy as Cityscapes measures them, person (IoU of that class, NaN where it is absent).
    threads: inside an operation, where TensorFlow has not begun; their number is part of the bits. processes: at once.
    """
    person = CLASS_WEIGHTS.copy()
    person[ID["person"]] = 1
    train = partial(_trials, images, labels, validation, steps, seeds, base_filters, batch_size, rate, threads)
    work = joblib.Parallel(n_jobs=processes, return_as="generator")(
        joblib.delayed(train)(*alike) for alike in (
            (False, CLASS_WEIGHTS, ("thesis", "divided by 255", "noise of today")),
            (False, person, ("person weight 1",)), (True, CLASS_WEIGHTS, ("corrected blocks",))))
    work = files.progress(work, "short trainings", total=3, unit="network")
    return pd.DataFrame([row for rows in work for row in rows])


def _trials(images, labels, validation, steps, seeds, base_filters, batch_size, rate, threads, corrected, weights,
            variants):
    """The trainings of one network with one loss, compiled once for all of them, for that takes longest."""
    try:
        tf.config.threading.set_intra_op_parallelism_threads(threads)
    except RuntimeError:  # it has begun in this process
        pass
    fresh = partial(build_unet, images.shape[1:], N_CLASSES, base_filters, corrected_blocks=corrected)
    model = fresh()
    model.compile(keras.optimizers.Adam(rate),
                  sm.losses.DiceLoss(class_weights=weights) + sm.losses.CategoricalFocalLoss())
    return [{"method": method, "seed": seed, "steps": steps}
            | _trial(model, fresh, images, labels, validation, method, seed, steps, batch_size)
            for method in variants for seed in range(seeds)]


def _trial(model, fresh, images, labels, validation, method, seed, steps, batch_size):
    keras.utils.set_random_seed(seed)
    model.set_weights(fresh().get_weights())
    for variable in model.optimizer.variables:
        if variable.name != "learning_rate":
            variable.assign(np.zeros(variable.shape))
    augmented = augmentation.augment_set(images, labels, _augmenter(images.shape[1], method), seed)
    scale = 255 if method == "divided by 255" else 1
    some, true = np.concatenate([images, augmented[0]]), np.concatenate([labels, augmented[1]])
    chosen = np.random.default_rng(seed).integers(0, len(some), steps * batch_size)
    model.fit(some[chosen].astype(np.float32) / scale, augmentation.one_hot(true[chosen], N_CLASSES),
              batch_size=batch_size, epochs=1, shuffle=False, verbose=0)
    predicted = model.predict(validation[0].astype(np.float32) / scale, verbose=0).argmax(axis=-1)
    mean_iou, accuracy, classes = quality.cityscapes_scores(quality.confusion_matrix(validation[1], predicted))
    return {"mean_iou": mean_iou, "accuracy": accuracy, "person": classes["iou"].get("person", np.nan)}


def _augmenter(size, method):
    transforms = augmentation.transform_list(size)
    if method == "noise of today":
        transforms = [A.GaussNoise(std_range=NOISE_OF_TODAY, p=one.p) if isinstance(one, A.GaussNoise) else one
                      for one in transforms]
    return augmentation.Augmenter(transforms)


def validation_losses(model, images, labels, seeds):
    """The validation loss of a model by what the set is augmented with: a table of seed, nothing, blur and all."""
    model.compile(loss=training.total_loss())
    size, rows = images.shape[1], []
    for seed in range(seeds):
        sets = {"nothing": (images, labels),
                "blur": augmentation.augment_set(images, labels, augmentation.validation_augmenter(size), seed),
                "all": augmentation.augment_set(images, labels, augmentation.validation_augmenter(size, full=True),
                                                seed)}
        rows.append({"seed": seed} | {name: float(model.evaluate(
            one.astype(np.float32), augmentation.one_hot(maps, N_CLASSES), batch_size=4, verbose=0))
            for name, (one, maps) in sets.items()})
    return pd.DataFrame(rows)


def invented(label_map, seed):
    """Share of pixels, percent, whose id the label map does not hold, where it is transformed as an image or as a mask.

    As an image (Figure 3.2 of the appendix): shifted, scaled and blurred with interpolation. Returns (image, mask).
    """
    transforms = [A.Affine(scale=(0.5, 1.5), translate_percent=(-0.1, 0.1), p=1), A.Blur(blur_limit=3, p=1)]
    found = []
    for kind in ("image", "mask"):
        compose = A.Compose(transforms)
        compose.set_random_seed(seed)
        given = {"image": label_map} if kind == "image" else {"image": np.zeros_like(label_map), "mask": label_map}
        changed = compose(**given)[kind]
        found.append(100 * float((~np.isin(changed, [0, *np.unique(label_map)])).mean()))
    return tuple(found)
