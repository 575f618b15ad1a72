"""Small vectors and 3x3 matrices in compiled functions.

They are tuples, matrices row by row: single numbers stay in registers.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from opencv_exact.compiling import inlined

_intrinsic: Any = intrinsic  # mypy does not know that callers leave out the first argument


@_intrinsic
def _multiply_add(typing_context, a, b, c):
    """Compute a * b + c, rounded once."""

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


@inlined
def _row_times_matrix(a0, a1, a2, b):
    """Product of a row and a 3x3 matrix.

    It has the bits of np.dot, which starts from 0.0 and fuses as well, where the processor can.
    """
    return (
        _multiply_add(a2, b[6], _multiply_add(a1, b[3], _multiply_add(a0, b[0], 0.0))),
        _multiply_add(a2, b[7], _multiply_add(a1, b[4], _multiply_add(a0, b[1], 0.0))),
        _multiply_add(a2, b[8], _multiply_add(a1, b[5], _multiply_add(a0, b[2], 0.0))),
    )


@inlined
def product(a, b):
    """Product of two 3x3 matrices."""
    p0, p1, p2 = _row_times_matrix(a[0], a[1], a[2], b)
    p3, p4, p5 = _row_times_matrix(a[3], a[4], a[5], b)
    p6, p7, p8 = _row_times_matrix(a[6], a[7], a[8], b)
    return p0, p1, p2, p3, p4, p5, p6, p7, p8


@inlined
def row_by_row(m):
    """An array (3, 3) as a tuple."""
    return m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2]


@inlined
def skew(v):
    """Matrix [v]x of the cross product with v (Equation 2.5)."""
    return 0.0, -v[2], v[1], v[2], 0.0, -v[0], -v[1], v[0], 0.0


@inlined
def cross(a, b):
    """Cross product of two vectors (3)."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def dot(a, b):
    """Scalar product of two vectors (3)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def normalised(v):
    """Unit vector (3) in the direction of v."""
    norm = np.sqrt(dot(v, v))
    return v[0] / norm, v[1] / norm, v[2] / norm


@inlined
def tangents(t):
    """Two unit vectors that are perpendicular to the unit vector t and to each other."""
    # cross product with the axis that t is farthest from
    if abs(t[0]) <= abs(t[1]) and abs(t[0]) <= abs(t[2]):
        first = normalised((0.0, t[2], -t[1]))
    elif abs(t[1]) <= abs(t[2]):
        first = normalised((-t[2], 0.0, t[0]))
    else:
        first = normalised((t[1], -t[0], 0.0))
    return first, cross(t, first)
