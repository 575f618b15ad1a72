"""One way to compile the inner loops."""

import hashlib
import os
from pathlib import Path

import numba

DIGEST_NAME = "compiled-from"  # the file beside Numba's


def forget_stale(folder):
    """Delete Numba's files of the modules in and below a folder where one of these has changed since, by its bytes.

    Numba itself only notices a change of a function's own file, by its date and size. It does not notice a change of a
    function that is called from another file. A clock can jump, so dates cannot be relied on.
    """
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(folder.rglob("*.py")))).hexdigest()
    record = folder / "__pycache__" / DIGEST_NAME
    try:
        if record.is_file() and record.read_text() == digest:
            return
        for index in folder.rglob("__pycache__/*.nbi"):
            index.unlink(missing_ok=True)
        record.parent.mkdir(exist_ok=True)
        temporary = record.with_name(f"{DIGEST_NAME}.{os.getpid()}")
        temporary.write_text(digest)
        os.replace(temporary, record)
    except OSError:  # nothing may be written here, so that nothing can be stale
        pass


for _folder in (path.parent for path in Path(__file__).parent.glob("*/__init__.py")):
    forget_stale(_folder)


def fast(function, **options):
    """Compile a function of numbers and arrays; kept on disk where possible, free to run beside other threads.

    Compiled functions call only what lies in their own folder of the package or below it. Division by zero gives
    infinity or NaN, as in numpy and OpenCV, not an exception.

    Numba compiles a function again for every combination of types and layouts, and every numpy call in it is compiled
    as well. So callers pass C-contiguous arrays of one type, and loops over single numbers take less time to compile
    than array expressions.
    """
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, **options}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that numba may write its cache to
        return numba.njit(**options)(function)


def inner(function):
    """Compile a function, as `fast` does, into the compiled ones that call it. Python cannot call it.

    Without an entry from Python it takes less time to compile, and as part of its callers, less to run.
    """
    return fast(function, forceinline=True, no_cpython_wrapper=True)
