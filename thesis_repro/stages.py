"""Results on disk that know what they were made from, and going on after a stop.

A *stage* is a folder with a record of what its results were made from (`stage`). A *state* is one file with what a long
job needs to go on, written whole or not at all (`store`, `resume`). A digest names an input in twelve letters.
"""

import ast
import hashlib
import json
import zipfile
from functools import lru_cache
from pathlib import Path

import numpy as np

from thesis_repro import InputError, longrun
from thesis_repro.files import atomic, write_text
from thesis_repro.longrun import LOG, RECORD

_PACKAGE = Path(__file__).parent


def stage(folder, *, replace=True, **inputs):
    """The folder of one stage, holding only results that were made from `inputs` (JSON values).

    What an earlier run with the same inputs finished is kept; half-written files of a killed run are deleted, and so
    are results of other inputs. Raises InputError for those if `replace` is False, for results of another kind (most of
    whose inputs have other names), for files that this project did not make, and for a folder that another run holds.
    """
    folder = Path(folder)
    with longrun.claimed(folder):
        wanted = json.loads(json.dumps(inputs, default=str))
        earlier = record(folder)
        if earlier is None and not all(_own(path) for path in folder.iterdir()):
            raise InputError(f"{folder}: holds files that this project did not make; choose an empty or new folder")
        if earlier is not None and earlier != wanted:
            if not replace:
                other = [key for key in {**wanted, **earlier} if wanted.get(key) != earlier.get(key)]
                raise InputError(f"{folder}: holds results of other settings ({', '.join(other)}); name another folder")
            if 2 * len(earlier.keys() & wanted.keys()) <= len(earlier.keys() | wanted.keys()):
                raise InputError(f"{folder}: holds results of another kind, made from {', '.join(sorted(earlier))}; "
                                 "choose another folder")
            _empty(folder)
        longrun.sweep(folder)
        if earlier != wanted:
            write_text(folder / RECORD, json.dumps(wanted, indent=1, sort_keys=True))
    return folder


def _own(path):
    """Whether a file may lie in a folder that is going to be a stage: the log, or a record that was half written."""
    return path.name == LOG or (path.name.startswith(f".{Path(RECORD).stem}.")
                                and longrun.TEMPORARY.fullmatch(path.name) is not None)


def _empty(folder):
    """Delete all but the log, records last: what is left when this is killed is known to be ours."""
    for path in sorted(folder.iterdir(), key=lambda path: path.name == RECORD):
        if path.is_dir() and not path.is_symlink():
            _empty(path)
            path.rmdir()
        elif path.name != LOG:
            path.unlink()


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
    trees = _trees(places)
    digest = hashlib.sha256()
    for path in sorted(trees):
        for node in ast.walk(trees[path]):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
                node.body = node.body[1:]
        digest.update(f"{path.relative_to(_PACKAGE)}{ast.dump(trees[path])}".encode())
    return digest.hexdigest()[:12]


def _trees(places):
    """The parsed modules of some places and of all that they import, {path: tree}."""
    paths = [path for place in places
             for path in (sorted((_PACKAGE / place).glob("*.py")) or [_PACKAGE / f"{place}.py"])]
    trees = {}
    while paths:
        path = paths.pop()
        if path not in trees:
            trees[path] = ast.parse(path.read_text(encoding="utf-8"))
            paths += _imported(trees[path])
    return trees


def _imported(tree):
    """The package's modules that a module imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == _PACKAGE.name:
            place = "/".join(node.module.split(".")[1:])
            for name in (place, *(f"{place}/{alias.name}".lstrip("/") for alias in node.names)):
                yield from (path for path in (_PACKAGE / f"{name}.py", _PACKAGE / name / "__init__.py")
                            if path.is_file())


def listing(paths):
    """A digest of files by name and size: enough to notice other data without reading gigabytes."""
    lines = [f"{path.parent.name}/{path.name}:{path.stat().st_size}\n" for path in map(Path, paths)]
    return hashlib.sha256("".join(lines).encode()).hexdigest()[:12]


def content(path):
    """A digest of one file's bytes."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]
