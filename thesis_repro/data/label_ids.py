"""Label maps with other ids or colours than Cityscapes' label ids, read through a table.

A table is a CSV file with a line for each id (34,building) or for each colour (#464646,building).
The names are those of `cityscapes.LABELS`; what is no class is "unlabeled". Two tables have names:
Cityscapes' train ids ("train") and colours ("colors").
"""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from thesis_repro.data.cityscapes import ID, LABELS, TRAINED, read_label_map
from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError
from thesis_repro.running.files import read_color, read_ids
from thesis_repro.running.provenance import digest_of_file

LABEL_IDS, TRAIN_IDS, COLORS = "labels", "train", "colors"
# {name: see `read_table`}; of labels with one colour, the first one is meant: "car" before "license
# plate"
TABLES: dict[Any, tuple[bool, dict[int, int]]] = {
    TRAIN_IDS: (
        False,
        {255: ID["unlabeled"]} | {number: ID[name] for number, name in enumerate(TRAINED)},
    ),
    COLORS: (True, {int.from_bytes(label.color): label.id for label in reversed(LABELS)}),
}
NOT_NAMED = 255  # no label id
RGB = np.array([1 << 16, 1 << 8, 1])  # makes one number of a colour


def read_table(path: str | Path) -> tuple[bool, dict[int, int]]:
    """Return (whether it names colours, {id or colour as one number: label id}) of a table.

    Raises InputError, naming the line, for a line that is not an id or a colour and a label.
    """
    if path in TABLES:
        return TABLES[path]
    lines = read_text(path).split("\n")
    table = {}
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


def record(ids: str | Path) -> dict[str, str]:
    """Return what the record of results has of a table in a file: its digest."""
    if ids in (LABEL_IDS, *TABLES):
        return {}
    return {"table": digest_of_file(ids)}


def read(path: str | Path, ids: str | Path = LABEL_IDS) -> np.ndarray:
    """Read a label map as label ids, (height, width) uint8.

    ids: "labels" as in `cityscapes.read_label_map`, or else the table to read through. The PNG has
    ids of up to 16 bits, a palette (its numbers are the ids, its colours the colours), or colours.
    Raises InputError for what is not in the table.
    """
    if ids == LABEL_IDS:
        return read_label_map(path)
    has_colors, table = read_table(ids)
    values = read_color(path) @ RGB if has_colors else read_ids(path)
    labels_by_value = np.full(1 << 24, NOT_NAMED, np.uint8)
    labels_by_value[list(table)] = list(table.values())
    labels = labels_by_value[values]
    unknown = np.unique(values[labels == NOT_NAMED])[:10].tolist()
    if unknown:
        numbers = ", ".join(f"#{value:06x}" if has_colors else str(value) for value in unknown)
        raise InputError(f"{path}: holds {numbers}, which --ids {ids} does not name")
    return labels
