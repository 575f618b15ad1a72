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

from opencv_exact import epipolar
from opencv_exact.compiling import compiled, inlined
from thesis_repro.odometry.refined import matrices
from thesis_repro.odometry.refined.normal_equations import normal_equations
from thesis_repro.odometry.types import Motion

MIN_CORRESPONDENCES = 5
MAX_ITERATIONS = 10
REFINE_ROUNDS = 3
SUPPORT_THRESHOLDS = 2  # a correspondence within so many thresholds supports a motion
RESTART_SCALES = (4, 1)  # scales of the second start, in thresholds
# of the largest angle between the headings of one motion
SAME_MOTION_COSINE = np.cos(np.radians(15.0))
LOWER_COST = 0.99  # of the first start's cost: a smaller difference may be rounding
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
    first_cost, _, _ = normal_equations(*first, points, threshold / 2, False)
    second_cost, _, _ = normal_equations(*second, points, threshold / 2, False)
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
    _, hessian, _ = normal_equations(rotation, translation, points, scale, True)
    values, vectors = np.linalg.eigh(hessian)
    if points.shape[1] < MIN_CORRESPONDENCES or not values[0] > 1e-12 * values[-1]:
        return np.inf, np.inf, np.inf
    covariance = scale * scale * (vectors / values) @ vectors.T
    rotation_std = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    heading_std = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    condition = float(values[-1] / values[0])
    return float(np.degrees(rotation_std)), float(np.degrees(heading_std)), condition


@compiled
def columns(current, previous):
    """Correspondences (N, 2) as (4, N): x, y, u and v."""
    points = np.empty((4, len(current)))
    for k in range(len(current)):
        points[0, k], points[1, k] = current[k, 0], current[k, 1]
        points[2, k], points[3, k] = previous[k, 0], previous[k, 1]
    return points


@compiled
def near(r, t, current, previous, limit):
    """N booleans: the correspondences whose Sampson distance from the motion is below the limit."""
    return _near(r, t, columns(current, previous), limit)


@inlined
def _near(r, t, points, limit):
    """As `near`, of points (4, N)."""
    essential = matrices.product(matrices.skew(t), matrices.row_by_row(r))
    mask = np.empty(points.shape[1], np.bool_)
    for k in range(len(mask)):
        x, y, u, v = points[0, k], points[1, k], points[2, k], points[3, k]
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(essential, x, y, u, v)
        square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        mask[k] = algebraic * algebraic < limit * limit * square
    return mask


@compiled
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


@compiled
def _rounds(r, t, points, support, threshold):
    """A motion fitted to its support (4, M), and again to the points (4, N) near it."""
    for k in range(REFINE_ROUNDS):
        if k > 0:
            support = _support(r, t, points, threshold)
        if support.shape[1] < MIN_CORRESPONDENCES:
            break
        r, t = _minimise(r, t, support, threshold / 2)
    return r, t


@compiled
def _minimise(r, t, points, scale):
    """Levenberg-Marquardt iteration: each step solves (H + damping diag H) change = -gradient."""
    damping = 1e-4
    integers = np.empty(8, np.int32)
    cost, hessian, gradient = normal_equations(r, t, points, scale, True)
    for k in range(MAX_ITERATIONS):
        damped = hessian.copy()
        for j in range(5):
            damped[j, j] += damping * hessian[j, j] + 1e-12
        change = -gradient
        _solve(damped, change, integers)
        r_new, t_new = _moved(r, t, change)
        is_last = k == MAX_ITERATIONS - 1
        cost_new, hessian_new, gradient_new = normal_equations(
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


@inlined
def _solve(matrix, right, integers):
    """Solve five linear equations with a symmetric matrix; right (5) becomes the solution.

    integers (8): space for the pivots and for the sizes that LAPACK takes by their addresses.
    """
    integers[0], integers[1], integers[2] = 5, 1, 0  # equations, right sides, status
    size, count, status = integers[0:].ctypes, integers[1:].ctypes, integers[2:].ctypes
    pivots = integers[3:].ctypes
    _gesv(size, count, matrix.ctypes, size, pivots, right.ctypes, size, status)


@compiled
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


@inlined
def _moved(r, t, change):
    """Motion after a change (5) of its parameters.

    The rotation becomes exp([turn]x) R (Rodrigues' formula). t moves along its tangents.
    """
    angle = np.sqrt(change[0] * change[0] + change[1] * change[1] + change[2] * change[2])
    cross = matrices.skew(change)
    square = matrices.product(cross, cross)
    sine, cosine = 1.0, 0.0
    if angle > 1e-12:
        sine = np.sin(angle) / angle
        cosine = (1 - np.cos(angle)) / (angle * angle)
    rodrigues = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            k = 3 * i + j
            rodrigues[i, j] = (i == j) + sine * cross[k] + cosine * square[k]
    first, second = matrices.tangents(t)
    heading = np.empty(3)
    heading[0], heading[1], heading[2] = matrices.normalised(
        t[0] + change[3] * first[0] + change[4] * second[0],
        t[1] + change[3] * first[1] + change[4] * second[1],
        t[2] + change[3] * first[2] + change[4] * second[2],
    )
    rotation = np.empty((3, 3))
    matrices.write(
        rotation.ravel(), matrices.product(matrices.row_by_row(rodrigues), matrices.row_by_row(r))
    )
    return rotation, heading
