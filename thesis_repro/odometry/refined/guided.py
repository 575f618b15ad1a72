"""RANSAC among the motions near an expected motion.

With few points or points far away, two motions may explain the matches almost equally well: a turn
looks like a shift to the side. Which of them plain RANSAC returns is chance. This search ignores
every essential matrix whose motion differs from the expected motion by more than given angles.
"""

import numpy as np

from opencv_exact import MAX_SAMPLES, WELL_CONDITIONED, draw_samples, epipolar, solve_five_points
from opencv_exact.compiling import compiled, inlined
from thesis_repro.odometry.refined import matrices
from thesis_repro.odometry.refined.fit import columns, near_epipolar_lines
from thesis_repro.odometry.step import Matches


def ransac_with_prior(
    matches: Matches,
    rotation: np.ndarray,
    translation: np.ndarray,
    max_rotation: float,
    max_heading: float,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Motion (rotation 3x3, unit translation) with most inliers near an expected motion.

    None if no motion is near it.

    A sample with a solution that rounding may change much is left out.
    matches: at least five. rotation, translation: the expected motion.
    max_rotation, max_heading: largest differences in degrees of the rotation and of the
    translation's direction, whose sign is ignored.
    """
    samples = draw_samples(len(matches.current), MAX_SAMPLES)
    solutions = solve_five_points(matches.current[samples], matches.previous[samples])
    is_solution = np.arange(10) < solutions.counts[:, None]
    is_bad = ((solutions.margins >= WELL_CONDITIONED) & is_solution).any(axis=1)
    is_solution[is_bad] = False
    most, best_rotation, best_translation = _best(
        solutions.matrices[is_solution],
        columns(matches),
        matches.threshold,
        np.ascontiguousarray(rotation),
        np.ascontiguousarray(translation),
        np.cos(np.radians(min(max_rotation, 180.0))),
        np.cos(np.radians(min(max_heading, 90.0))),
    )
    return (best_rotation.reshape(3, 3), best_translation) if most else None


@compiled
def _best(
    solutions, points, threshold, rotation, translation, min_rotation_cosine, min_heading_cosine
):
    """Most inliers of any motion near the expected one, and that motion (rotation, translation)."""
    most, best_r, best_t = 0, np.empty(9), np.empty(3)
    for index in range(len(solutions)):
        e = epipolar.entries(solutions[index])
        t = _translation(e)
        if abs(matrices.dot(t, translation)) < min_heading_cosine:
            continue
        for _ in range(2):  # t with one rotation, -t with the other
            r = _rotation(e, t)
            if _rotation_cosine(r, rotation) >= min_rotation_cosine:
                inliers = near_epipolar_lines(e, points, threshold).sum()
                if inliers > most:
                    most, best_r, best_t = inliers, np.array(r), np.array(t)
                break
            t = -t[0], -t[1], -t[2]
    return most, best_r, best_t


@inlined
def _rotation_cosine(r, rotation):
    """Cosine of the angle between two rotations, a tuple (9) and an array (3, 3)."""
    product = 0.0
    for i in range(3):
        for j in range(3):
            product += r[3 * i + j] * rotation[i, j]
    return (product - 1) / 2


@inlined
def _translation(e):
    """Unit translation of an essential matrix, with either sign. It is normal to all columns."""
    columns = (e[0], e[3], e[6]), (e[1], e[4], e[7]), (e[2], e[5], e[8])
    best, largest = (0.0, 0.0, 0.0), -1.0
    for k in range(3):  # use the best conditioned pair of columns
        normal = matrices.cross(columns[k], columns[(k + 1) % 3])
        size = matrices.dot(normal, normal)
        if size > largest:
            best, largest = normal, size
    return matrices.normalised(best)


@inlined
def _rotation(e, t):
    """Rotation R of an essential matrix [t]x R (unit norm) for one sign of t, row by row.

    Horn (1990), Recovering baseline and orientation from essential matrix: R = cof(E) - [t]x E for
    unit t.
    """
    size = np.sqrt(2.0)  # the norm of [t]x R
    first, second, third = (e[0], e[1], e[2]), (e[3], e[4], e[5]), (e[6], e[7], e[8])
    # the cofactors, row by row
    r = matrices.cross(second, third) + matrices.cross(third, first) + matrices.cross(first, second)
    c0, c3, c6 = matrices.cross(t, (e[0], e[3], e[6]))  # a column of [t]x E
    c1, c4, c7 = matrices.cross(t, (e[1], e[4], e[7]))
    c2, c5, c8 = matrices.cross(t, (e[2], e[5], e[8]))
    square = size * size
    return (
        square * r[0] - size * c0,
        square * r[1] - size * c1,
        square * r[2] - size * c2,
        square * r[3] - size * c3,
        square * r[4] - size * c4,
        square * r[5] - size * c5,
        square * r[6] - size * c6,
        square * r[7] - size * c7,
        square * r[8] - size * c8,
    )
