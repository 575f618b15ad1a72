import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from thesis_repro import InputError, longrun
from thesis_repro.files import (
    atomic,
    check_output,
    glance,
    progress,
    read_color,
    read_gray,
    read_ids,
    write_png,
    write_text,
)

IMAGE = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)


def test_reads_back_what_was_written(tmp_path):
    write_png(tmp_path / "folder" / "a.png", IMAGE)
    assert np.array_equal(read_gray(tmp_path / "folder" / "a.png"), IMAGE)
    assert os.listdir(tmp_path / "folder") == ["a.png"]


@pytest.mark.parametrize("damage", [
    lambda data: data[:-1], lambda data: data[:len(data) // 2], lambda data: b"", lambda data: b"hello",
    lambda data: data[:200] + b"????" + data[204:] if data[:1] == b"\x89" else data[:200]],
    ids=["end", "half", "empty", "text", "middle"])
@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_damaged_image_is_named(tmp_path, damage, ending):
    path = tmp_path / f"a.{ending}"
    path.write_bytes(damage(cv2.imencode(path.suffix, IMAGE)[1].tobytes()))
    with pytest.raises(InputError, match=f"{path}: ") as error:
        read_gray(path)
    assert "\n" not in str(error.value)


def png(rows, width, height, bits, colour, interlaced=0, palette=b""):
    """A PNG file of any kind from its rows of bytes."""
    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, interlaced)
    chunks = [(b"IHDR", head), *([(b"PLTE", palette)] if palette else []),
              (b"IDAT", zlib.compress(b"".join(b"\0" + bytes(row) for row in rows))), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, content) for kind, content in chunks)


def interlaced(image):
    """Its rows in the seven passes of Adam7."""
    passes = ((0, 8, 0, 8), (0, 8, 4, 8), (4, 8, 0, 4), (0, 4, 2, 4), (2, 4, 0, 2), (0, 2, 1, 2), (1, 2, 0, 1))
    return [row.tobytes() for top, down, left, across in passes for row in image[top::down, left::across] if row.size]


GRAYS = bytes(value for value in range(256) for _ in range(3))


@pytest.mark.parametrize("data, ids", [
    (png(interlaced(IMAGE), 60, 40, 8, 0, interlaced=1), True),
    (png(IMAGE, 60, 40, 8, 3, palette=GRAYS), False),  # of its colours; numbers are not those of a palette
    (png(np.repeat(IMAGE, 3, axis=1), 60, 40, 8, 2), True),  # three equal channels
    (png(np.dstack([IMAGE, np.full_like(IMAGE, 9)]).reshape(40, 120), 60, 40, 8, 4), True),
], ids=["interlaced", "palette", "colours", "transparency"])
def test_harmless_kinds_of_png_have_the_right_pixels(tmp_path, data, ids):
    path = tmp_path / "a.png"
    path.write_bytes(data)
    assert np.array_equal(read_gray(path), IMAGE) and glance(path) == (40, 60)
    if ids:
        assert np.array_equal(read_ids(path), IMAGE)
    else:
        with pytest.raises(InputError, match="a.png: "):
            read_ids(path)


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_pixels_are_those_of_opencv(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    colours = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (101, 67, 3), np.uint8), (0, 0), 2)
    for image in (colours, colours[..., 0]):
        cv2.imwrite(str(path), image)
        assert np.array_equal(read_gray(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        assert np.array_equal(read_color(path)[..., ::-1], cv2.imread(str(path)))


def test_too_little_memory_is_not_taken_for_damage(tmp_path, monkeypatch):
    write_png(tmp_path / "a.png", IMAGE)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: None)
    with pytest.raises(MemoryError):
        read_gray(tmp_path / "a.png")


def test_one_bit_is_black_and_white(tmp_path):
    (tmp_path / "mask.png").write_bytes(png([[0b10100000], [0b01100000]], 3, 2, 1, 0))
    assert np.array_equal(read_gray(tmp_path / "mask.png"), [[255, 0, 255], [0, 255, 255]])


def test_a_failed_write_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic(path) as temporary:
        temporary.write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_links_are_followed_and_streams_written_to(tmp_path, capsysbinary):
    (tmp_path / "link").symlink_to("file")
    write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "file").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    with open(os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)) as pipe:
        write_text(tmp_path / "pipe", "through")
        assert pipe.read() == "through" and (tmp_path / "pipe").is_fifo()
    for name in ("-", "/dev/stdout"):
        write_text(name, "printed")
    assert capsysbinary.readouterr().out == b"printedprinted"
    assert sorted(os.listdir(tmp_path)) == ["file", "link", "pipe"]
    with pytest.raises(InputError, match="pipe: "):
        read_gray(tmp_path / "pipe")


def test_a_result_is_no_place_for_other_output(tmp_path):
    check_output(tmp_path / "a" / "b.txt")
    check_output(tmp_path / "-")
    (tmp_path / longrun.RECORD).touch()
    with pytest.raises(InputError, match="b.txt: "):
        check_output(tmp_path / "a" / "b.txt")


def test_progress_goes_to_the_named_file(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROGRESS", str(tmp_path / "log"))
    monkeypatch.setattr("thesis_repro.files.BAR_DELAY", 0)
    assert list(progress(range(3), "counting")) == [0, 1, 2]
    assert "counting" in (tmp_path / "log").read_text()
