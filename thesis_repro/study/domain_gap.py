"""The gap between domains (Section 4.1): the quality of label maps, by class."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from thesis_repro.data import cityscapes, kitti
from thesis_repro.segmentation import prediction, quality

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
    for model_name, model in models.items():
        for domain, pairs in domains.items():
            images, true = cityscapes.load(pairs, *model.input_shape[2:])
            predicted = prediction.predict(model, images)
            mean_iou, accuracy, table = quality.cityscapes_scores(
                quality.confusion_matrix(true, predicted)
            )
            names = {"model": model_name, "domain": domain}
            scores.append(
                {
                    **names,
                    "images": len(pairs),
                    "classes": len(table),
                    "mean_iou": mean_iou,
                    "accuracy": accuracy,
                    "sky_recall": table["recall"].get("sky", np.nan),
                }
            )
            share = (table["pixels"] / table["pixels"].sum()).to_numpy()
            classes.append(table.reset_index().assign(**names, share=share))
    return Gap(pd.DataFrame(scores), pd.concat(classes, ignore_index=True))


def labelled_frames(drives: list[kitti.Sequence]) -> list[cityscapes.Pair]:
    """Return evenly spread frames of `kitti.Sequence`s with their exact label maps (labels_0);
    none for real data.
    """
    pairs = []
    for drive in drives:
        if (drive.folder / "labels_0").is_dir():
            count = min(len(drive), max(1, IMAGES // len(drives)))
            for index in ((np.arange(count) + 0.5) * len(drive) / count).astype(int):
                path = drive.frame_paths[index]
                pairs.append(
                    cityscapes.Pair(
                        f"{drive.name}_{path.stem}", path, drive.folder / "labels_0" / path.name
                    )
                )
    return pairs
