"""Essential matrices through five correspondences, and how far OpenCV's rounding may move them (see ransac).

After Nister (2004), An efficient solution to the five-point relative pose problem, PAMI 26(6), in his steps:

1. the epipolar constraints of five correspondences leave E = x X + y Y + z Z + W (`_null_space`);
2. the trace constraint and the determinant constraint make E essential: ten cubics in x, y, z (`_constraints`);
3. elimination leaves three equations B(z) (x, y, 1)^T = 0 (`_eliminate`);
4. det B(z) = 0, a polynomial of degree ten (`_determinant`);
5. its roots (`real_roots`): a complex one is no motion, so it is solved for the real ones alone;
6. x, y and with them E for each root (`_essential`).

His last step, rotation and translation from E and the vote, is pose.recover_pose.
"""

import numpy as np

from thesis_repro.compiled import fast

SAMPLE = 5
ERROR = 1e-12  # by which all equations are changed, at random, to see what rounding does to their solutions
ROOT_ERROR = 1e-13  # relative to the polynomial's terms: of finding a root
SAFETY = 8.0  # times such changes, and more where elimination is ill-conditioned, is granted to OpenCV's solutions
LEAST_MARGIN, LARGEST_MARGIN = 1e-9, 1e-3  # of a unit-norm essential matrix


def _signs() -> np.ndarray:
    """The vectors from which OpenCV's singular value decomposition completes a basis: 4 x 9 random signs."""
    state, signs = 0x12345678, np.empty((4, 9))
    for place in np.ndindex(signs.shape):
        state = (state & 0xFFFFFFFF) * 4164903690 + (state >> 32)
        signs[place] = 1.0 if state & 256 else -1.0
    return signs


def _products() -> tuple[np.ndarray, np.ndarray]:
    """Where monomials of x, y, z, 1 go when multiplied: (4, 4) to quadratic ones, (10, 4) to cubic ones.

    The cubic ones are in Nister's order, by which elimination leaves a system of three equations in x, y, 1: those of
    degree two and more in x and y first, then x, y and 1, each with its powers of z.
    """
    linear = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)]
    quadratic = [(2, 0, 0), (1, 1, 0), (1, 0, 1), (1, 0, 0), (0, 2, 0), (0, 1, 1), (0, 1, 0), (0, 0, 2), (0, 0, 1),
                 (0, 0, 0)]
    cubic = [(3, 0, 0), (0, 3, 0), (2, 1, 0), (1, 2, 0), (2, 0, 1), (2, 0, 0), (0, 2, 1), (0, 2, 0), (1, 1, 1),
             (1, 1, 0), (1, 0, 2), (1, 0, 1), (1, 0, 0), (0, 1, 2), (0, 1, 1), (0, 1, 0), (0, 0, 3), (0, 0, 2),
             (0, 0, 1), (0, 0, 0)]

    def table(lower, higher):
        return np.array([[higher.index(tuple(np.add(a, b))) for b in linear] for a in lower])

    return table(linear, quadratic), table(quadratic, cubic)


SIGNS = _signs()
CHANGES = ERROR * np.random.default_rng(0).choice([-1.0, 1.0], (2, 10, 20))
TO_QUADRATIC, TO_CUBIC = _products()


@fast
def solve(five: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Essential matrices through five correspondences (5, 4: x, y in the current frame, u, v in the previous one).

    Returns whether these are surely all that OpenCV finds, the matrices (K, 9) of unit norm, and K margins within
    which (Frobenius norm, up to sign) OpenCV's rounding leaves its own.
    """
    nothing, no_margins = np.empty((0, 9)), np.empty(0)
    sure, basis = _null_space(five)  # step 1
    if not sure:
        return False, nothing, no_margins
    equations = _constraints(basis)  # step 2
    # Steps 3 and 4, and once more with the equations changed a little in two ways: what changes is what rounding may.
    first, second = _eliminate(equations + CHANGES[0]), _eliminate(equations + CHANGES[1])
    b = _eliminate(equations)
    polynomial, polynomial_first, polynomial_second = _determinant(b), _determinant(first), _determinant(second)
    safety = SAFETY * (1 + 0.01 * np.abs(b).max())  # OpenCV inverts a matrix, at which the rounding grows
    # Step 5
    sure, roots = real_roots(polynomial, safety * (polynomial_first - polynomial),
                             safety * (polynomial_second - polynomial))
    if not sure:
        return False, nothing, no_margins
    # Step 6
    found, margins = np.empty((len(roots), 9)), np.empty(len(roots))
    absolute, moved = np.abs(polynomial), np.empty(9)
    for k in range(len(roots)):
        z = roots[k]
        _essential(b, basis, z, found[k])
        _essential(first, basis, _nearby_root(polynomial_first, z), moved)
        change = _distance(found[k], moved)
        _essential(second, basis, _nearby_root(polynomial_second, z), moved)
        change = np.hypot(change, _distance(found[k], moved))  # unlike a maximum, this keeps what is not a number
        _essential(b, basis, z + ROOT_ERROR * _horner(absolute, 10, abs(z))[0] / _horner(polynomial, 10, z)[1], moved)
        margins[k] = LEAST_MARGIN + safety * (change + _distance(found[k], moved))
        if not margins[k] < LARGEST_MARGIN:
            return False, nothing, no_margins
    return True, found, margins


@fast
def _nearby_root(polynomial, z):
    for _ in range(2):
        value, slope = _horner(polynomial, 10, z)
        z -= value / slope
    return z


@fast
def _distance(e, other):
    """Between two essential matrices (9, unit norm), whose signs mean nothing."""
    plus, minus = 0.0, 0.0
    for k in range(9):
        plus += (e[k] + other[k]) ** 2
        minus += (e[k] - other[k]) ** 2
    if plus < minus:
        return np.sqrt(plus)
    return np.sqrt(minus)


@fast
def _null_space(five):
    """Step 1: whether the epipolar constraints of five correspondences, (u, v, 1) E (x, y, 1)^T = 0, are independent,
    and the basis X, Y, Z, W (4, 9) that OpenCV takes of the matrices that meet them, each row by row.

    Where Nister has a QR factorisation this is Gram and Schmidt's, twice over for the rounding. With another basis the
    solutions would be the same, but not how much rounding changes them.
    """
    rows = np.empty((9, 9))
    for k in range(9):
        if k < SAMPLE:
            x, y, u, v = five[k]
            rows[k, 0], rows[k, 1], rows[k, 2] = x * u, y * u, u
            rows[k, 3], rows[k, 4], rows[k, 5] = x * v, y * v, v
            rows[k, 6], rows[k, 7], rows[k, 8] = x, y, 1.0
        else:
            rows[k] = SIGNS[k - SAMPLE]
        before = np.sqrt((rows[k] * rows[k]).sum())
        for _ in range(2):
            for j in range(k):
                along = 0.0
                for i in range(9):
                    along += rows[k, i] * rows[j, i]
                for i in range(9):
                    rows[k, i] -= along * rows[j, i]
        norm = np.sqrt((rows[k] * rows[k]).sum())
        if not norm > 1e-8 * before:
            return False, rows[SAMPLE:]
        rows[k] /= norm
    return True, rows[SAMPLE:]


@fast
def _constraints(basis):
    """Step 2: ten cubic equations (10, 20) in x, y, z for E = x X + y Y + z Z + W.

    Rows 0 to 8, the trace constraint: E E^T E - trace(E E^T) E / 2 = 0. Row 9, the determinant constraint: det E = 0.
    """
    squares, minors = np.zeros((3, 3, 10)), np.zeros((3, 10))
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                for p in range(4):
                    for q in range(4):
                        squares[i, j, TO_QUADRATIC[p, q]] += basis[p, 3 * i + k] * basis[q, 3 * j + k]  # E E^T
        for j in range(i):
            squares[j, i] = squares[i, j]
        first, second = 3 + (i + 1) % 3, 6 + (i + 2) % 3  # for the minors of E's first row, of the determinant
        for p in range(4):
            for q in range(4):
                minors[i, TO_QUADRATIC[p, q]] += (basis[p, first] * basis[q, second]
                                                  - basis[p, 3 + (i + 2) % 3] * basis[q, 6 + (i + 1) % 3])
    half = 0.5 * (squares[0, 0] + squares[1, 1] + squares[2, 2])
    for i in range(3):
        squares[i, i] -= half  # E E^T - trace(E E^T) / 2, which times E is the trace constraint
    equations = np.zeros((10, 20))
    for p in range(10):
        for q in range(4):
            place = TO_CUBIC[p, q]
            for i in range(3):
                equations[9, place] += minors[i, p] * basis[q, i]
                for j in range(3):
                    for k in range(3):
                        equations[3 * i + j, place] += squares[i, k, p] * basis[q, 3 * k + j]
    return equations


@fast
def _eliminate(a):
    """Step 3: Nister's B(z) (3, 13): three rows of three polynomials in z, to which (x, y, 1) is normal.

    Gauss and Jordan's elimination with partial pivoting of the ten equations a (10, 20), which it overwrites. A row
    of B is one row less z times the next, in which nothing but x, y and 1 is left; a polynomial has its highest power
    first, of degree 3, 3 and 4.
    """
    b = np.zeros((3, 13))
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        if a[pivot, k] == 0:
            return np.full((3, 13), np.nan)
        if pivot != k:
            for j in range(k, 20):
                a[k, j], a[pivot, j] = a[pivot, j], a[k, j]
        for i in range(k + 1, 10):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, 20):
                a[i, j] -= factor * a[k, j]
    for k in range(9, 3, -1):  # the first four unknowns are not needed
        for i in range(k + 1, 10):
            for j in range(10, 20):
                a[k, j] -= a[k, i] * a[i, j]
        for j in range(10, 20):
            a[k, j] /= a[k, k]
    for i in range(3):
        # the columns of x z^2 to x, y z^2 to y, z^3 to 1
        for start, stop, place in ((10, 13, 0), (13, 16, 4), (16, 20, 8)):
            for j in range(start, stop):
                b[i, place + j - start + 1] += a[4 + 2 * i, j]
                b[i, place + j - start] -= a[5 + 2 * i, j]
    return b


@fast
def _determinant(b):
    """Step 4: coefficients (11, highest power first) of det B(z), expanded along its last column."""
    polynomial = np.zeros(11)
    minor = np.empty(8)
    for i in range(3):
        first, second = (i + 1) % 3, (i + 2) % 3
        minor[:7] = 0
        for p in range(4):
            for q in range(4):
                minor[p + q] += b[first, p] * b[second, 4 + q] - b[second, p] * b[first, 4 + q]
        for p in range(7):
            for q in range(5):
                polynomial[p + q] += minor[p] * b[i, 8 + q]
    return polynomial


@fast
def _horner(polynomial, degree, z):
    """A polynomial's value and slope at z."""
    value, slope = polynomial[0], 0.0
    for k in range(1, degree + 1):
        slope = slope * z + value
        value = value * z + polynomial[k]
    return value, slope


@fast
def real_roots(polynomial: np.ndarray, error: np.ndarray, other: np.ndarray) -> tuple[bool, np.ndarray]:
    """Step 5: the real roots of a polynomial of degree ten (11, highest power first), and first whether they are
    surely all.

    error, other: polynomials; an extremum no larger than both together may be a double root or none at all.
    Between two roots of the derivative lies at most one, so the derivatives are solved one after the other.
    """
    bound = 0.0
    for k in range(1, 11):
        if not abs(polynomial[k]) < 1e15 * abs(polynomial[0]):
            return False, np.empty(0)
        bound = max(bound, 2 * (abs(polynomial[k]) / abs(polynomial[0])) ** (1.0 / k))
    if abs(polynomial[0]) < 1e-12:  # OpenCV drops a leading coefficient of 2e-16
        return False, np.empty(0)
    derivative = np.empty(11)
    edges, roots = np.empty(12), np.empty(11)
    found = 0
    for degree in range(1, 11):
        for k in range(degree + 1):
            factor = 1.0
            for power in range(degree - k + 1, 10 - k + 1):
                factor *= power
            derivative[k] = polynomial[k] * factor
        edges[0], edges[found + 1] = -bound, bound
        for k in range(found):
            edges[k + 1] = roots[k]
            if degree == 10:
                doubt = abs(_horner(error, 10, roots[k])[0]) + abs(_horner(other, 10, roots[k])[0])
                if not abs(_horner(polynomial, 10, roots[k])[0]) > doubt:
                    return False, np.empty(0)
        intervals, found = found + 1, 0
        left = _horner(derivative, degree, edges[0])[0]
        for k in range(intervals):
            right = _horner(derivative, degree, edges[k + 1])[0]
            if (left < 0) != (right < 0):
                roots[found] = _root_between(derivative, degree, edges[k], edges[k + 1], left < 0)
                found += 1
            left = right
    return True, roots[:found].copy()


@fast
def _root_between(polynomial, degree, left, right, rising):
    """Newton's iteration, with bisection where it would leave the interval or is slow."""
    z = 0.5 * (left + right)
    before = right - left
    for _ in range(100):
        value, slope = polynomial[0], 0.0
        for k in range(1, degree + 1):
            slope = slope * z + value
            value = value * z + polynomial[k]
        if (value < 0) == rising:
            left = z
        else:
            right = z
        step = value / slope if slope != 0 else np.inf
        if not (left <= z - step <= right) or abs(step) > 0.5 * before:
            step = z - 0.5 * (left + right)
        before = abs(step)
        z -= step
        if before <= 1e-14 * abs(z) + 1e-300:
            break
    return z


@fast
def _essential(b, basis, z, matrix):
    """Step 6: write the essential matrix (9, unit norm) that belongs to a root z: (x, y, 1) is normal to B(z)."""
    rows = np.empty((3, 3))
    for i in range(3):
        rows[i, 0] = ((b[i, 0] * z + b[i, 1]) * z + b[i, 2]) * z + b[i, 3]
        rows[i, 1] = ((b[i, 4] * z + b[i, 5]) * z + b[i, 6]) * z + b[i, 7]
        rows[i, 2] = (((b[i, 8] * z + b[i, 9]) * z + b[i, 10]) * z + b[i, 11]) * z + b[i, 12]
    x, y, w, largest = 0.0, 0.0, 1.0, -1.0
    for i in range(3):  # the rows span a plane; the best conditioned pair gives its normal
        p, q = rows[i], rows[(i + 1) % 3]
        c0, c1, c2 = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
        size = c0 * c0 + c1 * c1 + c2 * c2
        if size > largest:
            x, y, w, largest = c0, c1, c2, size
    total = 0.0
    for j in range(9):
        matrix[j] = x * basis[0, j] + y * basis[1, j] + w * (z * basis[2, j] + basis[3, j])
        total += matrix[j] * matrix[j]
    total = np.sqrt(total)
    for j in range(9):
        matrix[j] /= total
