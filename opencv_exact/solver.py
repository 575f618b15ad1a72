"""Essential matrices through five correspondences, with margins for OpenCV's rounding errors.

OpenCV takes the same steps with the operations in another order, so its solutions differ in the
last digits. `ransac` needs a bound of this difference: the margin. It is a first-order error
estimate from the conditioning of each step, in units of ROUNDING, times SAFETY_FACTOR.
"""

from typing import NamedTuple

import numpy as np

from opencv_exact import five_point
from opencv_exact.compiling import compiled, inlined
from opencv_exact.five_point import MIN_INDEPENDENCE, SAMPLE_SIZE
from opencv_exact.real_roots import LANES, real_roots

ROUNDING = 2.0**-52  # of a number of size 1
# Among 200,000 solutions of real and degenerate scenes, no difference was larger than 1.4 times the
# estimate.
SAFETY_FACTOR = 3.0
# Share of the errors of B(z) that reaches det B(z), as measured. Errors that the rows have in
# common cancel.
DETERMINANT_SHARE = 0.1
MIN_MARGIN = 1e-9  # for an essential matrix of unit norm
# A larger margin is multiplied by SAFETY_FACTOR once more: errors of second order may count.
WELL_CONDITIONED = 1e-3


class Solutions(NamedTuple):
    """Essential matrices through LANES samples of five correspondences, with margins.

    A sample is sure if OpenCV finds as many matrices, each within its margin of one of these
    (Frobenius norm, up to sign). Other samples have no matrices here.
    """

    sure: np.ndarray  # (LANES,) booleans
    counts: np.ndarray  # (LANES,), numbers of matrices
    matrices: np.ndarray  # (LANES, 10, 9), of unit norm
    margins: np.ndarray  # (LANES, 10)


def solve_five_points(current: np.ndarray, previous: np.ndarray) -> Solutions:
    """Essential matrices through K samples of five correspondences.

    current, previous: (K, 5, 2), normalised coordinates, K > 0.
    """
    columns = np.concatenate([current, previous], axis=2).reshape(-1, 4).T.copy()
    blocks = []
    for start in range(0, len(current), LANES):
        # the last sample fills the lanes that are left
        samples = np.minimum(np.arange(start, start + LANES), len(current) - 1)
        indices = SAMPLE_SIZE * samples[:, None] + np.arange(SAMPLE_SIZE)
        blocks.append(solve(correspondences(columns, indices)))
    return Solutions(*(np.concatenate(arrays)[: len(current)] for arrays in zip(*blocks)))


@compiled
def correspondences(columns, samples):
    """Correspondences (5, 4, LANES) of samples (LANES, 5) among columns (4, N)."""
    fives = np.empty((SAMPLE_SIZE, 4, LANES))
    for lane in range(LANES):
        for k in range(SAMPLE_SIZE):
            for j in range(4):
                fives[k, j, lane] = columns[j, samples[lane, k]]
    return fives


class _Steps(NamedTuple):
    """What the steps before the roots leave of LANES samples."""

    independences: np.ndarray  # (LANES,)
    rows: np.ndarray  # (9, 9, LANES); the last four are the basis
    b: np.ndarray  # (3, 13, LANES), B(z)
    b_sizes: np.ndarray  # absolute values of b
    errors: np.ndarray  # (6, LANES), see `_write_elimination_errors`
    polynomials: np.ndarray  # (11, LANES), det B(z), lowest power first


@compiled
def solve(fives):
    """Solutions of LANES samples of five correspondences.

    fives: (5, 4, LANES), rows x, y in the current frame, u, v in the previous frame.
    """
    steps = _first_steps(fives)
    roots = real_roots(steps.polynomials)  # step 5
    work, errors = np.empty((4, 3, 3, LANES)), np.empty(LANES)
    solutions = Solutions(
        np.zeros(LANES, np.bool_),
        np.zeros(LANES, np.int64),
        np.empty((LANES, 10, 9)),
        np.empty((LANES, 10)),
    )
    sure, counts = solutions.sure, solutions.counts
    for lane in range(LANES):
        # not solved if the equations were singular: the polynomial is not finite
        sure[lane] = roots.solved[lane] and steps.independences[lane] > MIN_INDEPENDENCE
    for k in range(roots.extremum_counts.max()):
        _write_determinant_errors(steps, roots.extrema[k], work, errors)
        for lane in range(LANES):
            # a value as small as rounding: a double root or none
            is_simple = abs(roots.heights[k, lane]) > SAFETY_FACTOR * ROUNDING * errors[lane]
            sure[lane] &= is_simple or k >= roots.extremum_counts[lane]
    for k in range(roots.counts.max()):
        _write_determinant_errors(steps, roots.roots[k], work, errors)
        for lane in range(LANES):
            if sure[lane] and k < roots.counts[lane]:
                root, error = roots.roots[k, lane], errors[lane]
                matrix = solutions.matrices[lane, k]
                margin = _write_solution(steps, lane, root, error, work, matrix)
                solutions.margins[lane, k] = margin
                sure[lane] &= margin < np.inf
    for lane in range(LANES):
        counts[lane] = roots.counts[lane] if sure[lane] else 0
    return solutions


@inlined
def _first_steps(fives):
    """Steps 1 to 4."""
    independences, rows = np.empty(LANES), np.empty((9, 9, LANES))
    equations, b = np.zeros((10, 20, LANES)), np.zeros((3, 13, LANES))
    errors, polynomials = np.empty((6, LANES)), np.zeros((11, LANES))
    b_sizes = np.empty((3, 13, LANES))
    five_point.null_space(fives, rows, independences)
    five_point.constraints(rows[SAMPLE_SIZE:], equations)
    five_point.eliminate(equations, b)
    _write_elimination_errors(equations, errors)
    five_point.determinant(b, polynomials)
    for i in range(3):
        for j in range(13):
            for lane in range(LANES):
                b_sizes[i, j, lane] = abs(b[i, j, lane])
    return _Steps(independences, rows, b, b_sizes, errors, polynomials)


@inlined
def _write_solution(steps, lane, root, error, work, matrix):
    """Write the essential matrix (9) of a root. Returns its margin.

    error: of det B(z), see `_write_determinant_errors`.
    """
    cofactors = work[3, :, :, lane]
    best = _best_row(cofactors)
    basis = steps.rows[SAMPLE_SIZE:, :, lane]
    five_point.essential(cofactors[best], basis, root, matrix)  # step 6
    change = _solution_error(steps, lane, best, root, error, work)
    margin = MIN_MARGIN + SAFETY_FACTOR * ROUNDING * (1 / steps.independences[lane] + change)
    return margin if margin < WELL_CONDITIONED else SAFETY_FACTOR * margin


@inlined
def _write_elimination_errors(a, errors):
    """Write the rounding errors of the six rows that B(z) is made from, OpenCV's way included.

    They are in units of ROUNDING, (6, LANES). a (10, 20, LANES): result of the elimination, with
    the triangle U of the last six unknowns. An error of one unit in the equations becomes |U^-1|
    times the size of the result. OpenCV inverts and multiplies, which adds |U^-1| |U| |U^-1|.
    """
    inverse, sums = np.empty((6, 6)), np.empty(6)
    for lane in range(LANES):
        triangle = a[4:, 4:, lane]
        _invert(triangle, inverse, sums)
        largest = 1.0
        for i in range(6):
            errors[i, lane] = 0.0
            for j in range(6, 16):
                largest = max(largest, abs(triangle[i, j]))
        for j in range(6):
            error = largest
            for k in range(j, 6):
                error += abs(triangle[j, k]) * sums[k]
            for i in range(j + 1):
                errors[i, lane] += abs(inverse[i, j]) * error


@inlined
def _invert(triangle, inverse, sums):
    """Write the inverse of an upper triangle (6, 6), and the sums of the sizes in its rows."""
    for i in range(5, -1, -1):
        inverse[i, i] = 1 / triangle[i, i]
        sums[i] = abs(inverse[i, i])
        for j in range(i + 1, 6):
            inverse[i, j] = 0.0
            for k in range(i + 1, j + 1):
                inverse[i, j] -= triangle[i, k] * inverse[k, j]
            inverse[i, j] /= triangle[i, i]
            sums[i] += abs(inverse[i, j])


@inlined
def _write_determinant_errors(steps, places, work, errors):
    """Write the rounding errors (LANES) of det B(z) at a place of each lane, in units of ROUNDING.

    They are Wilkinson's bound: the sum of the sizes of all terms. Also writes to work (4, 3, 3,
    LANES): B(z), the sizes of its terms, its errors in units of ROUNDING, its cofactors.
    """
    values, sizes, wrong, cofactors = work[0], work[1], work[2], work[3]
    for i in range(3):
        _write_row(steps.b[i], places, values[i])
        _write_sizes(
            steps.b_sizes[i],
            steps.errors[2 * i],
            steps.errors[2 * i + 1],
            places,
            sizes[i],
            wrong[i],
        )
    for lane in range(LANES):
        errors[lane] = 0.0
    for i in range(3):
        p = (i + 1) % 3
        q = (i + 2) % 3
        _write_cofactors(values[p], values[q], cofactors[i])
        _add_errors(cofactors[i], wrong[i], sizes[i], sizes[p], sizes[q], errors)


@inlined
def _write_row(b_row, places, values):
    """Write one row of B(z), (3, LANES)."""
    for lane in range(LANES):
        first, second, third = five_point.row_values(b_row[:, lane], places[lane])
        values[0, lane], values[1, lane], values[2, lane] = first, second, third


@inlined
def _write_sizes(b_sizes, error, next_error, places, sizes, wrong):
    """Write the sizes of the terms in one row of B(z), and its errors, (3, LANES).

    error, next_error: of the two eliminated rows that it is made from.
    """
    for lane in range(LANES):
        size = abs(places[lane])
        powers = 1 + size + size * size
        first, second, third = five_point.row_values(b_sizes[:, lane], size)
        sizes[0, lane], sizes[1, lane], sizes[2, lane] = first, second, third
        both = error[lane] + size * next_error[lane]
        wrong[0, lane] = both * powers + first
        wrong[1, lane] = both * powers + second
        wrong[2, lane] = both * (1 + size * powers) + third


@inlined
def _write_cofactors(first, second, cofactors):
    """Write the cofactors of one row from the two other rows, each (3, LANES)."""
    for lane in range(LANES):
        for j in range(3):
            m = (j + 1) % 3
            n = (j + 2) % 3
            left, right = first[m, lane] * second[n, lane], first[n, lane] * second[m, lane]
            cofactors[j, lane] = left - right


@inlined
def _add_errors(cofactors, wrong, sizes, first, second, errors):
    """Add one row's part of the errors. first, second: sizes in the two other rows."""
    for lane in range(LANES):
        error = errors[lane]
        for j in range(3):
            error += DETERMINANT_SHARE * abs(cofactors[j, lane]) * wrong[j, lane]
        terms = first[1, lane] * second[2, lane] + first[2, lane] * second[1, lane]
        errors[lane] = error + sizes[0, lane] * terms


@inlined
def _best_row(cofactors):
    """Index of the largest row of cofactors.

    It is the best conditioned normal of the plane that the rows of B(z) span.
    """
    best = 0
    largest = -1.0
    for i in range(3):
        size = (
            cofactors[i, 0] * cofactors[i, 0]
            + cofactors[i, 1] * cofactors[i, 1]
            + cofactors[i, 2] * cofactors[i, 2]
        )
        if size > largest:
            best = i
            largest = size
    return best


@inlined
def _solution_error(steps, lane, best, z, error, work):
    """First-order rounding error of the essential matrix of a root z, in units of ROUNDING.

    The matrix has unit norm. In the basis the matrix is (x, y, w z, w), where (x, y, w) is normal
    to B(z). An error of z changes it; that error is the error of det B(z) over the slope of det
    B(z). An error of B(z) changes it by the error over B(z)'s second singular value, which is the
    norm of the cofactors over the norm of B(z).
    """
    values, wrong, cofactors = work[0, :, :, lane], work[2, :, :, lane], work[3, :, :, lane]
    b = steps.b[:, :, lane]
    cofactor_norm = 0.0
    norm = 0.0
    for i in range(3):
        for j in range(3):
            cofactor_norm += cofactors[i, j] * cofactors[i, j]
            norm += values[i, j] * values[i, j]
    first = (best + 1) % 3
    second = (best + 2) % 3
    p, q = values[first], values[second]
    x, y, w = cofactors[best, 0], cofactors[best, 1], cofactors[best, 2]
    p0, p1, p2 = _row_slopes(b[first], z)
    q0, q1, q2 = _row_slopes(b[second], z)
    dx = p1 * q[2] - p2 * q[1] + p[1] * q2 - p[2] * q1
    dy = p2 * q[0] - p0 * q[2] + p[2] * q0 - p[0] * q2
    dw = p0 * q[1] - p1 * q[0] + p[0] * q1 - p[1] * q0
    dwz = dw * z + w
    square = x * x + y * y + w * w * (1 + z * z)
    along = (x * dx + y * dy + w * dw + w * z * dwz) / square  # the part that normalisation removes
    speed = (
        (dx - along * x) ** 2
        + (dy - along * y) ** 2
        + (dw - along * w) ** 2
        + (dwz - along * w * z) ** 2
    )
    tilt = 0.0
    for i in range(3):
        tilt += (abs(x) * wrong[i, 0] + abs(y) * wrong[i, 1] + abs(w) * wrong[i, 2]) ** 2
    tilt *= norm / cofactor_norm * (1 + z * z)
    height, slope = steps.polynomials[10, lane], 0.0
    for power in range(9, -1, -1):
        slope = slope * z + height
        height = height * z + steps.polynomials[power, lane]
    return (error / abs(slope) * np.sqrt(speed) + np.sqrt(tilt)) / np.sqrt(square)


@inlined
def _row_slopes(c, z):
    """Derivatives at z of the three polynomials in one row c (13) of B(z)."""
    return (
        (3 * c[0] * z + 2 * c[1]) * z + c[2],
        (3 * c[4] * z + 2 * c[5]) * z + c[6],
        ((4 * c[8] * z + 3 * c[9]) * z + 2 * c[10]) * z + c[11],
    )
