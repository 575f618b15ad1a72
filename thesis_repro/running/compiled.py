"""Compile the inner loops with Numba."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

DIGEST_NAME = "compiled-from"  # a file in the folder of Numba's cache


def forget_stale(folder: Path) -> None:
    """Delete Numba's cache of the modules in and below a folder if the bytes of one of them have
    changed.

    Numba compares only the date and size of the file that defines a function. It misses changes of
    functions that are called from other files, and changes that a jumping clock hides.
    """
    digest = hashlib.sha256(
        b"".join(path.read_bytes() for path in sorted(folder.rglob("*.py")))
    ).hexdigest()
    record = folder / "__pycache__" / DIGEST_NAME
    try:
        if record.is_file() and record.read_text() == digest:
            return
        for index in folder.rglob("__pycache__/*.nbi"):
            index.unlink(missing_ok=True)
        record.parent.mkdir(exist_ok=True)
        record.write_text(digest)
    except OSError:  # the folder is read-only, so it holds no stale cache
        pass


_PACKAGE = Path(__file__).parents[1]
for _folder in (*_PACKAGE.iterdir(), _PACKAGE.parent / "street_world"):
    if _folder.is_dir():
        forget_stale(_folder)


def fast(function: Callable, **options: Any) -> Callable:
    """Compile a function of numbers and arrays. The machine code is cached on disk and runs without
    Python's lock.

    Compiled functions may only call functions from their own folder of the package or below it (see
    `forget_stale`). Division by zero gives infinity or NaN, as in numpy and OpenCV.

    Numba compiles a function anew for each combination of types and memory layouts, and compiles
    the numpy calls in it as well. So callers pass C-contiguous arrays of one type. Loops over
    numbers compile faster than array expressions.
    """
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # Numba finds no folder that it may write its cache to
        return numba.njit(**options)(function)


def inner(function: Callable) -> Callable:
    """Compile a function for calls from compiled functions only: it is inlined there, and Python
    cannot call it.

    This saves compile time and run time.
    """
    return fast(function, forceinline=True, no_cpython_wrapper=True)
