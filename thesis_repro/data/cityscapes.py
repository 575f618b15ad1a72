"""Cityscapes: the table of labels, and pairs of images and label maps.

The pairs are in the official or the thesis's flat layout.
"""

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.data.cameras import Camera, undistorted
from thesis_repro.data.frames import eight_bits
from thesis_repro.errors import InputError
from thesis_repro.running.files import listed, progress, read_color, read_gray, read_ids


class Label(NamedTuple):
    """A row of Tables 3.1 and 3.2."""

    name: str
    id: int
    weight: float  # in the Dice loss
    color: tuple  # red, green, blue


# Tables 3.1 and 3.2, with the colours of the Cityscapes scripts. "background" is in the tables
# only: the network has 35 outputs, and no label map holds id 35 (audit row 9).
LABELS = tuple(
    Label(*row)
    for row in [
        ("unlabeled", 0, 1.0, (0, 0, 0)),
        ("ego vehicle", 1, 1.0, (0, 0, 0)),
        ("rectification border", 2, 1.0, (0, 0, 0)),
        ("out of roi", 3, 1.0, (0, 0, 0)),
        ("static", 4, 1.0, (0, 0, 0)),
        ("dynamic", 5, 1.0, (111, 74, 0)),
        ("ground", 6, 1.0, (81, 0, 81)),
        ("road", 7, 0.7, (128, 64, 128)),
        ("sidewalk", 8, 1.1, (244, 35, 232)),
        ("parking", 9, 2.2, (250, 170, 160)),
        ("rail track", 10, 2.9, (230, 150, 140)),
        ("building", 11, 0.8, (70, 70, 70)),
        ("wall", 12, 2.2, (102, 102, 156)),
        ("fence", 13, 2.2, (190, 153, 153)),
        ("guard rail", 14, 4.0, (180, 165, 180)),
        ("bridge", 15, 2.5, (150, 100, 100)),
        ("tunnel", 16, 3.4, (150, 120, 90)),
        ("pole", 17, 1.0, (153, 153, 153)),
        ("pole group", 18, 5.0, (153, 153, 153)),
        ("traffic light", 19, 2.5, (250, 170, 30)),
        ("traffic sign", 20, 2.3, (220, 220, 0)),
        ("vegetation", 21, 0.9, (107, 142, 35)),
        ("terrain", 22, 1.0, (152, 251, 152)),
        ("sky", 23, 1.2, (70, 130, 180)),
        ("person", 24, 2.0, (220, 20, 60)),
        ("rider", 25, 3.0, (255, 0, 0)),
        ("car", 26, 1.0, (0, 0, 142)),
        ("truck", 27, 2.3, (0, 0, 70)),
        ("bus", 28, 2.3, (0, 60, 100)),
        ("caravan", 29, 3.4, (0, 0, 90)),
        ("trailer", 30, 3.5, (0, 0, 110)),
        ("train", 31, 2.3, (0, 80, 100)),
        ("motorcycle", 32, 3.2, (0, 0, 230)),
        ("bicycle", 33, 2.3, (119, 11, 32)),
        ("license plate", 34, 0.5, (0, 0, 142)),
        ("background", 35, 0.5, (0, 0, 0)),
    ]
)
N_CLASSES = 35  # Figure A.1: ids 0 to 34
CLASS_WEIGHTS = np.array([label.weight for label in LABELS[:N_CLASSES]], np.float32)
COLORS = np.array([label.color for label in LABELS], np.uint8)
ID = {label.name: label.id for label in LABELS}
# Many networks are trained with Cityscapes' train ids: 0 to 18 in this order, and 255 for all other
# labels.
TRAINED = (
    "road",
    "sidewalk",
    "building",
    "wall",
    "fence",
    "pole",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "train",
    "motorcycle",
    "bicycle",
)


class Pair(NamedTuple):
    """An image and its label map."""

    name: str  # the common part of both file names
    image: Path
    label: Path


def colorize(label_map: np.ndarray) -> np.ndarray:
    """Colour image (height, width, 3), red, green, blue, of a label map (height, width)."""
    return COLORS[np.minimum(label_map, len(COLORS) - 1)]


def pairs(root: str | Path, split: str, limit: int | None = None) -> list[Pair]:
    """Pairs of image and label map of one split ("train" or "val"), sorted by name.

    Reads the official layout (leftImg8bit, gtFine) and the appendix's flat layout (train,
    trainannot). limit: largest number of pairs; None for all. They are spread evenly over the
    split, because it is sorted by city. The appendix pairs two unsorted directory listings by
    position (A.2); this function pairs equal names. Raises InputError if a folder is missing, a
    split is empty, or an image has no label map.
    """
    root = Path(root)
    if (root / "leftImg8bit").is_dir():  # one folder a city
        image_folder = root / "leftImg8bit" / split
        images = _by_name(image_folder, "*/*", "_leftImg8bit.png")
        labels = _by_name(root / "gtFine" / split, "*/*", "_gtFine_labelIds.png")
    elif (root / split).is_dir():
        image_folder = root / split
        images = _by_name(image_folder, "*", ".png")
        labels = _by_name(root / f"{split}annot", "*", ".png")
    else:
        raise InputError(
            f"{root}: must be a folder that holds leftImg8bit and gtFine, or {split} and {split}annot"
        )
    if not images:
        raise InputError(f"{image_folder}: no PNG images")
    if images.keys() != labels.keys():
        name = min(images.keys() ^ labels.keys())
        alone = images.get(name) or labels.get(name)
        raise InputError(f"{alone}: each image needs a label map, and each label map an image")
    names = sorted(images)
    if limit is not None and limit < len(names):
        names = [names[index * len(names) // limit] for index in range(limit)]
    return [Pair(name, images[name], labels[name]) for name in names]


def _by_name(folder: Path, pattern: str, ending: str) -> dict[str, Path]:
    """Return the files of a folder by their names without an ending."""
    return {path.name.removesuffix(ending): path for path in listed(folder, pattern + ending)}


def read_image(
    path: str | Path,
    height: int,
    width: int,
    channels: int = 1,
    white: int = 0,
    lens: Camera | None = None,
) -> np.ndarray:
    """Read an image and resize it bilinearly (A.2.1): uint8 (height, width, channels).

    channels: 1 for gray, as in the thesis; 3 for red, green, blue. white: see `frames.white_level`.
    lens: whose distortion is taken out.
    """
    read = read_gray if channels == 1 else read_color
    image = eight_bits(read(path, np.uint16 if white else np.uint8), white)
    if lens is not None:
        image = undistorted(image, lens)
    image = resize_bilinear(image, (height, width))
    return image.reshape(height, width, channels)


def resize_bilinear(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize an image, (h, w) or (h, w, 3) uint8, to (height, width), bilinearly.

    One channel has the same bits on x86 and on ARM. OpenCV has other code for it on ARM, whose
    result differs by up to two gray levels, but not for two channels. On x86, `cv2.resize` of the
    image alone gives these bits, too. Three channels were not compared on ARM.
    """
    if image.ndim == 3:
        return cv2.resize(image, size[::-1])
    twice = cv2.resize(cv2.merge([image, image]), size[::-1])
    return cv2.extractChannel(twice, 0)


def read_label_map(path: str | Path) -> np.ndarray:
    """Read a label map (height, width) of Cityscapes label ids, uint8.

    `label_ids.read` reads other ids. Raises InputError if a number is no label id, and as
    `read_ids` does.
    """
    label_map = read_ids(path)
    if label_map.max() >= N_CLASSES:
        advice = "give --ids train for train ids (0 to 18, 255)"
        if label_map[label_map != 255].max(initial=0) >= len(TRAINED):
            advice = "give --ids FILE for a table of these ids, with a line such as 255,unlabeled"
        raise InputError(
            f"{path}: label id {label_map.max()} is above {N_CLASSES - 1}; take the labelIds.png files, "
            f"or {advice}"
        )
    return label_map.astype(np.uint8)


def load(
    image_pairs: Collection[Pair], size: int, channels: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Read pairs at size x size (A.2).

    Returns images (n, size, size, channels) and label maps (n, size, size), both uint8. Label maps
    are resized by nearest neighbour, so that no new ids appear.
    """
    count, shape = len(image_pairs), (size, size)
    images = np.empty((count, *shape, channels), np.uint8)
    labels = np.empty((count, *shape), np.uint8)
    for index, pair in enumerate(progress(image_pairs, "reading images", unit="image")):
        images[index] = read_image(pair.image, size, size, channels)
        label_map = read_label_map(pair.label)
        labels[index] = cv2.resize(label_map, shape, interpolation=cv2.INTER_NEAREST)
    return images, labels
