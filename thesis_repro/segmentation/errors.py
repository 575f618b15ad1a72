"""Where label maps are wrong: at boundaries, and in shadows (Section 4.1)."""

import cv2
import numpy as np

from thesis_repro.cityscapes import LABELS, N_CLASSES

# The ids that the Cityscapes benchmark evaluates; pixels of all others are left out of its confusion matrix.
EVALUATED = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)

SIZE = 320  # pixels, both ways, on which boundaries are compared: that of written label maps
NEAR = 2  # pixels of that; a boundary so near to another one has found it
GROUND = (7, 8, 22)  # road, sidewalk, terrain: shadows fall there
DARK = 0.6  # of the median gray of its class in its image; a ground pixel below that is dark
AWAY = 4  # pixels of SIZE; nearer to a true boundary errors have other causes
ENOUGH = 50  # dark and as many other pixels, for an image to tell anything about shadows


def boundary_scores(true, predicted):
    """How well boundaries between evaluated classes are met, label maps (n, h, w) uint8 of both stretched to 320x320.

    Returns shares from 0 to 1: `found`, true boundary pixels with a predicted one within NEAR pixels; `right`,
    predicted ones with a true one as near; `chance`, all pixels with a predicted boundary as near, which is what
    boundaries that know nothing of the image would find.
    """
    counts = np.zeros((3, 2), np.int64)
    for one, other in zip(true, predicted, strict=True):
        one, other = (cv2.resize(label_map, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
                      for label_map in (one, other))
        counted = np.isin(one, EVALUATED)
        edge, given = _boundary(one, counted), _boundary(other, counted)
        near_edge, near_given = (cv2.dilate(found.astype(np.uint8), _square(NEAR)) > 0 for found in (edge, given))
        for row, (some, near) in enumerate(((edge, near_given), (given, near_edge), (counted, near_given))):
            counts[row] += (some & near).sum(), some.sum()
    return dict(zip(("found", "right", "chance"), (counts[:, 0] / np.maximum(counts[:, 1], 1)).tolist()))


def _boundary(label_map, counted):
    """Pixels whose right or lower neighbour has another class, both of them counted."""
    found = np.zeros(label_map.shape, bool)
    found[:, :-1] |= (label_map[:, :-1] != label_map[:, 1:]) & counted[:, :-1] & counted[:, 1:]
    found[:-1] |= (label_map[:-1] != label_map[1:]) & counted[:-1] & counted[1:]
    return found


def _square(reach):
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def shadow_errors(images, true, predicted):
    """Whether ground in shadow is taken for something else more often than ground in light (Section 4.1).

    images: (n, h, w, channels) uint8; true, predicted: (n, h, w) uint8. No data set marks its shadows, so a pixel of
    road, sidewalk or terrain (by the true label map) counts as shadow where its gray is below DARK times the median
    of its class in its image, and every other one as lit. Pixels near a true boundary are left out of both.

    Returns `dark`, the share of these pixels that are dark; `dark_wrong` and `lit_wrong`, the shares of dark and of lit
    ones that are given another class; `taken_for`, the class that wrong dark ones are given most often; `worse` of
    `compared` images in which dark ones are wrong more often.
    """
    away = max(1, round(AWAY * true.shape[1] / SIZE))
    counts = np.zeros((2, 2), np.int64)  # lit, dark: pixels, wrong ones
    taken, worse, compared = np.zeros(N_CLASSES, np.int64), 0, 0
    for image, one, other in zip(images, true, predicted, strict=True):
        gray = image.mean(axis=-1)
        usable = cv2.dilate(_boundary(one, np.ones(one.shape, bool)).astype(np.uint8), _square(away)) == 0
        here = np.zeros((2, 2), np.int64)
        for label in GROUND:
            some = (one == label) & usable
            if not some.any():
                continue
            dark, wrong = gray[some] < DARK * np.median(gray[one == label]), other[some] != label
            for which, chosen in enumerate((~dark, dark)):
                here[which] += chosen.sum(), (chosen & wrong).sum()
            taken += np.bincount(other[some][dark & wrong], minlength=N_CLASSES)
        counts += here
        if here[:, 0].min() >= ENOUGH:
            compared += 1
            worse += here[1, 1] * here[0, 0] > here[0, 1] * here[1, 0]
    shares = np.where(counts[:, 0] > 0, counts[:, 1] / np.maximum(counts[:, 0], 1), np.nan)
    return {"dark": float(counts[1, 0] / max(counts[:, 0].sum(), 1)), "dark_wrong": float(shares[1]),
            "lit_wrong": float(shares[0]), "taken_for": LABELS[taken.argmax()].name if taken.any() else None,
            "worse": int(worse), "compared": compared}
