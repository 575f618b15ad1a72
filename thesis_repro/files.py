"""Reading images, writing files whole or not at all, and showing progress."""

import os
import re
import struct
import sys
import zlib
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from thesis_repro import InputError, longrun

BAR_DELAY = 1  # seconds before a bar shows: what is over sooner needs none
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START, JPEG_SCAN, JPEG_END = b"\xff\xd8", b"\xff\xda", b"\xff\xd9"
IMAGES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}


def read_gray(path):
    """Read one image as 8-bit gray, shape (height, width); colours become their luminance.

    Raises InputError when the file is missing, empty, truncated, corrupt or no image. (What changed inside a JPEG
    cannot be noticed: it has no checksums.)
    """
    return _read(path, cv2.IMREAD_GRAYSCALE)


def read_color(path):
    """Read one image as 8-bit red, green, blue, shape (height, width, 3). Raises what `read_gray` raises."""
    return cv2.cvtColor(_read(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _read(path, flag):
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such image; check the folder it should be in") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from None
    if (data.startswith(PNG_SIGNATURE) and not _png_is_whole(data)
            or data.startswith(JPEG_START) and not _jpeg_is_whole(data)):
        raise InputError(f"{path}: the image is truncated or corrupt; copy or download it again")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flag) if data else None
    if image is None:
        raise InputError(f"{path}: not an image that OpenCV can read; copy or download it again")
    return image


def _png_is_whole(data):
    # OpenCV fills the missing rows of a damaged PNG and says nothing, so the chunks' checksums are read here.
    position = len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack(">I", data[position:position + 4])
        end = position + 12 + length
        if end > len(data):
            return False
        body = data[position + 4:end - 4]
        if zlib.crc32(body) != struct.unpack(">I", data[end - 4:end])[0]:
            return False
        if body[:4] == b"IEND":
            return True
        position = end
    return False


def _jpeg_is_whole(data):
    # OpenCV fills the missing rows of a cut JPEG with gray. The end's marker cannot stand among the pixels' bytes, but
    # may in a preview that a camera puts before them, so the segments before the first scan are stepped over.
    position = len(JPEG_START)
    while position + 4 <= len(data):
        if data[position:position + 2] == JPEG_SCAN:
            return JPEG_END in data[position:]
        (length,) = struct.unpack(">H", data[position + 2:position + 4])
        position += 2 + length
    return False


def listed(folder, pattern="*.png"):
    """Files of a folder that match, sorted; hidden ones are left out: a killed run may leave a half-written one."""
    return sorted(path for path in Path(folder).glob(pattern) if not path.name.startswith("."))


def images(folder):
    """The PNG or JPEG images of a folder, in the order of the numbers that their names end in, or else of the names.

    Hidden ones are left out. Raises InputError where there are both kinds.
    """
    found = [path for path in listed(folder, "*") if path.suffix.lower() in IMAGES]
    if len({IMAGES[path.suffix.lower()] for path in found}) > 1:
        raise InputError(f"{folder}: holds PNG and JPEG images; one folder must hold one kind, so move the others away")
    numbers = numbers_of(found)
    return found if numbers is None else [path for _, path in sorted(zip(numbers, found))]


def numbers_of(paths):
    """The numbers that the names of files end in, as integers; None where they do not count one series of files."""
    matches = [re.fullmatch(r"(.*?)(\d+)", path.stem) for path in paths]
    if not all(matches) or len({match[1] for match in matches}) > 1:
        return None
    return [int(match[2]) for match in matches]


@contextmanager
def atomic(path):
    """Yield a temporary path beside `path`; rename it when the block ends well, delete it when it does not."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = longrun.temporary(path)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:  # a full disk has no name, and the user does not know the temporary one
        if error.filename in (None, str(temporary), temporary):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path, text):
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_png(path, image):
    """Write one 8-bit image, (height, width) or (height, width, 3) as BGR."""
    data = cv2.imencode(".png", image)[1]  # cv2.imwrite does not notice where a disk is full
    with atomic(path) as temporary:
        temporary.write_bytes(data)


def write_array(path, array):
    """Write a numpy array as .npy."""
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.save(file, array)


def needed(path, notebook):
    """`path`, which an earlier notebook writes. Raises InputError, naming the notebook, where it does not exist."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: not there yet; run notebook {notebook} first")
    return path


def progress(iterable=None, description="", total=None, unit="frame", initial=0):
    """A progress bar on standard error, or on the file that THESIS_REPRO_PROGRESS names.

    The variable is how a bar inside a notebook reaches the terminal that executes the notebook. Where there is no
    terminal, a line now and then takes the place of the bar.
    """
    stream = sys.stderr
    target = os.environ.get("THESIS_REPRO_PROGRESS")
    if target:
        try:
            stream = open(target, "a", buffering=1)
        except OSError:
            pass
    live = stream.isatty()
    return tqdm(iterable, desc=description, total=total, unit=unit, initial=initial, dynamic_ncols=live,
                file=stream if live else _Lines(stream), mininterval=0.2 if live else 20, leave=not live,
                delay=BAR_DELAY, smoothing=0)  # all of the time so far tells more than the last few


class _Lines:
    """A file for tqdm that holds lines, not carriage returns."""

    def __init__(self, stream):
        self._stream = stream

    def write(self, text):
        text = text.strip()
        if text:
            self._stream.write(text + "\n")

    def flush(self):
        self._stream.flush()
