"""The gap between domains (Section 4.1): the quality of label maps, by class, and its table."""

from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from thesis_repro.data import cityscapes, kitti

IMAGES = 100  # most images of a domain
FRAMES = "the odometry's frames"  # the domain for which masks are made
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
    from thesis_repro.segmentation import prediction, quality  # TensorFlow takes seconds to load

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
        label_folder = drive.folder / kitti.TRUE_LABELS
        if label_folder.is_dir():
            count = min(len(drive), max(1, IMAGES // len(drives)))
            middles = (np.arange(count) + 0.5) * len(drive) / count  # of equal parts of the drive
            paths = [drive.frame_paths[index] for index in middles.astype(int)]
            pairs += [
                cityscapes.Pair(f"{drive.name}_{path.stem}", path, label_folder / path.name)
                for path in paths
            ]
    return pairs


def table(gap: Gap) -> pd.DataFrame:
    """Return one row for each measure and class, one column for each model and domain.

    A cell is empty if the class is absent.
    """
    measures = {}
    for key, (name, factor, digits) in MEASURES.items():
        measures[name] = (factor * gap.scores[key]).round(digits)
    columns = gap.scores["model"] + ": " + gap.scores["domain"]
    rows = pd.DataFrame(measures).set_axis(columns).T
    classes = gap.classes.assign(column=gap.classes["model"] + ": " + gap.classes["domain"])
    ious = classes.pivot(index=["id", "class"], columns="column", values="iou").droplevel("id")
    table = pd.concat([rows, ious.round(3).rename("IoU: {}".format)])
    return table.rename_axis(index="measure", columns=None).reset_index()


def label_map_quality(build: Path) -> list[dict[str, Any]]:
    """Return the scores of the model that the odometry uses, one dict a domain.

    They are read from RECORD in the build folder; [] if notebook 05 measured none. The odometry's
    frames come first if they have true label maps. `seen`: whether some of the domain's images are
    in the model's training data.
    """
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return []
    used = pd.read_csv(path).query("used")
    used = used.sort_values("domain", key=lambda names: names != FRAMES, kind="stable")
    seen = (used["model"] == SEEN[0]) & (used["domain"] == SEEN[1])
    return used.assign(seen=seen).to_dict("records")
