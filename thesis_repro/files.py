"""Reading images, writing files whole or not at all, and showing progress."""

import hashlib
import json
import os
import re
import stat
import struct
import sys
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageOps
from tqdm import tqdm
from tqdm.utils import ObjectWrapper

from thesis_repro import InputError, longrun

BAR_DELAY = 1  # seconds before a bar shows: what is over sooner needs none
END_MARKS = {"PNG": b"\0\0\0\0IEND\xaeB`\x82", "JPEG": b"\xff\xd9"}  # the last bytes of a whole file
TAIL = 4096  # bytes at the end of a file, where a quick look expects its end mark


def read_gray(path):
    """Read one image as 8-bit gray, shape (height, width); colours become their luminance.

    Raises InputError for a file that is no whole PNG or JPEG of 8 bits a channel, and for one that claims more pixels
    than Pillow takes for harmless. (JPEG has no checksums, so a changed byte inside one cannot be noticed.)
    """
    return _read(path, "L", cv2.IMREAD_GRAYSCALE)


def read_color(path):
    """Read one image as 8-bit red, green, blue, shape (height, width, 3). Raises what `read_gray` raises."""
    return _read(path, "RGB", cv2.IMREAD_COLOR_RGB)


def read_ids(path):
    """Read one PNG of numbers, such as class ids, shape (height, width) uint8, exactly as they are stored.

    Raises what `read_gray` raises, and InputError where reading as gray would change them: a palette, less than 8
    bits, colours (but for three equal channels), another format.
    """
    with _opened(path) as (_, image):
        stored = str(image.tile)  # with Pillow's name of the mode in the file: "L;4" is gray of 4 bits
    channels = np.atleast_3d(read_gray(path) if image.mode == "L" else read_color(path))
    if image.format != "PNG" or image.mode in ("1", "P") or "L;" in stored or (channels != channels[..., :1]).any():
        raise InputError(f"{path}: must be an 8-bit gray PNG, which keeps ids as they are; save it as one")
    return np.ascontiguousarray(channels[..., 0])


def glance(path):
    """What both ends of an image file say without decoding it: (height, width).

    Raises InputError where `read_gray` would, but for damage in the middle.
    """
    with _opened(path) as (file, image):
        file.seek(-min(TAIL, os.fstat(file.fileno()).st_size), os.SEEK_END)
        if END_MARKS["PNG" if image.format == "PNG" else "JPEG"] not in file.read():
            read_gray(path)  # some cameras and tools write behind the end
        return image.size[::-1]


def _read(path, mode, flag):
    with _opened(path) as (file, image):
        if image.format != "PNG":
            image.draft(mode, image.size)  # gray without converting colours first, as OpenCV does
            return np.array(ImageOps.exif_transpose(image).convert(mode))
        image.verify()  # the checksums, of which OpenCV and Pillow's own decoder take no notice
        file.seek(0)
        data = file.read()
        if END_MARKS["PNG"] not in data:
            raise OSError
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flag)  # faster than Pillow's decoder
        if pixels is None:
            Image.open(file).load()  # raises where the file is corrupt; OpenCV does not say why it fails
            raise MemoryError
        return pixels


@contextmanager
def _opened(path):
    """An image's file, which is no pipe or device, and its header. Whatever goes wrong is an InputError."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise InputError(f"{path}: is no file; an image must be one")
            image = Image.open(file, formats=tuple(END_MARKS))
            if ";16" in str(image.tile):
                raise InputError(f"{path}: has 16 bits a channel; convert it to 8 bits a channel")
            yield file, image
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(f"{path}: claims to hold more pixels than any camera takes; take it away") from None
    except (OSError, SyntaxError, ValueError, EOFError, IndexError, struct.error, cv2.error) as error:
        reason = getattr(error, "strerror", None) or "it is no whole PNG or JPEG image; copy it again"
        raise InputError(f"{path}: cannot be read: {reason}") from None


def listed(folder, pattern="*.png"):
    """Files of a folder that match, sorted; hidden ones are left out: a killed run may leave a half-written one."""
    return sorted(path for path in Path(folder).glob(pattern) if not path.name.startswith("."))


def images(folder):
    """The PNG or JPEG images of a folder, in the order of their names, in which numbers count as numbers: 9 before 10.

    Hidden ones are left out. Raises InputError where there are both kinds.
    """
    paths = [path for path in listed(folder, "*") if path.suffix.lower() in (".png", ".jpg", ".jpeg")]
    if len({path.suffix.lower() == ".png" for path in paths}) > 1:
        raise InputError(f"{folder}: holds PNG and JPEG images; move those of one kind away")
    return sorted(paths, key=lambda path: ([(letters, int(digits or -1)) for letters, digits in
                                            re.findall(r"(\D*)(\d*)", path.stem)], path))


def numbers_of(paths):
    """The numbers that the names of files end in, as integers; None where they do not count one series of files."""
    matches = [re.fullmatch(r"(.*?)(\d+)", path.stem) for path in paths]
    if not all(matches) or len({match[1] for match in matches}) > 1:
        return None
    return [int(match[2]) for match in matches]


def is_whole(path):
    """Whether an image is there, and both ends of its file are."""
    try:
        return bool(glance(path))
    except InputError:
        return False


@contextmanager
def atomic(path):
    """Yield a temporary path beside `path`; rename it when the block ends well, delete it when it does not.

    A link is followed to its file. In a folder of results the file is entered in its list, so that it is known to be
    ours (see `stages.stage`). A stream (see `is_stream`) cannot be renamed to: it is written to when the block ends.
    """
    path = Path(path)
    if is_stream(path):
        with tempfile.TemporaryDirectory() as folder:
            temporary = Path(folder, f"written{path.suffix}")
            yield temporary
            if is_stdout(path):
                sys.stdout.flush()
                sys.stdout.buffer.write(temporary.read_bytes())
            else:
                path.write_bytes(temporary.read_bytes())
        return
    target = path.resolve() if path.is_symlink() else path
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = longrun.temporary(target)
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_WRONLY, 0o666))
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())  # or a crash could leave an empty file under the new name
            _enter(target, file)
        os.replace(temporary, target)
    except Exception as error:
        number, name = longrun.number_of(error), getattr(error, "filename", None)
        if number is None or name not in (None, str(temporary), temporary):
            raise
        # libraries do not name the file, or by its temporary name
        raise OSError(number, os.strerror(number), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def _enter(path, file):
    """Enter a file that is about to appear in the list of the folder of results that it lies in, if any."""
    folder = next((folder for folder in path.absolute().parents if (folder / longrun.RECORD).exists()), None)
    if folder is not None and path.name != longrun.RECORD:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        with open(folder / longrun.LIST, "a", encoding="utf-8") as entries:  # one short line: whole beside others'
            entries.write(f"{digest} {json.dumps(str(path.absolute().relative_to(folder)))}\n")


def is_stream(path):
    """Whether a path is no file to be replaced: a device or a pipe; an open stream, whatever is behind it."""
    is_open = is_stdout(path) or str(path).startswith(("/dev/std", "/dev/fd/", "/proc/self/fd/"))
    return is_open or path.exists() and not path.is_file() and not path.is_dir()


def is_stdout(path):
    """Whether a path stands for standard output."""
    return str(path) in ("-", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1")


def check_output(path):
    """Raise InputError where a file that is to be written is a folder or one among results (which may be deleted with
    them), or where no folder for it can be made."""
    if is_stream(path):
        return
    path = path.resolve() if path.is_symlink() else path.absolute()
    parent = next(folder for folder in path.parents if folder.exists())
    if path.is_dir() or not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(f"{path}: cannot be written; name a file in a folder that you may write to")
    if any((folder / longrun.RECORD).exists() for folder in path.parents):
        raise InputError(f"{path}: lies in a folder of results, which are deleted together; name a file elsewhere")


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
    with suppress(KeyError, OSError):
        stream = open(os.environ["THESIS_REPRO_PROGRESS"], "a", buffering=1)
    live = stream.isatty()
    return tqdm(iterable, desc=description, total=total, unit=unit, initial=initial, dynamic_ncols=live,
                file=stream if live else _Lines(stream), mininterval=0.2 if live else 20, leave=not live,
                delay=BAR_DELAY, ascii=None if live else True,
                smoothing=0)  # all of the time so far tells more than the last few


class _Lines(ObjectWrapper):
    """A file for tqdm that holds lines, not carriage returns."""

    def write(self, text):
        if text.strip():
            self._wrapped.write(text.strip() + "\n")
