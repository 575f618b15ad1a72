"""The gap between domains (Section 4.1): how good label maps are on the images of a training's kind, and elsewhere."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from thesis_repro import cityscapes, kitti
from thesis_repro.cityscapes import Pair
from thesis_repro.segmentation import errors, prediction, quality
from thesis_repro.study.flicker import EXACT, flicker

IMAGES = 100  # of a domain, at most, spread evenly
DRIVES, FRAMES = 3, 12  # how much of the odometry's data the flicker is measured on


class Gap(NamedTuple):
    """What `measure` finds."""

    scores: pd.DataFrame  # a row for each model and domain
    classes: pd.DataFrame  # a row for each of these and each class that is there: model, domain, class, id, share, iou
    flicker: pd.Series  # by model: share of pixels that change between consecutive frames; of EXACT its floor


def labelled_frames(root: Path, names: Sequence[str], frames: int | None = None, limit: int = IMAGES) -> list[Pair]:
    """Frames of an odometry root that have exact label maps (labels_0), spread evenly; none on real data."""
    found = []
    for name in names:
        sequence = kitti.Sequence(root, name).subset(frames)
        labels = sequence.folder / "labels_0"
        if labels.is_dir():
            count = min(len(sequence), max(1, limit // len(names)))
            paths = [sequence.frame_paths[(2 * index + 1) * len(sequence) // (2 * count)] for index in range(count)]
            found += [Pair(f"{name}_{path.stem}", path, labels / path.name) for path in paths]
    return found


def measure(models: Mapping[str, Any], domains: Mapping[str, Sequence[Pair]],
            drives: Iterable[kitti.Sequence]) -> Gap:
    """Measure models on domains, and how much they flicker on the first frames of drives.

    models: Keras models by name; domains: pairs of image and true label map by name. Each model is measured at its own
    size, by one confusion matrix over the domain (`quality.cityscapes_scores`), with `errors.boundary_scores` and
    `errors.shadow_errors`.
    """
    scores, classes = [], []
    for model_name, model in models.items():
        size, channels = model.input_shape[2:]
        for domain, pairs in domains.items():
            images, labels = cityscapes.load(pairs, size, channels)
            predicted = prediction.predict(model, images)
            mean_iou, accuracy, table = quality.cityscapes_scores(quality.confusion_matrix(labels, predicted))
            sky = table.loc["sky"] if "sky" in table.index else {"iou": np.nan, "recall": np.nan}
            where = {"model": model_name, "domain": domain}
            scores.append({**where, "images": len(pairs), "mean_iou": mean_iou, "accuracy": accuracy,
                           "classes": len(table), "sky_iou": sky["iou"], "sky_recall": sky["recall"],
                           **errors.boundary_scores(labels, predicted),
                           **errors.shadow_errors(images, labels, predicted)})
            share = (table["pixels"] / table["pixels"].sum()).to_numpy()
            classes.append(table.reset_index().assign(**where, share=share))
    columns = ["model", "domain", "class", "id", "share", "iou", "recall"]
    return Gap(pd.DataFrame(scores), pd.concat(classes, ignore_index=True)[columns], _flicker(models, drives))


def _flicker(models: Mapping[str, Any], drives: Iterable[kitti.Sequence]) -> pd.Series:
    changed: dict[str, list[float]] = {}
    for drive in list(drives)[:DRIVES]:
        drive = drive.subset(FRAMES)
        frames = [drive.frame(index) for index in range(len(drive))]
        maps = {name: prediction.predict(model, np.stack([prediction.read_input(path, model.input_shape)
                                                          for path in drive.frame_paths]))
                for name, model in models.items()}
        if (drive.folder / "labels_0").is_dir():
            maps[EXACT] = [cityscapes.read_label_map(drive.folder / "labels_0" / path.name)
                           for path in drive.frame_paths]
        for name, some in maps.items():
            changed.setdefault(name, []).append(float(flicker(some, frames)["changed"].mean()))
    return pd.Series({name: float(np.mean(values)) for name, values in changed.items()}, dtype=float)
