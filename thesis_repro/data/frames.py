"""Frames in folders: in which order, of which bits, and what else a layout finds."""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro.data.cameras import Camera
from thesis_repro.data.trajectories import read_times, read_truth
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import images, read_gray

DECIMAL = re.compile(r"\d+\.\d+")  # names of frames that are numbers with a dot
# A 16-bit frame has hot pixels if its maximum is HOT times what all but 0.1 % stay below.
HOT, USUAL = 2, 99.9


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

    Raises InputError if there are none, and for names such as 0.15 and 0.2, which may be decimal
    numbers, or seconds and nanoseconds.
    """
    paths = images(folder)
    if not paths:
        raise InputError(f"{folder}: holds no PNG or JPEG images")
    digits = {len(path.stem.split(".")[1]) for path in paths if DECIMAL.fullmatch(path.stem)}
    if len(digits) > 1:
        raise InputError(
            f"{folder}: {paths[0].name} and others have {' and '.join(map(str, sorted(digits)))} digits "
            "after the dot, so their order is not known; rename them so that all have as many"
        )
    return paths


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
    say_once(f"{path.parent}: frames have 16 bits; {white}, {origin}, is white")
    return white


def eight_bits(image: np.ndarray, white: int) -> np.ndarray:
    """Image with `white` as 255, uint8. Images of 8 bits have the `white_level` 0, and stay."""
    return cv2.convertScaleAbs(image, alpha=255 / white) if white else image
