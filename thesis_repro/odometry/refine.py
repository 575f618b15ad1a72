"""A motion fitted to all correspondences that agree with it, where RANSAC's goes through five of them."""

import numpy as np
from numba import njit

from thesis_repro.odometry.pose import MIN_CORRESPONDENCES

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
