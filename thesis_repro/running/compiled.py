"""Compile the inner loops with Numba."""

import hashlib
import time
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import Any

import numba
from numba.extending import is_jitted

from thesis_repro.running import messages

DIGEST_NAME = "compiled-from"  # a file in each folder of Numba's cache
_PACKAGE = Path(__file__).parents[1]
_IMPORTED = time.time_ns()


def fast(function: Callable, **options: Any) -> Callable:
    """Compile a function of numbers and arrays, without Python's lock.

    The machine code is cached on disk. Compiled functions may only call functions from their own
    room of the package (see `room_of`). Division by zero gives infinity or NaN, as in numpy and
    OpenCV.

    Numba compiles a function anew for each combination of types and memory layouts, and compiles
    the numpy calls in it as well. So callers pass C-contiguous arrays of one type. Loops over
    numbers compile faster than array expressions.
    """
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
    try:
        dispatcher = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # Numba finds no folder that it may write its cache to
        return numba.njit(**options)(function)
    if is_jitted(dispatcher):  # NUMBA_DISABLE_JIT=1 returns the function as it is
        _check_cache_before_use(dispatcher, room_of(Path(function.__code__.co_filename)))
    return dispatcher


def inner(function: Callable, **options: Any) -> Callable:
    """Compile a function for calls from compiled functions only.

    It is inlined there, and Python cannot call it. This saves compile time and run time.
    """
    return fast(function, forceinline=True, no_cpython_wrapper=True, **options)


# The cache


def room_of(file: Path) -> Path:
    """Return the folder whose files the machine code of a file's functions can depend on.

    It is the room of the package, such as thesis_repro/odometry with all that is in it, or the
    file's own folder outside of the package, such as street_world.
    """
    if file.is_relative_to(_PACKAGE):
        return _PACKAGE / file.relative_to(_PACKAGE).parts[0]
    return file.parent


def _check_cache_before_use(dispatcher: Any, room: Path) -> None:
    """Let a compiled function call `forget_stale` before it looks into its cache.

    Numba calls `compile` for each new combination of types. It loads the machine code or makes it.
    A signal waits until it has, because callbacks of the compiler lose exceptions.
    """
    load_or_compile = dispatcher.compile

    @wraps(load_or_compile)
    def check_and_compile(types: Any) -> Any:
        with messages.held_signals():
            _forget_stale_once(Path(dispatcher.stats.cache_path), room)
            return load_or_compile(types)

    dispatcher.compile = check_and_compile


def forget_stale(cache_folder: Path, room: Path) -> None:
    """Delete the machine code in a folder of Numba's cache if a module of its room has changed.

    Numba compares only the date and size of the file that defines a function. It misses changes of
    functions that are called from other files, and changes that a jumping clock hides.
    """
    digest = _digest_of_modules(room)
    record = cache_folder / DIGEST_NAME
    try:
        if record.is_file() and record.read_text() == digest:
            return
        for index in cache_folder.glob("*.nbi"):
            index.unlink(missing_ok=True)
        record.write_text(digest)
    except OSError:  # the folder is read-only, so it holds no stale cache
        pass


_forget_stale_once = cache(forget_stale)  # files that change later are not imported again


def _digest_of_modules(room: Path) -> str:
    """Return a digest of the modules in and below a folder.

    If one was edited after this process started, it may still run what was there before. Then the
    digest is one that no files have, so that the next process compiles anew.
    """
    paths = sorted(room.rglob("*.py"))
    newest = max((path.stat().st_mtime_ns for path in paths), default=0)
    if _IMPORTED < newest <= time.time_ns():  # a date in the future says nothing
        return "edited while it was in use"
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()
