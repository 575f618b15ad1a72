"""Reading of images, atomic writing of files, and progress bars."""

import os
import re
import secrets
import stat
import struct
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TextIO

import cv2
import numpy as np
from PIL import Image, ImageFile, ImageOps
from tqdm import tqdm
from tqdm.utils import ObjectWrapper

from thesis_repro.errors import InputError
from thesis_repro.running import messages
from thesis_repro.running.folders import holds_results

# matches the names that `temporary_path` returns
TEMPORARY = re.compile(r"\..*\.thesis-repro-[0-9a-f]{8}(\.\w+)?")
BAR_DELAY = 1  # seconds before a progress bar appears
# the last bytes of a complete file
END_MARKS = {"PNG": b"\0\0\0\0IEND\xaeB`\x82", "JPEG": b"\xff\xd9"}
TAIL = 4096  # bytes at the end of a file in which `glance` looks for its end mark


def read_gray(path: str | Path) -> np.ndarray:
    """Read one image as 8-bit gray, shape (height, width). Colours become their luminance.

    Raises InputError if the file is not a complete PNG or JPEG image with 8 bits a channel, and if
    it claims more pixels than Pillow considers safe. JPEG has no checksums, so a changed byte
    inside a JPEG file goes unnoticed.
    """
    return _read(path, "L", cv2.IMREAD_GRAYSCALE)


def read_color(path: str | Path) -> np.ndarray:
    """Read one image as 8-bit red, green, blue, shape (height, width, 3).

    Raises what `read_gray` raises.
    """
    return _read(path, "RGB", cv2.IMREAD_COLOR)


def read_ids(path: str | Path) -> np.ndarray:
    """Read one PNG of numbers such as class ids, shape (height, width) uint8.

    No number is changed. Raises what `read_gray` raises, and InputError if reading as gray would
    change numbers: for a palette, fewer than 8 bits, channels that differ, or another format.
    """
    with _opened(path) as (_, image):
        # contains Pillow's name of the stored mode: "L;4" is gray with 4 bits
        stored = str(image.tile)
    read = read_gray if image.mode == "L" else read_color
    channels = np.atleast_3d(read(path))
    if (
        image.format != "PNG"
        or image.mode in ("1", "P")
        or "L;" in stored
        or (channels != channels[..., :1]).any()
    ):
        raise InputError(
            f"{path}: must be an 8-bit gray PNG, which keeps ids as they are; convert it"
        )
    return np.ascontiguousarray(channels[..., 0])


def glance(path: str | Path) -> tuple[int, int]:
    """Return the size (height, width) of an image, and check that the file has its end.

    Only the header is read. Nothing is decoded, so this is fast. Raises InputError as `read_gray`
    does, except for damage in the middle.
    """
    with _opened(path) as (file, image):
        end_mark = END_MARKS["PNG" if image.format == "PNG" else "JPEG"]
        size = os.fstat(file.fileno()).st_size
        file.seek(-min(TAIL, size), os.SEEK_END)
        if end_mark not in file.read():
            read_gray(path)  # some cameras and tools append bytes after the end mark
        return image.size[::-1]


def _read(path: str | Path, mode: str, flag: int) -> np.ndarray:
    with _opened(path) as (file, image):
        if image.format != "PNG":
            image.draft(mode, image.size)  # decodes gray directly, as OpenCV does
            return np.array(ImageOps.exif_transpose(image).convert(mode))
        image.verify()  # compares the checksums, which the decoders of OpenCV and Pillow ignore
        file.seek(0)
        data = file.read()
        if END_MARKS["PNG"] not in data:
            raise OSError
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flag)  # faster than Pillow's decoder
        if pixels is None:
            Image.open(file).load()  # raises if the file is damaged; OpenCV gives no reason
            raise MemoryError
        if mode == "RGB":
            return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
        return pixels


@contextmanager
def _opened(path: str | Path) -> Iterator[tuple[BinaryIO, ImageFile.ImageFile]]:
    """Open an image file and read its header: yields (file, image).

    Turns all errors of the block into InputError.
    """
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise InputError(f"{path}: is not a file; name an image file")
            image = Image.open(file, formats=tuple(END_MARKS))
            if ";16" in str(image.tile):
                raise InputError(f"{path}: has 16 bits a channel; convert it to 8 bits a channel")
            yield file, image
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(f"{path}: claims more pixels than any camera has; remove it") from None
    except cv2.error as error:  # such as a limit that OPENCV_IO_MAX_IMAGE_PIXELS sets
        raise InputError(f"{path}: cannot be read: OpenCV: {error.err}") from None
    except (
        OSError,
        SyntaxError,
        ValueError,
        EOFError,
        IndexError,
        struct.error,
    ) as error:
        reason = (
            getattr(error, "strerror", None)
            or "it is not a complete PNG or JPEG image; copy it again"
        )
        raise InputError(f"{path}: cannot be read: {reason}") from None


def listed(folder: str | Path, pattern: str = "*.png") -> list[Path]:
    """Return the files of a folder that match a pattern, in sorted order.

    Hidden (temporary) files are left out. Raises InputError if a folder may not be listed, because
    its files would silently be missing.
    """
    folders = [Path(folder)]
    if "/" in pattern:
        folders += Path(folder).glob(pattern.rpartition("/")[0])
    for place in folders:
        check_readable(place)
    return sorted(path for path in Path(folder).glob(pattern) if not path.name.startswith("."))


def check_readable(folder: Path, access: int = os.R_OK | os.X_OK) -> None:
    """Raise InputError for a folder whose files this user may not list (R_OK) or open (X_OK)."""
    if os.path.isdir(folder) and not os.access(folder, access):
        raise InputError(f"{folder}: may not be read; change its permissions (chmod u+rx)")


def images(folder: str | Path) -> list[Path]:
    """Return the PNG or JPEG images of a folder, sorted by name with 9 before 10.

    Hidden files are left out. Raises InputError if the folder holds both kinds.
    """
    pngs, jpegs = [], []
    for path in listed(folder, "*"):
        if path.suffix.lower() == ".png":
            pngs.append(path)
        elif path.suffix.lower() in (".jpg", ".jpeg"):
            jpegs.append(path)
    if pngs and jpegs:
        raise InputError(f"{folder}: holds PNG and JPEG images; move those of one kind away")
    return sorted(pngs or jpegs, key=_natural_order)


def _natural_order(path: Path) -> tuple[list[tuple[str, int]], Path]:
    """Return a key that sorts names with 9 before 10."""
    pieces = re.findall(r"(\D*)(\d*)", path.stem)
    return [(letters, int(digits or -1)) for letters, digits in pieces], path


def numbers_of(paths: Iterable[Path]) -> list[int] | None:
    """Return the integers at the ends of file names.

    Returns None if a name has none or the names start differently.
    """
    numbers, starts = [], set()
    for path in paths:
        match = re.fullmatch(r"(.*?)(\d+)", path.stem)
        if match is None:
            return None
        starts.add(match[1])
        numbers.append(int(match[2]))
    if len(starts) > 1:
        return None
    return numbers


def is_whole(path: str | Path) -> bool:
    """Return whether a file is an image with a valid header and end (see `glance`)."""
    try:
        return bool(glance(path))
    except InputError:
        return False


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path, and rename it to `path` when the block ends.

    It is deleted if the block raises an error. A symbolic link is kept and its target is replaced;
    in a folder of results, the link is.
    """
    path = Path(path)
    target = path
    if path.is_symlink() and not any(map(holds_results, path.absolute().parents)):
        target = path.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_path(target)
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_WRONLY, 0o666))
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())  # otherwise a crash of the system could leave an empty file
        os.replace(temporary, target)
    except Exception as error:
        number, name = messages.number_of(error), getattr(error, "filename", None)
        if number is None or name not in (None, str(temporary), temporary):
            raise
        # instead of the temporary name or none
        raise OSError(number, os.strerror(number), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def temporary_path(path: Path) -> Path:
    """Return a temporary path beside `path`, with a random name that nobody can predict."""
    ending = path.suffix if re.fullmatch(r"\.\w{1,8}", path.suffix) else ""
    return path.with_name(f".{path.stem[:40]}.thesis-repro-{secrets.token_hex(4)}{ending}")


def check_output(path: Path) -> None:
    """Raise InputError if a file cannot be written to `path`.

    Also if it could be moved away later with results around it.
    """
    # renaming a file cannot replace a device, a pipe or an open stream
    is_stream = str(path).startswith(("/dev/std", "/dev/fd/", "/proc/")) or path.name == "-"
    folders = (path.resolve() if path.is_symlink() else path.absolute()).parents
    parent = next(folder for folder in folders if folder.exists())
    is_file = path.is_file() or not path.exists()
    if is_stream or not is_file or not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(
            f"{path}: cannot be written; name a file in a folder that you may write to"
        )
    try:
        str(path).encode()
    except UnicodeEncodeError:  # OpenCV would crash
        raise InputError(f"{path}: is no UTF-8; choose another name") from None
    if any(map(holds_results, folders)):
        raise InputError(
            f"{path}: is in a folder of results, with which it could be moved; name a file elsewhere"
        )


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
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: does not exist yet; run notebook {notebook} first")
    return path


def progress(
    iterable: Iterable | None = None,
    description: str = "",
    total: int | None = None,
    unit: str = "frame",
    initial: int = 0,
) -> tqdm:
    """Return a tqdm progress bar on standard error.

    It is on the file that THESIS_REPRO_PROGRESS names, if that is set: `make figures` sets
    it to its terminal for the bars inside notebooks. Without a terminal, the bar is replaced by a
    line every 20 seconds.
    """
    own_file = None
    with suppress(KeyError, OSError):
        # the bar closes it
        own_file = open(os.environ["THESIS_REPRO_PROGRESS"], "a", buffering=1)  # noqa: SIM115
    stream = own_file or sys.stderr
    options: dict[str, Any] = {"file": _Lines(stream), "mininterval": 20, "ascii": True}
    if stream.isatty():
        options = {"file": stream, "mininterval": 0.2, "dynamic_ncols": True, "leave": False}
    bar = _Bar(
        iterable,
        desc=description,
        total=total,
        unit=unit,
        initial=initial,
        delay=BAR_DELAY,
        smoothing=0,  # the average over the whole time predicts better than the last steps
        **options,
    )
    bar.own_file = own_file
    return bar


class _Bar(tqdm):
    """A bar that closes the file which was opened for it."""

    own_file: TextIO | None = None

    def close(self) -> None:
        """Clear or leave the bar."""
        super().close()
        if self.own_file:
            self.own_file.close()


class _Lines(ObjectWrapper):
    """A file that turns the carriage returns of tqdm into lines."""

    def write(self, text: str) -> None:
        if text.strip():
            self._wrapped.write(text.strip() + "\n")
