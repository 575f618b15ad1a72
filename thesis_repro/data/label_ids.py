"""Label maps with other ids or colours than Cityscapes' label ids, read through a table.

A table is a CSV file with a line for each id (34,building) or for each colour (#464646,building).
The names are those of `cityscapes.LABELS`; what is no class is "unlabeled". COLORS in place of a
file stands for the colours of Cityscapes.
"""

import csv
from pathlib import Path

import numpy as np
from PIL import Image

from thesis_repro.data.cityscapes import ID, LABELS, read_label_map
from thesis_repro.data.trajectories import text_of
from thesis_repro.errors import InputError

COLORS = "colors"
NOT_NAMED = 255  # no label id


def read_table(path: str | Path) -> tuple[bool, dict[int, int]]:
    """Return (whether it names colours, {id or colour as one number: label id}) of a table.

    Raises InputError, naming the line, for a line that is not an id or a colour and a label.
    """
    if path == COLORS:
        # of labels with one colour, the first one is meant: "car" before "license plate"
        return True, {int.from_bytes(label.color): label.id for label in reversed(LABELS)}
    lines = text_of(path).split("\n")
    table: dict[int, int] = {}
    for number, row in enumerate(csv.reader(lines), 1):
        if not row or row[0] in ("id", "color"):
            continue
        try:
            key, name = map(str.strip, row)
            base = 16 if key.startswith("#") else 10
            table[int(key.removeprefix("#"), base)] = ID[name]
        except (ValueError, KeyError):
            raise InputError(
                f"{path}, line {number}: must hold an id or a colour (#464646), a comma and one of "
                f"{', '.join(ID)}"
            ) from None
    return any(line.startswith("#") for line in lines), table


def read(path: str | Path, ids: str | Path) -> np.ndarray:
    """Read a label map as label ids, (height, width) uint8.

    ids: "labels" or "train" as in `cityscapes.read_label_map`, or else the table to read through.
    The PNG then has ids of 1 to 16 bits, a palette (its numbers are the ids, its colours the
    colours), or colours. Raises InputError for what is not in the table.
    """
    if ids in ("labels", "train"):
        return read_label_map(path, ids == "train")
    has_colors, table = read_table(ids)
    try:
        with Image.open(path, formats=["PNG"]) as image:
            if has_colors:
                pixels = np.asarray(image.convert("RGB")) @ np.array([1 << 16, 1 << 8, 1])
            else:
                pixels = np.asarray(image)
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as PNG: {error}") from None
    if pixels.ndim == 3:
        raise InputError(f"{path}: holds colours, but {ids} names ids")
    labels_by_value = np.full(1 << 24 if has_colors else 1 << 16, NOT_NAMED, np.uint8)
    labels_by_value[list(table)] = list(table.values())
    labels = labels_by_value[pixels]
    unknown = np.unique(pixels[labels == NOT_NAMED])[:10].tolist()
    if unknown:
        values = ", ".join(f"#{value:06x}" if has_colors else str(value) for value in unknown)
        raise InputError(f"{path}: holds {values}, which {ids} does not name")
    return labels
