"""RANSAC among the motions near an expected motion.

With few points or points far away, two motions may explain the correspondences almost equally well:
a turn looks like a shift to the side. Which of them plain RANSAC returns is chance. This search
ignores every essential matrix whose motion differs from the expected motion by more than given
angles.
"""

import numpy as np
from opencv_exact.rounding import WELL_CONDITIONED, solve

from opencv_exact import epipolar
from opencv_exact.compiling import compiled, inlined
from opencv_exact.ransac import MAX_SAMPLES, draw, first_block
from opencv_exact.real_roots import LANES


def ransac_with_prior(
    current: np.ndarray,
    previous: np.ndarray,
    threshold: float,
    rotation: np.ndarray,
    translation: np.ndarray,
    max_rotation: float,
    max_heading: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Motion (rotation 3x3, unit translation) with most inliers near an expected motion.

    None if no motion is near it.

    A sample with a solution that rounding may change much is left out.
    current, previous: normalised correspondences (N, 2), N >= 5. rotation, translation: the
    expected motion.
    max_rotation, max_heading: largest differences in degrees of the rotation and of the
    translation's direction, whose sign is ignored.
    """
    columns = np.ascontiguousarray(np.hstack([current, previous]).T)
    block = first_block()
    kept_matrices = []
    # in Python: `solve` within another compiled function would be compiled once more
    for start in range(0, MAX_SAMPLES, LANES):
        draw(columns, block)
        solve(block.fives, block.solutions)
        _, counts, matrices, margins = block.solutions
        is_solution = np.arange(matrices.shape[1]) < counts[:, None]
        is_bad = ((margins >= WELL_CONDITIONED) & is_solution).any(axis=1)
        is_solution[is_bad] = False
        is_solution[MAX_SAMPLES - start :] = False
        kept_matrices.append(matrices[is_solution])
    most, best_rotation, best_translation = _best(
        np.concatenate(kept_matrices),
        columns,
        threshold * threshold,
        np.ascontiguousarray(rotation),
        np.ascontiguousarray(translation),
        np.cos(np.radians(min(max_rotation, 180.0))),
        np.cos(np.radians(min(max_heading, 90.0))),
    )
    return (best_rotation, best_translation) if most else None


@compiled
def _best(
    solutions, columns, limit, rotation, translation, min_rotation_cosine, min_heading_cosine
):
    """Most inliers of any motion near the expected one, and that motion (rotation, translation)."""
    r, t = np.empty((3, 3)), np.empty(3)
    most, best_r, best_t = 0, np.empty((3, 3)), np.empty(3)
    for index in range(len(solutions)):
        e = epipolar.entries(solutions[index])
        _translation(e, t)
        cosine = t[0] * translation[0] + t[1] * translation[1] + t[2] * translation[2]
        if abs(cosine) < min_heading_cosine:
            continue
        is_near = False
        for _ in range(2):  # t with one rotation, -t with the other
            _rotation(e, t, r)
            product = 0.0
            for i in range(3):
                for j in range(3):
                    product += r[i, j] * rotation[i, j]
            is_near = (product - 1) / 2 >= min_rotation_cosine
            if is_near:
                break
            t[0], t[1], t[2] = -t[0], -t[1], -t[2]
        if not is_near:
            continue
        inliers = 0
        for k in range(columns.shape[1]):
            algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(
                e, columns[0, k], columns[1, k], columns[2, k], columns[3, k]
            )
            square = l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1
            inliers += algebraic * algebraic <= limit * square
        if inliers > most:
            most, best_r, best_t = inliers, r.copy(), t.copy()
    return most, best_r, best_t


@inlined
def _translation(e, t):
    """Write the unit translation of an essential matrix, with either sign.

    It is normal to all columns.
    """
    largest = -1.0
    for a in range(3):  # use the best conditioned pair of columns
        b = (a + 1) % 3
        c0 = e[3 + a] * e[6 + b] - e[6 + a] * e[3 + b]
        c1 = e[6 + a] * e[b] - e[a] * e[6 + b]
        c2 = e[a] * e[3 + b] - e[3 + a] * e[b]
        size = c0 * c0 + c1 * c1 + c2 * c2
        if size > largest:
            largest, t[0], t[1], t[2] = size, c0, c1, c2
    norm = np.sqrt(largest)
    t[0], t[1], t[2] = t[0] / norm, t[1] / norm, t[2] / norm


@inlined
def _rotation(e, t, r):
    """Write the rotation R of an essential matrix [t]x R (unit norm) for one sign of t.

    Horn (1990), Recovering baseline and orientation from essential matrix: R = cof(E) - [t]x E for
    unit t.
    """
    size = np.sqrt(2.0)  # the norm of [t]x R
    for i in range(3):
        p = (i + 1) % 3
        q = (i + 2) % 3
        for j in range(3):
            m = (j + 1) % 3
            n = (j + 2) % 3
            cofactor = e[3 * p + m] * e[3 * q + n] - e[3 * p + n] * e[3 * q + m]
            product = t[p] * e[3 * q + j] - t[q] * e[3 * p + j]  # of [t]x E
            r[i, j] = size * size * cofactor - size * product
