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
from llvmlite import binding
from numba import types
from numba.extending import get_cython_function_address

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
# LAPACK's gesv, which solves linear equations, as SciPy brings it. np.linalg.solve calls it, too,
# but takes seconds to compile.
binding.add_symbol(
    "gesv_of_scipy", get_cython_function_address("scipy.linalg.cython_lapack", "dgesv")
)
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
    support = near(rotation, heading, current, previous, SUPPORT_THRESHOLDS * threshold)
    current = current.compress(support, axis=0)
    previous = previous.compress(support, axis=0)
    forward, backward = cheirality_votes(rotation, heading, current, previous, threshold)
    rotation_std, heading_std, condition = _deviations(
        rotation, heading, current, previous, threshold / 2
    )
    return RefinedMotion(
        rotation,
        heading if forward >= backward else -heading,
        inliers,
        max(forward, backward),
        support=len(current),
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
    start = np.ascontiguousarray(rotation), np.ascontiguousarray(translation)
    first = _rounds(start, current, previous, inliers, threshold)
    second = first
    for scale in RESTART_SCALES:
        second = _minimise(*second, current, previous, scale * threshold)
    near_second = near(*second, current, previous, SUPPORT_THRESHOLDS * threshold)
    second = _rounds(second, current, previous, near_second, threshold)
    first_cost, _, _ = _normal_equations(*first, current, previous, threshold / 2)
    second_cost, _, _ = _normal_equations(*second, current, previous, threshold / 2)
    rotation, heading = first
    is_same_motion = abs(second[1] @ heading) > SAME_MOTION_COSINE
    if is_same_motion and second_cost < LOWER_COST * first_cost:
        rotation, heading = second
    if heading @ translation >= 0:
        return rotation, heading
    return rotation, -heading


def _rounds(
    motion: tuple[np.ndarray, np.ndarray],
    current: np.ndarray,
    previous: np.ndarray,
    support: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray]:
    """A motion (rotation, translation) fitted to its support, and again to the points near it.

    support: N booleans.
    """
    for _ in range(REFINE_ROUNDS):
        if support.sum() < MIN_CORRESPONDENCES:
            break
        current_support = current.compress(support, axis=0)
        previous_support = previous.compress(support, axis=0)
        motion = _minimise(*motion, current_support, previous_support, threshold / 2)
        support = near(*motion, current, previous, SUPPORT_THRESHOLDS * threshold)
    return motion


def _deviations(
    rotation: np.ndarray,
    translation: np.ndarray,
    current: np.ndarray,
    previous: np.ndarray,
    scale: float,
) -> tuple[float, float, float]:
    """Largest standard deviations of rotation and heading, degrees, and the condition number.

    The condition number is that of the normal equations.
    The covariance is the inverse of the Gauss-Newton matrix times scale^2, the variance of the
    residuals.
    """
    _, hessian, _ = _normal_equations(rotation, translation, current, previous, scale)
    values, vectors = np.linalg.eigh(hessian)
    if len(current) < MIN_CORRESPONDENCES or not values[0] > 1e-12 * values[-1]:
        return np.inf, np.inf, np.inf
    covariance = scale * scale * (vectors / values) @ vectors.T
    rotation_std = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    heading_std = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    condition = float(values[-1] / values[0])
    return float(np.degrees(rotation_std)), float(np.degrees(heading_std)), condition


@fast
def near(r, t, current, previous, limit):
    """N booleans: the correspondences whose Sampson distance from the motion is below the limit."""
    essential = epipolar.entries(_product(_skew(t), r, np.empty((3, 3))).ravel())
    mask = np.empty(len(current), np.bool_)
    for index in range(len(current)):
        x, y = current[index, 0], current[index, 1]
        u, v = previous[index, 0], previous[index, 1]
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(essential, x, y, u, v)
        square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        mask[index] = algebraic * algebraic < limit * limit * square
    return mask


@fast
def _minimise(r, t, current, previous, scale):
    """Levenberg-Marquardt iteration: each step solves (H + damping diag H) change = -gradient."""
    damping = 1e-4
    integers = np.empty(8, np.int32)
    cost, hessian, gradient = _normal_equations(r, t, current, previous, scale)
    for _ in range(MAX_ITERATIONS):
        damped = hessian.copy()
        for k in range(5):
            damped[k, k] += damping * hessian[k, k] + 1e-12
        change = -gradient
        _solve(damped, change, integers)
        r_new, t_new = _moved(r, t, change)
        cost_new, hessian_new, gradient_new = _normal_equations(
            r_new, t_new, current, previous, scale
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
def cheirality_votes(rotation, t, current, previous, parallax):
    """Numbers of points in front of both cameras under (rotation, t) and (rotation, -t).

    current, previous: correspondences (N, 2). Points whose rays meet at less than `parallax` (the
    sine of the angle) do not determine the sign, so they do not vote. (pose.recover_pose leaves out
    points beyond 50 translations, which in a slow step are a few metres.)
    """
    forward = 0
    backward = 0
    for k in range(len(current)):
        x, y = current[k, 0], current[k, 1]
        # Ray a in the previous camera's coordinates, and ray b; they meet where depth a + t = other
        # b.
        a0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
        a1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
        a2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
        b0, b1 = previous[k, 0], previous[k, 1]
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


@inner
def _product(a, b, product):
    """Write and return the product of two 3x3 matrices.

    So np.dot is compiled once, and it is faster than without `product`.
    """
    return np.dot(a, b, product)


@inner
def _skew(v):
    """Matrix [v]x of the cross product with v (Equation 2.5)."""
    matrix = np.zeros((3, 3))
    matrix[0, 1], matrix[0, 2], matrix[1, 2] = -v[2], v[1], -v[0]
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = v[2], -v[1], v[0]
    return matrix


@inner
def _normalised(v0, v1, v2):
    """Unit vector (3) in the direction of (v0, v1, v2)."""
    norm = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    vector = np.empty(3)
    vector[0], vector[1], vector[2] = v0 / norm, v1 / norm, v2 / norm
    return vector


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
    second = np.empty(3)
    second[0] = t[1] * first[2] - t[2] * first[1]
    second[1] = t[2] * first[0] - t[0] * first[2]
    second[2] = t[0] * first[1] - t[1] * first[0]
    return first, second


@inner
def _moved(r, t, change):
    """Motion after a change (5) of its parameters.

    The rotation becomes exp([turn]x) R (Rodrigues' formula). t moves along its tangents.
    """
    angle = np.sqrt(change[0] * change[0] + change[1] * change[1] + change[2] * change[2])
    cross = _skew(change)
    square = _product(cross, cross, np.empty((3, 3)))
    sine, cosine = 1.0, 0.0
    if angle > 1e-12:
        sine = np.sin(angle) / angle
        cosine = (1 - np.cos(angle)) / (angle * angle)
    rodrigues = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            rodrigues[i, j] = (i == j) + sine * cross[i, j] + cosine * square[i, j]
    first, second = _tangents(t)
    heading = _normalised(
        t[0] + change[3] * first[0] + change[4] * second[0],
        t[1] + change[3] * first[1] + change[4] * second[1],
        t[2] + change[3] * first[2] + change[4] * second[2],
    )
    return _product(rodrigues, r, np.empty((3, 3))), heading


@inner
def _essential_and_derivatives(r, t):
    """E = [t]x R and its five derivatives (6, 9), row by row.

    Three derivatives are [t]x [unit]x R, by the rotation. Two are [tangent]x R, by the direction.
    """
    matrices = np.empty((6, 3, 3))
    unit = np.zeros((3, 3))
    cross = _skew(t)
    first, second = _tangents(t)
    _product(cross, r, matrices[0])
    for k in range(3):
        unit[k, k] = 1.0
        _product(cross, _product(_skew(unit[k]), r, np.empty((3, 3))), matrices[1 + k])
    _product(_skew(first), r, matrices[4])
    _product(_skew(second), r, matrices[5])
    return matrices.reshape(6, 9)


@fast
def _normal_equations(r, t, current, previous, scale):
    """Cauchy cost of the Sampson distances, its Gauss-Newton matrix (5, 5) and its gradient (5).

    With residual s and weight w = 1 / (1 + (s / scale)^2): the sums of log(1 + (s / scale)^2), of w
    J^T J and of w s J.
    """
    matrices = _essential_and_derivatives(r, t)
    essential = epipolar.entries(matrices[0])
    cost = 0.0
    sums = np.zeros((6, 6))
    # Points are handled in blocks, one quantity after the other, so that these loops are
    # vectorised. The sums go point by point, so the bits are those of one loop over all points.
    size = POINTS_PER_BLOCK
    x, y, u, v = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    l0, l1, m0, m1 = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    inverse, residual, rarity, weight = (
        np.empty(size),
        np.empty(size),
        np.empty(size),
        np.empty(size),
    )
    rows = np.empty((size, 6))  # derivatives of the residual, then the residual
    for start in range(0, len(current), size):
        count = min(size, len(current) - start)
        for i in range(count):
            x[i], y[i] = current[start + i, 0], current[start + i, 1]
            u[i], v[i] = previous[start + i, 0], previous[start + i, 1]
        for i in range(count):
            algebraic, l0[i], l1[i], m0[i], m1[i] = epipolar.sampson_terms(
                essential, x[i], y[i], u[i], v[i]
            )
            square = l0[i] * l0[i] + l1[i] * l1[i] + m0[i] * m0[i] + m1[i] * m1[i]
            # a point at an epipole has no residual
            inverse[i] = 1 / np.sqrt(square) if square >= 1e-18 else 0.0
            residual[i] = algebraic * inverse[i]  # signed Sampson distance
            ratio = residual[i] / scale
            rarity[i] = 1 + ratio * ratio
            weight[i] = 1 / rarity[i]
        for k in range(5):
            derivative = epipolar.entries(matrices[1 + k])
            for i in range(count):
                change, d0, d1, c0, c1 = epipolar.sampson_terms(derivative, x[i], y[i], u[i], v[i])
                # (a / sqrt(q))' = a' / sqrt(q) - a q' / (2 q sqrt(q)), where q = l0^2 + l1^2 + m0^2
                # + m1^2
                slope = l0[i] * d0 + l1[i] * d1 + m0[i] * c0 + m1[i] * c1
                rows[i, k] = (change - residual[i] * inverse[i] * slope) * inverse[i]
        for i in range(count):
            cost += np.log(rarity[i])
        for i in range(count):
            rows[i, 5] = residual[i]
            _add_products(sums, rows[i], weight[i])
    hessian = sums[:5, :5].copy()
    _mirror(hessian)
    return cost, hessian, sums[5, :5].copy()


@inner
def _add_products(sums, row, weight):
    """Add weight * row[k] * row[j] to the lower triangle of the sums (6, 6).

    All numbers are read before a sum is written. So the compiler knows that writing a sum does not
    change them, and does not read them again.
    """
    numbers = row[0], row[1], row[2], row[3], row[4], row[5]
    for k in range(6):
        weighted = weight * numbers[k]
        for j in range(k + 1):
            sums[k, j] += weighted * numbers[j]


@inner
def _mirror(matrix):
    """Copy the lower triangle of a matrix (5, 5) to the upper one."""
    for k in range(5):
        for j in range(k):
            matrix[j, k] = matrix[k, j]
