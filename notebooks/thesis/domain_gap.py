"""The gap between domains (Section 4.1): the quality of label maps, by class."""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from thesis_repro.data import cityscapes, kitti
from thesis_repro.segmentation import prediction, quality
from thesis_repro.study.methods import true_labels

IMAGES = 100  # most images of a domain


class Gap(NamedTuple):
    """The result of `measure`."""

    scores: pd.DataFrame  # a row for each model and domain; shares and IoU from 0 to 1
    # a row for each model, domain and class present: model, domain, class, id, share, iou
    classes: pd.DataFrame


def measure(models: dict[str, Any], domains: dict[str, list[cityscapes.Pair]]) -> Gap:
    """Measure models on domains; return a Gap.

    models: Keras models by name; domains: lists of `cityscapes.Pair` by name. The images are
    resized to the model's input. The mean IoU comes from one confusion matrix over the domain
    (`quality.cityscapes_scores`); the columns `classes` and `images` hold the number of classes and
    images.
    """
    scores, classes = [], []
    for (model_name, model), (domain, pairs) in product(models.items(), domains.items()):
        images, true = cityscapes.load(pairs, *model.input_shape[2:])
        confusion = quality.confusion_matrix(true, prediction.predict(model, images))
        mean_iou, accuracy, table = quality.cityscapes_scores(confusion)
        names = {"model": model_name, "domain": domain}
        numbers = {
            "images": len(pairs),
            "classes": len(table),
            "mean_iou": mean_iou,
            "accuracy": accuracy,
            "sky_recall": table["recall"].get("sky", np.nan),
        }
        scores.append(names | numbers)
        share = (table["pixels"] / table["pixels"].sum()).to_numpy()
        classes.append(table.reset_index().assign(**names, share=share))
    return Gap(pd.DataFrame(scores), pd.concat(classes, ignore_index=True))


def labelled_frames(drives: list[kitti.Sequence]) -> list[cityscapes.Pair]:
    """Return evenly spread frames of sequences with their exact label maps; none for real data."""
    pairs = []
    for drive in drives:
        label_folder = true_labels(drive.root, drive.name)
        if label_folder.is_dir():
            count = min(len(drive), max(1, IMAGES // len(drives)))
            middles = (np.arange(count) + 0.5) * len(drive) / count  # of equal parts of the drive
            paths = [drive.frame_paths[index] for index in middles.astype(int)]
            pairs += [
                cityscapes.Pair(f"{drive.name}_{path.stem}", path, label_folder / path.name)
                for path in paths
            ]
    return pairs
