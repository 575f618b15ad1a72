"""The quality of label maps (Section 4.1): by class and domain, by area, and their boundaries."""

from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis.run_settings import Settings
from thesis_repro import masks
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.cityscapes import ID, read_label_map
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import MaskSettings

IMAGES = 100  # most images of a domain
LABELLED_FRAMES = 50  # most frames of all sequences together
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
FRAMES = 12  # of each sequence whose label maps are compared with the exact ones
SMALL = [ID[name] for name in ("pole", "traffic light", "traffic sign", "person")]
# of the median road of a frame; darker road counts as shadow, in rendered frames rightly
SHADOW = 0.7
EXACT = MaskSettings("exact")
THIN = MaskSettings("exact", classes=("pole", "traffic sign"))
THRESHOLDS = (5, 15), (20, 60), (40, 120)  # of Canny, for thin objects
NEAR = 2  # pixels: a boundary with an edge within this distance counts as found


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


def labelled_frames(sequences: list[Sequence]) -> list[cityscapes.Pair]:
    """Return evenly spread frames of sequences with their exact label maps; none for real data."""
    pairs = []
    for sequence in sequences:
        label_folder = sequence.folder / kitti.TRUE_LABELS
        if label_folder.is_dir():
            count = min(len(sequence), max(1, LABELLED_FRAMES // len(sequences)))
            middles = (
                (np.arange(count) + 0.5) * len(sequence) / count
            )  # of equal parts of the sequence
            for path in (sequence.frame_paths[index] for index in middles.astype(int)):
                name = f"{sequence.name}_{path.stem}"
                pairs.append(cityscapes.Pair(name, path, label_folder / path.name))
    return pairs


def table_of_scores(scores: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each measure and class, one column for each model and domain.

    scores: of `scores_of_models`. A cell is empty if the class is absent.
    """
    measures = {}
    for column, (name, factor, digits) in MEASURES.items():
        measures[name] = (factor * scores[column]).round(digits)
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


# By area of the frame


def right_pixels(settings: Settings, sequences: list[Sequence], labels: Path) -> pd.DataFrame:
    """Compare label maps with the exact ones, if there are any; returns one row a frame."""
    rows = []
    for sequence in sequences:
        whole = Sequence(settings.kitti, sequence.name).subset(settings.sizes.frames).subset(FRAMES)
        true_folder = sequence.folder / kitti.TRUE_LABELS
        for index, name in enumerate(whole.label_names if true_folder.is_dir() else ()):
            predicted = read_label_map(labels / sequence.name / name)
            shares = right_shares(predicted, read_label_map(true_folder / name), whole.frame(index))
            rows.append({"sequence": sequence.name, "frame": index} | shares)
    return pd.DataFrame(rows)


def right_shares(predicted: np.ndarray, exact: np.ndarray, frame: np.ndarray) -> dict[str, float]:
    """Return the shares (%) of right pixels in pairs of areas: {area: share}.

    rim: within a tenth of the height from the frame's edges; inside. small: SMALL things; large:
    all others. dark: road in shadow; lit. A pair whose first area is empty is left out.
    """
    enlarged = cv2.resize(predicted, exact.shape[::-1], interpolation=cv2.INTER_NEAREST)
    right = enlarged == exact
    margin = exact.shape[0] // 10
    rim = np.ones(exact.shape, bool)
    rim[margin:-margin, margin:-margin] = False
    small, road = np.isin(exact, SMALL), exact == ID["road"]
    dark = road & (frame < SHADOW * np.median(frame[road]))
    shares: dict[str, float] = {}
    for name, area, other, rest in (
        ("rim", rim, "inside", ~rim),
        ("small", small, "large", ~small),
        ("dark", dark, "lit", road & ~dark),
    ):
        if area.any():
            shares |= {name: 100 * right[area].mean(), other: 100 * right[rest].mean()}
    return shares


# Boundaries


def boundaries(sequences: list[Sequence], labels: Path, frames: int) -> pd.DataFrame:
    """Measure the boundaries of label maps; returns one row for each of some frames of a sequence.

    Columns: lost, the share (%) of boundary pixels that Canny on enlarged ids loses; "thin 5/15"
    and so on, the share of the boundaries of THIN objects that it finds, by its thresholds. Thin
    objects are those of the exact label maps, if there are any. NaN without boundaries.
    """
    rows = []
    for sequence in sequences:
        own, exact = labels / sequence.name, sequence.folder / kitti.TRUE_LABELS
        for index in range(0, len(sequence), max(1, len(sequence) // frames)):
            name = sequence.frame_paths[index].name
            label_map = read_label_map(own / name)
            thin_map = read_label_map((exact if exact.is_dir() else own) / name)
            row = {"sequence": sequence.name, "frame": index}
            row["lost"] = 100 - found_boundaries(label_map, sequence.size, EXACT)
            for low, high in THRESHOLDS:
                found = found_boundaries(thin_map, sequence.size, THIN, (low, high))
                row[f"thin {low}/{high}"] = found
            rows.append(row)
    return pd.DataFrame(rows)


def found_boundaries(
    label_map: np.ndarray,
    size: tuple[int, int],
    which: MaskSettings,
    canny: tuple[int, int] = masks.CANNY,
) -> float:
    """Return the share (%) of a label map's boundaries with an edge within NEAR pixels.

    size: (height, width), to which the map is enlarged. which: boundaries. NaN without any.
    """
    boundary = masks.edges(label_map, size, which) > 0
    edges = masks.edges(label_map, size, MaskSettings(canny=canny))
    found = masks.dilate(edges, 2 * NEAR + 1) > 0
    return 100 * found[boundary].mean() if boundary.any() else np.nan


def invented(predicted: np.ndarray, exact: np.ndarray, canny: tuple[int, int]) -> float:
    """Return the share (%) of a predicted map's edges that lie beside the true boundaries.

    Beside: by more than NEAR pixels. canny: thresholds. NaN without edges.
    """
    edges = masks.edges(predicted, exact.shape, MaskSettings(canny=canny)) > 0
    boundary = masks.dilate(masks.edges(exact, exact.shape, EXACT), 2 * NEAR + 1) > 0
    return 100 * (1 - boundary[edges].mean()) if edges.any() else np.nan
