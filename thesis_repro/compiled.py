"""One way to compile the inner loops."""

import hashlib
import os
from pathlib import Path

import numba

MADE_FROM = "compiled-from"  # beside what Numba keeps


def forget_stale(folder):
    """Delete what Numba keeps of a folder's modules where one of them has changed since, by its bytes.

    Numba itself notices a change of a function's own file alone, and that by its date and size; not of a function that
    it calls from another one. A clock can jump, so dates say nothing here.
    """
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(folder.glob("*.py")))).hexdigest()
    record = folder / "__pycache__" / MADE_FROM
    try:
        if record.is_file() and record.read_text() == digest:
            return
        for index in folder.glob("__pycache__/*.nbi"):
            index.unlink(missing_ok=True)
        record.parent.mkdir(exist_ok=True)
        temporary = record.with_name(f"{MADE_FROM}.{os.getpid()}")
        temporary.write_text(digest)
        os.replace(temporary, record)
    except OSError:  # nothing may be written here, so that nothing can be stale
        pass


for _folder in (path.parent for path in Path(__file__).parent.glob("*/__init__.py")):
    forget_stale(_folder)


def fast(function, **options):
    """Compile a function of numbers and arrays; kept on disk where possible, free to run beside other threads.

    Compiled functions call only what lies in their own folder. Division by zero gives infinity or NaN, as in numpy and
    OpenCV, not an exception.
    """
    options = {"nogil": True, "error_model": "numpy", **options}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that numba may write its cache to
        return numba.njit(**options)(function)


def inner(function):
    """Compile a small function, as `fast` does, into the compiled ones that call it.

    Python cannot call it: without a way in from there it takes less time to compile, and as part of its callers, less
    to run.
    """
    return fast(function, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
