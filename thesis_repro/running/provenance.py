"""What results were made from: folders of results with a record of their inputs, and locks.

A *stage* is a folder of results with a record of their inputs (`stage`). Its lock keeps other runs
out (`claimed`). A *digest* stands for the content of an input and has twelve hexadecimal digits.
"""

import fcntl
import hashlib
import json
import os
import platform
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import pandas as pd

from thesis_repro.errors import InputError
from thesis_repro.running import program
from thesis_repro.running.files import TEMPORARY, progress, write_text

ROOT = Path(__file__).resolve().parents[2]  # holds the packages
RECORD = "made-from.json"  # in the folder of a stage
# What a system puts into a folder of its own accord: Finder, NFS, a new disk. A folder with such
# files alone counts as empty.
OF_SYSTEM = re.compile(r"\.DS_Store|\._.*|\.nfs.*|lost\+found")


def stage(folder: str | Path, *, replace: Any = True, **inputs: Any) -> Path:
    """Prepare a folder for results that are made from `inputs` (JSON values), and return its path.

    Results that an earlier run made from the same inputs stay. Temporary files of killed runs are
    deleted. Results of other inputs are moved to a new folder beside it, FOLDER.old-1, or
    InputError is raised if `replace` is False. Raises InputError also if another run uses the
    folder, and if it holds files that are no results.
    """
    folder = Path(folder)
    with claimed(folder):
        inputs = json.loads(json.dumps(inputs, default=str))
        earlier = record(folder)
        sweep(folder)
        if earlier is None and not all(OF_SYSTEM.fullmatch(path.name) for path in folder.iterdir()):
            raise InputError(
                f"{folder}: holds files that this project did not make; choose an empty or new folder"
            )
        if earlier is not None and earlier != inputs:
            names = sorted(inputs | earlier)
            changed = [name for name in names if inputs.get(name) != earlier.get(name)]
            if not replace:
                raise InputError(
                    f"{folder}: holds results of other settings ({', '.join(changed)}); name another "
                    "folder"
                )
            _move_aside(folder, ", ".join(changed))
        if earlier != inputs:
            write_text(folder / RECORD, json.dumps(inputs, indent=1, sort_keys=True))
    return folder


def _move_aside(folder: Path, changed: str) -> None:
    """Move all that is in a folder of results into a new folder beside it.

    Nothing is deleted, because a user may have changed or added files.
    """
    number = 1
    place = folder.resolve()  # not beside a link, which may lie on another disk
    while (aside := place.with_name(f"{place.name}.old-{number}")).exists():
        number += 1
    aside.mkdir()
    # the record goes last, so that a killed move can be repeated
    for path in sorted(folder.iterdir(), key=lambda path: path.name == RECORD):
        path.rename(aside / path.name)
    program.log.info(f"{folder}: moved what was made with other {changed} to {aside}")


def record(folder: str | Path) -> Any:
    """Return the inputs of the results in a stage's folder as a dict.

    Returns None if the folder is not a stage.
    """
    path = Path(folder) / RECORD
    if not path.is_file():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        raise InputError(f"{path}: is damaged; delete its folder") from None


def sweep(folder: str | Path) -> None:
    """Delete the temporary files of killed runs in and below a folder.

    The caller must hold its lock.
    """
    for path in Path(folder).rglob(".*"):
        if TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


_held: set[tuple[int, int]] = set()  # device and inode of each folder that this process has locked


@contextmanager
def claimed(folder: str | Path) -> Iterator[None]:
    """Create a folder if needed, and lock it until the block ends.

    The same process may lock it again within the block. Raises InputError if another process has
    locked it.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)  # the lock ends with the process, even if killed
    status = os.fstat(descriptor)
    key = status.st_dev, status.st_ino
    is_outermost = key not in _held
    try:
        if is_outermost:
            _lock(descriptor, folder)
            _held.add(key)
        yield
    finally:
        os.close(descriptor)
        if is_outermost:
            _held.discard(key)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(f"{folder}: another run uses it; wait, or name another folder") from None
    except OSError:
        program.log.warning(f"{folder}: cannot be locked; do not start a second run in it")


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a table as CSV."""
    write_text(path, table.to_csv(index=False))


# Digests


def versions(*packages: str) -> dict[str, Any]:
    """Return the machine and the versions of packages that results depend on.

    "opencv" is any of its four. The machine is "x86_64" or "arm64", say: OpenCV and TensorFlow
    round differently on other architectures.
    """
    found = {name: _version(name) for name in packages if name != "opencv"}
    return {"versions": {"opencv": cv2.__version__, **found}, "machine": platform.machine()}


def _version(name: str) -> str:
    """Return the version of a package, also of one that another distribution brings."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:  # such as tensorflow-cpu
        return sys.modules[name].__version__


@cache  # a process has loaded its code once
def digest_of_code(*parts: str) -> str:
    """Return one digest of the code in folders and files of the packages: "thesis_repro/masks".

    Any edit there changes it, even of a comment: it may repeat too much, and misses nothing.
    """
    digest = hashlib.sha256()
    for part in parts:
        place = ROOT / part
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            name = path.relative_to(ROOT).as_posix()
            digest.update(f"{name}:{digest_of_file(path)}\n".encode())
    return digest.hexdigest()[:12]


def digest_of_files(paths: Iterable[str | Path]) -> str:
    """Return one digest of the names and contents of files."""
    digest = hashlib.sha256()
    for path in progress(list(map(Path, paths)), "reading the data", unit="file"):
        digest.update(os.fsencode(f"{path.name}:{digest_of_file(path)}\n"))
    return digest.hexdigest()[:12]


def first_frame(paths: list[Path]) -> dict[str, list[str]]:
    """Return name and digest of the first of some frames: whose label maps or masks are.

    Two cameras, and two sequences, name their frames alike.
    """
    return {"first_frame": [paths[0].name, digest_of_file(paths[0])]}


def digest_of_file(path: str | Path) -> str:
    """Return a digest of the bytes of one file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]
