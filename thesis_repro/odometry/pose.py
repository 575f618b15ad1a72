"""Relative motion of a calibrated camera from point correspondences (Section 2.2).

The essential matrix comes first, then the motion.

As in PySLAM, points of the current frame come first. So the rotation and the unit translation take
coordinates of the current camera to coordinates of the previous camera. A camera-to-world pose is
moved by them without an inverse.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from thesis_repro.odometry.opencv_exact import ransac
from thesis_repro.running.compiled import fast, inner

PROBABILITY = 0.999  # of RANSAC
MAX_DEPTH = 50.0  # in lengths of the translation; as in cv2.recoverPose, farther points do not vote
# for homogeneous points of unit norm; points nearer to a limit are left to OpenCV
LIMIT_MARGIN = 1e-7
MIN_CORRESPONDENCES = 5
FLOW_ROUNDS = 2  # they leave 0.1 pixels of a turn by 5 degrees; one leaves 10
FLOW_DAMPING = 1e-10  # keeps equations solvable; with points all over a frame it changes nothing


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the camera between two frames.

    If it is not known, `rotation` is None and `problem` says why.
    """

    rotation: np.ndarray | None = None  # 3x3
    translation: np.ndarray | None = None  # 3, unit length
    # N booleans: correspondences that agree with the essential matrix
    inliers: np.ndarray | None = None
    pose_inliers: int = 0  # correspondences in front of both cameras and not too far away
    problem: str = ""


def normalise(points: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Normalised image coordinates (N, 2), in double precision, of pixels (N, 2).

    u * (1 / fx) + (-cx / fx) equals the product of the inverse camera matrix and (u, v, 1) to the
    last bit. The formula (u - cx) / fx does not. RANSAC amplifies a difference in the last bit, so
    the trajectory would be another one.
    """
    focal = np.array([intrinsics[0, 0], intrinsics[1, 1]])
    return points * (1 / focal) + (-intrinsics[:2, 2] / focal)


def essential_matrix(
    current: np.ndarray, previous: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray, str]:
    """Essential matrix of normalised correspondences (N, 2). Returns (matrix, inliers, problem).

    If there is no matrix or more than one, `matrix` is None and `problem` says why. (From exactly
    five correspondences, OpenCV returns all solutions in one array.)
    """
    no_inliers = np.zeros(len(current), bool)
    if len(current) < MIN_CORRESPONDENCES:
        return None, no_inliers, "fewer than five correspondences"
    matrix, inliers = ransac.find_essential_matrix(current, previous, threshold, PROBABILITY)
    if matrix is None or inliers is None or not np.isfinite(matrix).all():
        return None, no_inliers, "no essential matrix"
    if matrix.shape != (3, 3):
        return None, no_inliers, "several essential matrices"
    return matrix, inliers.ravel() > 0, ""


@fast
def rotation_and_zoom(current, previous, inliers, near):
    """How well the motion of a camera that only turned or zoomed explains the points.

    current, previous: normalised correspondences (N, 2). inliers: N booleans. Returns (share,
    zoom). A rotation and a zoom of a camera that stays in its place would move the previous points
    somewhere. share is that of the inliers whose current point is nearer to there than `near`.
    1.01 is a zoom that shows everything one per cent closer.

    Rotation and zoom are fitted by least squares. Each round linearises the motion (flow) that they
    cause (Longuet-Higgins and Prazdny, 1980).
    """
    moved = previous.copy()
    zoom = 1.0
    for _ in range(FLOW_ROUNDS):
        turn_x, turn_y, turn_z, growth = _flow(current, moved, inliers)
        for k in range(len(moved)):
            moved[k, 0], moved[k, 1] = _turned(moved[k, 0], moved[k, 1], turn_x, turn_y, turn_z)
            moved[k, 0] *= 1 + growth
            moved[k, 1] *= 1 + growth
        zoom *= 1 + growth
    count, close = 0, 0
    for k in range(len(moved)):
        dx = current[k, 0] - moved[k, 0]
        dy = current[k, 1] - moved[k, 1]
        count += inliers[k]
        close += inliers[k] and dx * dx + dy * dy < near * near
    return close / count, zoom


@inner
def _flow(current, moved, inliers):
    """Three rotations and a zoom that move the inliers of `moved` to `current`, linearised."""
    across = np.empty(4)  # change of x by the three rotations and by the zoom
    down = np.empty(4)  # change of y
    products = np.zeros((4, 4))
    right = np.zeros(4)
    for k in range(len(moved)):
        if not inliers[k]:
            continue
        x, y = moved[k, 0], moved[k, 1]
        dx, dy = current[k, 0] - x, current[k, 1] - y
        across[0], across[1], across[2], across[3] = -x * y, 1 + x * x, -y, x
        down[0], down[1], down[2], down[3] = -1 - y * y, x * y, x, y
        for i in range(4):
            right[i] += across[i] * dx + down[i] * dy
            for j in range(i + 1):
                products[i, j] += across[i] * across[j] + down[i] * down[j]
    for i in range(4):  # points that do not determine all four leave the rest at about zero
        products[i, i] += FLOW_DAMPING
    _cholesky(products)
    return _solve(products, right[0], right[1], right[2], right[3])


@inner
def _turned(x, y, turn_x, turn_y, turn_z):
    """Image (x, y) of a point after a rotation by a vector (Rodrigues' formula)."""
    angle = np.sqrt(turn_x * turn_x + turn_y * turn_y + turn_z * turn_z)
    sine, cosine = 1.0, 0.5
    if angle > 1e-6:
        sine = np.sin(angle) / angle
        cosine = (1 - np.cos(angle)) / (angle * angle)
    # turn x point, and turn x (turn x point)
    first_x, first_y, first_z = turn_y - turn_z * y, turn_z * x - turn_x, turn_x * y - turn_y * x
    second_x = turn_y * first_z - turn_z * first_y
    second_y = turn_z * first_x - turn_x * first_z
    second_z = turn_x * first_y - turn_y * first_x
    depth = 1 + sine * first_z + cosine * second_z
    return (
        (x + sine * first_x + cosine * second_x) / depth,
        (y + sine * first_y + cosine * second_y) / depth,
    )


def recover_pose(
    matrix: np.ndarray, current: np.ndarray, previous: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray]:
    """Motion from an essential matrix: (votes, R, t), with the bits of cv2.recoverPose.

    That is cv2.recoverPose(matrix, current, previous).

    An essential matrix allows four motions. A point votes for a motion if it lies in front of both
    cameras and nearer than MAX_DEPTH. The motion with most votes wins. OpenCV triangulates every
    point four times with a singular value decomposition. Here a few steps of inverse iteration
    decide how nearly all points vote, for both signs of the translation at once. OpenCV's
    triangulation decides only about points close to a limit.
    """
    first, second, translation = cv2.decomposeEssentialMat(matrix)
    motions = [
        (first, translation),
        (second, translation),
        (first, -translation),
        (second, -translation),
    ]
    votes = np.zeros(4, np.int64)
    doubtful = [np.empty(0, np.int64), np.empty(0, np.int64)]  # points, for each rotation
    # A car's rotation is the smaller one. Its votes are counted first; the other's only while it
    # can still win.
    smaller = int(np.trace(first) < np.trace(second))
    for index in (smaller, 1 - smaller):
        rotation, _ = motions[index]
        votes[index], votes[index + 2], doubtful[index] = _count_in_front(
            current, previous, rotation, translation.ravel(), votes.max()
        )
    most_certain = votes.max()
    for index, motion in enumerate(motions):
        points = doubtful[index % 2]
        if len(points) and votes[index] + len(points) >= most_certain:  # this motion can still win
            votes[index] += _triangulate_and_count(current[points], previous[points], *motion)
    best = int(np.argmax(votes))  # the first of equal numbers, as in OpenCV
    rotation, translation = motions[best]
    return int(votes[best]), rotation, translation.ravel()


def _triangulate_and_count(
    current: np.ndarray, previous: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> int:
    """Number of votes for a motion, counted as OpenCV does."""
    projection = np.hstack([rotation, translation])
    points = cv2.triangulatePoints(np.eye(3, 4), projection, current.T.copy(), previous.T.copy())
    with np.errstate(divide="ignore", invalid="ignore"):
        votes = points[2] * points[3] > 0
        points = points / points[3]
        depth = projection[2] @ points
        votes &= points[2] < MAX_DEPTH
        votes &= (depth > 0) & (depth < MAX_DEPTH)
    return int(votes.sum())


@fast
def _count_in_front(current, previous, rotation, t, least):
    """Votes for (rotation, t) and (rotation, -t), and the points that are too close to a limit.

    Stops as soon as neither motion can reach `least` votes.
    """
    forward, backward, doubts = 0, 0, 0
    doubtful = np.empty(len(current), np.int64)
    a = np.zeros((4, 4))
    b = np.empty((4, 4))
    for index in range(len(current)):
        if max(forward, backward) + doubts + len(current) - index < least:
            break
        # Rows x * P[2] - P[0] and y * P[2] - P[1] of both cameras. The point is the right singular
        # vector of the least singular value.
        u = previous[index, 0]
        v = previous[index, 1]
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
                b[i, j] = (
                    a[0, i] * a[0, j] + a[1, i] * a[1, j] + a[2, i] * a[2, j] + a[3, i] * a[3, j]
                )
        sure, x, y, z, w = _least_eigenvector(b)
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + t[2] * w
        if w < 0:
            z, w, depth = -z, -w, -depth
        farthest = MAX_DEPTH * w
        margin = MAX_DEPTH * LIMIT_MARGIN
        if (
            not sure
            or w < LIMIT_MARGIN
            or abs(z) < LIMIT_MARGIN
            or abs(depth) < LIMIT_MARGIN
            or abs(abs(z) - farthest) < margin
            or abs(abs(depth) - farthest) < margin
        ):
            doubtful[doubts] = index
            doubts += 1
        elif 0 < z < farthest and 0 < depth < farthest:
            forward += 1
        elif 0 < -z < farthest and 0 < -depth < farthest:
            backward += 1  # the opposite t changes the signs of w and of both depths
    return forward, backward, doubtful[:doubts]


@inner
def _least_eigenvector(b):
    """Unit eigenvector of the least eigenvalue of b (4, 4; lower triangle), by inverse iteration.

    Returns whether the iteration converged, and the four coordinates of the vector.
    """
    if not _cholesky(b):
        return False, 0.0, 0.0, 0.0, 1.0
    x0, x1, x2, x3 = 0.5, 0.5, 0.5, 0.5
    change = 1.0
    for _ in range(30):
        y0, y1, y2, y3 = _solve(b, x0, x1, x2, x3)
        norm = 1 / np.sqrt(y0 * y0 + y1 * y1 + y2 * y2 + y3 * y3)
        y0, y1, y2, y3 = y0 * norm, y1 * norm, y2 * norm, y3 * norm
        change = abs(y0 - x0) + abs(y1 - x1) + abs(y2 - x2) + abs(y3 - x3)
        x0, x1, x2, x3 = y0, y1, y2, y3
        if change < 1e-11:
            return True, x0, x1, x2, x3
    return False, x0, x1, x2, x3


@inner
def _cholesky(b):
    """Replace the lower triangle of b (4, 4) by its Cholesky factor.

    Returns whether b is positive definite.
    """
    for j in range(4):
        for k in range(j):
            b[j, j] -= b[j, k] * b[j, k]
        if b[j, j] < 1e-15:
            return False
        b[j, j] = np.sqrt(b[j, j])
        for i in range(j + 1, 4):
            for k in range(j):
                b[i, j] -= b[i, k] * b[j, k]
            b[i, j] /= b[j, j]
    return True


@inner
def _solve(b, x0, x1, x2, x3):
    """Solution of the four equations whose Cholesky factor is b and whose right side is x."""
    y0 = x0 / b[0, 0]
    y1 = (x1 - b[1, 0] * y0) / b[1, 1]
    y2 = (x2 - b[2, 0] * y0 - b[2, 1] * y1) / b[2, 2]
    y3 = (x3 - b[3, 0] * y0 - b[3, 1] * y1 - b[3, 2] * y2) / b[3, 3]
    y3 = y3 / b[3, 3]
    y2 = (y2 - b[3, 2] * y3) / b[2, 2]
    y1 = (y1 - b[2, 1] * y2 - b[3, 1] * y3) / b[1, 1]
    y0 = (y0 - b[1, 0] * y1 - b[2, 0] * y2 - b[3, 0] * y3) / b[0, 0]
    return y0, y1, y2, y3
