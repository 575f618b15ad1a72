"""One way to compile the inner loops."""

from pathlib import Path

import numba


def forget_stale(folder):
    """Delete what Numba keeps of a folder's modules where one of them is newer.

    Numba itself notices a change of a function's own file alone, not of a function that it calls from another one.
    """
    newest = max((path.stat().st_mtime for path in folder.glob("*.py")), default=0)
    for index in folder.glob("__pycache__/*.nbi"):
        try:
            if index.stat().st_mtime < newest:
                index.unlink()
        except OSError:  # another process was faster, or may not write here, so that nothing can be stale
            pass


for _folder in (path.parent for path in Path(__file__).parent.glob("*/__init__.py")):
    forget_stale(_folder)


def fast(function):
    """Compile a function of numbers and arrays; kept on disk where possible, free to run beside other threads.

    Compiled functions call only what lies in their own folder. Division by zero gives infinity or NaN, as in numpy and
    OpenCV, not an exception.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder that numba may write its cache to
        return numba.njit(nogil=True, error_model="numpy")(function)
