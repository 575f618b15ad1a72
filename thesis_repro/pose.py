"""Relative motion of a calibrated camera from point correspondences (Section 2.2): essential matrix, vote, refinement.

Directions as in PySLAM: points of the current frame come first, so the rotation and the unit translation take
current camera coordinates to previous ones, and composing them onto a camera-to-world pose needs no inverse.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numba import njit

from thesis_repro import ransac

PROBABILITY = 0.999  # of RANSAC
MAX_DEPTH = 50.0  # in units of the translation: recoverPose lets no point beyond it vote
MIN_CORRESPONDENCES = 5

ESTIMATORS = {"ransac": cv2.RANSAC, "usac": cv2.USAC_DEFAULT, "usac-accurate": cv2.USAC_ACCURATE,
              "usac-magsac": cv2.USAC_MAGSAC}


@dataclass(frozen=True)
class Motion:
    """What two frames say about the camera's motion; `rotation` is None where they say nothing (see `problem`)."""

    rotation: np.ndarray | None = None  # 3x3
    translation: np.ndarray | None = None  # 3, unit length
    inliers: np.ndarray | None = None  # N booleans: correspondences that agree with the essential matrix
    pose_inliers: int = 0  # correspondences that lie in front of both cameras and not too far away
    problem: str = ""


def normalise(points, intrinsics):
    """Pixels (N, 2) to normalised image coordinates (N, 2) in double precision.

    u * (1 / fx) + (-cx / fx), which is the inverse camera matrix times (u, v, 1) to the last bit. RANSAC amplifies the
    last bit, so (u - cx) / fx would lead to another trajectory.
    """
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    return points * (1 / focal) + (-intrinsics[:2, 2] / focal)


def essential_matrix(current, previous, threshold, estimator="ransac"):
    """The essential matrix of normalised correspondences (N, 2): (matrix, inliers, problem).

    `matrix` is None, and `problem` says why, where there is none or more than one: OpenCV stacks all solutions of
    exactly five correspondences, returns nothing for four, and raises for none.
    """
    none = np.zeros(len(current), bool)
    if len(current) < MIN_CORRESPONDENCES:
        return None, none, "fewer than five correspondences"
    try:
        if estimator == "ransac":
            matrix, inliers = ransac.find(current, previous, threshold, PROBABILITY)
        else:
            matrix, inliers = cv2.findEssentialMat(current, previous, focal=1.0, pp=(0.0, 0.0),
                                                   method=ESTIMATORS[estimator], prob=PROBABILITY, threshold=threshold)
    except cv2.error:  # the USAC estimators raise on degenerate points
        matrix = None
    if matrix is None or not np.isfinite(matrix).all():
        return None, none, "no essential matrix"
    if matrix.shape != (3, 3):
        return None, none, "several essential matrices"
    return matrix, inliers.ravel() > 0, ""


def recover_pose(matrix, current, previous):
    """cv2.recoverPose(matrix, current, previous) without its inlier mask, to the last bit: (votes, R, t).

    An essential matrix allows four motions; the one that puts most points in front of both cameras, and nearer than
    MAX_DEPTH, wins. OpenCV triangulates every point four times with a singular value decomposition. Only the side of
    a few limits counts, so a few steps of inverse iteration decide nearly all points, one of them for both signs of
    the translation; the few points too close to a limit are triangulated by OpenCV itself.
    """
    first, second, translation = cv2.decomposeEssentialMat(matrix)
    direction = translation.ravel()
    votes = np.zeros(4, np.int64)
    for index, rotation in enumerate((first, second)):
        forward, backward, doubtful = _count_in_front(current, previous, rotation, direction)
        for sign, count, slot in ((1.0, forward, index), (-1.0, backward, index + 2)):
            if len(doubtful):
                count += _triangulate_and_count(current[doubtful], previous[doubtful], rotation, sign * translation)
            votes[slot] = count
    candidates = ((first, direction), (second, direction), (first, -direction), (second, -direction))
    best = int(np.argmax(votes))  # the first of equals, as in OpenCV
    return int(votes[best]), *candidates[best]


@lru_cache
def warm_up():
    """Load the compiled functions (compile them the first time ever), so that no frame's time holds that."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 2))
    essential_matrix(points, points + 0.01 * points[::-1], 1e-3)
    recover_pose(np.diag([1.0, 1.0, 0.0]), points, points)
    refine(np.eye(3), np.array([0.0, 0.0, 1.0]), points, points, np.ones(8, bool), 1.0)


def _triangulate_and_count(current, previous, rotation, translation):
    projection = np.hstack([rotation, translation])
    points = cv2.triangulatePoints(np.eye(3, 4), projection, current.T.copy(), previous.T.copy())
    with np.errstate(divide="ignore", invalid="ignore"):
        good = points[2] * points[3] > 0
        points = points / points[3]
        depth = projection[2] @ points
        return int((good & (points[2] < MAX_DEPTH) & (depth > 0) & (depth < MAX_DEPTH)).sum())


@njit(cache=True, nogil=True)
def _count_in_front(current, previous, rotation, t):
    """Votes for (rotation, t), for (rotation, -t), and the indices of points too close to a limit to be sure."""
    margin = 1e-7
    forward = 0
    backward = 0
    doubtful = np.empty(len(current), np.int64)
    doubts = 0
    a = np.zeros((4, 4))
    b = np.empty((4, 4))
    for index in range(len(current)):
        # Rows x * P[2] - P[0], y * P[2] - P[1] of both cameras; the point is their singular vector of least value.
        u, v = previous[index, 0], previous[index, 1]
        a[0, 0] = -1.0
        a[0, 2] = current[index, 0]
        a[1, 1] = -1.0
        a[1, 2] = current[index, 1]
        for k in range(3):
            a[2, k] = u * rotation[2, k] - rotation[0, k]
            a[3, k] = v * rotation[2, k] - rotation[1, k]
        a[2, 3] = u * t[2] - t[0]
        a[3, 3] = v * t[2] - t[1]
        for i in range(4):
            for j in range(i + 1):
                b[i, j] = a[0, i] * a[0, j] + a[1, i] * a[1, j] + a[2, i] * a[2, j] + a[3, i] * a[3, j]
        sure, x, y, z, w = _least_eigenvector(b)
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + t[2] * w
        if w < 0:
            z, w, depth = -z, -w, -depth
        if (not sure or w < margin or abs(z) < margin or abs(depth) < margin
                or abs(abs(z) - MAX_DEPTH * w) < MAX_DEPTH * margin
                or abs(abs(depth) - MAX_DEPTH * w) < MAX_DEPTH * margin):
            doubtful[doubts] = index
            doubts += 1
        elif 0 < z < MAX_DEPTH * w and 0 < depth < MAX_DEPTH * w:
            forward += 1
        elif 0 < -z < MAX_DEPTH * w and 0 < -depth < MAX_DEPTH * w:
            backward += 1  # the other sign of t turns the sign of w and of both depths
    return forward, backward, doubtful[:doubts]


@njit(cache=True, nogil=True)
def _least_eigenvector(b):
    """Unit eigenvector of the least eigenvalue of b (lower triangle; overwritten) and whether it is sure."""
    for j in range(4):  # Cholesky
        for k in range(j):
            b[j, j] -= b[j, k] * b[j, k]
        if b[j, j] < 1e-15:
            return False, 0.0, 0.0, 0.0, 1.0
        b[j, j] = np.sqrt(b[j, j])
        for i in range(j + 1, 4):
            for k in range(j):
                b[i, j] -= b[i, k] * b[j, k]
            b[i, j] /= b[j, j]
    x0, x1, x2, x3 = 0.5, 0.5, 0.5, 0.5
    change = 1.0
    for _ in range(30):
        y0 = x0 / b[0, 0]
        y1 = (x1 - b[1, 0] * y0) / b[1, 1]
        y2 = (x2 - b[2, 0] * y0 - b[2, 1] * y1) / b[2, 2]
        y3 = (x3 - b[3, 0] * y0 - b[3, 1] * y1 - b[3, 2] * y2) / b[3, 3]
        y3 = y3 / b[3, 3]
        y2 = (y2 - b[3, 2] * y3) / b[2, 2]
        y1 = (y1 - b[2, 1] * y2 - b[3, 1] * y3) / b[1, 1]
        y0 = (y0 - b[1, 0] * y1 - b[2, 0] * y2 - b[3, 0] * y3) / b[0, 0]
        norm = 1 / np.sqrt(y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3)
        y0, y1, y2, y3 = y0 * norm, y1 * norm, y2 * norm, y3 * norm
        change = abs(y0 - x0) + abs(y1 - x1) + abs(y2 - x2) + abs(y3 - x3)
        x0, x1, x2, x3 = y0, y1, y2, y3
        if change < 1e-11:
            return True, x0, x1, x2, x3
    return False, x0, x1, x2, x3


REFINE_STEPS = 10
REFINE_ROUNDS = 3


def refine(rotation, translation, current, previous, inliers, threshold):
    """The motion (rotation 3x3, unit translation) fitted to all its inliers among correspondences (N, 2).

    Levenberg-Marquardt over the rotation and the two angles of the translation's direction, on Sampson distances with
    Cauchy weights at half the estimator's threshold: RANSAC's answer goes through five points, this one uses them all.
    It starts from `inliers` (N booleans), and twice fits again to what lies within two thresholds, so that the chance
    by which RANSAC chose its inliers is gone as well. An essential matrix does not know the sign of the translation,
    so the sign that was voted for is kept.
    """
    turned, direction, chosen = np.ascontiguousarray(rotation), np.ascontiguousarray(translation), inliers
    for _ in range(REFINE_ROUNDS):
        if chosen.sum() < MIN_CORRESPONDENCES:
            break
        turned, direction = _refine(turned, direction, current[chosen], previous[chosen], threshold / 2)
        chosen = _near(turned, direction, current, previous, 2 * threshold)
    return turned, direction if direction @ translation >= 0 else -direction


@njit(cache=True, nogil=True)
def _near(r, t, current, previous, limit):
    """N booleans: the correspondences whose Sampson distance from the motion is below the limit."""
    e = np.dot(_skew(t), r)
    near = np.empty(len(current), np.bool_)
    for index in range(len(current)):
        x, y = current[index, 0], current[index, 1]
        u, v = previous[index, 0], previous[index, 1]
        l0 = e[0, 0] * x + e[0, 1] * y + e[0, 2]
        l1 = e[1, 0] * x + e[1, 1] * y + e[1, 2]
        l2 = e[2, 0] * x + e[2, 1] * y + e[2, 2]
        m0 = e[0, 0] * u + e[1, 0] * v + e[2, 0]
        m1 = e[0, 1] * u + e[1, 1] * v + e[2, 1]
        algebraic = u * l0 + v * l1 + l2
        near[index] = algebraic * algebraic < limit * limit * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)
    return near


@njit(cache=True, nogil=True)
def _refine(rotation, translation, current, previous, scale):
    damping = 1e-4
    r, t = rotation.copy(), translation.copy()
    cost, hessian, gradient = _normal_equations(r, t, current, previous, scale)
    for _ in range(REFINE_STEPS):
        damped = hessian.copy()
        for k in range(5):
            damped[k, k] += damping * hessian[k, k] + 1e-12
        change = np.linalg.solve(damped, -gradient)
        r_new, t_new = _moved(r, t, change)
        cost_new, hessian_new, gradient_new = _normal_equations(r_new, t_new, current, previous, scale)
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


@njit(cache=True, nogil=True)
def _tangents(t):
    """Two unit vectors that are perpendicular to the unit vector t and to each other."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(t))] = 1.0
    first = np.cross(t, axis)
    first /= np.sqrt((first * first).sum())
    return first, np.cross(t, first)


@njit(cache=True, nogil=True)
def _skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True, nogil=True)
def _moved(r, t, change):
    turn = change[:3].copy()
    angle = np.sqrt((turn * turn).sum())
    cross = _skew(turn)
    if angle > 1e-12:
        rodrigues = (np.eye(3) + np.sin(angle) / angle * cross
                     + (1 - np.cos(angle)) / (angle * angle) * np.dot(cross, cross))
    else:
        rodrigues = np.eye(3) + cross
    first, second = _tangents(t)
    t_new = t + change[3] * first + change[4] * second
    return np.dot(rodrigues, r), t_new / np.sqrt((t_new * t_new).sum())


@njit(cache=True, nogil=True)
def _normal_equations(r, t, current, previous, scale):
    """Cauchy cost of the Sampson distances, and its Gauss-Newton matrix and gradient in the five parameters."""
    e = np.dot(_skew(t), r)
    first, second = _tangents(t)
    derivatives = np.empty((5, 3, 3))
    for k in range(3):
        unit = np.zeros(3)
        unit[k] = 1.0
        derivatives[k] = np.dot(_skew(t), np.dot(_skew(unit), r))
    derivatives[3] = np.dot(_skew(first), r)
    derivatives[4] = np.dot(_skew(second), r)
    hessian, gradient, jacobian = np.zeros((5, 5)), np.zeros(5), np.empty(5)
    cost = 0.0
    for index in range(len(current)):
        x, y = current[index, 0], current[index, 1]
        u, v = previous[index, 0], previous[index, 1]
        # The epipolar lines: l = E (x, y, 1) in the previous frame, m = E^T (u, v, 1) in the current one.
        l0 = e[0, 0] * x + e[0, 1] * y + e[0, 2]
        l1 = e[1, 0] * x + e[1, 1] * y + e[1, 2]
        l2 = e[2, 0] * x + e[2, 1] * y + e[2, 2]
        m0 = e[0, 0] * u + e[1, 0] * v + e[2, 0]
        m1 = e[0, 1] * u + e[1, 1] * v + e[2, 1]
        square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
        if square < 1e-18:
            continue
        inverse = 1 / np.sqrt(square)
        residual = (u * l0 + v * l1 + l2) * inverse
        for k in range(5):
            d = derivatives[k]
            d0 = d[0, 0] * x + d[0, 1] * y + d[0, 2]
            d1 = d[1, 0] * x + d[1, 1] * y + d[1, 2]
            d2 = d[2, 0] * x + d[2, 1] * y + d[2, 2]
            c0 = d[0, 0] * u + d[1, 0] * v + d[2, 0]
            c1 = d[0, 1] * u + d[1, 1] * v + d[2, 1]
            slope = l0 * d0 + l1 * d1 + m0 * c0 + m1 * c1
            jacobian[k] = ((u * d0 + v * d1 + d2) - residual * inverse * slope) * inverse
        ratio = residual / scale
        weight = 1 / (1 + ratio * ratio)
        cost += np.log(1 + ratio * ratio)
        for k in range(5):
            gradient[k] += weight * residual * jacobian[k]
            for j in range(k + 1):
                hessian[k, j] += weight * jacobian[k] * jacobian[j]
    for k in range(5):
        for j in range(k):
            hessian[j, k] = hessian[k, j]
    return cost, hessian, gradient
