"""A motion fitted to all correspondences that agree with it.

RANSAC's motion is computed from five of them.

The essential matrix is E = [t]x R (Equation 2.5, without its factor). The residual of a
correspondence (x, y), (u, v) is its signed Sampson distance: its distance, to first order, from a
pair with (u, v, 1) E (x, y, 1)^T = 0.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from opencv_exact import epipolar
from opencv_exact.compiling import compiled, inlined
from thesis_repro.odometry.refined import matrices
from thesis_repro.odometry.refined.normal_equations import normal_equations
from thesis_repro.odometry.step import Matches, Motion

MIN_MATCHES = 5  # that determine a motion
MAX_ITERATIONS = 10
REFINE_ROUNDS = 3
SUPPORT_THRESHOLDS = 2  # a correspondence within so many thresholds supports a motion
RESTART_SCALES = (4, 1)  # scales of the second start, in thresholds
# of the largest angle between the headings of one motion
SAME_MOTION_COSINE = np.cos(np.radians(15.0))
LOWER_COST = 0.99  # of the first start's cost: a smaller difference may be rounding


@dataclass(frozen=True, eq=False)
class RefinedMotion(Motion):
    """A fitted motion with its uncertainty."""

    support: int = 0  # number of matches near the motion
    # standard deviation of the rotation in its least certain direction, degrees
    rotation_std_deg: float = 0.0
    # standard deviation of the translation's direction in its least certain one, degrees
    heading_std_deg: float = 0.0


def smaller_rotation(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smaller rotation (3x3) of an essential matrix, and its translation.

    The translation (3) has unit length and either sign. The other rotation differs by 180 degrees
    about the translation (twisted pair). No car turns so far between frames.
    """
    first, second, translation = cv2.decomposeEssentialMat(matrix)
    smaller = first if np.trace(first) >= np.trace(second) else second
    return smaller, translation.ravel()


def fit(rotation: np.ndarray, translation: np.ndarray, matches: Matches) -> RefinedMotion:
    """Motion refined from a start, with its uncertainty.

    See `refine` for the arguments. The start's unit translation may have either sign: the points
    near the motion vote on it (`ahead`).
    """
    rotation, heading, support = refine(rotation, translation, matches)
    signed, votes = ahead(rotation, heading, support, matches.threshold)
    rotation_std, heading_std = _deviations(rotation, heading, support, matches.threshold / 2)
    return RefinedMotion(
        rotation,
        signed,
        votes,
        support=support.shape[1],
        rotation_std_deg=rotation_std,
        heading_std_deg=heading_std,
    )


def refine(
    rotation: np.ndarray, translation: np.ndarray, matches: Matches
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motion (rotation 3x3, unit translation) fitted to all its inliers, and its support (4, M).

    Levenberg-Marquardt over the rotation and the two angles of the translation's direction. It
    minimises Sampson distances with Cauchy weights at half the threshold. The first fit uses the
    inliers. Two more fits use the points within SUPPORT_THRESHOLDS, so the result hardly depends on
    which inliers RANSAC happened to choose.

    The cost at this narrow scale has many minima. So a second start fits the first result to all
    matches at wider scales first, and the motion with the lower cost is returned. A second result
    with another heading (see SAME_MOTION_COSINE) is another motion and is not used. The sign of the
    given translation is kept, because the cost does not depend on it.
    """
    start = np.ascontiguousarray(rotation), np.ascontiguousarray(translation)
    return _refine(*start, columns(matches), matches.inliers, matches.threshold)


def ahead(
    rotation: np.ndarray, heading: np.ndarray, support: np.ndarray, threshold: float
) -> tuple[np.ndarray, int]:
    """Heading with the sign that puts more of its support in front of the cameras, and how many."""
    forward, backward = cheirality_votes(rotation, heading, support, threshold)
    return (heading if forward >= backward else -heading), max(forward, backward)


@compiled
def _refine(r, t, points, inliers, threshold):
    """As `refine`, of points (4, N)."""
    first_r, first_t = _rounds(r, t, points, points[:, np.flatnonzero(inliers)], threshold)
    second_r, second_t = first_r, first_t
    for scale in RESTART_SCALES:
        second_r, second_t = _minimise(second_r, second_t, points, scale * threshold)
    support = _support(second_r, second_t, points, threshold)
    second_r, second_t = _rounds(second_r, second_t, points, support, threshold)
    first_cost, _, _ = normal_equations(first_r, first_t, points, threshold / 2, False)
    second_cost, _, _ = normal_equations(second_r, second_t, points, threshold / 2, False)
    is_same_motion = abs(matrices.dot(second_t, first_t)) > SAME_MOTION_COSINE
    if is_same_motion and second_cost < LOWER_COST * first_cost:
        first_r, first_t = second_r, second_t
    heading = first_t if matrices.dot(first_t, t) >= 0 else -first_t
    return first_r, heading, _support(first_r, heading, points, threshold)


def _deviations(
    rotation: np.ndarray, translation: np.ndarray, points: np.ndarray, scale: float
) -> tuple[float, float]:
    """Largest standard deviations of rotation and heading, degrees; infinite if not determined.

    The covariance is the inverse of the Gauss-Newton matrix times scale^2, the variance of the
    residuals.
    """
    _, hessian, _ = normal_equations(rotation, translation, points, scale, True)
    values, vectors = np.linalg.eigh(hessian)
    if points.shape[1] < MIN_MATCHES or not values[0] > 1e-12 * values[-1]:
        return np.inf, np.inf
    covariance = scale * scale * (vectors / values) @ vectors.T
    rotation_std = np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    heading_std = np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])
    return float(np.degrees(rotation_std)), float(np.degrees(heading_std))


def columns(matches: Matches) -> np.ndarray:
    """Matches as (4, N), C-contiguous: x, y, u and v."""
    return np.array([*matches.current.T, *matches.previous.T])


def near(
    rotation: np.ndarray, translation: np.ndarray, matches: Matches, limit: float
) -> np.ndarray:
    """N booleans: the matches whose Sampson distance from the motion is below the limit."""
    return _near(rotation, translation, columns(matches), limit)


@compiled
def _near(r, t, points, limit):
    """As `near`, of points (4, N)."""
    essential = matrices.product(matrices.skew(t), matrices.row_by_row(r))
    return near_epipolar_lines(essential, points, limit)


@inlined
def near_epipolar_lines(essential, points, limit):
    """Booleans: the points (4, N) whose Sampson distance is below the limit."""
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
    supporting = _near(r, t, points, SUPPORT_THRESHOLDS * threshold)
    return points[:, np.flatnonzero(supporting)]


@compiled
def _rounds(r, t, points, support, threshold):
    """A motion fitted to its support (4, M), and again to the points (4, N) near it."""
    for k in range(REFINE_ROUNDS):
        if k > 0:
            support = _support(r, t, points, threshold)
        if support.shape[1] < MIN_MATCHES:
            break
        r, t = _minimise(r, t, support, threshold / 2)
    return r, t


@compiled
def _minimise(r, t, points, scale):
    """Levenberg-Marquardt iteration: each step solves (H + damping diag H) change = -gradient."""
    damping = 1e-4
    cost, hessian, gradient = normal_equations(r, t, points, scale, True)
    for k in range(MAX_ITERATIONS):
        damped = hessian.copy()
        for j in range(5):
            damped[j, j] += damping * hessian[j, j] + 1e-12
        try:
            change = np.linalg.solve(damped, -gradient)
        except Exception:  # singular, such as for one point many times
            break
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


@compiled
def cheirality_votes(rotation, t, points, parallax):
    """Numbers of points (4, N) in front of both cameras under (rotation, t) and (rotation, -t).

    Points whose rays meet at less than `parallax` (the sine of the angle) do not determine the
    sign, so they do not vote. (cv2.recoverPose leaves out points beyond 50 translations, which in a
    slow step are a few metres.)
    """
    forward = 0
    backward = 0
    heading = t[0], t[1], t[2]
    for k in range(points.shape[1]):
        x, y = points[0, k], points[1, k]
        # Ray a in the previous camera's coordinates, and ray b; they meet where depth a + t = other
        # b.
        a = (
            rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2],
            rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2],
            rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2],
        )
        b = points[2, k], points[3, k], 1.0
        normal = matrices.cross(a, b)
        squared_lengths = (x * x + y * y + 1) * matrices.dot(b, b)
        if matrices.dot(normal, normal) <= parallax * parallax * squared_lengths:
            continue
        depth = matrices.dot(normal, matrices.cross(b, heading))
        other = matrices.dot(normal, matrices.cross(a, heading))
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
    angle = np.sqrt(matrices.dot(change, change))
    cross = matrices.skew(change)
    square = matrices.product(cross, cross)
    sine, cosine = 1.0, 0.0
    if angle > 1e-12:
        sine = np.sin(angle) / angle
        cosine = (1 - np.cos(angle)) / (angle * angle)
    turn = np.eye(3)
    for i in range(3):
        for j in range(3):
            turn[i, j] = turn[i, j] + sine * cross[3 * i + j] + cosine * square[3 * i + j]
    rotation = matrices.product(matrices.row_by_row(turn), matrices.row_by_row(r))
    first, second = matrices.tangents(t)
    heading = matrices.normalised(
        (
            t[0] + change[3] * first[0] + change[4] * second[0],
            t[1] + change[3] * first[1] + change[4] * second[1],
            t[2] + change[3] * first[2] + change[4] * second[2],
        )
    )
    return np.array(rotation).reshape(3, 3), np.array(heading)
