"""The normal equations of a fit: how the Sampson distances change with the motion.

A motion is a rotation and a translation's direction; its five parameters are a small rotation and
two changes of the direction along its tangents.
"""

import numpy as np

from opencv_exact import epipolar
from opencv_exact.compiling import compiled, inlined
from thesis_repro.odometry.refined import matrices

# Points are handled in blocks, one quantity after the other, because such loops are vectorised: a
# plain loop over the points takes twice as long. The sums go point by point, so the bits are those
# of a plain loop.
POINTS_PER_BLOCK = 64
# Rows of a block, one quantity each. DERIVATIVES: five of the residual. WEIGHTED: the same,
# times the weight, and the residual times the weight. They are rows of one array, so that the
# compiler sees that they do not overlap.
X, Y, U, V, L0, L1, M0, M1, INVERSE, RESIDUAL, RARITY, WEIGHT = range(12)
DERIVATIVES, WEIGHTED, ROWS = 12, 17, 23


@compiled
def normal_equations(r, t, points, scale, with_derivatives):
    """Cauchy cost of the Sampson distances, its Gauss-Newton matrix (5, 5) and its gradient (5).

    With residual s and weight w = 1 / (1 + (s / scale)^2): the sums of log(1 + (s / scale)^2), of w
    J^T J and of w s J. Without derivatives, only the cost is computed.
    """
    essential, derivatives = _essential_and_derivatives(r, t)
    cost = 0.0
    sums = np.zeros((6, 5))
    rows = np.empty((ROWS, POINTS_PER_BLOCK))
    for start in range(0, points.shape[1], POINTS_PER_BLOCK):
        count = min(POINTS_PER_BLOCK, points.shape[1] - start)
        for i in range(count):
            rows[X, i], rows[Y, i] = points[0, start + i], points[1, start + i]
            rows[U, i], rows[V, i] = points[2, start + i], points[3, start + i]
        _write_residuals(essential, scale, rows, count)
        for i in range(count):
            cost += np.log(rows[RARITY, i])
        if not with_derivatives:
            continue
        for k in range(5):
            _write_derivatives(derivatives[k], k, rows, count)
        for k in range(6):
            _add_products(sums[k], rows[WEIGHTED + k], rows[DERIVATIVES:], count)
    hessian = np.empty((5, 5))
    for k in range(5):
        for j in range(k + 1):
            hessian[k, j] = hessian[j, k] = sums[k, j]
    return cost, hessian, sums[5].copy()


@inlined
def _write_residuals(essential, scale, rows, count):
    """Write residuals and weights of a block's points, and what their derivatives need."""
    for i in range(count):
        x, y, u, v = rows[X, i], rows[Y, i], rows[U, i], rows[V, i]
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(essential, x, y, u, v)
        square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        # a point at an epipole has no residual
        inverse = 1 / np.sqrt(square) if square >= 1e-18 else 0.0
        residual = algebraic * inverse  # signed Sampson distance
        ratio = residual / scale
        rarity = 1 + ratio * ratio
        weight = 1 / rarity
        rows[L0, i], rows[L1, i], rows[M0, i], rows[M1, i] = l0, l1, m0, m1
        rows[INVERSE, i], rows[RESIDUAL, i], rows[RARITY, i] = inverse, residual, rarity
        rows[WEIGHT, i], rows[WEIGHTED + 5, i] = weight, weight * residual


@inlined
def _write_derivatives(derivative, k, rows, count):
    """Write the derivatives of the residuals for parameter k of the motion.

    (a / sqrt(q))' = a' / sqrt(q) - a q' / (2 q sqrt(q)), where q = l0^2 + l1^2 + m0^2 + m1^2.
    """
    for i in range(count):
        x, y, u, v = rows[X, i], rows[Y, i], rows[U, i], rows[V, i]
        change, d0, d1, c0, c1 = epipolar.sampson_terms(derivative, x, y, u, v)
        slope = rows[L0, i] * d0 + rows[L1, i] * d1 + rows[M0, i] * c0 + rows[M1, i] * c1
        inverse = rows[INVERSE, i]
        number = (change - rows[RESIDUAL, i] * inverse * slope) * inverse
        rows[DERIVATIVES + k, i], rows[WEIGHTED + k, i] = number, rows[WEIGHT, i] * number


@inlined
def _add_products(sums, factors, numbers, count):
    """Add factors[i] * numbers[k, i] to the five sums, point by point."""
    sum0, sum1, sum2, sum3, sum4 = sums[0], sums[1], sums[2], sums[3], sums[4]
    for i in range(count):
        sum0 += factors[i] * numbers[0, i]
        sum1 += factors[i] * numbers[1, i]
        sum2 += factors[i] * numbers[2, i]
        sum3 += factors[i] * numbers[3, i]
        sum4 += factors[i] * numbers[4, i]
    sums[0], sums[1], sums[2], sums[3], sums[4] = sum0, sum1, sum2, sum3, sum4


@inlined
def _essential_and_derivatives(r, t):
    """E = [t]x R and its five derivatives, row by row.

    Three derivatives are [t]x [axis]x R, by the rotation. Two are [tangent]x R, by the direction.
    """
    rotation, cross = matrices.row_by_row(r), matrices.skew(t)
    first, second = matrices.tangents(t)
    derivatives = (
        matrices.product(cross, matrices.product(matrices.skew((1.0, 0.0, 0.0)), rotation)),
        matrices.product(cross, matrices.product(matrices.skew((0.0, 1.0, 0.0)), rotation)),
        matrices.product(cross, matrices.product(matrices.skew((0.0, 0.0, 1.0)), rotation)),
        matrices.product(matrices.skew(first), rotation),
        matrices.product(matrices.skew(second), rotation),
    )
    return matrices.product(cross, rotation), derivatives
