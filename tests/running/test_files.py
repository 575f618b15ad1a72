"""Files are written whole; images and label maps are read as they are, or refused by name."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from thesis_repro.data import cityscapes
from thesis_repro.errors import InputError
from thesis_repro.running import files, folders

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[:-1],
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda data: b"hello",
        lambda data: data[:200] + b"????" + data[204:] if data[:1] == b"\x89" else data[:200],
    ],
    ids=["end", "half", "empty", "text", "middle"],
)
@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_damaged_image_is_named(tmp_path, damage, ending):
    path = tmp_path / f"a.{ending}"
    path.write_bytes(damage(cv2.imencode(path.suffix, IMAGE)[1].tobytes()))
    with pytest.raises(InputError, match=f"{path}: ") as error:
        files.read_gray(path)
    assert "\n" not in str(error.value)


GRAY = Image.fromarray(np.where(IMAGE > 99, np.uint8(255), np.uint8(0)))


@pytest.mark.parametrize(
    "image, ids",
    [
        # three equal channels; transparency
        (GRAY.convert("RGB"), True),
        (Image.merge("LA", (GRAY, GRAY)), True),
        # the stored numbers are not the pixels
        (GRAY.convert("P"), False),
        (GRAY.convert("1"), False),
    ],
)
def test_other_kinds_of_gray_png_have_the_right_pixels(tmp_path, image, ids):
    path = tmp_path / "a.png"
    image.save(path)
    assert np.array_equal(files.read_gray(path), GRAY) and files.glance(path) == (40, 60)
    if ids:
        assert np.array_equal(files.read_ids(path), GRAY)
    else:
        with pytest.raises(InputError, match="a.png: "):
            files.read_ids(path)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_pixels_equal_opencvs(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    colours = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 256, (101, 67, 3), np.uint8), (0, 0), 2
    )
    for image in (colours, colours[..., 0]):
        cv2.imwrite(str(path), image)
        assert np.array_equal(files.read_gray(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        assert np.array_equal(files.read_color(path)[..., ::-1], cv2.imread(str(path)))


def test_too_little_memory_is_not_reported_as_damage(tmp_path, monkeypatch):
    files.write_png(tmp_path / "a.png", IMAGE)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: None)
    with pytest.raises(MemoryError):
        files.read_gray(tmp_path / "a.png")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), files.atomic(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_output_to_a_link_replaces_its_target(tmp_path):
    (tmp_path / "link").symlink_to("file")
    files.write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "file").read_text() == "new"


def test_output_to_streams_and_into_folders_of_results_is_refused(tmp_path):
    files.check_output(tmp_path / "a" / "b.txt")
    os.mkfifo(tmp_path / "pipe")
    files.write_text(tmp_path / "results" / folders.RECORD, "")
    for path in (
        tmp_path / "pipe",
        "-",
        "/dev/null",
        "/dev/stdout",
        tmp_path / "results" / "a" / "b.txt",
    ):
        with pytest.raises(InputError, match=f"{path}: "):
            files.check_output(Path(path))


def test_progress_is_written_to_the_named_file(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROGRESS", str(tmp_path / "log"))
    monkeypatch.setattr("thesis_repro.running.files.BAR_DELAY", 0)
    assert list(files.progress(range(3), "counting")) == [0, 1, 2]
    assert "counting" in (tmp_path / "log").read_text()


def test_progress_closes_the_named_file(tmp_path, monkeypatch):
    opened = []

    def noted(*arguments, **options):
        opened.append(open(*arguments, **options))  # noqa: SIM115  the bar closes it
        return opened[-1]

    monkeypatch.setenv("THESIS_REPRO_PROGRESS", str(tmp_path / "log"))
    monkeypatch.setattr(files, "open", noted, raising=False)
    with files.progress(None, "held", 3):
        list(files.progress(range(3), "ended"))
        next(iter(files.progress(range(3), "stopped")))
    assert [file.closed for file in opened] == [True] * 3


# Pairs of images and label maps


def test_the_class_weights_are_those_of_table_3_2():
    # the column of Table 3.2 adds up to 69.2; "background" (0.5) has no output
    assert cityscapes.CLASS_WEIGHTS.sum() == pytest.approx(68.7)


def test_both_layouts_give_the_same_pairs(tiny_cityscapes, tmp_path):
    flat = cityscapes.pairs(tiny_cityscapes, "train")
    official = tmp_path / "official"
    for pair in flat:
        for source, folder, end in (
            (pair.image, "leftImg8bit", "leftImg8bit"),
            (pair.label, "gtFine", "gtFine_labelIds"),
        ):
            target = official / folder / "train" / "town" / f"{pair.name}_{end}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read_bytes())
    pairs = cityscapes.pairs(official, "train")
    assert (
        [pair.name for pair in pairs]
        == [pair.name for pair in flat]
        == [f"street_{i}" for i in range(4)]
    )
    np.testing.assert_equal(cityscapes.load(flat, 16), cityscapes.load(pairs, 16))
    assert [pair.name for pair in cityscapes.pairs(official, "train", limit=2)] == [
        "street_0",
        "street_2",
    ]
    assert len(cityscapes.pairs(official, "train", limit=99)) == 4


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


def test_train_ids_become_label_ids(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.array([[*range(19), 255]], np.uint8))
    names = [
        cityscapes.LABELS[label].name
        for label in cityscapes.read_label_map(tmp_path / "a.png", True)[0]
    ]
    assert names == [*cityscapes.TRAINED, "unlabeled"]
    for train_ids, value in ((True, 19), (False, 255)):
        cv2.imwrite(str(tmp_path / "a.png"), np.array([[value]], np.uint8))
        with pytest.raises(InputError, match="a.png: .*--ids"):
            cityscapes.read_label_map(tmp_path / "a.png", train_ids)
