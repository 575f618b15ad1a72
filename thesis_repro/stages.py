"""Results on disk that know what they were made from, and going on after a stop.

A *stage* is a folder with a record of what its results were made from, and with a list of them (`stage`). A *state* is
one file with what a long job needs to go on, written whole or not at all (`store`, `resume`). A digest names an input
in twelve letters.
"""

import ast
import hashlib
import importlib.metadata
import json
import os
import sqlite3
import stat
import time
import zipfile
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from functools import lru_cache
from modulefinder import ModuleFinder
from pathlib import Path

import numpy as np
import pandas as pd

from thesis_repro import InputError, longrun
from thesis_repro.files import atomic, progress, write_text
from thesis_repro.longrun import LIST, LOG, RECORD

_PACKAGE = Path(__file__).parent


def stage(folder, *, replace=True, **inputs):
    """The folder of one stage, holding only results that were made from `inputs` (JSON values).

    What an earlier run with the same inputs finished is kept; half-written files of a killed run are deleted, and so
    are results of other inputs, after a line that says so. Raises InputError for those if `replace` is False, for
    results of another kind (most of whose inputs have other names), for a folder that another run holds, and for files
    that would have to be deleted and are not on the list of what was written here, or have changed since.
    """
    folder = Path(folder)
    with longrun.claimed(folder):
        wanted, earlier = json.loads(json.dumps(inputs, default=str)), record(folder)
        names = [path.name for path in folder.iterdir()]
        if earlier is None and not all(name in (LOG, LIST) or longrun.TEMPORARY.fullmatch(name) for name in names):
            raise InputError(f"{folder}: holds files that this project did not make; choose an empty or new folder")
        if earlier is not None and earlier != wanted:
            changed = ", ".join(sorted(key for key in wanted | earlier if wanted.get(key) != earlier.get(key)))
            if not replace:
                raise InputError(f"{folder}: holds results of other settings ({changed}); name another folder")
            if 2 * len(earlier.keys() & wanted.keys()) <= len(earlier.keys() | wanted.keys()):
                raise InputError(f"{folder}: holds results of another kind, made from {', '.join(sorted(earlier))}; "
                                 "choose another folder")
            _empty(folder, changed)
        longrun.sweep(folder)
        if earlier != wanted:
            write_text(folder / RECORD, json.dumps(wanted, indent=1, sort_keys=True))
    return folder


def _empty(folder, changed):
    """Delete what is listed (see `files.atomic`), the records last: what is left when this is killed is ours. Raises
    InputError, before anything is deleted, for a file that is not ours."""
    listed, results, records = defaultdict(set), [], []
    for path in folder.rglob(LIST):
        for line in path.read_text(encoding="utf-8").splitlines():
            with suppress(ValueError):  # a line that was cut off
                digest, name = line.split(" ", 1)
                listed[path.parent / json.loads(name)].add(digest)
    for path in (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir()):
        if path.name in (RECORD, LIST):
            records.append(path)
        elif path.name != LOG and not longrun.TEMPORARY.fullmatch(path.name):
            if path not in listed or path.is_symlink() or _sha256(path) not in listed[path]:
                raise InputError(f"{folder}: its results have to go, for {changed} changed; but {path} was not "
                                 "written here, or was changed since; move it away, or name another folder")
            results.append(path)
    if results:
        longrun.say(f"{folder}: deleting {len(results):,} files, the results of another {changed}")
    for path in (*results, *sorted(records, key=lambda path: (-len(path.parts), path.name == RECORD))):
        path.unlink()
        with suppress(OSError):  # not empty
            path.parent.rmdir()
    folder.mkdir(exist_ok=True)


def record(folder):
    """What the results in a stage's folder were made from: a dict, or None where the folder is no stage."""
    path = Path(folder) / RECORD
    if not path.is_file():
        return None
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError):
        raise InputError(f"{path}: is damaged; remove its folder") from None


def made_from(folder):
    """A digest of what the results in a stage's folder were made from."""
    return content(Path(folder) / RECORD)


def check_worker(folder, made_from, **here):
    """Raise InputError where this worker does not see the record of a stage that the others see, or has other inputs.

    made_from: the record that the others see. here: inputs as this worker has them, such as versions of packages.
    """
    if record(folder) != made_from:
        raise InputError(f"{folder}: this worker does not see what the others see there; all of them need the same "
                         "folders under the same paths")
    if made_from | here != made_from:
        raise InputError("this worker has another model, or another version of thesis_repro or its packages; give all "
                         "of them the same, and start them again")


TEXT_COLUMNS = ("sequence", "run", "method", "estimator", "stage", "flag")


def kept_table(path, rows=None, **options):
    """The table that an earlier run left in a file, or None: where there is none, and where it is empty, cut off, has
    another number of rows or holds text in another column than TEXT_COLUMNS."""
    path = Path(path)
    if not path.is_file():
        return None
    with suppress(ValueError, UnicodeError):  # pandas' errors are ValueErrors
        table = pd.read_csv(path, **options)
        plain = all(name in TEXT_COLUMNS or pd.api.types.is_numeric_dtype(table[name]) for name in table)
        if plain and rows in (None, len(table)) and path.read_bytes().endswith(b"\n"):
            return table
    longrun.say(f"{path}: is damaged, and made again", warning=True)
    return None


# The state of a long job


def store(path, job, arrays):
    """Write what a long job needs to go on: `job` (JSON values) and arrays by name."""
    with atomic(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, job=json.dumps(job), **{f"array {name}": array for name, array in arrays.items()})


def resume(path, arrays=True):
    """What `store` wrote, (job, arrays), or with `arrays` False the job alone, {}; None where there is nothing.

    Raises InputError for a damaged file.
    """
    path = Path(path)
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as state:
            names = [name for name in state.files if name != "job"] if arrays else []
            return json.loads(str(state["job"])), {name.removeprefix("array "): state[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise InputError(f"{path}: is damaged; remove it to begin anew") from None


# Digests


@lru_cache
def code(*places):
    """A digest of what folders ("odometry") or modules ("study/controls") of this package do.

    Everything of the package that they import counts with them. Comments and docstrings do not.
    """
    digest = hashlib.sha256()
    for path in _modules(places):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
                node.body = node.body[1:]
        digest.update(f"{path.relative_to(_PACKAGE)}{ast.dump(tree)}".encode())
    return digest.hexdigest()[:12]


class _PackageFinder(ModuleFinder):
    """Finds what is imported of this package, and nothing of those that are installed beside it."""

    def find_module(self, name, path, parent=None):
        if path is None and name != _PACKAGE.name:
            raise ImportError(name)
        return super().find_module(name, path, parent)


def _modules(places):
    """The files of some places and of all of the package that they import, sorted."""
    finder = _PackageFinder([str(_PACKAGE.parent)])
    for place in places:
        for path in sorted((_PACKAGE / place).glob("*.py")) or [_PACKAGE / f"{place}.py"]:
            finder.import_hook(".".join(path.relative_to(_PACKAGE.parent).with_suffix("").parts))
    return sorted({Path(module.__file__) for module in finder.modules.values() if module.__file__})


def made_with(*packages):
    """What bits depend on beside the data and the code: versions, and how TensorFlow is told to calculate."""
    versions = {name: importlib.metadata.version(name) for name in packages}
    return {"versions": versions, "onednn": os.environ.get("TF_ENABLE_ONEDNN_OPTS")}


def listing(paths):
    """A digest of files by name and content."""
    paths = [Path(path) for path in paths]
    lines = [f"{path.name}:{digest}\n" for path, digest in zip(paths, contents(paths), strict=True)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:12]


def content(path):
    """A digest of one file's bytes."""
    return contents([path])[0]


SETTLED = 0.1  # seconds: a file that is younger may change again within one tick of the file system's clock


def contents(paths):
    """Digests of the bytes of files. They are remembered in the build folder, so a file is read again only where
    its path, size, dates or inode are others: gigabytes cost their reading once."""
    paths = [Path(path).absolute() for path in paths]
    identities = {path: _identity(path) for path in paths}
    keys = {path: (json.dumps(str(path)), json.dumps(identity)) for path, identity in identities.items()}
    digests = {}
    with suppress(OSError, sqlite3.Error), _remembered() as database:
        query = "SELECT digest FROM digests WHERE path = ? AND identity = ?"
        rows = ((path, database.execute(query, key).fetchone()) for path, key in keys.items())
        digests = {path: row[0] for path, row in rows if row}
    unknown = [path for path in keys if path not in digests]
    with ThreadPoolExecutor(4) as pool:
        read = pool.map(_sha256, unknown)
        digests |= zip(unknown, progress(read, "looking at the data once", len(unknown), unit="file"))
    settled = [path for path in unknown if max(identities[path][1:3]) < time.time_ns() - SETTLED * 1e9]
    with suppress(OSError, sqlite3.Error), _remembered() as database:
        database.executemany("INSERT OR REPLACE INTO digests VALUES (?, ?, ?)",
                             [(*keys[path], digests[path]) for path in settled])
    return [digests[path][:12] for path in paths]


def _identity(path):
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: is no file; data must be in files")
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev


@contextmanager
def _remembered():
    """The database of digests. Where none can be kept, files are read again."""
    folder = Path(os.environ.get("THESIS_REPRO_BUILD") or _PACKAGE.parent / "build")
    folder.mkdir(parents=True, exist_ok=True)
    with closing(sqlite3.connect(folder / "digests.sqlite", timeout=2)) as database, database:
        database.execute("CREATE TABLE IF NOT EXISTS digests (path TEXT PRIMARY KEY, identity TEXT, digest TEXT)")
        yield database


def _sha256(path):
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
