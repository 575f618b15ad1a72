"""The table of layouts: where the files of a sequence lie.

To add one, write a module with LAYOUT, `is_mine`, `poses` and `files`, as kitti_odometry has, and
enter it in LAYOUTS.
"""

import os
from pathlib import Path
from typing import Any

from thesis_repro.data import euroc, kitti_odometry, kitti_raw, tum
from thesis_repro.data.frames import Files
from thesis_repro.errors import InputError
from thesis_repro.running.files import listed

# The first one whose `is_mine` is true reads a folder; any folder of images may be the last one's.
LAYOUTS: tuple[Any, ...] = kitti_raw, euroc, tum, kitti_odometry


def files(folder: Path, camera: str | None = None) -> Files:
    """Files of the sequence in a folder, in whichever layout.

    camera: one of the layout's; the default is the left one, gray or else colour.
    Raises InputError, which lists the layouts, if there is none.
    """
    if folder.is_file():
        raise InputError(
            f"{folder}: is a file; a sequence is a folder of frames (docs/own-data.md reads a video)"
        )
    return layout_of(folder).files(folder, camera)


def poses(folder: Path) -> Path:
    """File or folder, perhaps missing, of the poses of the sequence in a folder."""
    return layout_of(folder).poses(folder)


def layout_of(folder: Path) -> Any:
    """Layout of the sequence in a folder. Raises InputError, which lists them, if there is none."""
    for layout in LAYOUTS:
        if layout.is_mine(folder):
            return layout
    known = "; ".join(layout.LAYOUT for layout in LAYOUTS)
    state = "holds no PNG or JPEG images" if folder.is_dir() else "no such folder"
    raise InputError(f"{folder}: {state}; layouts that are read: {known}")


def has_frames(folder: Path) -> bool:
    """Whether a folder is that of a sequence, or holds images itself."""
    return any(layout.is_mine(folder) for layout in LAYOUTS)


def folders_with_frames(parent: Path) -> list[Path]:
    """Folders of sequences in a folder, in sorted order, without hidden ones, as Finder leaves."""
    return [folder for folder in listed(parent, "*") if folder.is_dir() and has_frames(folder)]


def sequences_folder(root: str | Path) -> Path:
    """Folder of a root's sequences.

    It is root/sequences, or else the root itself if it holds sequences of another layout than
    KITTI's.
    """
    root = Path(root)
    folder = root / "sequences"
    if folder.is_dir():
        return folder
    for layout in LAYOUTS[:-1]:
        if any(map(layout.is_mine, root.glob("*"))):
            return root
    return folder


def locate(root: str | Path | None, name: str | Path | int) -> Path:
    """Folder of a sequence. The arguments are those of Sequence."""
    if root is None:
        folder = Path(os.path.abspath(str(name)))
        # the calibration of a raw drive may lie beside a link to it
        return folder if kitti_raw.is_mine(folder) else folder.resolve()
    name = str(Path(str(name)))  # a shell completes 07 to 07/
    folder = sequences_folder(root) / name
    if name.isdigit() and not folder.is_dir():
        return folder.with_name(name.zfill(2))
    return folder
