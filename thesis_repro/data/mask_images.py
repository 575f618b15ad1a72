"""Masks as other tools write them: in an alpha channel, with gray edges, as JPEG."""

from pathlib import Path

import cv2
import numpy as np

from thesis_repro.errors import InputError
from thesis_repro.running.files import listed, read_gray

ENDINGS = ".png", ".jpg", ".jpeg"  # in small or capital letters
MAX_GRAY = 0.2  # share of a mask's pixels; label maps have more, edges of JPEG files less


def by_name(folder: str | Path) -> dict[str, Path]:
    """Masks of a folder by their names with the ending .png."""
    paths = [path for path in listed(folder, "*") if path.suffix.lower() in ENDINGS]
    return {f"{path.stem}.png": path for path in paths}


def read(path: str | Path) -> np.ndarray:
    """Read a mask, (height, width) uint8: 0 where keypoints are forbidden, 255 elsewhere.

    It is the alpha channel of an image of one colour. Any other value may stand for 255, and of
    gray edges the nearer value counts. Raises InputError for a picture with an alpha channel, and
    for more gray than edges have, as in a label map.
    """
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        return read_gray(path)  # raises the error that says why
    mask = pixels
    if pixels.ndim == 3:
        mask = cv2.cvtColor(pixels[..., :3], cv2.COLOR_BGR2GRAY)
        alpha = pixels[..., 3:]
        if (alpha != alpha[:1, :1]).any():
            if (mask != mask[0, 0]).any():
                raise InputError(f"{path}: holds a picture and an alpha channel; save one of them")
            mask = alpha[..., 0]
    shares = mask / max(mask.max(), 1)
    gray = np.mean((shares > 0.1) & (shares < 0.9))
    if gray > MAX_GRAY:
        raise InputError(
            f"{path}: {gray:.0%} of its pixels are gray; a mask has 0 and 255 (label maps go with "
            "--labels)"
        )
    return np.where(shares > 0.5, np.uint8(255), np.uint8(0))
