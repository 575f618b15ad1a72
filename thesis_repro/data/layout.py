"""Where the files of a sequence lie: KITTI's layout, raw drives, and folders of own frames."""

import re
from decimal import Decimal
from functools import cache
from itertools import pairwise
from pathlib import Path

from thesis_repro.data import kitti_raw
from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import images

# left gray, left colour, then the right ones
IMAGE_FOLDERS = ("image_0", "image_2", "image_1", "image_3")
DECIMAL = re.compile(r"\d+\.\d+")  # names of frames that may be seconds


def folders_with_frames(parent: Path) -> list[Path]:
    """Folders of sequences in a folder, in sorted order."""
    return sorted(folder for folder in parent.iterdir() if folder.is_dir() and has_frames(folder))


def has_frames(folder: Path) -> bool:
    """Whether a folder is that of a sequence, or holds images itself."""
    return frame_folder(folder) != folder or bool(images(folder))


def sequences_folder(root: str | Path) -> Path:
    """Folder of a root's sequences.

    It is the root itself if it holds raw drives, else root/sequences, which may hold raw drives as
    well.
    """
    root = Path(root)
    folder = root / "sequences"
    if not folder.is_dir() and any(map(kitti_raw.is_drive, root.glob("*"))):
        return root
    return folder


def frame_folder(folder: str | Path, camera: str | None = None) -> Path:
    """Folder of a sequence's frames.

    The default is the left camera's, gray or else colour. If neither exists, it is the sequence's
    folder itself. Raises InputError if the camera is unknown, or if the folder is missing.
    """
    folder = Path(folder)
    cameras, inner = IMAGE_FOLDERS, ""
    if kitti_raw.is_drive(folder):
        cameras, inner = kitti_raw.IMAGE_FOLDERS, kitti_raw.FRAMES
    names: tuple[str, ...] = cameras[:2]
    if camera is not None:
        names = (camera,)
        if camera not in cameras:
            known = ", ".join(sorted(cameras))
            raise InputError(f"camera {camera!r}: unknown; choose one of {known}")
    for name in names:
        if (folder / name / inner).is_dir():
            return folder / name / inner
    if folder.is_file():
        raise InputError(
            f"{folder}: is a file; a sequence is a folder of frames (docs/own-masks.md says how to write "
            "those of a video)"
        )
    if camera is not None or not folder.is_dir():
        raise InputError(f"{folder / (camera or '')}: no such folder; it must hold the frames")
    return folder


def frames_in(folder: Path) -> list[Path]:
    """Images of a folder in the order of their numbers.

    Names such as 0.15 and 0.2, which differ in their number of decimals, are decimal numbers, or
    seconds and nanoseconds without leading zeros. Raises InputError if they may be both, in
    different orders, and if there are no images.
    """
    paths = images(folder)
    if not paths:
        raise InputError(f"{folder}: holds no PNG or JPEG images")
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


@cache
def say_once(line: str) -> None:
    """Print a line for people, unless this process has printed it."""
    program.log.info(line)


def locate(root: str | Path | None, name: str | Path) -> tuple[Path, Path, Path]:
    """Root, folder and poses of a sequence.

    The poses are root/poses/NN.txt or else poses.txt in the sequence's folder, or the OXTS's folder
    of a raw drive. The arguments are those of Sequence.
    """
    folder = Path(name).resolve()
    poses = folder / "poses.txt"
    if root is None and folder.parent.name == "sequences":
        root, name = folder.parent.parent, folder.name  # the folder belongs to a KITTI root
    if root is not None:
        root, name = Path(root), str(name)
        if name.isdigit() and not (sequences_folder(root) / name).is_dir():
            name = name.zfill(2)
        folder, poses = sequences_folder(root) / name, root / "poses" / f"{name}.txt"
    if kitti_raw.is_drive(folder):
        poses = folder / kitti_raw.OXTS
    elif not poses.exists() and (folder / "poses.txt").exists():
        poses = folder / "poses.txt"
    return root or folder.parent, folder, poses
