"""Pairs of images and label maps."""

import os
import shutil
import zlib
from types import SimpleNamespace

import cells
import cv2
import numpy as np
import pytest

from thesis_repro.data import cityscapes
from thesis_repro.errors import InputError


def test_ids_and_colours_are_those_of_cityscapes():
    assert [label.id for label in cityscapes.LABELS] == list(range(36))
    assert zlib.crc32(cityscapes.COLORS.tobytes()) == 1305786318


def test_the_class_weights_are_those_of_table_3_2():
    # the column of Table 3.2 adds up to 69.2; "background" (0.5) has no output
    assert cityscapes.CLASS_WEIGHTS.sum() == pytest.approx(68.7)


def test_both_layouts_give_the_same_pairs(tiny_cityscapes, tmp_path):
    flat = cityscapes.pairs(tiny_cityscapes, "train")
    official = tmp_path / "official"
    images, labels = official / "leftImg8bit/train/town", official / "gtFine/train/town"
    for folder in (images, labels):
        folder.mkdir(parents=True)
    for pair in flat:
        shutil.copy(pair.image, images / f"{pair.name}_leftImg8bit.png")
        shutil.copy(pair.label, labels / f"{pair.name}_gtFine_labelIds.png")
    pairs = cityscapes.pairs(official, "train")
    for read in (flat, pairs):
        assert [pair.name for pair in read] == [f"street_{index}" for index in range(4)]
    np.testing.assert_equal(cityscapes.load(flat, 16), cityscapes.load(pairs, 16))
    limited = cityscapes.pairs(official, "train", limit=2)
    assert [pair.name for pair in limited] == ["street_0", "street_2"]
    assert len(cityscapes.pairs(official, "train", limit=99)) == 4


def listed_by_lesson(root, split):
    """The images and label maps that notebook 1 lists."""
    names = {"os": os, "settings": SimpleNamespace(cityscapes=root)}
    for text in cells.cells(cells.named("01"), "code").values():
        if text.startswith(("def folders", "def listed")):
            exec(text, names)
    return names["listed"](split)


def test_what_a_mac_leaves_and_a_licence_are_no_data(tiny_cityscapes):
    """The package and notebook 1 list the same files."""
    town = {name: tiny_cityscapes / name / "train" / "town" for name in ("leftImg8bit", "gtFine")}
    for name, source in (("leftImg8bit", "train"), ("gtFine", "trainannot")):
        ending = "gtFine_labelIds" if name == "gtFine" else name
        town[name].mkdir(parents=True)
        for path in (tiny_cityscapes / source).iterdir():
            path.rename(town[name] / f"{path.stem}_{ending}.png")
        for path in [*town[name].iterdir()]:
            path.with_name(f"._{path.name}").write_bytes(b"copy")
        for extra in (".DS_Store", "license.txt", "town/.DS_Store"):
            (town[name].parent / extra).write_bytes(b"no data")
    pairs = cityscapes.pairs(tiny_cityscapes, "train")
    listed = [[str(path) for path in paths] for paths in zip(*(pair[1:] for pair in pairs))]
    assert len(pairs) == 4 and listed == [*listed_by_lesson(tiny_cityscapes, "train")]


def test_images_are_read_in_colour_or_gray(tiny_cityscapes):
    pairs = cityscapes.pairs(tiny_cityscapes, "train")
    cv2.imwrite(str(pairs[0].image), np.full((16, 32, 3), (10, 100, 200), np.uint8))
    images, labels = cityscapes.load(pairs, 16, channels=3)
    assert images.shape == (4, 16, 16, 3) and images[0, 5, 5].tolist() == [200, 100, 10]
    gray, same_labels = cityscapes.load(pairs, 16)
    assert gray.shape == (4, 16, 16, 1) and np.array_equal(labels, same_labels)
    assert set(np.unique(cityscapes.load(pairs, 48)[1])) == {7, 11, 23}  # resizing invents no label
    assert np.array_equal(images[1, ..., :1], gray[1])  # a gray file has three equal channels


def test_faults_are_named(tiny_cityscapes):
    cv2.imwrite(
        str(tiny_cityscapes / "trainannot" / "street_0.png"), np.full((16, 32), 35, np.uint8)
    )
    with pytest.raises(InputError, match="trainannot/street_0.png: label id 35"):
        cityscapes.load(cityscapes.pairs(tiny_cityscapes, "train"), 16)
    (tiny_cityscapes / "trainannot" / "street_2.png").unlink()
    for path in (tiny_cityscapes / "val").iterdir():
        path.unlink()
    for root, split, named in (
        (tiny_cityscapes / "nowhere", "train", "nowhere"),
        (tiny_cityscapes, "test", "test"),
        (tiny_cityscapes, "train", "train/street_2.png"),
        (tiny_cityscapes, "val", "val"),
    ):
        with pytest.raises(InputError, match=named):
            cityscapes.pairs(root, split)
