"""Quality of a model on a set of images.

The scores are those of segmentation-models and those of the Cityscapes benchmark.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import tensorflow as tf

from thesis_repro.data.cityscapes import LABELS, N_CLASSES
from thesis_repro.running import files
from thesis_repro.segmentation import training

# The ids that the Cityscapes benchmark evaluates; pixels of all other ids are ignored.
EVALUATED = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)


@dataclass(frozen=True)
class Quality:
    """Scores of a model on a set of images."""

    # segmentation-models: mean over 35 classes (absent ones score 1), then over batches as in Keras
    iou_score: float
    f1_score: float  # the same for F1
    # Cityscapes: from one confusion matrix over the set, mean over the classes present
    mean_iou: float
    accuracy: float  # share of evaluated pixels with the right class
    classes: pd.DataFrame  # a row for each class present: id, pixels, iou, precision, recall
    confusion: np.ndarray  # (35, 35) pixels: true class, predicted class


def quality(model: Any, images: np.ndarray, labels: np.ndarray, batch_size: int = 16) -> Quality:
    """Measure a model on images and true label maps.

    images: (n, size, size, channels) uint8. labels: (n, size, size) uint8.
    Only the scores of segmentation-models depend on the batch size (Sections 3.3 and 4.1).
    Raises InputError for images that do not fit the model.
    """
    training.check_images(images, model.input_shape)
    scores = training.metrics()

    @tf.function(reduce_retracing=True)
    def run(batch_images: tf.Tensor, batch_labels: tf.Tensor) -> tuple[list, tf.Tensor]:
        probabilities = model(tf.cast(batch_images, tf.float32), training=False)
        true = tf.one_hot(batch_labels, N_CLASSES)
        predicted = tf.argmax(probabilities, axis=-1, output_type=tf.int32)
        return [score(true, probabilities) for score in scores], predicted

    batch_scores, confusion = [], np.zeros((N_CLASSES, N_CLASSES), np.int64)
    for start in files.progress(range(0, len(images), batch_size), "measuring", unit="batch"):
        true = labels[start : start + batch_size]
        values, predicted = run(images[start : start + batch_size], true)
        batch_scores.append([float(value) for value in values])
        confusion += confusion_matrix(true, predicted.numpy())
    iou_score, f1_score = np.mean(batch_scores, axis=0)
    return Quality(iou_score, f1_score, *cityscapes_scores(confusion), confusion)


def confusion_matrix(true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return pixel counts by true class (rows) and predicted class (columns).

    Pixels without a class do not count.
    """
    known = true < N_CLASSES
    pairs = true[known].astype(np.int64) * N_CLASSES + predicted[known]
    return np.bincount(pairs, minlength=N_CLASSES**2).reshape(N_CLASSES, N_CLASSES)


def cityscapes_scores(confusion: np.ndarray) -> tuple[float, float, pd.DataFrame]:
    """Return the Cityscapes benchmark's mean IoU, pixel accuracy and scores by class.

    Pixels whose true class is not evaluated are ignored. The mean is over the evaluated classes in
    the true label maps. A pixel that is wrongly given a class that is not evaluated is an error of
    its true class.
    """
    evaluated = np.zeros_like(confusion)
    evaluated[EVALUATED, :] = confusion[EVALUATED, :]
    right, true, predicted = np.diag(evaluated), evaluated.sum(1), evaluated.sum(0)
    present = np.flatnonzero(true)
    table = pd.DataFrame(
        {
            "id": present,
            "pixels": true[present],
            "iou": right[present] / (true + predicted - right)[present],
            "precision": right[present] / np.maximum(predicted[present], 1),
            "recall": right[present] / true[present],
        },
        index=pd.Index([LABELS[number].name for number in present], name="class"),
    )
    accuracy = float(right.sum() / true.sum())
    return float(table["iou"].mean()), accuracy, table
