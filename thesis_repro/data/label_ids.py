"""Label maps with other ids or colours than Cityscapes' label ids, read through a table.

Cityscapes' train ids and colours are known by name. Another table is a CSV file with a line for
each id (34,building) or for each colour (#464646,building). The names are those of
`cityscapes.LABELS`; what is no class is "unlabeled".
"""

import csv
import re
from pathlib import Path

import numpy as np

from thesis_repro.data.cityscapes import COLORS, ID, N_CLASSES, TRAINED, read_label_map
from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError
from thesis_repro.running.files import read_color, read_ids
from thesis_repro.running.provenance import digest_of_file

LABEL_IDS = "labels"  # Cityscapes' own, which need no table
NAMES = LABEL_IDS, "train", "colors"  # what --ids knows beside files
NOT_NAMED = 255  # no label id
LARGEST = {False: 0xFFFF, True: 0xFFFFFF}  # id of 16 bits, and colour
RGB = np.array([1 << 16, 1 << 8, 1])  # makes one number of a colour


def read_table(ids: str | Path) -> tuple[bool, dict[int, int]]:
    """Return (whether it names colours, {id or colour as one number: label id}) of a table.

    ids: its name or file. Raises InputError, naming the line, for a line that is not an id or a
    colour and a label.
    """
    if ids == "train":
        train_ids = {number: ID[name] for number, name in enumerate(TRAINED)}
        return False, train_ids | {255: ID["unlabeled"]}
    if ids == "colors":
        colors: dict[int, int] = {}
        for label, value in enumerate((COLORS[:N_CLASSES] @ RGB).tolist()):
            colors.setdefault(value, label)  # of labels that share a colour, the first one
        return True, colors
    path = Path(ids)
    if not path.exists():
        raise InputError(f"--ids {ids}: must be {', '.join(NAMES)}, or a file, which is not there")
    lines = read_text(path).split("\n")
    table: dict[int, int] = {}
    kinds = set()
    for number, row in enumerate(csv.reader(lines), 1):
        if not row or row[0] in ("id", "color"):
            continue
        try:
            key, name = map(str.strip, row)
            is_color = re.fullmatch("#[0-9a-fA-F]{6}", key) is not None
            value = int(key.removeprefix("#"), 16) if is_color else int(key)
            label = ID[name]
        except (ValueError, KeyError):
            raise InputError(
                f"{path}, line {number}: must hold an id or a colour of six digits (#464646), a comma and "
                f"one of {', '.join(ID)}"
            ) from None
        kinds.add(is_color)
        if value in table or len(kinds) > 1 or not -1 <= value <= LARGEST[is_color]:
            raise InputError(
                f"{path}, line {number}: {key} must stand there once, be at most {LARGEST[False]}, and "
                "either all lines name ids or all name colours"
            )
        table[value] = label
    return True in kinds, table


def record(ids: str | Path) -> dict[str, str]:
    """Return what the record of results has of a table: its name, or the digest of its file."""
    if ids == LABEL_IDS:
        return {}
    return {"table": str(ids) if ids in NAMES else digest_of_file(Path(ids))}


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
