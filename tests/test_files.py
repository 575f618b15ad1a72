import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from thesis_repro import InputError, console, files
from thesis_repro.files import (
    atomic,
    check_output,
    glance,
    progress,
    read_color,
    read_gray,
    read_ids,
    write_png,
)

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
        read_gray(path)
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
    assert np.array_equal(read_gray(path), GRAY) and glance(path) == (40, 60)
    if ids:
        assert np.array_equal(read_ids(path), GRAY)
    else:
        with pytest.raises(InputError, match="a.png: "):
            read_ids(path)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_pixels_equal_opencvs(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    colours = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 256, (101, 67, 3), np.uint8), (0, 0), 2
    )
    for image in (colours, colours[..., 0]):
        cv2.imwrite(str(path), image)
        assert np.array_equal(read_gray(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        assert np.array_equal(read_color(path)[..., ::-1], cv2.imread(str(path)))


def test_too_little_memory_is_not_reported_as_damage(tmp_path, monkeypatch):
    write_png(tmp_path / "a.png", IMAGE)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: None)
    with pytest.raises(MemoryError):
        read_gray(tmp_path / "a.png")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_output_to_a_link_replaces_its_target(tmp_path):
    (tmp_path / "link").symlink_to("file")
    files.write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "file").read_text() == "new"


def test_output_to_streams_and_into_folders_of_results_is_refused(tmp_path):
    check_output(tmp_path / "a" / "b.txt")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / console.RECORD).touch()
    for path in (tmp_path / "pipe", "-", "/dev/stdout", tmp_path / "results" / "a" / "b.txt"):
        with pytest.raises(InputError, match=f"{path}: "):
            check_output(Path(path))


def test_progress_is_written_to_the_named_file(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROGRESS", str(tmp_path / "log"))
    monkeypatch.setattr("thesis_repro.files.BAR_DELAY", 0)
    assert list(progress(range(3), "counting")) == [0, 1, 2]
    assert "counting" in (tmp_path / "log").read_text()
