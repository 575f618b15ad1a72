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

import numpy as np

from thesis_repro.running.compiled import fast, inner

SAMPLE_SIZE = 5
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
def null_space(five):
    """Step 1: basis X, Y, Z, W of the matrices that meet five epipolar constraints.

    Returns the independence of the constraints (0 to 1) and the basis (4, 9; matrices row by row).
    A constraint is (u, v, 1) E (x, y, 1)^T = 0. An independence below MIN_INDEPENDENCE is returned
    as 0. Nister uses a QR factorisation. This is Gram-Schmidt, run twice against rounding. It gives
    OpenCV's basis: in another basis, rounding would change the solutions by other amounts.
    """
    rows = np.empty((9, 9))
    independence = 1.0
    for k in range(9):
        if k < SAMPLE_SIZE:
            _write_constraint(five[k], rows[k])
        else:
            for i in range(9):
                rows[k, i] = SIGNS[k - SAMPLE_SIZE, i]
        independence = min(independence, _orthonormalise(rows, k))
        if not independence > MIN_INDEPENDENCE:
            return 0.0, rows[SAMPLE_SIZE:]
    return independence, rows[SAMPLE_SIZE:]


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
def constraints(basis):
    """Step 2: ten cubic equations (10, 20) in x, y, z for E = x X + y Y + z Z + W.

    Rows 0 to 8, the trace constraint: E E^T E - trace(E E^T) E / 2 = 0. Row 9, the determinant
    constraint: det E = 0.
    """
    squares = _squares(basis)
    minors = _minors(basis)
    for p in range(10):
        half = 0.5 * (squares[0, p] + squares[4, p] + squares[8, p])
        for i in range(3):
            # E E^T - trace(E E^T) / 2, which times E is the trace constraint
            squares[4 * i, p] -= half
    equations = np.zeros((10, 20))
    for p in range(10):
        for q in range(4):
            place = TO_CUBIC[p, q]
            for i in range(3):
                equations[9, place] += minors[i, p] * basis[q, i]
                for j in range(3):
                    for k in range(3):
                        equations[3 * i + j, place] += squares[3 * i + k, p] * basis[q, 3 * k + j]
    return equations


@inner
def _squares(basis):
    """Entries (9) of E E^T, quadratic in x, y, z (10)."""
    squares = np.zeros((9, 10))
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
    return squares


@inner
def _minors(basis):
    """Minors (3) of the first row of E, quadratic in x, y, z (10)."""
    minors = np.zeros((3, 10))
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
    return minors


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
def determinant(b):
    """Step 4: coefficients (11, highest power first) of det B(z).

    The determinant is expanded along the last column.
    """
    polynomial = np.zeros(11)
    minor = np.empty(7)
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
    return polynomial


@fast
def real_roots(polynomial: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Step 5: solve a polynomial of degree ten (11, highest power first).

    Returns (solved, real roots, places of the extrema). At most one root lies between two
    neighbouring extrema. The extrema are the roots of the derivative, so all derivatives are
    solved, the lowest degree first and less precisely. The caller must look at the extrema: where
    the polynomial is nearly 0 there, it has a double root or none.
    """
    edges, roots, bends = np.empty(12), np.empty(11), np.empty(12)
    bound = _root_bound(polynomial)
    if bound < 0:
        return False, roots[:0], edges[:0]
    derivatives = _derivatives(polynomial)
    count, intervals = 0, 0
    for degree in range(1, 11):
        derivative, slopes = derivatives[degree], derivatives[degree - 1]
        precision = 1e-14 if degree > 8 else 1e-6
        # the intervals lie between the bounds and the roots of the previous degree
        edges[0] = -bound
        edges[count + 1] = bound
        for k in range(count):
            edges[k + 1] = roots[k]
        intervals = count + 1
        count = 0
        left = value(derivative, degree, -bound)
        for k in range(intervals):
            right = value(derivative, degree, edges[k + 1])
            if (left < 0) != (right < 0):
                start = _start(edges, bends, k, intervals, left, right)
                roots[count] = _root_between(
                    derivative,
                    slopes,
                    degree,
                    edges[k],
                    edges[k + 1],
                    left < 0,
                    start,
                    precision,
                )
                count += 1
            left = right
        for k in range(count):
            bends[k + 1] = value(slopes, degree - 1, roots[k])
    return True, roots[:count], edges[1:intervals]


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
def _derivatives(polynomial):
    """All derivatives (11, 11): row d is the one of degree d, and row 10 the polynomial itself."""
    derivatives = np.empty((11, 11))
    for k in range(11):
        derivatives[10, k] = polynomial[k]
    for degree in range(10, 0, -1):
        for k in range(degree):
            derivatives[degree - 1, k] = derivatives[degree, k] * (degree - k)
    return derivatives


@inner
def _start(edges, bends, k, intervals, left, right):
    """Where the search for the root of interval k starts.

    left, right: values at the ends of the interval. bends: second derivatives at the edges.
    """
    if 0 < k < intervals - 1:  # root of the cubic with the same two extrema
        part = 0.5 - math.sin(math.asin((left + right) / (left - right)) / 3)
        return edges[k] + part * (edges[k + 1] - edges[k])
    # beyond the last extremum: root of the parabola with the same bend there
    if k > 0:
        return edges[k] + math.sqrt(abs(2 * left / bends[k]))
    if intervals > 1:
        return edges[1] - math.sqrt(abs(2 * right / bends[1]))
    return 0.5 * (edges[k] + edges[k + 1])


@inner
def value(polynomial, degree, z):
    """Value of a polynomial at z.

    Even and odd powers are summed apart, so the processor runs both sums at once.
    """
    if not degree:
        return polynomial[0]
    square = z * z
    first, second = polynomial[0], polynomial[1]
    for k in range(2, degree, 2):
        first = first * square + polynomial[k]
        second = second * square + polynomial[k + 1]
    if degree % 2:
        return first * z + second
    return first * square + polynomial[degree] + second * z


@inner
def _root_between(polynomial, slopes, degree, left, right, rising, start, precision):
    """Root in an interval by Newton's method.

    Bisection replaces a step that leaves the interval or converges slowly.
    """
    z = 0.5 * (left + right)
    if left < start < right:
        z = start
    before = right - left
    for _ in range(100):
        height = value(polynomial, degree, z)
        slope = value(slopes, degree - 1, z)
        if (height < 0) == rising:
            left = z
        else:
            right = z
        step = np.inf
        if slope != 0:
            step = height / slope
        if not (left <= z - step <= right) or abs(step) > 0.5 * before:
            step = z - 0.5 * (left + right)
        before = abs(step)
        z -= step
        if before <= precision * abs(z) + 1e-300:
            break
    return z


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
