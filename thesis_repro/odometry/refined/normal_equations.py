"""The normal equations of a fit: how the Sampson distances change with the motion.

A motion is a rotation and a translation's direction; its five parameters are a small rotation and
two changes of the direction along its tangents.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from opencv_exact import epipolar
from opencv_exact.compiling import compiled, inlined
from thesis_repro.odometry.refined import matrices

POINTS_PER_BLOCK = 64
# Rows of a block, one quantity each. NUMBERS: five derivatives of the residual, then the residual.
# WEIGHTED: the same, times the weight.
X, Y, U, V, L0, L1, M0, M1, INVERSE, RARITY, WEIGHT, PRODUCT, NUMBERS = range(13)
RESIDUAL = NUMBERS + 5
WEIGHTED = NUMBERS + 6
ROWS = WEIGHTED + 6
_intrinsic: Any = intrinsic  # mypy does not know that callers leave out the first argument


@compiled
def normal_equations(r, t, points, scale, with_derivatives):
    """Cauchy cost of the Sampson distances, its Gauss-Newton matrix (5, 5) and its gradient (5).

    With residual s and weight w = 1 / (1 + (s / scale)^2): the sums of log(1 + (s / scale)^2), of w
    J^T J and of w s J. Without derivatives, only the cost is computed.
    """
    essentials = _essential_and_derivatives(r, t)
    essential = epipolar.entries(essentials[0])
    cost = 0.0
    sums = np.zeros((6, 8))
    # Points are handled in blocks, one quantity after the other, so that these loops are
    # vectorised. The sums go point by point, so the bits are those of one loop over all points.
    # All quantities are rows of one array: the compiler sees that they do not overlap.
    size = POINTS_PER_BLOCK
    rows = np.empty((ROWS, size))
    for start in range(0, points.shape[1], size):
        count = min(size, points.shape[1] - start)
        for i in range(count):
            rows[X, i], rows[Y, i] = points[0, start + i], points[1, start + i]
            rows[U, i], rows[V, i] = points[2, start + i], points[3, start + i]
        for i in range(count):
            algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(
                essential, rows[X, i], rows[Y, i], rows[U, i], rows[V, i]
            )
            square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
            # a point at an epipole has no residual
            inverse = 1 / np.sqrt(square) if square >= 1e-18 else 0.0
            residual = algebraic * inverse  # signed Sampson distance
            ratio = residual / scale
            rows[L0, i], rows[L1, i], rows[M0, i], rows[M1, i] = l0, l1, m0, m1
            rows[INVERSE, i], rows[RESIDUAL, i] = inverse, residual
            rows[RARITY, i] = 1 + ratio * ratio
        for i in range(count):
            cost += np.log(rows[RARITY, i])
        if not with_derivatives:
            continue
        for i in range(count):
            rows[WEIGHT, i] = 1 / rows[RARITY, i]
            rows[WEIGHTED + 5, i] = rows[WEIGHT, i] * rows[RESIDUAL, i]
            rows[PRODUCT, i] = rows[RESIDUAL, i] * rows[INVERSE, i]
        for k in range(5):
            derivative = epipolar.entries(essentials[1 + k])
            for i in range(count):
                change, d0, d1, c0, c1 = epipolar.sampson_terms(
                    derivative, rows[X, i], rows[Y, i], rows[U, i], rows[V, i]
                )
                # (a / sqrt(q))' = a' / sqrt(q) - a q' / (2 q sqrt(q)), where q = l0^2 + l1^2 + m0^2
                # + m1^2
                slope = rows[L0, i] * d0 + rows[L1, i] * d1 + rows[M0, i] * c0 + rows[M1, i] * c1
                number = (change - rows[PRODUCT, i] * slope) * rows[INVERSE, i]
                rows[NUMBERS + k, i] = number
                rows[WEIGHTED + k, i] = rows[WEIGHT, i] * number
        _add_products(sums, rows, count)
    hessian = sums[:5, :5].copy()
    _mirror(hessian)
    return cost, hessian, sums[5, :5].copy()


@_intrinsic
def _add_products(typing_context, sums, rows, count):
    """Add rows[WEIGHTED + k, i] * rows[NUMBERS + j, i] to sums[k, j], point by point (i), j <= k.

    sums: (6, 8). rows: (ROWS, POINTS_PER_BLOCK). count: number of points.

    The compiler would add one sum after the other. Here the sums of a row are one vector, which
    stays in a register: four sums (j < 4) and, in the last two rows, two more. A vector also holds
    sums with j > k, which nobody reads.
    """
    double, index = ir.DoubleType(), ir.IntType(32)
    four, two = ir.VectorType(double, 4), ir.VectorType(double, 2)

    def generate(context, builder, signature, arguments):
        sums, rows = (
            context.make_array(kind)(context, builder, array).data
            for kind, array in zip(signature.args[:2], arguments[:2], strict=True)
        )

        def place(array, offset):
            return builder.gep(array, [context.get_constant(types.intp, offset)])

        def vector(kind, values):
            result = ir.Constant(kind, ir.Undefined)
            for k, value in enumerate(values):
                result = builder.insert_element(result, value, ir.Constant(index, k))
            return result

        def column(first, i):
            places = [place(rows, POINTS_PER_BLOCK * (first + k)) for k in range(6)]
            return [builder.load(builder.gep(start, [i])) for start in places]

        parts = [(k, 0, four) for k in range(6)] + [(k, 4, two) for k in (4, 5)]
        totals = []
        for k, first, kind in parts:
            source = builder.bitcast(place(sums, 8 * k + first), kind.as_pointer())
            total = cgutils.alloca_once_value(builder, builder.load(source, align=8))
            totals.append((source, total))
        with cgutils.for_range(builder, arguments[2]) as loop:
            factors = column(WEIGHTED, loop.index)
            row = column(NUMBERS, loop.index)
            vectors = {0: vector(four, row[:4]), 4: vector(two, row[4:])}
            for (k, first, kind), (_, total) in zip(parts, totals, strict=True):
                factor = vector(kind, [factors[k]] * kind.count)
                product = builder.fmul(factor, vectors[first])
                builder.store(builder.fadd(builder.load(total), product), total)
        for target, total in totals:
            builder.store(builder.load(total), target, align=8)

    return types.void(sums, rows, count), generate


@inlined
def _mirror(matrix):
    """Copy the lower triangle of a matrix (5, 5) to the upper one."""
    for k in range(5):
        for j in range(k):
            matrix[j, k] = matrix[k, j]


@inlined
def _essential_and_derivatives(r, t):
    """E = [t]x R and its five derivatives (6, 9), row by row.

    Three derivatives are [t]x [unit]x R, by the rotation. Two are [tangent]x R, by the direction.
    """
    essentials = np.empty((6, 9))
    rotation = matrices.row_by_row(r)
    cross = matrices.skew(t)
    first, second = matrices.tangents(t)
    _write_product(cross, rotation, essentials[0])
    for k in range(3):
        axis = 1.0 * (k == 0), 1.0 * (k == 1), 1.0 * (k == 2)
        turned = matrices.product(matrices.skew(axis), rotation)
        _write_product(cross, turned, essentials[1 + k])
    _write_product(matrices.skew(first), rotation, essentials[4])
    _write_product(matrices.skew(second), rotation, essentials[5])
    return essentials


@inlined
def _write_product(a, b, entries):
    matrices.write(entries, matrices.product(a, b))
