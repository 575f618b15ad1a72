"""Files are written whole; images and label maps are read as they are, or refused by name."""

import errno
import os

import cv2
import numpy as np
import pytest
from PIL import Image

from thesis_repro.errors import InputError
from thesis_repro.running import files

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data[: len(data) // 2],
        lambda data: b"",
        lambda data: b"hello",
        lambda data: data[:200] + b"????" + data[204:] if data[:1] == b"\x89" else data[:200],
    ],
    ids=["half", "empty", "text", "middle"],
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
        (GRAY.convert("RGB"), GRAY),
        (Image.merge("LA", (GRAY, GRAY)), GRAY),  # with transparency
        (GRAY.convert("P"), GRAY),  # a palette
        (GRAY.convert("1"), GRAY.point(lambda gray: gray > 0)),  # the numbers are 0 and 1
    ],
)
def test_other_kinds_of_gray_png_have_the_right_pixels(tmp_path, image, ids):
    path = tmp_path / "a.png"
    image.save(path)
    assert np.array_equal(files.read_gray(path), GRAY)
    assert np.array_equal(files.read_ids(path), ids)
    cv2.imwrite(str(path), IMAGE.astype(np.uint16))
    assert np.array_equal(files.read_ids(path), IMAGE)
    with pytest.raises(InputError, match="a.png: .*16 bits"):
        files.read_gray(path)
    cv2.imwrite(str(path), np.dstack([IMAGE, IMAGE, 255 - IMAGE]))
    with pytest.raises(InputError, match="a.png: .*--ids"):
        files.read_ids(path)


def test_images_are_listed_by_number_and_of_one_kind(tmp_path):
    for name in ("10.png", "9.png", ".hidden.png", "text.txt"):
        (tmp_path / name).touch()
    paths = files.images(tmp_path)
    assert [path.name for path in paths] == ["9.png", "10.png"]
    (tmp_path / "11.JPG").touch()
    with pytest.raises(InputError, match=f"{tmp_path}: "):
        files.images(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), files.atomic(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("named", [False, True])
def test_a_full_disk_names_the_file_and_not_the_temporary_file(tmp_path, named):
    with (
        pytest.raises(OSError, match="a.txt") as caught,
        files.atomic(tmp_path / "a.txt") as temporary,
    ):
        raise OSError(errno.ENOSPC, "No space left", str(temporary) if named else None)
    assert caught.value.filename == str(tmp_path / "a.txt") and list(tmp_path.iterdir()) == []


def test_a_temporary_name_is_short_and_recognised(tmp_path):
    for name in ("a.txt", "a.", f"a.{'n' * 253}", f"{'n' * 251}.txt", "a.b-c", "é" * 127):
        files.write_text(tmp_path / name, "text")
        temporary = files.temporary_path(tmp_path / name)
        assert files.TEMPORARY.fullmatch(temporary.name) and len(os.fsencode(temporary.name)) < 255


def test_no_time_is_estimated_from_the_first_step():
    """It also compiles: from the first of 100 batches in six minutes, two hours were said."""
    bar = files.progress(None, "label maps", 500, initial=40)
    for step in range(4):
        assert ("<?," in str(bar)) == (step < 2)
        bar.start_t -= 60  # seconds that the step took
        bar.update(16)
    bar.close()


def test_progress_is_written_to_the_named_file(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROGRESS", str(tmp_path / "log"))
    monkeypatch.setattr("thesis_repro.running.files.DELAY", 0)
    assert list(files.progress(range(3), "counting")) == [0, 1, 2]
    assert "counting" in (tmp_path / "log").read_text()
