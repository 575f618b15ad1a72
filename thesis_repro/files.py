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
MOST_PIXELS = 2**27  # of an image, twelve times those of a 4K one: a small file may claim to hold any number
GLANCE = 4096  # bytes of both ends of a file
JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of segments that say the size; those are tables
GRAY, PALETTE = 0, 3  # PNG's types of colour; 2 and 6 are red, green, blue, 4 and 6 have transparency


def read_gray(path):
    """Read one image as 8-bit gray, shape (height, width); colours become their luminance.

    Raises InputError when the file is missing, empty, truncated, corrupt or no image, where it has 16 bits a channel,
    and where it claims more than MOST_PIXELS. (What changed inside a JPEG cannot be noticed: it has no checksums.)
    """
    return _read(path, cv2.IMREAD_GRAYSCALE)


def read_ids(path):
    """Read one PNG of numbers, such as class ids, shape (height, width) uint8, exactly as they are stored.

    Raises what `read_gray` raises, and InputError where reading as gray would change them: a palette, less than 8
    bits, colours (but for three equal channels), another format.
    """
    data = _bytes(path)
    if not data.startswith(PNG_SIGNATURE):
        raise InputError(f"{path}: is no PNG file; ids must be stored exactly, as an 8-bit gray PNG")
    bits, colour = data[24:26]
    if colour == PALETTE or bits < 8:
        raise InputError(f"{path}: holds {'a palette' if colour == PALETTE else f'{bits} bits a pixel'}, so the ids "
                         "would be read as colours; save them as an 8-bit gray PNG")
    if colour == GRAY:
        return _decoded(path, data, cv2.IMREAD_GRAYSCALE)
    channels = _decoded(path, data, cv2.IMREAD_COLOR)
    if (channels != channels[..., :1]).any():
        raise InputError(f"{path}: holds colours where ids are expected; save the ids as an 8-bit gray PNG")
    return np.ascontiguousarray(channels[..., 0])


def read_color(path):
    """Read one image as 8-bit red, green, blue, shape (height, width, 3). Raises what `read_gray` raises."""
    return cv2.cvtColor(_read(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _read(path, flag):
    return _decoded(path, _bytes(path), flag)


def _decoded(path, data, flag):
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
    except cv2.error:
        image = None
    if image is None:
        np.empty((*_size(data), 8), np.uint8)  # raises MemoryError where that is the reason, of which OpenCV is silent
        raise InputError(f"{path}: not an image that OpenCV can read; copy or download it again")
    return image


def _bytes(path):
    """The bytes of a PNG or JPEG file, which is whole and has 8 bits a channel (or less); else an InputError."""
    data, _ = _ends(path, None)
    _checked_size(path, data)
    if not (_png_is_whole(data) if data.startswith(PNG_SIGNATURE) else _jpeg_is_whole(data)):
        raise InputError(f"{path}: the image is truncated or corrupt; copy or download it again")
    return data


def _ends(path, count):
    """The first `count` bytes of a file and the last ones, all of them for None; an InputError says why not."""
    path = Path(path)
    try:
        with open(path, "rb") as file:
            if count is None:
                return (data := file.read()), data
            head = file.read(count)
            file.seek(-min(count, os.fstat(file.fileno()).st_size), os.SEEK_END)
            return head, file.read()
    except FileNotFoundError:
        broken = f" (it is a link to {os.readlink(path)}, which does not exist)" if path.is_symlink() else ""
        raise InputError(f"{path}: no such image{broken}; check the folder it should be in") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the file and its permissions") from None


def _checked_size(path, head):
    size = _size(head)
    if size is None:
        raise InputError(f"{path}: {'is empty' if not head else 'not a PNG or JPEG image'}; copy or download it again")
    if not 0 < size[0] * size[1] <= MOST_PIXELS:
        raise InputError(f"{path}: claims to hold {size[1]}x{size[0]} pixels, not 1 to {MOST_PIXELS:,}; it is damaged "
                         "or made to exhaust memory, so take it away")
    if head.startswith(PNG_SIGNATURE) and head[24] == 16:
        raise InputError(f"{path}: has 16 bits a channel; convert it to 8 bits a channel")
    return size


def glance(path):
    """What both ends of an image file say without decoding it: (height, width), and whether it has colours.

    Raises InputError where `read_gray` would, but for damage in the middle.
    """
    head, tail = _ends(path, GLANCE)
    if _size(head) is None or (b"IEND" if head.startswith(PNG_SIGNATURE) else JPEG_END) not in tail:
        head = _bytes(path)  # where a camera puts much before the size, or a tool something behind the end
    return _checked_size(path, head), _is_colour(head)


def _is_colour(head):
    if head.startswith(PNG_SIGNATURE):
        return head[25] not in (GRAY, 4)
    return any(marker in JPEG_FRAMES and head[position + 9:position + 10] > b"\1"
               for position, marker in _jpeg_segments(head))


def _size(head):
    """(height, width) of an image from the first bytes of its file, PNG or JPEG; None where they do not say it."""
    if head.startswith(PNG_SIGNATURE) and head[12:16] == b"IHDR" and len(head) >= 26:
        return struct.unpack(">II", head[16:24])[::-1]
    if not head.startswith(JPEG_START):
        return None
    for position, marker in _jpeg_segments(head):
        if marker in JPEG_FRAMES:
            return struct.unpack(">HH", head[position + 5:position + 9]) if position + 9 <= len(head) else None
    return None


def _png_is_whole(data):
    # OpenCV fills the missing rows of a damaged PNG and says nothing, so the chunks' checksums are read here.
    position, first = len(PNG_SIGNATURE), True
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
        if body[:4] == b"IDAT" and first:  # what was packed wrongly has the right checksum
            try:
                first = not zlib.decompressobj().decompress(body[4:], 1)
            except zlib.error:
                return False
        position = end
    return False


def _jpeg_is_whole(data):
    # OpenCV fills the missing rows of a cut JPEG with gray. The end's marker cannot stand among the pixels' bytes, but
    # may in a preview that a camera puts before them, so the segments before the first scan are stepped over.
    return any(marker == JPEG_SCAN[1] and JPEG_END in data[position:] for position, marker in _jpeg_segments(data))


def _jpeg_segments(data):
    """(position, marker) of the segments of a JPEG up to the first scan."""
    position = len(JPEG_START)
    while position + 4 <= len(data) and data[position] == 0xFF:
        if data[position + 1] == 0xFF:  # there may be any number of them before a marker
            position += 1
            continue
        yield position, data[position + 1]
        if data[position:position + 2] == JPEG_SCAN:
            return
        (length,) = struct.unpack(">H", data[position + 2:position + 4])
        position += 2 + length


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
    except Exception as error:
        number, name = longrun.number_of(error), getattr(error, "filename", None)
        if number is None or name not in (None, str(temporary), temporary):
            raise
        # libraries do not name the file, or by its temporary name
        raise OSError(number, os.strerror(number), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_output(path):
    """Raise InputError where a file that is to be written is a folder, or where no folder for it can be made."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file to write")
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir():
        raise InputError(f"{path}: cannot be written, since {above} is a file; name another one")
    if not os.access(above, os.W_OK):
        raise InputError(f"{path}: cannot be written, since {above} may not be written to; name another one")


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
