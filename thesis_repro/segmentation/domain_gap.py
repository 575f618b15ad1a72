"""The gap between domains (Section 4.1): errors of label maps by class and in shadows, and
their flicker.
"""

from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd

from thesis_repro import cityscapes, files
from thesis_repro.segmentation import prediction, quality

# where shadows fall
GROUND = tuple(cityscapes.ID[name] for name in ("road", "sidewalk", "terrain"))
# ground darker than this share of the median gray of its class in its image counts as shadow
DARK = 0.6
AWAY = 4 / 320  # share of the image height; errors this near to a true boundary have other causes
# pixels; only pixels whose forward and backward flow add up to at most this are compared
CONSISTENT = 1.0

IMAGES = 100  # most images of a domain
DRIVES, FRAMES = 3, 12  # number of sequences, and of frames of each, for measuring the flicker
EXACT = "exact label maps"  # their flicker shows what the measure gives without any real flicker


class Gap(NamedTuple):
    """The result of `measure`."""

    scores: pd.DataFrame  # a row for each model and domain; shares and IoU from 0 to 1
    # a row for each model, domain and class present: model, domain, class, id, share, iou
    classes: pd.DataFrame
    # by model, and for EXACT: share of pixels that change their class between frames
    flicker: pd.Series


def measure(models, domains, drives):
    """Measure models on domains, and their flicker on the first frames of drives; return a Gap.

    models: Keras models by name; domains: lists of `cityscapes.Pair` by name; drives: list of
    `kitti.Sequence`. The images are resized to the model's input. The mean IoU comes from one
    confusion matrix over the domain (`quality.cityscapes_scores`); the columns `classes` and
    `images` hold the number of classes and images.
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
                    **shadow_errors(images, true, predicted),
                }
            )
            share = (table["pixels"] / table["pixels"].sum()).to_numpy()
            classes.append(table.reset_index().assign(**names, share=share))
    shares = []
    for drive in (drive.subset(FRAMES) for drive in drives[:DRIVES]):
        label_maps = {
            name: prediction.predict(
                model,
                np.stack(
                    [
                        cityscapes.read_image(path, *model.input_shape[1:])
                        for path in drive.frame_paths
                    ]
                ),
            )
            for name, model in models.items()
        }
        if exact := labelled_frames([drive]):
            label_maps[EXACT] = [cityscapes.read_label_map(pair.label) for pair in exact]
        frames = list(drive.frames())
        shares.append({name: flicker(maps, frames).mean() for name, maps in label_maps.items()})
    return Gap(
        pd.DataFrame(scores), pd.concat(classes, ignore_index=True), pd.DataFrame(shares).mean()
    )


def labelled_frames(drives):
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


def shadow_errors(images, true, predicted):
    """Return how often ground in shadow and ground in light are given a wrong class (Section 4.1).

    images: (n, h, w, channels) uint8; true, predicted: (n, h, w) uint8. No data set marks its
    shadows, so they are estimated: a pixel whose true class is in GROUND counts as dark if its gray
    is below DARK times the median of its class in its image, otherwise as lit. Pixels near a true
    boundary are ignored.

    The keys are `dark`, the share of ground pixels that are dark, and `dark_wrong` and `lit_wrong`,
    the shares of dark and of lit pixels with a wrong class (NaN without such pixels).
    """
    away = np.ones((2 * max(1, round(AWAY * true.shape[1])) + 1,) * 2, np.uint8)
    pixels, wrong = np.zeros(2), np.zeros(2)  # lit, dark
    for image, true_map, predicted_map in zip(images, true, predicted, strict=True):
        gray = image.mean(axis=-1)
        for label in GROUND:
            ground = cv2.erode((true_map == label).astype(np.uint8), away) > 0
            if ground.any():
                dark = (gray[ground] < DARK * np.median(gray[true_map == label])).astype(int)
                pixels += np.bincount(dark, minlength=2)
                wrong += np.bincount(dark, weights=predicted_map[ground] != label, minlength=2)
    with np.errstate(invalid="ignore"):
        lit_wrong, dark_wrong = wrong / pixels
    return {
        "dark": float(pixels[1] / max(pixels.sum(), 1)),
        "dark_wrong": dark_wrong,
        "lit_wrong": lit_wrong,
    }


def flicker(label_maps, frames):
    """Return the share of pixels whose class changes between consecutive frames, without motion: (n
    - 1,), 0 to 1.

    label_maps: n of (h, w) uint8, any size; frames: n of (height, width) uint8. The motion is
    measured by dense optical flow in both directions. Only pixels whose two flows cancel are
    compared, so pixels that are occluded, enter or leave are ignored. Even exact label maps flicker
    a little, because the flow is not exact at boundaries.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    frames = [np.ascontiguousarray(frame) for frame in frames]
    label_maps = [
        cv2.resize(label_map, frame.shape[::-1], interpolation=cv2.INTER_NEAREST)
        for label_map, frame in zip(label_maps, frames, strict=True)
    ]
    height, width = frames[0].shape
    columns, rows = np.meshgrid(
        np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    )
    shares = []
    for index in files.progress(range(1, len(frames)), "flicker"):
        forward = flow.calc(frames[index - 1], frames[index], None)
        backward = flow.calc(frames[index], frames[index - 1], None)
        # each pixel's position in the frame before
        origin = columns + backward[..., 0], rows + backward[..., 1]
        forward = cv2.remap(forward, *origin, cv2.INTER_LINEAR, borderValue=(np.inf, np.inf))
        with np.errstate(invalid="ignore"):
            compared = np.linalg.norm(forward + backward, axis=-1) <= CONSISTENT
        changed = (
            cv2.remap(label_maps[index - 1], *origin, cv2.INTER_NEAREST) != label_maps[index]
        ) & compared
        shares.append(changed.sum() / max(compared.sum(), 1))
    return np.array(shares)
