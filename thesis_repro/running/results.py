"""Folders of results: their inputs, their locks, and how a stopped job resumes.

A *stage* is a folder of results with a record of their inputs (`stage`). Its lock keeps other runs
out (`claimed`). A *checkpoint* is one file from which a long job resumes (`store`, `resume`). A
*digest* stands for the content of an input and has twelve hexadecimal digits.
"""

import ast
import fcntl
import hashlib
import importlib.metadata
import json
import os
import sqlite3
import stat
import time
import zipfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd

from thesis_repro.errors import InputError
from thesis_repro.running import messages
from thesis_repro.running.files import TEMPORARY, atomic, progress, write_text
from thesis_repro.running.folders import DIGESTS, LOG, RECORD
from thesis_repro.running.settings import ROOT

_PACKAGE = Path(__file__).parents[1]


def stage(folder: str | Path, *, replace: Any = True, **inputs: Any) -> Path:
    """Prepare a folder for results that are made from `inputs` (JSON values), and return its path.

    Results that an earlier run made from the same inputs stay. Temporary files of killed runs are
    deleted. Results of other inputs are moved to a new folder beside it, FOLDER.old-1, or
    InputError is raised if `replace` is False. Raises InputError also if another run uses the
    folder, and if most of its inputs have other names (results of another kind).
    """
    folder = Path(folder)
    with claimed(folder):
        inputs, earlier = json.loads(json.dumps(inputs, default=str)), record(folder)
        names = [path.name for path in folder.iterdir()]
        if earlier is None and not all(name == LOG or TEMPORARY.fullmatch(name) for name in names):
            raise InputError(
                f"{folder}: holds files that this project did not make; choose an empty or new folder"
            )
        if earlier is not None and earlier != inputs:
            changed = ", ".join(
                sorted(key for key in inputs | earlier if inputs.get(key) != earlier.get(key))
            )
            if not replace:
                raise InputError(
                    f"{folder}: holds results of other settings ({changed}); name another folder"
                )
            if 2 * len(earlier.keys() & inputs.keys()) <= len(earlier.keys() | inputs.keys()):
                raise InputError(
                    f"{folder}: holds results of another kind, made from {', '.join(sorted(earlier))}; "
                    "choose another folder"
                )
            _move_aside(folder, changed)
        sweep(folder)
        if earlier != inputs:
            write_text(folder / RECORD, json.dumps(inputs, indent=1, sort_keys=True))
    return folder


def _move_aside(folder: Path, changed: str) -> None:
    """Move all that is in a folder of results into a new folder beside it.

    Nothing is deleted, because a user may have changed or added files.
    """
    # the record goes last, so that a killed move can be repeated; the log is being written
    paths = sorted(folder.glob("*"), key=lambda path: path.name == RECORD)
    paths = [path for path in paths if path.name != LOG]
    if len(paths) < 2:  # there is only the record
        return
    # beside the folder itself, not beside a link to it, which may lie on another disk
    aside = _unused(folder.resolve())
    aside.mkdir()
    for path in paths:
        path.rename(aside / path.name)
    messages.log.info(f"{folder}: moved what was made with another {changed} to {aside}")


def _unused(path: Path) -> Path:
    """Return the first path of PATH.old-1, PATH.old-2, ... that does not exist."""
    number = 1
    while (aside := path.with_name(f"{path.name}.old-{number}")).exists():
        number += 1
    return aside


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


def made_from(folder: str | Path) -> str:
    """Return a digest of the inputs of the results in a stage's folder."""
    return digest_of_file(Path(folder) / RECORD)


def check_worker(folder: str | Path, made_from: dict[str, Any], **here: Any) -> None:
    """Raise InputError if this worker sees another record in a stage's folder, or has other inputs.

    made_from: the record that the main process sees. here: inputs as this worker has them, such as
    package versions.
    """
    if record(folder) != made_from:
        raise InputError(
            f"{folder}: this worker sees other files there; all workers need the same folders under the "
            "same paths"
        )
    if made_from | here != made_from:
        raise InputError(
            "this worker has another model, or another version of thesis_repro or its packages; give all "
            "workers the same, and restart them"
        )


def sweep(folder: str | Path) -> None:
    """Delete the temporary files of killed runs in and below a folder.

    The caller must hold its lock.
    """
    for path in Path(folder).rglob(".*"):
        if TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


_held: set[tuple[int, int]] = set()  # device and inode of each path that this process has locked


@contextmanager
def claimed(folder: str | Path) -> Iterator[None]:
    """Create a folder if needed, and lock it until the block ends.

    Folders that were created here and are still empty at the end are removed. Raises InputError if
    another process has locked it.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder for the results")
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with locked(folder):
            yield
    finally:
        with suppress(OSError):
            for path in new:
                path.rmdir()


@contextmanager
def locked(path: str | Path) -> Iterator[None]:
    """Lock an existing folder or file until the block ends.

    The same process may lock it again within the block.
    """
    status = os.stat(path)
    key = status.st_dev, status.st_ino
    if key in _held:
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)  # the lock ends with the process, even if it is killed
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path}: another run uses it; wait, or name another folder") from None
        except OSError:
            pass  # the file system has no locks
        _held.add(key)
        yield
    finally:
        _held.discard(key)
        os.close(descriptor)


def write_table(path: str | Path, table: pd.DataFrame) -> None:
    """Write a table as CSV, and append its digest to the list DIGESTS beside it."""
    with atomic(path) as temporary:
        temporary.write_text(table.to_csv(index=False), encoding="utf-8")
        # before the table has its name, so that no table lacks its digest; several processes append
        with open(temporary.with_name(DIGESTS), "a", encoding="utf-8") as file:
            file.write(_line_of_digest(temporary, Path(path).name))


def has_table(path: str | Path) -> bool:
    """Return whether a file holds a table as `write_table` wrote it.

    A file that was changed since, or that is not in the list of digests, is moved aside.
    """
    path = Path(path)
    if not path.is_file():
        return False
    written = path.with_name(DIGESTS)
    if written.is_file() and _line_of_digest(path, path.name).encode() in written.read_bytes():
        return True
    aside = _unused(path)
    path.rename(aside)
    messages.log.warning(f"{path}: was changed; moved to {aside.name}, to be made again")
    return False


def _line_of_digest(path: Path, name: str) -> str:
    """Return a line as sha256sum writes it, for the content of a file under a name."""
    return f"{_sha256(path)}  {name}\n"


# Checkpoints


def store(path: str | Path, job: Any, arrays: dict[str, Any]) -> None:
    """Write a checkpoint: `job` (JSON values) and arrays by name."""
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file, job=json.dumps(job), **{f"array {name}": array for name, array in arrays.items()}
        )


def resume(path: str | Path) -> Any:
    """Return (job, arrays) of a checkpoint that `store` wrote, or None if there is no file.

    Raises InputError for a damaged file.
    """
    path = Path(path)
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as checkpoint:
            arrays = {
                name.removeprefix("array "): checkpoint[name]
                for name in checkpoint.files
                if name != "job"
            }
            return json.loads(str(checkpoint["job"])), arrays
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise InputError(f"{path}: is damaged; delete it to start from the beginning") from None


# Digests


PROJECT = ("thesis_repro", "street_world")
# Rooms that no number comes from: messages, files, folders and options. How loops are compiled can
# change a number.
NO_NUMBERS = ("thesis_repro.errors", "thesis_repro.running", "thesis_repro.command")
EXCEPT = ("thesis_repro.running.compiled",)


@lru_cache
def digest_of_code(*modules: str) -> str:
    """Return a digest of the code that results come from.

    It is that of modules ("thesis_repro.masks") and of all modules of this project that they
    import. Code counts, but not its place: not its module, its order there, imports, comments,
    docstrings, and what errors and the log say. Modules that no number comes from are left out
    (NO_NUMBERS).
    """
    pieces = []
    for tree in _sources(modules).values():
        _drop_words(tree)
        pieces += [ast.dump(statement) for statement in tree.body]
    return hashlib.sha256("\n".join(sorted(pieces)).encode()).hexdigest()[:12]


def source_modules(*modules: str) -> list[str]:
    """Return the modules whose code decides results of the given ones, sorted."""
    return sorted(_sources(modules))


def _sources(modules: Iterable[str]) -> dict[str, ast.Module]:
    trees: dict[str, ast.Module] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in trees or (name.startswith(NO_NUMBERS) and name not in EXCEPT):
            continue
        path = _file(name)
        if path is None:
            raise ImportError(f"{name}: no such module of this project")
        trees[name] = ast.parse(path.read_text(encoding="utf-8"))
        waiting += _imported(trees[name])
    return trees


def _imported(tree: ast.Module) -> list[str]:
    """Return the modules of this project that a module imports."""
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            modules = [name for name in inner if _file(name)]
            names += modules
            if len(modules) < len(inner):  # some names are functions of the package itself
                names.append(node.module)
    return [name for name in names if _file(name)]


def _file(module: str) -> Path | None:
    """Return the source file of a module or package of this project, or None for any other name."""
    if module.partition(".")[0] not in PROJECT:
        return None
    place = _PACKAGE.parent.joinpath(*module.split("."))
    for path in (place.with_suffix(".py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


def _drop_words(tree: ast.Module) -> None:
    """Drop imports, docstrings and the arguments of errors and log messages from a syntax tree."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _says_something(node.func):
            node.args = []
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            node.body = [statement for statement in node.body if not _is_no_code(statement)]


def _says_something(function: ast.expr) -> bool:
    if isinstance(function, ast.Name):
        return function.id == "InputError"
    return isinstance(function, ast.Attribute) and ast.unparse(function).startswith("messages.log.")


def _is_no_code(statement: ast.stmt) -> bool:
    """Say whether a statement is an import or a text that stands alone."""
    if isinstance(statement, (ast.Import, ast.ImportFrom)):
        return True
    if not isinstance(statement, ast.Expr) or not isinstance(statement.value, ast.Constant):
        return False
    return isinstance(statement.value.value, str)


OPENCV = (
    "opencv-python-headless",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-contrib-python",
)


def made_with(*packages: str) -> dict[str, Any]:
    """Return the versions of packages that results depend on.

    "opencv" stands for the distributions of OpenCV that are installed.
    """
    versions: dict[str, str] = {}
    for name in packages:
        if name == "opencv":
            versions |= _opencv_versions()
        else:
            versions[name] = importlib.metadata.version(name)
    return {"versions": versions}


def _opencv_versions() -> dict[str, str]:
    versions = {}
    for name in OPENCV:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions or {"opencv": cv2.__version__}  # built by the user or the system


def digest_of_files(paths: Iterable[str | Path]) -> str:
    """Return one digest of the names and contents of files."""
    files = [Path(path) for path in paths]
    lines = [f"{path.name}:{digest}\n" for path, digest in zip(files, digests(files), strict=True)]
    return hashlib.sha256(os.fsencode("".join(lines))).hexdigest()[:12]


def digest_of_file(path: str | Path) -> str:
    """Return a digest of the bytes of one file."""
    return digests([path])[0]


# seconds; a younger file may change again without a new date, so its digest is not remembered
SETTLED = 0.1


def digests(paths: Iterable[str | Path]) -> list[str]:
    """Return a digest of the bytes of each file, in order.

    The digests are remembered in the build folder. A file is read again only if its path, size,
    dates or inode differ. Raises InputError for a path that is not a regular file.
    """
    versions = [_version(Path(path).absolute()) for path in paths]
    known = _recall(versions)
    new = [version for version in dict.fromkeys(versions) if version not in known]
    with ThreadPoolExecutor(4) as pool:
        read = pool.map(_sha256, [version.path for version in new])
        bar = progress(read, "reading the data once", len(new), unit="file")
        read_now = dict(zip(new, bar))
    _remember(read_now)
    known |= read_now
    return [known[version][:12] for version in versions]


class _Version(NamedTuple):
    """A file as it is now: it was not changed if all of this stays the same."""

    path: Path
    size: int  # bytes
    modified: int  # ns
    status_changed: int  # ns
    inode: int
    device: int

    def key(self) -> tuple[str, str]:
        """Return the path and the rest as the database has them."""
        return json.dumps(str(self.path)), json.dumps(self[1:])


def _version(path: Path) -> _Version:
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is not a file; data must be in files")
    times = status.st_mtime_ns, status.st_ctime_ns
    return _Version(path, status.st_size, *times, status.st_ino, status.st_dev)


def _recall(versions: Iterable[_Version]) -> dict[_Version, str]:
    """Return the digests of those files that were read before and have not changed."""
    recalled: dict[_Version, str] = {}
    query = "SELECT digest FROM digests WHERE path = ? AND identity = ?"
    with suppress(OSError, sqlite3.Error), _digest_database() as database:
        for version in versions:
            row = database.execute(query, version.key()).fetchone()
            if row:
                recalled[version] = row[0]
    return recalled


def _remember(new: dict[_Version, str]) -> None:
    """Write digests into the database, except those of files that may just be changing."""
    newest = time.time_ns() - SETTLED * 1e9
    rows = [
        (*version.key(), digest)
        for version, digest in new.items()
        if max(version.modified, version.status_changed) < newest
    ]
    with suppress(OSError, sqlite3.Error), _digest_database() as database:
        database.executemany("INSERT OR REPLACE INTO digests VALUES (?, ?, ?)", rows)


@contextmanager
def _digest_database() -> Iterator[sqlite3.Connection]:
    """Open the database of digests.

    The caller ignores its errors and then reads the files again.
    """
    folder = _digest_folder()
    folder.mkdir(parents=True, exist_ok=True)
    with closing(sqlite3.connect(folder / "digests.sqlite", timeout=2)) as database, database:
        database.execute(
            "CREATE TABLE IF NOT EXISTS digests (path TEXT PRIMARY KEY, identity TEXT, digest TEXT)"
        )
        yield database


def _digest_folder() -> Path:
    """Return the build folder, or the user's cache folder if the package is installed without one.

    Raises OSError if the user has no folders.
    """
    build = os.environ.get("THESIS_REPRO_BUILD")
    if build:
        return Path(build)
    if (ROOT / "pyproject.toml").is_file() and (ROOT / "notebooks").is_dir():  # a checkout
        return ROOT / "build"
    cache = os.environ.get("XDG_CACHE_HOME")
    if cache:
        return Path(cache) / "thesis-repro"
    try:
        return Path.home() / ".cache" / "thesis-repro"
    except RuntimeError as error:
        raise OSError("this user has no home folder") from error


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
