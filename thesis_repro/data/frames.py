"""Frames in folders: in which order, of which times and bits, and what else a layout finds."""

import re
from collections.abc import Callable
from decimal import Decimal
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.data.cameras import Camera
from thesis_repro.data.trajectories import read_times, read_truth
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import images, read_gray

DECIMAL = re.compile(r"\d+\.\d+")  # names of frames that may be seconds
# Times since 1970 in names, with words before or after, and their unit in seconds. Of two numbers,
# the second one has 3 or 6 decimals in all names, or is nanoseconds without leading zeros.
EPOCH_NAMES = {
    r"1\d{18}": 1e-9,
    r"1\d{15}": 1e-6,
    r"1\d{12}": 1e-3,
    r"1\d{9}\.(?:\d{3}|\d{6}|\d{9})": 1,
    r"1\d{9}[_-]\d{1,9}": 1,
}
MAX_KINDS = 4  # of pictures in one folder; hexadecimal numbers look like more
SHARED_NUMBERS = 0.6  # numbers a frame, or fewer, if most frames are there twice
# A 16-bit frame has hot pixels if its maximum is HOT times what all but 0.1 % stay below.
HOT, USUAL = 2, 99.9
FEW_LEVELS = 32  # of 256


class Files(NamedTuple):
    """What a layout finds in the folder of a sequence. All but the frames may be missing.

    frames: in their order. read_poses: a function of `poses`, the times and the largest difference
    of times, as `trajectories.read_truth`. others: what the poses are made from as well. camera:
    name of the camera's folder.
    """

    frames: list[Path]
    calibration: Path
    read_camera: Callable[[Path], Camera]
    times: Path
    poses: Path
    read_times: Callable[[Path], np.ndarray] = read_times
    read_poses: Callable[[Path, np.ndarray | None, float], tuple] = read_truth
    others: tuple[Path, ...] = ()
    camera: str = ""


def camera_folder(
    parent: Path, known: tuple[str, ...], camera: str | None, inner: str = ""
) -> Path | None:
    """Folder of a camera's frames; None if there is none.

    known: the cameras of a layout. The default is the first one, or else the second. inner: folder
    in the camera's that holds the frames. Raises InputError if `camera` is unknown or missing.
    """
    if camera is not None and camera not in known:
        raise InputError(f"camera {camera!r}: unknown; choose one of {', '.join(sorted(known))}")
    for name in (camera,) if camera else known[:2]:
        if (parent / name / inner).is_dir():
            return parent / name / inner
    if camera is not None:
        raise InputError(f"{parent / camera}: no such folder; it must hold the frames")
    return None


def frames_in(folder: Path) -> list[Path]:
    """Images of a folder in the order of their numbers.

    Names such as 0.15 and 0.2, which differ in their number of decimals, are decimal numbers, or
    seconds and nanoseconds without leading zeros. Raises InputError if they may be both, in
    different orders, if there are no images, and if there are left and right ones.
    """
    paths = images(folder)
    if not paths:
        raise InputError(f"{folder}: holds no PNG or JPEG images")
    _check_kinds(folder, paths)
    parts = [path.stem.split(".") for path in paths if DECIMAL.fullmatch(path.stem)]
    fractions = [fraction for _, fraction in parts]
    if len(parts) < len(paths) or len(set(map(len, fractions))) < 2:
        return paths
    by_value = sorted(paths, key=lambda path: Decimal(path.stem))
    by_nanoseconds = sorted(paths, key=lambda path: _nanoseconds(path.stem))
    form, ordered = "decimal numbers", by_value
    if _may_be_nanoseconds(by_nanoseconds, fractions):
        # decimals without their last zeros do not end with a zero
        if any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions):
            form, ordered = "seconds and nanoseconds", by_nanoseconds
        elif by_value != by_nanoseconds:
            raise InputError(
                f"{folder}: {paths[0].name} and the like may be decimal numbers, or seconds and nanoseconds, "
                "in different orders; rename the frames so that all have as many digits after the dot"
            )
    say_once(
        f"{folder}: frames are in the order of their names as {form}, {ordered[0].stem} to "
        f"{ordered[-1].stem}"
    )
    return ordered


def _check_kinds(folder: Path, paths: list[Path]) -> None:
    """Raise InputError if pictures of two kinds, such as left and right, have the same numbers."""
    kinds = {re.sub(r"\d+", "*", path.name) for path in paths}
    numbers = {tuple(re.findall(r"\d+", path.stem)) for path in paths}
    numbered = () not in numbers
    if numbered and 2 <= len(kinds) <= MAX_KINDS and len(numbers) <= SHARED_NUMBERS * len(paths):
        raise InputError(
            f"{folder}: holds {' and '.join(sorted(kinds))} with the same numbers; move all but one "
            "camera's frames away"
        )


def _nanoseconds(stem: str) -> int:
    seconds, fraction = stem.split(".")
    return int(seconds) * 10**9 + int(fraction)


def _may_be_nanoseconds(ordered: list[Path], fractions: list[str]) -> bool:
    """Whether names may be seconds and nanoseconds without leading zeros.

    ordered: the frames in the order of these times, of which no camera makes more than 100,000 a
    second.
    """
    times = [_nanoseconds(path.stem) for path in ordered]
    is_slow = all(later - time >= 10_000 for time, later in pairwise(times))
    has_no_zeros = not any(len(text) > 1 and text.startswith("0") for text in fractions)
    return is_slow and has_no_zeros and max(map(len, fractions)) <= 9


def times_in_names(paths: list[Path]) -> np.ndarray | None:
    """Times of frames, (n,), seconds, if their names hold times since 1970 that increase."""
    for form, unit in EPOCH_NAMES.items():
        found = [re.fullmatch(rf"(?:.*\D)??({form})(?:\D.*)?", path.stem) for path in paths]
        if not all(found):
            continue
        words = [re.split("[_-]", match[1]) for match in found if match]
        times = unit * np.array([word[0] for word in words], np.float64)
        if len(words[0]) > 1:
            digits = {len(word[1]) for word in words}
            decimals = digits.pop() if digits in ({3}, {6}) else 9
            times += 10.0**-decimals * np.array([word[1] for word in words], np.float64)
        return times if (np.diff(times) > 0).all() else None
    return None


@cache
def say_once(line: str, warns: bool = False) -> None:
    """Print a line for people, unless this process has printed it."""
    say = program.log.warning if warns else program.log.info
    say(line)


# Bits


def white_level(path: Path) -> int:
    """Gray value that becomes 255 in the frames of a folder; 0 for 8-bit frames.

    path: the first frame. The value is its maximum, hot pixels left out.
    """
    first = read_gray(path, np.uint16)
    if first.dtype == np.uint8:
        return 0
    white, usual = int(first.max()), int(np.percentile(first, USUAL))
    origin = "the first one's maximum"
    if white > HOT * max(usual, 1):
        white, origin = max(usual, 1), f"what {USUAL} % of the first one's pixels do not exceed"
    levels = round(255 * (1 - np.percentile(first, 100 - USUAL) / white))
    line = f"{path.parent}: frames have 16 bits; {white}, {origin}, is white"
    if levels < FEW_LEVELS:
        line += (
            f"; that leaves {levels} gray levels, so frames may be flagged as flat: write them with "
            "8 bits, from the darkest to the brightest"
        )
    say_once(line, levels < FEW_LEVELS)
    return white


def eight_bits(image: np.ndarray, white: int) -> np.ndarray:
    """Image with `white` as 255, uint8. Images of 8 bits have the `white_level` 0, and stay."""
    return cv2.convertScaleAbs(image, alpha=255 / white) if white else image
