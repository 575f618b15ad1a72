"""Essential matrices through five correspondences, with margins for OpenCV's rounding errors.

OpenCV takes the same steps with the operations in another order, so its solutions differ in the
last digits. `ransac` needs a bound of this difference: the margin. It is a first-order error
estimate from the conditioning of each step, in units of ROUNDING, times SAFETY_FACTOR.
"""

from typing import NamedTuple

import numpy as np

from thesis_repro.odometry.opencv_exact import five_point
from thesis_repro.odometry.opencv_exact.five_point import LANES, SAMPLE_SIZE
from thesis_repro.running.compiled import fast, inner

ROUNDING = 2.0**-52  # of a number of size 1
# Among 200,000 solutions of real and degenerate scenes, no difference was larger than 1.4 times the
# estimate.
SAFETY_FACTOR = 3.0
# Share of the errors of B(z) that reaches det B(z), as measured. Errors that the rows have in
# common cancel.
DETERMINANT_SHARE = 0.1
MIN_MARGIN = 1e-9  # for an essential matrix of unit norm
# A larger margin is multiplied by SAFETY_FACTOR once more: errors of second order may count. (Of
# 4,500 samples with such a margin, none differed from OpenCV's by more than 0.8 of it before.)
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


def no_solutions() -> Solutions:
    """Space for the solutions of LANES samples."""
    return Solutions(
        np.zeros(LANES, bool),
        np.zeros(LANES, np.int64),
        np.empty((LANES, 10, 9)),
        np.empty((LANES, 10)),
    )


class _Steps(NamedTuple):
    """What the steps before the roots leave of each of LANES samples."""

    independences: np.ndarray  # (LANES,)
    rows: np.ndarray  # (LANES, 9, 9); the last four are the basis
    b: np.ndarray  # (LANES, 3, 13), B(z)
    errors: np.ndarray  # (LANES, 6), see `_write_elimination_errors`
    polynomials: np.ndarray  # (LANES, 11), det B(z); 0 if a step failed


@fast
def solve(fives, solutions):
    """Solve LANES samples of five correspondences, and write their Solutions.

    fives: (LANES, 5, 4), rows x, y in the current frame, u, v in the previous frame.
    """
    steps = _first_steps(fives)
    roots = five_point.real_roots(steps.polynomials)  # step 5
    b_sizes = np.empty((3, 13))
    work = np.empty((4, 3, 3))
    for lane in range(LANES):
        for i in range(3):
            for j in range(13):
                b_sizes[i, j] = abs(steps.b[lane, i, j])
        sure = roots.solved[lane] and _are_simple(lane, roots, steps, b_sizes, work)
        count = roots.counts[lane] if sure else 0
        for k in range(count):
            margin = _write_solution(
                lane, roots.roots[k, lane], steps, b_sizes, work, solutions.matrices[lane, k]
            )
            solutions.margins[lane, k] = margin
            sure &= margin < np.inf
        solutions.sure[lane] = sure
        solutions.counts[lane] = count if sure else 0


@inner
def _first_steps(fives):
    """Steps 1 to 4."""
    steps = _Steps(
        np.zeros(LANES),
        np.empty((LANES, 9, 9)),
        np.zeros((LANES, 3, 13)),
        np.empty((LANES, 6)),
        np.zeros((LANES, 11)),
    )
    # space that all samples use in turn, because getting it anew takes as long as a step
    equations, squares, minors = np.empty((10, 20)), np.empty((9, 10)), np.empty((3, 10))
    minor, inverse, sums = np.empty(7), np.empty((6, 6)), np.empty(6)
    for lane in range(LANES):
        rows = steps.rows[lane]
        steps.independences[lane] = five_point.null_space(fives[lane], rows)
        if steps.independences[lane] == 0:
            continue
        five_point.constraints(rows[SAMPLE_SIZE:], equations, squares, minors)
        if five_point.eliminate(equations, steps.b[lane]):
            _write_elimination_errors(equations, inverse, sums, steps.errors[lane])
            five_point.determinant(steps.b[lane], steps.polynomials[lane], minor)
    return steps


@inner
def _are_simple(lane, roots, steps, b_sizes, work):
    """Whether all roots are surely simple.

    Where det B(z) is as small as rounding at an extremum, it has a double root or none.
    """
    for k in range(roots.extremum_counts[lane]):
        error = _determinant_error(
            steps.b[lane], b_sizes, steps.errors[lane], roots.extrema[k, lane], work
        )
        if not abs(roots.heights[k, lane]) > SAFETY_FACTOR * ROUNDING * error:
            return False
    return True


@inner
def _write_solution(lane, root, steps, b_sizes, work, matrix):
    """Write the essential matrix (9) of a root. Returns its margin."""
    b = steps.b[lane]
    error = _determinant_error(b, b_sizes, steps.errors[lane], root, work)
    best = _best_row(work[3])
    five_point.essential(work[3, best], steps.rows[lane, SAMPLE_SIZE:], root, matrix)  # step 6
    change = _solution_error(b, best, root, error, steps.polynomials[lane], work)
    margin = MIN_MARGIN + SAFETY_FACTOR * ROUNDING * (1 / steps.independences[lane] + change)
    return margin if margin < WELL_CONDITIONED else SAFETY_FACTOR * margin


@inner
def _write_elimination_errors(a, inverse, sums, total):
    """Write the rounding errors (6) of the six rows that B(z) is made from, OpenCV's way included.

    They are in units of ROUNDING. a (10, 20): result of the elimination, with the triangle U of the
    last six unknowns. inverse (6, 6), sums (6): space. An error of one unit in the equations
    becomes |U^-1| times the size of the result. OpenCV inverts and multiplies, which adds
    |U^-1| |U| |U^-1|.
    """
    largest = 1.0
    for k in range(4, 10):
        for j in range(10, 20):
            largest = max(largest, abs(a[k, j]))
    inverse[:] = 0.0
    sums[:] = 0.0
    total[:] = 0.0
    for i in range(5, -1, -1):
        inverse[i, i] = 1 / a[4 + i, 4 + i]
        for j in range(i + 1, 6):
            for k in range(i + 1, j + 1):
                inverse[i, j] -= a[4 + i, 4 + k] * inverse[k, j]
            inverse[i, j] /= a[4 + i, 4 + i]
        for j in range(i, 6):
            sums[i] += abs(inverse[i, j])
    for j in range(6):
        error = largest
        for k in range(j, 6):
            error += abs(a[4 + j, 4 + k]) * sums[k]
        for i in range(j + 1):
            total[i] += abs(inverse[i, j]) * error


@inner
def _determinant_error(b, b_sizes, errors, z, work):
    """Rounding error of det B(z), in units of ROUNDING.

    It is Wilkinson's bound: the sum of the sizes of all terms. Also writes to work (4, 3, 3): B(z),
    the sizes of its terms, its errors in units of ROUNDING, its cofactors.
    """
    values, sizes, wrong, cofactors = work[0], work[1], work[2], work[3]
    size = abs(z)
    powers = 1 + size + size * size
    for i in range(3):
        values[i, 0], values[i, 1], values[i, 2] = five_point.row_values(b[i], z)
        sizes[i, 0], sizes[i, 1], sizes[i, 2] = five_point.row_values(b_sizes[i], size)
        error = errors[2 * i] + size * errors[2 * i + 1]
        wrong[i, 0] = error * powers + sizes[i, 0]
        wrong[i, 1] = error * powers + sizes[i, 1]
        wrong[i, 2] = error * (1 + size * powers) + sizes[i, 2]
    error = 0.0
    for i in range(3):
        p = (i + 1) % 3
        q = (i + 2) % 3
        for j in range(3):
            m = (j + 1) % 3
            n = (j + 2) % 3
            cofactors[i, j] = values[p, m] * values[q, n] - values[p, n] * values[q, m]
            error += DETERMINANT_SHARE * abs(cofactors[i, j]) * wrong[i, j]
        error += sizes[i, 0] * (sizes[p, 1] * sizes[q, 2] + sizes[p, 2] * sizes[q, 1])
    return error


@inner
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


@inner
def _solution_error(b, best, z, error, polynomial, work):
    """First-order rounding error of the essential matrix of a root z, in units of ROUNDING.

    The matrix has unit norm. In the basis the matrix is (x, y, w z, w), where (x, y, w) is normal
    to B(z). An error of z changes it; that error is the error of det B(z) over the slope of det
    B(z). An error of B(z) changes it by the error over B(z)'s second singular value, which is the
    norm of the cofactors over the norm of B(z).
    """
    values, wrong, cofactors = work[0], work[2], work[3]
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
    height, slope = polynomial[0], 0.0
    for k in range(1, 11):
        slope = slope * z + height
        height = height * z + polynomial[k]
    return (error / abs(slope) * np.sqrt(speed) + np.sqrt(tilt)) / np.sqrt(square)


@inner
def _row_slopes(c, z):
    """Derivatives at z of the three polynomials in one row c (13) of B(z)."""
    return (
        (3 * c[0] * z + 2 * c[1]) * z + c[2],
        (3 * c[4] * z + 2 * c[5]) * z + c[6],
        ((4 * c[8] * z + 3 * c[9]) * z + 2 * c[10]) * z + c[11],
    )
