"""How the functions of this package are compiled by Numba."""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.extending import is_jitted


def compiled(function: Callable, **options: Any) -> Callable:
    """Compile a function of numbers and arrays, without Python's lock.

    Division by zero gives infinity or NaN, as in numpy and OpenCV. The machine code is cached on
    disk. Compiled functions may call functions of their own folder and of this package.

    Numba compiles a function anew for each combination of types and memory layouts. So callers pass
    C-contiguous arrays of one type.
    """
    # said, fastmath is not inherited from the function that calls this one
    usual = {"nogil": True, "error_model": "numpy", "fastmath": False, "no_cfunc_wrapper": True}
    options = {**usual, **options}
    try:
        dispatcher = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # Numba finds no folder that it may write its cache to
        return numba.njit(**options)(function)
    if is_jitted(dispatcher):  # NUMBA_DISABLE_JIT=1 returns the function as it is
        _notice_changes(dispatcher, Path(function.__code__.co_filename).parent)
    return dispatcher


def inlined(function: Callable, **options: Any) -> Callable:
    """Compile a function that is inlined into compiled functions. Python cannot call it."""
    return compiled(function, forceinline=True, no_cpython_wrapper=True, **options)


def is_on_disk(function: Any) -> bool:
    """Return whether the machine code of a compiled function is on disk."""
    file = getattr(getattr(function, "_cache", None), "_cache_file", None)
    return file is not None and bool(file._load_index())


def _notice_changes(dispatcher: Any, folder: Path) -> None:
    """Let Numba compile anew after a change of a module in a function's folder or this package.

    Numba itself compares date and size of the one file that defines a function, so it misses a
    change of a function that is called from another file.
    """
    dispatcher._cache._cache_file._source_stamp = _digest_of_modules(folder)


@cache
def _digest_of_modules(folder: Path) -> str:
    """Digest of the modules in a folder and in this package."""
    paths = sorted({*folder.glob("*.py"), *Path(__file__).parent.glob("*.py")})
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()
