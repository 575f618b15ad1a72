"""Label maps with other ids or colours, and tables of them."""

import cv2
import numpy as np
import pytest
from PIL import Image

from thesis_repro.data import label_ids
from thesis_repro.data.cityscapes import COLORS, ID, LABELS, TRAINED
from thesis_repro.errors import InputError

IDS = np.repeat([[7, 11], [34, 300]], 3, axis=0).astype(np.uint16)
NAMES = {7: "road", 11: "building", 34: "building", 300: "unlabeled"}
EXPECTED = np.array([[ID[NAMES[value]] for value in row] for row in IDS.tolist()], np.uint8)


def table(folder, rows):
    path = folder / "ids.csv"
    path.write_text("id,name\n" + "".join(f"{key}, {name}\n" for key, name in rows))
    return path


def test_ids_are_read_through_a_table(tmp_path):
    path, ids = tmp_path / "a.png", table(tmp_path, NAMES.items())
    cv2.imwrite(str(path), IDS)  # 16 bits
    assert np.array_equal(label_ids.read(path, ids), EXPECTED)
    small = np.minimum(IDS, 255).astype(np.uint8)
    palette = Image.fromarray(small, "P")
    palette.putpalette([number % 251 for number in range(768)])
    palette.save(path)
    with pytest.raises(InputError, match=r"a.png: holds 255, which .*ids.csv does not name"):
        label_ids.read(path, ids)
    ids = table(tmp_path, [*NAMES.items(), (255, "unlabeled")])
    assert np.array_equal(label_ids.read(path, ids), EXPECTED)
    cv2.imwrite(str(path), np.dstack([small] * 3))  # equal channels
    assert np.array_equal(label_ids.read(path, ids), EXPECTED)


def test_train_ids_and_colours_are_known_by_name(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.array([[*range(19), 255]], np.uint8))
    named = [LABELS[label].name for label in label_ids.read(path, "train")[0]]
    assert named == [*TRAINED, "unlabeled"]
    names = ["road", "car", "sky", "pole", "unlabeled"]  # three of which share their colour
    labels = np.array([[ID[name] for name in names]], np.uint8)
    cv2.imwrite(str(path), COLORS[labels][..., ::-1])
    assert np.array_equal(label_ids.read(path, "colors"), labels)
    rows = [("#{:02x}{:02x}{:02x}".format(*COLORS[ID[name]]), name) for name in names]
    assert np.array_equal(label_ids.read(path, table(tmp_path, rows)), labels)
    with pytest.raises(InputError, match="holds #804080, which"):
        label_ids.read(path, table(tmp_path, rows[1:]))
    with pytest.raises(InputError, match="--ids colors"):
        label_ids.read(path, table(tmp_path, NAMES.items()))
    with pytest.raises(
        InputError, match="--ids mapilary: must be labels, train, colors, or a file"
    ):
        label_ids.read(path, "mapilary")


@pytest.mark.parametrize("other, advice", [(18, "--ids train"), (26, "255,unlabeled")])
def test_the_advice_for_255_among_label_ids_is_one_that_reads_it(tmp_path, other, advice):
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[7, other, 255]], np.uint8))
    with pytest.raises(InputError, match=f"a.png: label id 255.*{advice}"):
        label_ids.read(tmp_path / "a.png")


@pytest.mark.parametrize(
    "lines, line",
    [
        ("7,road\n8", 2),
        ("7,road\n8,street", 2),
        ("7,road\nx,sky", 2),
        ("#464646ff,building", 1),  # with alpha
        ("#464646,building\n#80408080,road", 2),
        ("#444,building", 1),
        ("#4646_6,building", 1),
        ("7,road\n11,building\n7,sky", 3),
        ("#464646,road\n#464646,building", 2),
        ("7,road\n#464646,building", 2),
        ("65536,road", 1),
        ("-2,road", 1),
    ],
)
def test_a_line_that_cannot_be_meant_is_named(tmp_path, lines, line):
    path = tmp_path / "table.csv"
    path.write_text(lines)
    with pytest.raises(InputError, match=f"table.csv, line {line}: "):
        label_ids.read_table(path)


def test_colours_and_ids(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("color,name\n#464646,building\n#80408A,road\n")
    assert label_ids.read_table(path) == (True, {0x464646: 11, 0x80408A: 7})
    path.write_text("-1,unlabeled\n65535,sky\n")  # Cityscapes' own list has -1
    assert label_ids.read_table(path) == (False, {-1: 0, 65535: 23})
