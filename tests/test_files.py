import os

import cv2
import numpy as np
import pytest

from thesis_repro import InputError
from thesis_repro.files import atomic, progress, read_gray, write_png

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)


def test_reads_back_what_was_written(tmp_path):
    write_png(tmp_path / "folder" / "a.png", IMAGE)
    assert np.array_equal(read_gray(tmp_path / "folder" / "a.png"), IMAGE)
    assert os.listdir(tmp_path / "folder") == ["a.png"]


@pytest.mark.parametrize("damage, says", [
    (lambda data: data[:-1], "truncated or corrupt"),
    (lambda data: data[:len(data) // 2], "truncated or corrupt"),
    (lambda data: data[:200] + b"????" + data[204:], "truncated or corrupt"),
    (lambda data: b"", "is empty"),
    (lambda data: b"hello", "not a PNG or JPEG image"),
])
def test_damaged_image_is_named(tmp_path, damage, says):
    path = tmp_path / "a.png"
    path.write_bytes(damage(cv2.imencode(".png", IMAGE)[1].tobytes()))
    with pytest.raises(InputError, match=f"a.png: .*{says}") as error:
        read_gray(path)
    assert "\n" not in str(error.value)


def test_missing_image_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere.png: no such image"):
        read_gray(tmp_path / "nowhere.png")


def test_a_failed_write_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_progress_goes_to_the_named_file(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROGRESS", str(tmp_path / "log"))
    monkeypatch.setattr("thesis_repro.files.BAR_DELAY", 0)
    assert list(progress(range(3), "counting")) == [0, 1, 2]
    assert "counting" in (tmp_path / "log").read_text()
