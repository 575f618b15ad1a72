"""The gap between domains (Section 4.1): the quality of label maps, by class, and its table."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence

IMAGES = 100  # most images of a domain
LABELLED_FRAMES = 50  # most frames of all drives together
DRIVES = "the odometry's frames"  # the domain for which masks are made
# a model and a domain with images that are in the model's training data
SEEN = ("the model in the package", "KITTI's street scenes")
RECORD = "quality"  # name of the table in the build folder with the scores of all models
MEASURES = {  # column: name in the table, factor, digits
    "images": ("images", 1, 0),
    "classes": ("classes present", 1, 0),
    "mean_iou": ("mean IoU over these", 1, 3),
    "accuracy": ("pixel accuracy", 1, 3),
    "sky_recall": ("sky found (%)", 100, 1),
}
IOU = "IoU: {}"  # columns of the classes


def scores_of_models(
    models: dict[str, Any], domains: dict[str, list[cityscapes.Pair]]
) -> pd.DataFrame:
    """Measure models on domains; returns one row for each model and domain.

    models: Keras models by name; domains: lists of `cityscapes.Pair` by name. The images are
    resized to the model's input. Columns: model, domain, the number of images and of classes
    present; mean_iou, accuracy and sky_recall (shares), from one confusion matrix over the domain
    (`quality.cityscapes_scores`); and the IoU of each class, NaN where it is absent.
    """
    from thesis_repro.segmentation import prediction, quality  # TensorFlow takes seconds to load

    rows = []
    for (model_name, model), (domain, pairs) in product(models.items(), domains.items()):
        images, true = cityscapes.load(pairs, *model.input_shape[2:])
        confusion = quality.confusion_matrix(true, prediction.predict(model, images))
        mean_iou, accuracy, classes = quality.cityscapes_scores(confusion)
        numbers = {
            "model": model_name,
            "domain": domain,
            "images": len(pairs),
            "classes": len(classes),
            "mean_iou": mean_iou,
            "accuracy": accuracy,
            "sky_recall": classes["recall"].get("sky", np.nan),
        }
        rows.append(numbers | classes["iou"].rename(IOU.format).to_dict())
    return pd.DataFrame(rows)


def labelled_frames(drives: list[Sequence]) -> list[cityscapes.Pair]:
    """Return evenly spread frames of sequences with their exact label maps; none for real data."""
    pairs = []
    for drive in drives:
        label_folder = drive.folder / kitti.TRUE_LABELS
        if label_folder.is_dir():
            count = min(len(drive), max(1, LABELLED_FRAMES // len(drives)))
            middles = (np.arange(count) + 0.5) * len(drive) / count  # of equal parts of the drive
            for path in (drive.frame_paths[index] for index in middles.astype(int)):
                name = f"{drive.name}_{path.stem}"
                pairs.append(cityscapes.Pair(name, path, label_folder / path.name))
    return pairs


def table_of_scores(scores: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each measure and class, one column for each model and domain.

    scores: of `scores_of_models`. A cell is empty if the class is absent.
    """
    measures = {
        name: (factor * scores[column]).round(digits)
        for column, (name, factor, digits) in MEASURES.items()
    }
    ious = scores.filter([IOU.format(label.name) for label in cityscapes.LABELS]).round(3)
    rows = pd.DataFrame(measures).join(ious).set_axis(scores["model"] + ": " + scores["domain"]).T
    return rows.rename_axis(index="measure", columns=None).reset_index()


def label_map_quality(build: Path) -> pd.DataFrame:
    """Return the scores of the model that the odometry uses, one row a domain.

    They are read from RECORD in the build folder; the table is empty if notebook 05 measured none.
    The odometry's frames come first if they have true label maps. `seen`: whether some of the
    domain's images are in the model's training data.
    """
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return pd.DataFrame()
    used = pd.read_csv(path).query("used")
    used = used.sort_values("domain", key=lambda names: names != DRIVES, kind="stable")
    return used.assign(seen=(used["model"] == SEEN[0]) & (used["domain"] == SEEN[1]))
