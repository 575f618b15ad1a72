"""RANSAC among the motions near an expected one.

With few points, or points far away, two motions may explain the correspondences nearly as well: a turn looks like a
shift to the side. RANSAC then keeps the one that its samples happen to favour. Here only essential matrices whose
motion lies within given angles of an expected one are counted, so the other cannot win.
"""

import numpy as np

from thesis_repro.compiled import fast, inner
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
    most, best_rotation, best_translation = _best(
        columns, threshold * threshold, np.ascontiguousarray(rotation), np.ascontiguousarray(translation),
        np.cos(np.radians(min(max_rotation, 180.0))), np.cos(np.radians(min(max_heading, 90.0))),
        np.uint64(OPENCV_SEED))
    return (best_rotation, best_translation) if most else None


@fast
def _best(columns, limit, rotation, translation, min_rotation_cosine, min_heading_cosine, state):
    sample, five = np.empty(SAMPLE_SIZE, np.int64), np.empty((SAMPLE_SIZE, 4))
    r, t = np.empty((3, 3)), np.empty(3)
    most, best_r, best_t = 0, np.empty((3, 3)), np.empty(3)
    for _ in range(MAX_SAMPLES):
        state = draw(state, columns, sample, five)
        _, solutions, _ = solve(five)  # none where it is unsure
        for index in range(len(solutions)):
            e, near = epipolar.entries(solutions[index]), False
            _translation(e, t)
            if abs(t[0] * translation[0] + t[1] * translation[1] + t[2] * translation[2]) < min_heading_cosine:
                continue
            for _ in range(2):  # with t, and with -t, which belongs to the other rotation
                _rotation(e, t, r)
                product = 0.0
                for i in range(3):
                    for j in range(3):
                        product += r[i, j] * rotation[i, j]
                near = (product - 1) / 2 >= min_rotation_cosine
                if near:
                    break
                t[0], t[1], t[2] = -t[0], -t[1], -t[2]
            if not near:
                continue
            inliers = 0
            for k in range(columns.shape[1]):
                algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(e, columns[0, k], columns[1, k], columns[2, k],
                                                                   columns[3, k])
                inliers += 1 if algebraic * algebraic <= limit * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1) else 0
            if inliers > most:
                most, best_r, best_t = inliers, r.copy(), t.copy()
    return most, best_r, best_t


@inner
def _translation(e, t):
    """Write the unit translation of an essential matrix, one of its two signs: it is normal to all columns."""
    largest = -1.0
    for a in range(3):  # the best conditioned pair of columns gives it
        b = (a + 1) % 3
        c0 = e[3 + a] * e[6 + b] - e[6 + a] * e[3 + b]
        c1 = e[6 + a] * e[b] - e[a] * e[6 + b]
        c2 = e[a] * e[3 + b] - e[3 + a] * e[b]
        size = c0 * c0 + c1 * c1 + c2 * c2
        if size > largest:
            largest, t[0], t[1], t[2] = size, c0, c1, c2
    norm = np.sqrt(largest)
    t[0], t[1], t[2] = t[0] / norm, t[1] / norm, t[2] / norm


@inner
def _rotation(e, t, r):
    """Write the rotation that makes an essential matrix (unit norm) [t]x R; the other sign of t gives the other one.

    Horn (1990), Recovering baseline and orientation from essential matrix: R = cof(E) - [t]x E for unit t.
    """
    size = np.sqrt(2.0)  # the norm of [t]x R
    for i in range(3):
        i1, i2 = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3)
        for j in range(3):
            j1, j2 = (j + 1) % 3, (j + 2) % 3
            cofactor = e[i1 + j1] * e[i2 + j2] - e[i1 + j2] * e[i2 + j1]
            r[i, j] = size * size * cofactor - size * (t[(i + 1) % 3] * e[i2 + j] - t[(i + 2) % 3] * e[i1 + j])
