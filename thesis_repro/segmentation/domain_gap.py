"""The gap between domains (Section 4.1): label maps measured by class, in shadows and from frame to frame."""

from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd

from thesis_repro import cityscapes, files
from thesis_repro.segmentation import prediction, quality

GROUND = tuple(cityscapes.ID[name] for name in ("road", "sidewalk", "terrain"))  # where shadows fall
DARK = 0.6  # of the median gray of its class in its image; ground below that counts as shadow
AWAY = 4 / 320  # of an image; nearer to a true boundary errors have other causes
CONSISTENT = 1.0  # pixels; forward and backward flow must cancel to this, or the pixel is not compared

IMAGES = 100  # of a domain at most, spread evenly
DRIVES, FRAMES = 3, 12  # how much of the odometry's data the flicker is measured on
EXACT = "exact label maps"  # whose flicker is the floor of that measure


class Gap(NamedTuple):
    """What `measure` returns."""

    scores: pd.DataFrame  # a row for each model and domain; shares and IoU from 0 to 1
    classes: pd.DataFrame  # a row for each of these and each class present: model, domain, class, id, share, iou
    flicker: pd.Series  # by model: the share of pixels that change their class between frames; of EXACT too


def measure(models, domains, drives):
    """Measure models on domains, and their flicker on the first frames of drives; returns a Gap.

    models: Keras models by name; domains: lists of `cityscapes.Pair` by name; drives: `kitti.Sequence`s. Each model is
    measured at its own size. A mean IoU is that of one confusion matrix over the domain (`quality.cityscapes_scores`);
    `classes` and `images` say over how many of each.
    """
    scores, classes = [], []
    for model_name, model in models.items():
        for domain, pairs in domains.items():
            images, true = cityscapes.load(pairs, *model.input_shape[2:])
            predicted = prediction.predict(model, images)
            mean_iou, accuracy, table = quality.cityscapes_scores(quality.confusion_matrix(true, predicted))
            where = {"model": model_name, "domain": domain}
            scores.append({**where, "images": len(pairs), "classes": len(table), "mean_iou": mean_iou,
                           "accuracy": accuracy, "sky_recall": table["recall"].get("sky", np.nan),
                           **shadow_errors(images, true, predicted)})
            share = (table["pixels"] / table["pixels"].sum()).to_numpy()
            classes.append(table.reset_index().assign(**where, share=share))
    shares = []
    for drive in (drive.subset(FRAMES) for drive in drives[:DRIVES]):
        label_maps = {name: prediction.predict(model, np.stack([
            cityscapes.read_image(path, *model.input_shape[1:]) for path in drive.frame_paths]))
            for name, model in models.items()}
        if exact := labelled_frames([drive]):
            label_maps[EXACT] = [cityscapes.read_label_map(pair.label) for pair in exact]
        frames = list(drive.frames())
        shares.append({name: flicker(maps, frames).mean() for name, maps in label_maps.items()})
    return Gap(pd.DataFrame(scores), pd.concat(classes, ignore_index=True), pd.DataFrame(shares).mean())


def labelled_frames(drives):
    """Frames of `kitti.Sequence`s with their exact label maps (labels_0), spread evenly; none on real data."""
    pairs = []
    for drive in drives:
        if (drive.folder / "labels_0").is_dir():
            count = min(len(drive), max(1, IMAGES // len(drives)))
            for index in ((np.arange(count) + 0.5) * len(drive) / count).astype(int):
                path = drive.frame_paths[index]
                pairs.append(cityscapes.Pair(f"{drive.name}_{path.stem}", path, drive.folder / "labels_0" / path.name))
    return pairs


def shadow_errors(images, true, predicted):
    """Whether ground in shadow is taken for another class more often than ground in light (Section 4.1).

    images: (n, h, w, channels) uint8; true, predicted: (n, h, w) uint8. No data set marks its shadows. So a pixel of
    GROUND (by the true label map) counts as dark where its gray is below DARK times the median of its class in its
    image, and as lit elsewhere. Pixels near a true boundary are left out.

    Returns `dark`, the share of these pixels that are dark, and `dark_wrong` and `lit_wrong`, the shares of dark and
    of lit ones that are given another class (NaN where there are none).
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
    return {"dark": float(pixels[1] / max(pixels.sum(), 1)), "dark_wrong": dark_wrong, "lit_wrong": lit_wrong}


def flicker(label_maps, frames):
    """The share of pixels whose class changes between consecutive frames, motion taken out: (n - 1,), from 0 to 1.

    label_maps: n of (h, w) uint8, any size; frames: n of (height, width) uint8. The motion is measured by dense optical
    flow in both directions. Only pixels whose two flows cancel are compared, which leaves out what is occluded, enters
    or leaves. Exact label maps show the floor of the measure: flow that is off by a pixel at a boundary.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    frames = [np.ascontiguousarray(frame) for frame in frames]
    label_maps = [cv2.resize(label_map, frame.shape[::-1], interpolation=cv2.INTER_NEAREST)
                  for label_map, frame in zip(label_maps, frames, strict=True)]
    height, width = frames[0].shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    shares = []
    for index in files.progress(range(1, len(frames)), "flicker"):
        forward = flow.calc(frames[index - 1], frames[index], None)
        backward = flow.calc(frames[index], frames[index - 1], None)
        origin = columns + backward[..., 0], rows + backward[..., 1]  # where each pixel was in the frame before
        there = cv2.remap(forward, *origin, cv2.INTER_LINEAR, borderValue=(np.inf, np.inf))
        with np.errstate(invalid="ignore"):
            compared = np.linalg.norm(there + backward, axis=-1) <= CONSISTENT
        changed = (cv2.remap(label_maps[index - 1], *origin, cv2.INTER_NEAREST) != label_maps[index]) & compared
        shares.append(changed.sum() / max(compared.sum(), 1))
    return np.array(shares)
