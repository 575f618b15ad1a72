"""A motion fitted to all correspondences that agree with it, where RANSAC's goes through five of them.

The essential matrix is E = [t]x R (Equation 2.5, without its factor). The residual of a correspondence (x, y), (u, v)
is its signed Sampson distance: to first order, how far it is from meeting (u, v, 1) E (x, y, 1)^T = 0.
"""

import numpy as np

from thesis_repro.compiled import fast
from thesis_repro.odometry.opencv_exact import epipolar
from thesis_repro.odometry.pose import MIN_CORRESPONDENCES, Motion, sides

REFINE_STEPS = 10
REFINE_ROUNDS = 3
NEAR = 2  # thresholds within which a correspondence supports a motion
WIDE = (4, 1)  # thresholds: scales of the second start
ELSEWHERE = np.cos(np.radians(15.0))  # of the angle between two directions of motion
BLOCK = 64  # points that are looked at together
BETTER = 0.99  # of the first start's cost: more than what rounding makes of one and the same minimum


def fit(rotation: np.ndarray, translation: np.ndarray, current: np.ndarray, previous: np.ndarray,
        inliers: np.ndarray, threshold: float) -> Motion:
    """The motion that `refine` makes of a start whose translation (unit) has any sign, with all that a Motion tells.

    The points near it vote on the sign: see pose.sides.
    """
    turned, direction = refine(rotation, translation, current, previous, inliers, threshold)
    support = near(turned, direction, current, previous, NEAR * threshold)
    current, previous = current[support], previous[support]
    forward, backward = sides(turned, direction, current, previous, threshold)
    turn_sd, swing_sd = _deviations(turned, direction, current, previous, threshold / 2)
    return Motion(turned, direction if forward >= backward else -direction, inliers, max(forward, backward),
                  support=len(current), turn_sd=turn_sd, swing_sd=swing_sd)


def refine(rotation: np.ndarray, translation: np.ndarray, current: np.ndarray, previous: np.ndarray,
           inliers: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """The motion (rotation 3x3, unit translation) fitted to all its inliers among correspondences (N, 2).

    Levenberg-Marquardt over the rotation and the two angles of the translation's direction, on Sampson distances with
    Cauchy weights at half the estimator's threshold: RANSAC's answer goes through five points, this one uses them all.
    It starts from `inliers` (N booleans), and twice fits again to what lies within two thresholds, so that the chance
    by which RANSAC chose its inliers is gone as well. So narrow a scale has many minima; therefore it starts a second
    time from the motion found, on all correspondences at wider scales first, and keeps the better of both. What lies
    farther away than ELSEWHERE is another motion, between which the fit does not choose. An essential matrix does not
    know the sign of the translation, so the sign that was given is kept.
    """
    turned, direction = _rounds(np.ascontiguousarray(rotation), np.ascontiguousarray(translation), current, previous,
                                inliers, threshold)
    again = turned, direction
    for scale in WIDE:
        again = _refine(*again, current, previous, scale * threshold)
    again = _rounds(*again, current, previous, near(*again, current, previous, NEAR * threshold), threshold)
    if (abs(again[1] @ direction) > ELSEWHERE and _normal_equations(*again, current, previous, threshold / 2)[0]
            < BETTER * _normal_equations(turned, direction, current, previous, threshold / 2)[0]):
        turned, direction = again
    return turned, direction if direction @ translation >= 0 else -direction


def _rounds(rotation, translation, current, previous, chosen, threshold):
    for _ in range(REFINE_ROUNDS):
        if chosen.sum() < MIN_CORRESPONDENCES:
            break
        rotation, translation = _refine(rotation, translation, current[chosen], previous[chosen], threshold / 2)
        chosen = near(rotation, translation, current, previous, NEAR * threshold)
    return rotation, translation


def _deviations(rotation, translation, current, previous, scale):
    """Standard deviations, degrees, of the rotation and of the translation's direction, each where it is largest.

    From the inverse of the Gauss-Newton matrix, for residuals whose own is `scale`. Points that leave the motion open,
    all on one line in space, say, make them large.
    """
    hessian = _normal_equations(rotation, translation, current, previous, scale)[1]
    values, vectors = np.linalg.eigh(hessian)
    if len(current) < MIN_CORRESPONDENCES or not values[0] > 1e-12 * values[-1]:
        return np.inf, np.inf
    covariance = scale * scale * (vectors / values) @ vectors.T
    return tuple(float(np.degrees(np.sqrt(np.linalg.eigvalsh(part)[-1])))
                 for part in (covariance[:3, :3], covariance[3:, 3:]))


@fast
def near(r, t, current, previous, limit):
    """N booleans: the correspondences whose Sampson distance from the motion is below the limit."""
    essential = epipolar.entries(np.dot(_skew(t), r))
    mask = np.empty(len(current), np.bool_)
    for index in range(len(current)):
        x, y = current[index, 0], current[index, 1]
        u, v = previous[index, 0], previous[index, 1]
        algebraic, l0, l1, m0, m1 = epipolar.lines(essential, x, y, u, v)
        mask[index] = algebraic * algebraic < limit * limit * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)
    return mask


@fast
def _refine(rotation, translation, current, previous, scale):
    """Levenberg and Marquardt's iteration: steps of (H + damping diag H) change = -gradient, while the cost falls."""
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


@fast
def _tangents(t):
    """Two unit vectors that are perpendicular to the unit vector t and to each other."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(t))] = 1.0
    first = np.cross(t, axis)
    first /= np.sqrt((first * first).sum())
    return first, np.cross(t, first)


@fast
def _skew(v):
    """The matrix [v]x of the cross product with v (Equation 2.5)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@fast
def _moved(r, t, change):
    """The motion after a change of five parameters: exp([turn]x) R (Rodrigues' formula), t moved along its tangents."""
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


@fast
def _normal_equations(r, t, current, previous, scale):
    """Cauchy cost of the Sampson distances, and its Gauss-Newton matrix (5, 5) and gradient (5) in the parameters.

    With residual s and weight w = 1 / (1 + (s / scale)^2): sum of log(1 + (s / scale)^2), of w J^T J, and of w s J.
    """
    essential = epipolar.entries(np.dot(_skew(t), r))
    first, second = _tangents(t)
    derivatives = np.empty((5, 3, 3))  # of E: [t]x [unit]x R by the rotation's three, [tangent]x R by t's two
    for k in range(3):
        unit = np.zeros(3)
        unit[k] = 1.0
        derivatives[k] = np.dot(_skew(t), np.dot(_skew(unit), r))
    derivatives[3] = np.dot(_skew(first), r)
    derivatives[4] = np.dot(_skew(second), r)
    hessian, gradient = np.zeros((5, 5)), np.zeros(5)
    cost = 0.0
    # In blocks, each quantity of all points at once, which the processor does several at a time; the sums go point by
    # point, so the bits are those of one loop over all points.
    x, y, u, v = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    l0, l1, m0, m1 = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    inverse, residual, rarity, weight = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    jacobian = np.empty((5, BLOCK))
    for start in range(0, len(current), BLOCK):
        count = min(BLOCK, len(current) - start)
        for i in range(count):
            x[i], y[i] = current[start + i, 0], current[start + i, 1]
            u[i], v[i] = previous[start + i, 0], previous[start + i, 1]
        for i in range(count):
            algebraic, l0[i], l1[i], m0[i], m1[i] = epipolar.lines(essential, x[i], y[i], u[i], v[i])
            square = l0[i] * l0[i] + l1[i] * l1[i] + m0[i] * m0[i] + m1[i] * m1[i]
            inverse[i] = 1 / np.sqrt(square) if square >= 1e-18 else 0.0  # at the epipoles a point says nothing
            residual[i] = algebraic * inverse[i]  # the Sampson distance, with its sign
            ratio = residual[i] / scale
            rarity[i] = 1 + ratio * ratio
            weight[i] = 1 / rarity[i]
        for k in range(5):
            derivative, column = epipolar.entries(derivatives[k]), jacobian[k]
            for i in range(count):
                change, d0, d1, c0, c1 = epipolar.lines(derivative, x[i], y[i], u[i], v[i])
                # (a / sqrt(q))' = a' / sqrt(q) - a q' / (2 q sqrt(q)), where q = l0^2 + l1^2 + m0^2 + m1^2
                slope = l0[i] * d0 + l1[i] * d1 + m0[i] * c0 + m1[i] * c1
                column[i] = (change - residual[i] * inverse[i] * slope) * inverse[i]
        for i in range(count):
            cost += np.log(rarity[i])
            for k in range(5):
                gradient[k] += weight[i] * residual[i] * jacobian[k, i]
                for j in range(k + 1):
                    hessian[k, j] += weight[i] * jacobian[k, i] * jacobian[j, i]
    for k in range(5):
        for j in range(k):
            hessian[j, k] = hessian[k, j]
    return cost, hessian, gradient
