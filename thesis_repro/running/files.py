"""Reading of images, writing of whole files, and progress bars."""

import os
import re
import secrets
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
from PIL import Image
from tqdm import tqdm

from thesis_repro.errors import InputError
from thesis_repro.running import program

# matches the names that `temporary_path` returns
TEMPORARY = re.compile(r"\..*\.thesis-repro-[0-9a-f]{8}(\..*)?")
DELAY = 1  # seconds before a progress bar appears


def read_gray(path: str | Path, largest: type = np.uint8) -> np.ndarray:
    """Read one image as gray, shape (height, width), uint8. Colours become their luminance.

    largest: of the types of numbers that are allowed. Raises InputError if the file is not a
    complete image of such numbers.
    """
    return _decoded(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH, largest)


def read_color(path: str | Path, largest: type = np.uint8) -> np.ndarray:
    """Read one image as red, green, blue, shape (height, width, 3), uint8.

    largest: of the types of numbers, and errors, as of `read_gray`.
    """
    pixels = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH, largest)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def read_unchanged(path: str | Path) -> np.ndarray:
    """Read one image with all its channels: (height, width), or blue, green, red and alpha last.

    Its numbers are those of the file. Raises InputError if it is not a complete image.
    """
    return _decoded(path, cv2.IMREAD_UNCHANGED, np.float64)


def read_ids(path: str | Path) -> np.ndarray:
    """Read one PNG of numbers such as class ids, shape (height, width), uint8 or uint16.

    No number is changed; those of a palette are its indices. Raises InputError if the file is not a
    complete PNG, or has channels that differ.
    """
    channels = np.atleast_3d(_decoded(path, cv2.IMREAD_UNCHANGED, np.uint16))
    with Image.open(path) as image:
        if image.mode in ("1", "P"):  # OpenCV gives colours for the numbers
            channels = np.asarray(image)[..., None].astype(np.uint8)
        if image.format != "PNG" or (channels[..., :3] != channels[..., :1]).any():
            raise InputError(
                f"{path}: must be a PNG of ids; convert it, or read colours with --ids colors or FILE"
            )
    return channels[..., 0]


def _decoded(path: str | Path, flag: int, largest: type) -> np.ndarray:
    """Decode an image. OpenCV checks PNG's checksums and the end of both formats."""
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), flag)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except cv2.error:  # an empty file
        pixels = None
    if pixels is None and Path(path).suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise InputError(f"{path}: is no image; write a PNG image for each frame")
    if pixels is None:
        raise InputError(f"{path}: is not a complete PNG or JPEG image; copy it again")
    if not np.can_cast(pixels.dtype, largest):
        raise InputError(f"{path}: has 16 bits a channel; convert it to 8 bits a channel")
    return pixels


# Listing


def listed(folder: str | Path, pattern: str = "*.png") -> list[Path]:
    """Return the files of a folder that match a pattern, in sorted order, without hidden ones."""
    return sorted(path for path in Path(folder).glob(pattern) if not path.name.startswith("."))


def images(folder: str | Path) -> list[Path]:
    """Return the PNG or JPEG images of a folder, sorted by name with 9 before 10.

    Hidden files are left out. Raises InputError if the folder holds both kinds.
    """
    paths = listed(folder, "*")
    pngs = [path for path in paths if path.suffix.lower() == ".png"]
    jpegs = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg")]
    if pngs and jpegs:
        raise InputError(f"{folder}: holds PNG and JPEG images; move those of one kind away")
    return sorted(pngs or jpegs, key=_natural_order)


def _natural_order(path: Path) -> tuple[list[tuple[str, int]], Path]:
    """Return a key that sorts names with 9 before 10."""
    pieces = re.findall(r"(\D*)(\d*)", path.stem)
    return [(letters, int(digits or -1)) for letters, digits in pieces], path


# Writing


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path, and rename it to `path` when the block ends.

    It is deleted if the block raises an error. The target of a symbolic link is replaced.
    """
    target = Path(path).resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(target)
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        if error.errno:
            error.filename = str(path)  # what the user knows, not the temporary name
        raise
    finally:
        temporary.unlink(missing_ok=True)


def temporary_path(path: Path) -> Path:
    """Return a temporary path beside `path`, hidden and with a random name."""
    return path.with_name(f".{path.stem[:40]}.thesis-repro-{secrets.token_hex(4)}{path.suffix[:8]}")


def write_text(path: str | Path, text: str) -> None:
    r"""Write a text as UTF-8. A byte of a file's name that is not UTF-8 is written as \udcff."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write one 8-bit image, (height, width) or (height, width, 3) as BGR."""
    data = cv2.imencode(".png", image)[1]  # cv2.imwrite does not notice a full disk
    with atomic(path) as temporary:
        temporary.write_bytes(data)


def write_array(path: str | Path, array: np.ndarray) -> None:
    """Write a numpy array as .npy."""
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.save(file, array)


def needed(path: str | Path, notebook: str) -> Path:
    """Return `path`, which an earlier notebook writes.

    Raises InputError with the notebook's name if it is missing.
    """
    if not Path(path).exists():
        raise InputError(f"{path}: does not exist yet; run notebook {notebook} first")
    return Path(path)


# Progress


def _unstopped(items: Iterable) -> Iterator[Any]:
    """Yield items for steps that a signal to stop does not break."""
    for item in items:
        with program.unstopped():
            yield item


class _Bar(tqdm):
    first = 0  # how many items had been done when the bar first moved

    def __iter__(self) -> Iterator[Any]:
        return _unstopped(super().__iter__())

    @property
    def format_dict(self) -> dict[str, Any]:
        values = super().format_dict
        done = values["n"] - values["initial"]
        self.first = self.first or done
        if done <= self.first:  # the first step also compiles, so it says nothing of the others
            values["rate"] = 0
        return values


def progress(
    iterable: Iterable | None = None,
    description: str | None = "",
    total: int | None = None,
    unit: str = "frame",
    initial: int = 0,
) -> Any:
    """Return a tqdm progress bar on standard error; without a description, only the items.

    THESIS_REPRO_PROGRESS may name another file: `make figures` names its terminal, for the bars
    inside notebooks. Ctrl-C waits for the end of a step of the loop.
    """
    if iterable is not None and description is None:
        return _unstopped(iterable)
    options: dict[str, Any] = {
        "file": sys.stderr,
        "mininterval": 0.2,
        "leave": False,
        "delay": DELAY,
    }
    if type(sys.stderr).__module__ == "ipykernel.iostream":  # a notebook shows it as an error
        options["file"] = sys.stdout
    other = os.environ.get("THESIS_REPRO_PROGRESS")
    if other:
        options["file"] = _opened(other)
    if not options["file"].isatty():  # a log
        options["mininterval"] = 20
    return _Bar(iterable, description, total, unit=unit, initial=initial, **options)


@cache
def _opened(name: str) -> TextIO:
    """Open a file for the bars of this process."""
    return open(name, "a", buffering=1)
