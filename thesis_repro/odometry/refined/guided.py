"""RANSAC among the motions near an expected one.

With few points, or points far away, two motions may explain the correspondences nearly as well: a turn looks like a
shift to the side. RANSAC then keeps the one that its samples happen to favour. Here only essential matrices whose
motion lies within given angles of an expected one are counted, so the other cannot win.
"""

import numpy as np

from thesis_repro.compiled import fast
from thesis_repro.odometry.opencv_exact import epipolar
from thesis_repro.odometry.opencv_exact.five_point import SAMPLE_SIZE
from thesis_repro.odometry.opencv_exact.ransac import MAX_SAMPLES, OPENCV_SEED, draw
from thesis_repro.odometry.opencv_exact.rounding import solve


def ransac_with_prior(current: np.ndarray, previous: np.ndarray, threshold: float, rotation: np.ndarray,
                      translation: np.ndarray, max_rotation: float, max_heading: float
                      ) -> tuple[np.ndarray, np.ndarray] | None:
    """The motion (rotation 3x3, unit translation) with most inliers among those near an expected one; None for none.

    current, previous: normalised correspondences (N, 2), N of five or more. rotation, translation: the expected motion.
    max_rotation, max_heading: degrees by which a rotation and a translation's direction may differ from it; the
    translation's sign is not looked at.
    """
    columns = np.ascontiguousarray(np.hstack([current, previous]).T)
    matrices = _candidates(columns)
    headings = _translations(matrices)
    near = np.abs((headings * translation).sum(axis=1)) >= np.cos(np.radians(min(max_heading, 90.0)))
    matrices, headings = matrices[near], headings[near]
    most, best = 0, None
    pairs = (headings, _rotations(matrices, headings)), (-headings, _rotations(matrices, -headings))
    near_rotation = [((rotations * rotation).sum(axis=(1, 2)) - 1) / 2 >= np.cos(np.radians(min(max_rotation, 180.0)))
                     for _, rotations in pairs]
    for index in np.flatnonzero(near_rotation[0] | near_rotation[1]):
        inliers = _count_inliers(matrices[index], columns, threshold * threshold)
        if inliers > most:
            signed_headings, rotations = pairs[0 if near_rotation[0][index] else 1]
            most, best = inliers, (rotations[index], signed_headings[index])
    return best


def _candidates(columns):
    """Essential matrices (K, 3, 3) of unit norm through random samples of five correspondences (columns: 4, N)."""
    state, sample, five = OPENCV_SEED, np.empty(SAMPLE_SIZE, np.int64), np.empty((SAMPLE_SIZE, 4))
    solutions = [np.empty((0, 9))]
    for _ in range(MAX_SAMPLES):
        state = draw(np.uint64(state), columns, sample, five)
        sure, matrices, _ = solve(five)
        if sure:
            solutions.append(matrices)
    return np.concatenate(solutions).reshape(-1, 3, 3)


def _translations(matrices):
    """The unit translations (K, 3) of essential matrices (K, 3, 3), of any sign: each is normal to all columns."""
    normals = np.stack([np.cross(matrices[:, :, a], matrices[:, :, (a + 1) % 3]) for a in range(3)])
    squares = (normals * normals).sum(axis=2)
    index = squares.argmax(axis=0), np.arange(len(matrices))  # of the best conditioned pair of columns
    return normals[index] / np.sqrt(squares[index])[:, None]


def _rotations(matrices, translations):
    """The rotations (K, 3, 3) that make essential matrices (K, 3, 3, unit norm) [t]x R for unit translations (K, 3).

    Horn (1990), Recovering baseline and orientation from essential matrix: R = cof(E) - [t]x E for unit t.
    """
    size = np.sqrt(2.0)  # the norm of [t]x R
    cofactors = np.stack([np.cross(matrices[:, (i + 1) % 3], matrices[:, (i + 2) % 3]) for i in range(3)], axis=1)
    return size * size * cofactors - size * np.cross(translations[:, :, None], matrices, axis=1)


@fast
def _count_inliers(matrix, columns, limit):
    """How many correspondences (4, N) have a squared Sampson distance within the limit."""
    e, inliers = epipolar.entries(matrix), 0
    for k in range(columns.shape[1]):
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(e, columns[0, k], columns[1, k], columns[2, k],
                                                           columns[3, k])
        inliers += 1 if algebraic * algebraic <= limit * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1) else 0
    return inliers
