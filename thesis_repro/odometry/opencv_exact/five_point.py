"""The five-point algorithm: essential matrices from five correspondences.

The steps follow Nister (2004), An efficient solution to the five-point relative pose problem, PAMI
26(6):

1. `null_space`: five epipolar constraints leave E = x X + y Y + z Z + W with unknown x, y, z;
2. `constraints`: the trace constraint and the determinant constraint on E are ten cubic equations
in x, y, z;
3. `eliminate`: Gauss-Jordan elimination leaves three equations B(z) (x, y, 1)^T = 0;
4. `determinant`: det B(z) is a polynomial of degree ten in z;
5. `real_roots`: the real roots of det B(z) = 0 (a complex root gives no motion);
6. `essential`: x, y and E for one root.

`rounding.solve` runs these steps. Nister's last step, rotation and translation from E, is
pose.recover_pose.
"""

import math
from typing import NamedTuple

import numpy as np

from thesis_repro.running.compiled import inner

SAMPLE_SIZE = 5
# Samples whose polynomials are solved side by side, one in each lane. Fewer than 16 are not
# vectorised; with more, more samples are solved in vain when a search ends.
LANES = 16
MIN_INDEPENDENCE = 1e-8  # of five epipolar constraints; with less, no solution is trusted


def _signs() -> np.ndarray:
    """Random signs (4, 9) from which OpenCV's singular value decomposition completes a basis."""
    state = 0x12345678
    signs = np.full((4, 9), -1.0)
    for place in np.ndindex(signs.shape):
        state = (state & 0xFFFFFFFF) * 4164903690 + (state >> 32)
        if state & 256:
            signs[place] = 1.0
    return signs


def _products() -> tuple[np.ndarray, np.ndarray]:
    """Tables of monomial products: linear times linear (4, 4) and quadratic times linear (10, 4).

    Entry [p, q] is the index of the product of monomials p and q. The cubic monomials are in
    Nister's order: first those of degree two or more in x and y, then x, y and 1 times powers of z.
    So elimination leaves x, y and 1.
    """
    linear = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]
    quadratic = [
        (2, 0, 0),
        (1, 1, 0),
        (1, 0, 1),
        (1, 0, 0),
        (0, 2, 0),
        (0, 1, 1),
        (0, 1, 0),
        (0, 0, 2),
        (0, 0, 1),
        (0, 0, 0),
    ]
    cubic = [
        (3, 0, 0),
        (0, 3, 0),
        (2, 1, 0),
        (1, 2, 0),
        (2, 0, 1),
        (2, 0, 0),
        (0, 2, 1),
        (0, 2, 0),
        (1, 1, 1),
        (1, 1, 0),
        (1, 0, 2),
        (1, 0, 1),
        (1, 0, 0),
        (0, 1, 2),
        (0, 1, 1),
        (0, 1, 0),
        (0, 0, 3),
        (0, 0, 2),
        (0, 0, 1),
        (0, 0, 0),
    ]

    def table(lower: list, higher: list) -> np.ndarray:
        places = np.empty((len(lower), len(linear)), np.int64)
        for p, powers in enumerate(lower):
            for q, linear_powers in enumerate(linear):
                product = tuple(np.add(powers, linear_powers))
                places[p, q] = higher.index(product)
        return places

    return table(linear, quadratic), table(quadratic, cubic)


SIGNS = _signs()
TO_QUADRATIC, TO_CUBIC = _products()


@inner
def null_space(five, rows):
    """Step 1: basis X, Y, Z, W of the matrices that meet five epipolar constraints.

    Returns the independence of the constraints (0 to 1). Writes the constraints to the first five
    rows (9, 9), made orthonormal, and the basis to the others, each a matrix row by row. A
    constraint is (u, v, 1) E (x, y, 1)^T = 0. An independence below MIN_INDEPENDENCE is returned
    as 0. Nister uses a QR factorisation. This is Gram-Schmidt, run twice against rounding. It gives
    OpenCV's basis: in another basis, rounding would change the solutions by other amounts.
    """
    independence = 1.0
    for k in range(9):
        if k < SAMPLE_SIZE:
            _write_constraint(five[k], rows[k])
        else:
            for i in range(9):
                rows[k, i] = SIGNS[k - SAMPLE_SIZE, i]
        independence = min(independence, _orthonormalise(rows, k))
        if not independence > MIN_INDEPENDENCE:
            return 0.0
    return independence


@inner
def _write_constraint(correspondence, row):
    """Write the factors (9) of E's entries in one correspondence's epipolar constraint."""
    x, y = correspondence[0], correspondence[1]
    u, v = correspondence[2], correspondence[3]
    row[0], row[1], row[2] = x * u, y * u, u
    row[3], row[4], row[5] = x * v, y * v, v
    row[6], row[7], row[8] = x, y, 1.0


@inner
def _orthonormalise(rows, k):
    """Make row k normal to the rows before it, with unit norm.

    Returns the share of its norm that was left before it was divided by it.
    """
    before = 0.0
    for i in range(9):
        before += rows[k, i] * rows[k, i]
    for _ in range(2):
        for j in range(k):
            along = 0.0
            for i in range(9):
                along += rows[k, i] * rows[j, i]
            for i in range(9):
                rows[k, i] -= along * rows[j, i]
    norm = 0.0
    for i in range(9):
        norm += rows[k, i] * rows[k, i]
    norm = np.sqrt(norm)
    for i in range(9):
        rows[k, i] /= norm
    return norm / np.sqrt(before)


@inner
def constraints(basis, equations, squares, minors):
    """Step 2: write ten cubic equations (10, 20) in x, y, z for E = x X + y Y + z Z + W.

    Rows 0 to 8, the trace constraint: E E^T E - trace(E E^T) E / 2 = 0. Row 9, the determinant
    constraint: det E = 0. squares (9, 10), minors (3, 10): space.
    """
    _write_squares(basis, squares)
    _write_minors(basis, minors)
    for p in range(10):
        half = 0.5 * (squares[0, p] + squares[4, p] + squares[8, p])
        for i in range(3):
            # E E^T - trace(E E^T) / 2, which times E is the trace constraint
            squares[4 * i, p] -= half
    equations[:] = 0.0
    for p in range(10):
        for q in range(4):
            place = TO_CUBIC[p, q]
            for i in range(3):
                equations[9, place] += minors[i, p] * basis[q, i]
                for j in range(3):
                    for k in range(3):
                        equations[3 * i + j, place] += squares[3 * i + k, p] * basis[q, 3 * k + j]


@inner
def _write_squares(basis, squares):
    """Write the entries (9) of E E^T, quadratic in x, y, z (10)."""
    squares[:] = 0.0
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                for p in range(4):
                    for q in range(4):
                        product = basis[p, 3 * i + k] * basis[q, 3 * j + k]
                        squares[3 * i + j, TO_QUADRATIC[p, q]] += product
        for j in range(i):
            for p in range(10):
                squares[3 * j + i, p] = squares[3 * i + j, p]


@inner
def _write_minors(basis, minors):
    """Write the minors (3) of the first row of E, quadratic in x, y, z (10)."""
    minors[:] = 0.0
    for i in range(3):
        # columns of the minor's entries in E's second and third row
        left = (i + 1) % 3
        right = (i + 2) % 3
        for p in range(4):
            for q in range(4):
                minors[i, TO_QUADRATIC[p, q]] += (
                    basis[p, 3 + left] * basis[q, 6 + right]
                    - basis[p, 3 + right] * basis[q, 6 + left]
                )


@inner
def eliminate(a, b):
    """Step 3: write B(z) to b (3, 13; given as zeros).

    Returns False if the equations a (10, 20) are singular. They are eliminated in place. A row of
    B(z) is one eliminated row minus z times the next one, so that only x, y and 1 are left. It
    holds their factors: polynomials in z of degree 3, 3 and 4, each with its highest power first.
    """
    # Gauss-Jordan elimination
    if not _make_triangular(a):
        return False
    _substitute_back(a)
    for i in range(3):
        # the columns of x z^2 to x, y z^2 to y, z^3 to 1
        for start, stop, place in ((10, 13, 0), (13, 16, 4), (16, 20, 8)):
            for j in range(start, stop):
                b[i, place + j - start + 1] += a[4 + 2 * i, j]
                b[i, place + j - start] -= a[5 + 2 * i, j]
    return True


@inner
def _make_triangular(a):
    """Clear a (10, 20) below its diagonal, with partial pivoting.

    Returns False if a is singular.
    """
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        if a[pivot, k] == 0:
            return False
        if pivot != k:
            for j in range(k, 20):
                a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
        for i in range(k + 1, 10):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, 20):
                a[i, j] -= factor * a[k, j]
    return True


@inner
def _substitute_back(a):
    """Solve the triangular equations a (10, 20) for the last six unknowns: B(z) needs no others."""
    for k in range(9, 3, -1):
        for i in range(k + 1, 10):
            for j in range(10, 20):
                a[k, j] -= a[k, i] * a[i, j]
        for j in range(10, 20):
            a[k, j] /= a[k, k]


@inner
def row_values(c, z):
    """Values at z of the three polynomials in one row c (13) of B(z)."""
    return (
        ((c[0] * z + c[1]) * z + c[2]) * z + c[3],
        ((c[4] * z + c[5]) * z + c[6]) * z + c[7],
        (((c[8] * z + c[9]) * z + c[10]) * z + c[11]) * z + c[12],
    )


@inner
def determinant(b, polynomial, minor):
    """Step 4: write the coefficients (11, highest power first) of det B(z).

    The determinant is expanded along the last column. minor (7): space.
    """
    polynomial[:] = 0.0
    for i in range(3):
        first = (i + 1) % 3
        second = (i + 2) % 3
        for p in range(7):
            minor[p] = 0.0
        for p in range(4):
            for q in range(4):
                minor[p + q] += b[first, p] * b[second, 4 + q] - b[second, p] * b[first, 4 + q]
        for p in range(7):
            for q in range(5):
                polynomial[p + q] += minor[p] * b[i, 8 + q]


class RealRoots(NamedTuple):
    """Real roots and extrema of LANES polynomials, one in each lane."""

    solved: np.ndarray  # (LANES,) booleans
    counts: np.ndarray  # (LANES,), numbers of roots
    roots: np.ndarray  # (10, LANES)
    extremum_counts: np.ndarray  # (LANES,)
    extrema: np.ndarray  # (10, LANES), places
    heights: np.ndarray  # (10, LANES), values at the extrema


@inner
def real_roots(polynomials):
    """Step 5: solve LANES polynomials of degree ten (LANES, 11; highest power first).

    At most one root lies between two neighbouring extrema. The extrema are the roots of the
    derivative, so all derivatives are solved, the lowest degree first and less precisely. The
    caller must look at the extrema: where the polynomial is nearly 0 there, it has a double root or
    none.

    One polynomial alone keeps the processor waiting: each step of Newton's method needs the one
    before. So the polynomials are solved side by side, and the loops over the lanes are vectorised.
    """
    solved, bounds, derivatives = _prepare(polynomials)
    brackets = np.empty((4, 10, LANES))  # start, left end, right end, and whether it rises (1 or 0)
    counts, new_counts = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    roots, extrema = np.empty((10, LANES)), np.empty((10, LANES))
    # of the next polynomial and of its second derivative, at its extrema
    heights, bends = np.empty((10, LANES)), np.empty((10, LANES))
    first_heights, last_heights = np.empty(LANES), np.empty(LANES)  # at the bounds
    state, flags = np.empty((4, LANES)), np.empty((2, LANES), np.int64)
    for degree in range(1, 11):
        polynomial, slopes = derivatives[degree], derivatives[degree - 1]
        _values(polynomial, -bounds, first_heights)
        _values(polynomial, bounds, last_heights)
        most = 0
        for lane in range(LANES):
            new_counts[lane] = _write_brackets(
                lane,
                counts[lane],
                bounds[lane],
                roots,
                heights,
                bends,
                first_heights[lane],
                last_heights[lane],
                brackets,
            )
            most = max(most, new_counts[lane])
        counts, new_counts = new_counts, counts
        roots, extrema = extrema, roots
        precision = 1e-14 if degree > 8 else 1e-6
        for k in range(most):
            for lane in range(LANES):
                left, right = brackets[1, k, lane], brackets[2, k, lane]
                state[0, lane], state[1, lane] = brackets[0, k, lane], left
                state[2, lane], state[3, lane] = right, right - left
                flags[0, lane], flags[1, lane] = brackets[3, k, lane] > 0, k < counts[lane]
            for _ in range(100):
                if not _newton_step(polynomial, slopes, state, flags, precision):
                    break
            for lane in range(LANES):
                roots[k, lane] = state[0, lane]
            _values(slopes, roots[k], bends[k])
            if degree < 10:
                _values(derivatives[degree + 1], roots[k], heights[k])
    return RealRoots(solved, counts, roots, new_counts, extrema, heights)


@inner
def _prepare(polynomials):
    """Which polynomials can be solved, bounds of their roots, and all their derivatives.

    derivatives: (11, 11, LANES). Row d is the one of degree d, its lowest power first; row 10 is
    the polynomial itself. One that cannot be solved is replaced by the constant 1.
    """
    solved, bounds = np.zeros(LANES, np.bool_), np.ones(LANES)
    derivatives = np.zeros((11, 11, LANES))
    for lane in range(LANES):
        bound = _root_bound(polynomials[lane])
        derivatives[10, 0, lane] = 1.0
        if bound >= 0:
            solved[lane] = True
            bounds[lane] = bound
            for power in range(11):
                derivatives[10, power, lane] = polynomials[lane, 10 - power]
    for degree in range(10, 0, -1):
        for power in range(1, degree + 1):
            for lane in range(LANES):
                coefficient = derivatives[degree, power, lane]
                derivatives[degree - 1, power - 1, lane] = coefficient * power
    return solved, bounds, derivatives


@inner
def _root_bound(polynomial):
    """Bound of the absolute values of all roots; -1 if the leading coefficient is too small."""
    bound = 0.0
    for k in range(1, 11):
        if not abs(polynomial[k]) < 1e15 * abs(polynomial[0]):
            return -1.0
        bound = max(bound, 2 * (abs(polynomial[k]) / abs(polynomial[0])) ** (1.0 / k))
    if abs(polynomial[0]) < 1e-12:  # OpenCV drops a leading coefficient of 2e-16
        return -1.0
    return bound


@inner
def _write_brackets(
    lane, extrema, bound, places, heights, bends, first_height, last_height, brackets
):
    """Write the intervals between a lane's extrema that have a root, and where to start in each.

    Returns their number. extrema: number of extrema. places, heights, bends: of the extrema, their
    values and second derivatives, (10, LANES).
    """
    count = 0
    left, left_height = -bound, first_height
    for k in range(extrema + 1):
        right, right_height = bound, last_height
        if k < extrema:
            right, right_height = places[k, lane], heights[k, lane]
        if (left_height < 0) != (right_height < 0):
            if 0 < k < extrema:  # root of the cubic with the same two extrema
                turn = math.asin((left_height + right_height) / (left_height - right_height))
                start = left + (0.5 - math.sin(turn / 3)) * (right - left)
            # beyond the last extremum: root of the parabola with the same bend there
            elif k > 0:
                start = left + math.sqrt(abs(2 * left_height / bends[k - 1, lane]))
            elif extrema > 0:
                start = right - math.sqrt(abs(2 * right_height / bends[0, lane]))
            else:
                start = 0.5 * (left + right)
            if not left < start < right:
                start = 0.5 * (left + right)
            brackets[0, count, lane] = start
            brackets[1, count, lane], brackets[2, count, lane] = left, right
            brackets[3, count, lane] = left_height < 0
            count += 1
        left, left_height = right, right_height
    return count


@inner
def value(polynomial, z, lane):
    """Value at z of one of several polynomials (11, LANES; lowest power first).

    Even and odd powers are summed apart, so the processor runs both sums at once. The sums are
    written out, because the compiler does not vectorise a loop over lanes with a loop inside.
    """
    square = z * z
    even = polynomial[10, lane] * square + polynomial[8, lane]
    even = (even * square + polynomial[6, lane]) * square + polynomial[4, lane]
    even = (even * square + polynomial[2, lane]) * square + polynomial[0, lane]
    odd = polynomial[9, lane] * square + polynomial[7, lane]
    odd = (odd * square + polynomial[5, lane]) * square + polynomial[3, lane]
    odd = odd * square + polynomial[1, lane]
    return even + odd * z


@inner
def _values(polynomial, places, values):
    """Write the values (LANES) of polynomials (11, LANES) at a place of each."""
    for lane in range(LANES):
        values[lane] = value(polynomial, places[lane], lane)


@inner
def _newton_step(polynomial, slopes, state, flags, precision):
    """Make one step of Newton's method in each lane. Returns the number of lanes that go on.

    Bisection replaces a step that leaves the interval or converges slowly.
    state (4, LANES): place, ends of the interval, size of the last step. flags (2, LANES): whether
    the polynomial rises at the root, whether the lane goes on; the others keep their places.
    """
    going_on = 0
    for lane in range(LANES):
        z = state[0, lane]
        height = value(polynomial, z, lane)
        step = height / value(slopes, z, lane)
        is_left = (height < 0) == (flags[0, lane] != 0)
        left = z if is_left else state[1, lane]
        right = state[2, lane] if is_left else z
        is_inside = (left <= z - step) & (z - step <= right)
        is_shorter = abs(step) <= 0.5 * state[3, lane]
        step = step if is_inside & is_shorter else z - 0.5 * (left + right)
        moved = z - step
        goes_on = flags[1, lane]
        state[0, lane] = moved if goes_on else z
        state[1, lane], state[2, lane], state[3, lane] = left, right, abs(step)
        goes_on = 0 if abs(step) <= precision * abs(moved) + 1e-300 else goes_on
        flags[1, lane] = goes_on
        going_on += goes_on
    return going_on


@inner
def essential(normal, basis, z, matrix):
    """Step 6: write the essential matrix (9, unit norm) of a root z.

    normal: three numbers that solve B(z) normal = 0.
    """
    total = 0.0
    for j in range(9):
        matrix[j] = (
            normal[0] * basis[0, j]
            + normal[1] * basis[1, j]
            + normal[2] * (z * basis[2, j] + basis[3, j])
        )
        total += matrix[j] * matrix[j]
    total = np.sqrt(total)
    for j in range(9):
        matrix[j] /= total
