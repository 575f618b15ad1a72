"""A motion fitted to all correspondences that agree with it.

RANSAC's motion is computed from five of them.

The essential matrix is E = [t]x R (Equation 2.5, without its factor). The residual of a
correspondence (x, y), (u, v) is its signed Sampson distance: its distance, to first order, from a
pair with (u, v, 1) E (x, y, 1)^T = 0.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import get_cython_function_address, intrinsic

from thesis_repro.odometry.opencv_exact import epipolar
from thesis_repro.odometry.pose import MIN_CORRESPONDENCES, Motion
from thesis_repro.running.compiled import fast, inner

MAX_ITERATIONS = 10
REFINE_ROUNDS = 3
SUPPORT_THRESHOLDS = 2  # a correspondence within so many thresholds supports a motion
RESTART_SCALES = (4, 1)  # scales of the second start, in thresholds
# of the largest angle between the headings of one motion
SAME_MOTION_COSINE = np.cos(np.radians(15.0))
LOWER_COST = 0.99  # of the first start's cost: a smaller difference may be rounding
POINTS_PER_BLOCK = 64
# Rows of a block, one quantity each. NUMBERS: five derivatives of the residual, then the residual.
# WEIGHTED: the same, times the weight.
X, Y, U, V, L0, L1, M0, M1, INVERSE, RARITY, WEIGHT, PRODUCT, NUMBERS = range(13)
RESIDUAL = NUMBERS + 5
WEIGHTED = NUMBERS + 6
ROWS = WEIGHTED + 6
# LAPACK's gesv, which solves linear equations, as SciPy brings it. np.linalg.solve calls it, too,
# but takes seconds to compile.
binding.add_symbol(
    "gesv_of_scipy", get_cython_function_address("scipy.linalg.cython_lapack", "dgesv")
)
_intrinsic: Any = intrinsic  # mypy does not know that callers leave out the first argument
_INTEGER, _NUMBERS = types.CPointer(types.int32), types.CPointer(types.float64)
_gesv: Any = types.ExternalFunction(
    "gesv_of_scipy",
    # n, number of right sides, matrix, its stride, pivots, right sides, their stride, status
    types.void(_INTEGER, _INTEGER, _NUMBERS, _INTEGER, _INTEGER, _NUMBERS, _INTEGER, _INTEGER),
)


@dataclass(frozen=True, eq=False)
class RefinedMotion(Motion):
    """A fitted motion with its uncertainty."""

    support: int = 0  # number of correspondences near the motion
    # standard deviation of the rotation in its least certain direction, degrees
    rotation_std_deg: float = 0.0
    # standard deviation of the translation's direction in its least certain one, degrees
    heading_std_deg: float = 0.0
    condition: float = 1.0  # condition number of the normal equations


def smaller_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smaller rotation (3x3) of an essential matrix, and its translation.

    The translation (3) has unit length and either sign. The other rotation differs by 180 degrees
    about the translation (twisted pair). No car turns so far between frames.
    """
    first, second, translation = cv2.decomposeEssentialMat(matrix)
    smaller = first if np.trace(first) >= np.trace(second) else second
    return smaller, translation.ravel()


def fit(
    rotation: np.ndarray,
    translation: np.ndarray,
    current: np.ndarray,
    previous: np.ndarray,
    inliers: np.ndarray,
    threshold: float,
) -> RefinedMotion:
    """Motion refined from a start, with its uncertainty.

    See `refine` for the arguments. The start's unit translation may have either sign (see
    `with_uncertainty`).
    """
    rotation, heading = refine(rotation, translation, current, previous, inliers, threshold)
    return with_uncertainty(rotation, heading, current, previous, inliers, threshold)


def with_uncertainty(
    rotation: np.ndarray,
    heading: np.ndarray,
    current: np.ndarray,
    previous: np.ndarray,
    inliers: np.ndarray,
    threshold: float,
) -> RefinedMotion:
    """The same motion with its uncertainty.

    The points near the motion vote on the sign of its heading (`cheirality_votes`).
    """
    support = _support(rotation, heading, columns(current, previous), threshold)
    forward, backward = cheirality_votes(rotation, heading, support, threshold)
    rotation_std, heading_std, condition = _deviations(rotation, heading, support, threshold / 2)
    return RefinedMotion(
        rotation,
        heading if forward >= backward else -heading,
        inliers,
        max(forward, backward),
        support=support.shape[1],
        rotation_std_deg=rotation_std,
        heading_std_deg=heading_std,
        condition=condition,
    )


def refine(
    rotation: np.ndarray,
    translation: np.ndarray,
    current: np.ndarray,
    previous: np.ndarray,
    inliers: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Motion (rotation 3x3, unit translation) fitted to all its inliers.

    current, previous: normalised correspondences (N, 2). Levenberg-Marquardt over the rotation and
    the two angles of the translation's direction. It minimises Sampson distances with Cauchy
    weights at half the threshold. The first fit uses `inliers` (N booleans). Two more fits use the
    points within SUPPORT_THRESHOLDS, so the result hardly depends on which inliers RANSAC happened
    to choose.

    The cost at this narrow scale has many minima. So a second start fits the first result to all
    correspondences at wider scales first, and the motion with the lower cost is returned. A second
    result with another heading (see SAME_MOTION_COSINE) is another motion and is not used. The sign
    of the given translation is kept, because the cost does not depend on it.
    """
    points = columns(current, previous)
    start = np.ascontiguousarray(rotation), np.ascontiguousarray(translation)
    first = _rounds(*start, points, points.compress(inliers, axis=1), threshold)
    second = first
    for scale in RESTART_SCALES:
        second = _minimise(*second, points, scale * threshold)
    second = _rounds(*second, points, _support(*second, points, threshold), threshold)
    first_cost, _, _ = _normal_equations(*first, points, threshold / 2, False)
    second_cost, _, _ = _normal_equations(*second, points, threshold / 2, False)
    rotation, heading = first
    is_same_motion = abs(second[1] @ heading) > SAME_MOTION_COSINE
    if is_same_motion and second_cost < LOWER_COST * first_cost:
        rotation, heading = second
    if heading @ translation >= 0:
        return rotation, heading
    return rotation, -heading


def _deviations(
    rotation: np.ndarray, translation: np.ndarray, points: np.ndarray, scale: float
) -> tuple[float, float, float]:
    """Largest standard deviations of rotation and heading, degrees, and the condition number.

    The condition number is that of the normal equations.
    The covariance is the inverse of the Gauss-Newton matrix times scale^2, the variance of the
    residuals.
    """
    _, hessian, _ = _normal_equations(rotation, translation, points, scale, True)
    values, vectors = np.linalg.eigh(hessian)
    if points.shape[1] < MIN_CORRESPONDENCES or not values[0] > 1e-12 * values[-1]:
        return np.inf, np.inf, np.inf
    covariance = scale * scale * (vectors / values) @ vectors.T
    rotation_std = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    heading_std = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    condition = float(values[-1] / values[0])
    return float(np.degrees(rotation_std)), float(np.degrees(heading_std)), condition


@fast
def columns(current, previous):
    """Correspondences (N, 2) as (4, N): x, y, u and v."""
    points = np.empty((4, len(current)))
    for k in range(len(current)):
        points[0, k], points[1, k] = current[k, 0], current[k, 1]
        points[2, k], points[3, k] = previous[k, 0], previous[k, 1]
    return points


@fast
def near(r, t, current, previous, limit):
    """N booleans: the correspondences whose Sampson distance from the motion is below the limit."""
    return _near(r, t, columns(current, previous), limit)


@inner
def _near(r, t, points, limit):
    """As `near`, of points (4, N)."""
    essential = _product(_skew(t), _row_by_row(r))
    mask = np.empty(points.shape[1], np.bool_)
    for k in range(len(mask)):
        x, y, u, v = points[0, k], points[1, k], points[2, k], points[3, k]
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(essential, x, y, u, v)
        square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        mask[k] = algebraic * algebraic < limit * limit * square
    return mask


@fast
def _support(r, t, points, threshold):
    """The points (4, N) that support a motion."""
    mask = _near(r, t, points, SUPPORT_THRESHOLDS * threshold)
    count = 0
    for k in range(len(mask)):
        count += mask[k]
    support = np.empty((4, count))
    k, place = 0, 0
    while place < count:
        for row in range(4):
            support[row, place] = points[row, k]
        place += mask[k]  # otherwise the next point is written to the same place
        k += 1
    return support


@fast
def _rounds(r, t, points, support, threshold):
    """A motion fitted to its support (4, M), and again to the points (4, N) near it."""
    for k in range(REFINE_ROUNDS):
        if k > 0:
            support = _support(r, t, points, threshold)
        if support.shape[1] < MIN_CORRESPONDENCES:
            break
        r, t = _minimise(r, t, support, threshold / 2)
    return r, t


@fast
def _minimise(r, t, points, scale):
    """Levenberg-Marquardt iteration: each step solves (H + damping diag H) change = -gradient."""
    damping = 1e-4
    integers = np.empty(8, np.int32)
    cost, hessian, gradient = _normal_equations(r, t, points, scale, True)
    for k in range(MAX_ITERATIONS):
        damped = hessian.copy()
        for j in range(5):
            damped[j, j] += damping * hessian[j, j] + 1e-12
        change = -gradient
        _solve(damped, change, integers)
        r_new, t_new = _moved(r, t, change)
        is_last = k == MAX_ITERATIONS - 1
        cost_new, hessian_new, gradient_new = _normal_equations(
            r_new, t_new, points, scale, not is_last
        )
        if cost_new < cost:
            settled = cost - cost_new < 1e-6 * cost
            r, t, cost, hessian, gradient = r_new, t_new, cost_new, hessian_new, gradient_new
            damping *= 0.1
            if settled:
                break
        else:
            damping *= 10
            if damping > 1e3:
                break
    return r, t


@inner
def _solve(matrix, right, integers):
    """Solve five linear equations with a symmetric matrix; right (5) becomes the solution.

    integers (8): space for the pivots and for the sizes that LAPACK takes by their addresses.
    """
    integers[0], integers[1], integers[2] = 5, 1, 0  # equations, right sides, status
    size, count, status = integers[0:].ctypes, integers[1:].ctypes, integers[2:].ctypes
    pivots = integers[3:].ctypes
    _gesv(size, count, matrix.ctypes, size, pivots, right.ctypes, size, status)


@fast
def cheirality_votes(rotation, t, points, parallax):
    """Numbers of points (4, N) in front of both cameras under (rotation, t) and (rotation, -t).

    Points whose rays meet at less than `parallax` (the
    sine of the angle) do not determine the sign, so they do not vote. (pose.recover_pose leaves out
    points beyond 50 translations, which in a slow step are a few metres.)
    """
    forward = 0
    backward = 0
    for k in range(points.shape[1]):
        x, y, b0, b1 = points[0, k], points[1, k], points[2, k], points[3, k]
        # Ray a in the previous camera's coordinates, and ray b; they meet where depth a + t = other
        # b.
        a0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
        a1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
        a2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
        n0, n1, n2 = a1 - a2 * b1, a2 * b0 - a0, a0 * b1 - a1 * b0  # a x b
        squared_sine = n0 * n0 + n1 * n1 + n2 * n2  # times both squared lengths
        if squared_sine <= parallax * parallax * (x * x + y * y + 1) * (b0 * b0 + b1 * b1 + 1):
            continue
        # n (b x t)
        depth = n0 * (b1 * t[2] - t[1]) + n1 * (t[0] - b0 * t[2]) + n2 * (b0 * t[1] - b1 * t[0])
        # n (a x t)
        other = (
            n0 * (a1 * t[2] - a2 * t[1])
            + n1 * (a2 * t[0] - a0 * t[2])
            + n2 * (a0 * t[1] - a1 * t[0])
        )
        if depth > 0 and other > 0:
            forward += 1
        elif depth < 0 and other < 0:
            backward += 1
    return forward, backward


# Matrices are tuples here, row by row: single numbers stay in registers.


@_intrinsic
def _multiply_add(typing_context, a, b, c):
    """Compute a * b + c, rounded once."""

    def generate(context, builder, signature, arguments):
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


@inner
def _row_times_matrix(a0, a1, a2, b):
    """Product of a row and a 3x3 matrix.

    It has the bits of np.dot, which starts from 0.0 and fuses as well, where the processor can.
    """
    return (
        _multiply_add(a2, b[6], _multiply_add(a1, b[3], _multiply_add(a0, b[0], 0.0))),
        _multiply_add(a2, b[7], _multiply_add(a1, b[4], _multiply_add(a0, b[1], 0.0))),
        _multiply_add(a2, b[8], _multiply_add(a1, b[5], _multiply_add(a0, b[2], 0.0))),
    )


@inner
def _product(a, b):
    """Product of two 3x3 matrices."""
    p0, p1, p2 = _row_times_matrix(a[0], a[1], a[2], b)
    p3, p4, p5 = _row_times_matrix(a[3], a[4], a[5], b)
    p6, p7, p8 = _row_times_matrix(a[6], a[7], a[8], b)
    return p0, p1, p2, p3, p4, p5, p6, p7, p8


@inner
def _row_by_row(m):
    """An array (3, 3) as a tuple."""
    return m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2]


@inner
def _skew(v):
    """Matrix [v]x of the cross product with v (Equation 2.5)."""
    return 0.0, -v[2], v[1], v[2], 0.0, -v[0], -v[1], v[0], 0.0


@inner
def _normalised(v0, v1, v2):
    """Unit vector (3) in the direction of (v0, v1, v2)."""
    norm = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    return v0 / norm, v1 / norm, v2 / norm


@inner
def _tangents(t):
    """Two unit vectors that are perpendicular to the unit vector t and to each other."""
    # cross product with the axis that t is farthest from
    if abs(t[0]) <= abs(t[1]) and abs(t[0]) <= abs(t[2]):
        x, y, z = 0.0, t[2], -t[1]
    elif abs(t[1]) <= abs(t[2]):
        x, y, z = -t[2], 0.0, t[0]
    else:
        x, y, z = t[1], -t[0], 0.0
    first = _normalised(x, y, z)
    second = (
        t[1] * first[2] - t[2] * first[1],
        t[2] * first[0] - t[0] * first[2],
        t[0] * first[1] - t[1] * first[0],
    )
    return first, second


@inner
def _moved(r, t, change):
    """Motion after a change (5) of its parameters.

    The rotation becomes exp([turn]x) R (Rodrigues' formula). t moves along its tangents.
    """
    angle = np.sqrt(change[0] * change[0] + change[1] * change[1] + change[2] * change[2])
    cross = _skew(change)
    square = _product(cross, cross)
    sine, cosine = 1.0, 0.0
    if angle > 1e-12:
        sine = np.sin(angle) / angle
        cosine = (1 - np.cos(angle)) / (angle * angle)
    rodrigues = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            rodrigues[i, j] = (i == j) + sine * cross[k] + cosine * square[k]
    first, second = _tangents(t)
    heading = np.empty(3)
    heading[0], heading[1], heading[2] = _normalised(
        t[0] + change[3] * first[0] + change[4] * second[0],
        t[1] + change[3] * first[1] + change[4] * second[1],
        t[2] + change[3] * first[2] + change[4] * second[2],
    )
    rotation = np.empty((3, 3))
    _write(rotation.ravel(), _product(_row_by_row(rodrigues), _row_by_row(r)))
    return rotation, heading


@inner
def _write(array, entries):
    """Write the entries of a matrix to an array (9)."""
    for k in range(9):
        array[k] = entries[k]


@inner
def _essential_and_derivatives(r, t):
    """E = [t]x R and its five derivatives (6, 9), row by row.

    Three derivatives are [t]x [unit]x R, by the rotation. Two are [tangent]x R, by the direction.
    """
    matrices = np.empty((6, 9))
    rotation = _row_by_row(r)
    cross = _skew(t)
    first, second = _tangents(t)
    _write(matrices[0], _product(cross, rotation))
    _write(matrices[1], _product(cross, _product(_skew((1.0, 0.0, 0.0)), rotation)))
    _write(matrices[2], _product(cross, _product(_skew((0.0, 1.0, 0.0)), rotation)))
    _write(matrices[3], _product(cross, _product(_skew((0.0, 0.0, 1.0)), rotation)))
    _write(matrices[4], _product(_skew(first), rotation))
    _write(matrices[5], _product(_skew(second), rotation))
    return matrices


@fast
def _normal_equations(r, t, points, scale, with_derivatives):
    """Cauchy cost of the Sampson distances, its Gauss-Newton matrix (5, 5) and its gradient (5).

    With residual s and weight w = 1 / (1 + (s / scale)^2): the sums of log(1 + (s / scale)^2), of w
    J^T J and of w s J. Without derivatives, only the cost is computed.
    """
    matrices = _essential_and_derivatives(r, t)
    essential = epipolar.entries(matrices[0])
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
            derivative = epipolar.entries(matrices[1 + k])
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


@inner
def _mirror(matrix):
    """Copy the lower triangle of a matrix (5, 5) to the upper one."""
    for k in range(5):
        for j in range(k):
            matrix[j, k] = matrix[k, j]
