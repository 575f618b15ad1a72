"""One way to compile the inner loops."""

import numba


def fast(function):
    """Compile a function of numbers and arrays; kept on disk where possible, free to run beside other threads.

    Division by zero gives infinity or NaN, as in numpy and OpenCV, not an exception.
    """
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder that numba may write its cache to
        return numba.njit(nogil=True, error_model="numpy")(function)
