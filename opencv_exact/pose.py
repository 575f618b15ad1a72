"""cv2.recoverPose: the same bits, several times faster (the last step of `five_point`)."""

import cv2
import numpy as np

from opencv_exact.compiling import compiled, inlined
from opencv_exact.points import as_pairs

MAX_DEPTH = 50.0  # in lengths of the translation; as in cv2.recoverPose, farther points do not vote
# for homogeneous points of unit norm; points nearer to a limit are left to OpenCV
LIMIT_MARGIN = 1e-7
FORWARD, BACKWARD, DOUBTFUL = 1, 2, 3  # how a point votes: for t, for -t, or too close to a limit


def recover_pose(
    E: np.ndarray, points1: np.ndarray, points2: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Motion from an essential matrix: (votes, R, t, mask), with the bits of cv2.recoverPose.

    That is cv2.recoverPose(E, points1, points2). points1, points2: normalised coordinates (N, 2) or
    (N, 1, 2). t: (3, 1). mask: (N, 1) uint8, 255 for points that vote for the motion.

    An essential matrix allows four motions. A point votes for a motion if it lies in front of both
    cameras and nearer than MAX_DEPTH. The motion with most votes wins. OpenCV triangulates every
    point four times with a singular value decomposition. Here a few steps of inverse iteration
    decide how nearly all points vote, for both signs of the translation at once. OpenCV's
    triangulation decides only about points close to a limit.
    Raises ValueError for points that OpenCV refuses.
    """
    current, previous = as_pairs(points1, points2)
    first, second, translation = cv2.decomposeEssentialMat(E)
    motions = [
        (first, translation),
        (second, translation),
        (first, -translation),
        (second, -translation),
    ]
    votes = np.zeros(4, np.int64)
    sides = [np.empty(0, np.int8), np.empty(0, np.int8)]  # of the points, for each rotation
    # A car's rotation is the smaller one. Its votes are counted first; the other's only while it
    # can still win.
    smaller = int(np.trace(first) < np.trace(second))
    for index in (smaller, 1 - smaller):
        rotation, _ = motions[index]
        votes[index], votes[index + 2], sides[index] = _count_in_front(
            current, previous, rotation, translation.ravel(), votes.max()
        )
    most_certain = votes.max()
    masks = [sides[index % 2] == (FORWARD, BACKWARD)[index // 2] for index in range(4)]
    for index, motion in enumerate(motions):
        doubtful = np.flatnonzero(sides[index % 2] == DOUBTFUL)
        if len(doubtful) and votes[index] + len(doubtful) >= most_certain:  # it can still win
            masks[index][doubtful] = _triangulate_and_vote(
                current[doubtful], previous[doubtful], *motion
            )
            votes[index] = masks[index].sum()
    best = int(np.argmax(votes))  # the first of equal numbers, as in OpenCV
    rotation, translation = motions[best]
    mask = np.where(masks[best], np.uint8(255), np.uint8(0)).reshape(-1, 1)
    return int(votes[best]), rotation, translation, mask


def _triangulate_and_vote(
    current: np.ndarray, previous: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Whether points vote for a motion, (N,) booleans, as OpenCV decides it."""
    projection = np.hstack([rotation, translation])
    points = cv2.triangulatePoints(np.eye(3, 4), projection, current.T.copy(), previous.T.copy())
    with np.errstate(divide="ignore", invalid="ignore"):
        votes = points[2] * points[3] > 0
        points = points / points[3]
        depth = projection[2] @ points
        votes &= points[2] < MAX_DEPTH
        return votes & (depth > 0) & (depth < MAX_DEPTH)


@compiled
def _count_in_front(current, previous, rotation, t, least):
    """Votes for (rotation, t) and (rotation, -t), and how each point votes, (N,) int8.

    Stops as soon as neither motion can reach `least` votes.
    """
    forward, backward, doubts = 0, 0, 0
    sides = np.zeros(len(current), np.int8)
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
            sides[index] = DOUBTFUL
            doubts += 1
        elif 0 < z < farthest and 0 < depth < farthest:
            sides[index] = FORWARD
            forward += 1
        elif 0 < -z < farthest and 0 < -depth < farthest:
            sides[index] = BACKWARD
            backward += 1  # the opposite t changes the signs of w and of both depths
    return forward, backward, sides


@inlined
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


@inlined
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


@inlined
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
