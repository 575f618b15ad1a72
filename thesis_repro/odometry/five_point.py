"""Essential matrices through five correspondences, and how far OpenCV's rounding may move them (see ransac).

Nister (2004), An efficient solution to the five-point relative pose problem: the matrices are combinations of four
that five correspondences allow; ten cubic equations make them essential; elimination leaves a polynomial of degree
ten. Only its real roots are of use, so it is solved for them alone.
"""

import numpy as np
from numba import njit

SAMPLE = 5
ERROR = 1e-12  # by which all equations are changed, at random, to see what rounding does to their solutions
ROOT_ERROR = 1e-13  # relative to the polynomial's terms: of finding a root
SAFETY = 8.0  # times such changes, and more where elimination is ill-conditioned, is granted to OpenCV's solutions
LEAST_MARGIN, LARGEST_MARGIN = 1e-9, 1e-3  # of a unit-norm essential matrix

FAST = njit(cache=True, nogil=True, error_model="numpy")  # as in OpenCV, x / 0 is infinite


def _signs():
    """The vectors from which OpenCV's singular value decomposition completes a basis: 4 x 9 random signs."""
    state, signs = 0x12345678, np.empty((4, 9))
    for place in np.ndindex(signs.shape):
        state = (state & 0xFFFFFFFF) * 4164903690 + (state >> 32)
        signs[place] = 1.0 if state & 256 else -1.0
    return signs


def _products():
    """Where monomials of x, y, z, 1 go when multiplied: (4, 4) to quadratic ones, (10, 4) to cubic ones.

    The cubic ones are in Nister's order, by which elimination leaves a system of three equations in x, y, 1.
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


@FAST
def solve(five):
    """Essential matrices through five correspondences (5, 4: x, y in the current frame, u, v in the previous one).

    Returns whether these are surely all that OpenCV finds, the matrices (K, 9) of unit norm, and K margins within
    which (Frobenius norm, up to sign) OpenCV's rounding leaves its own.
    """
    nothing, no_margins = np.empty((0, 9)), np.empty(0)
    sure, basis = _null_space(five)
    if not sure:
        return False, nothing, no_margins
    equations = _constraints(basis)
    first, second = _eliminate(equations + CHANGES[0]), _eliminate(equations + CHANGES[1])
    b = _eliminate(equations)
    polynomial, polynomial_first, polynomial_second = _determinant(b), _determinant(first), _determinant(second)
    safety = SAFETY * (1 + 0.01 * np.abs(b).max())  # OpenCV inverts a matrix, at which the rounding grows
    sure, roots = real_roots(polynomial, safety * (polynomial_first - polynomial),
                             safety * (polynomial_second - polynomial))
    if not sure:
        return False, nothing, no_margins
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


@FAST
def _nearby_root(polynomial, z):
    for _ in range(2):
        value, slope = _horner(polynomial, 10, z)
        z -= value / slope
    return z


@FAST
def _distance(e, other):
    """Between two essential matrices (9, unit norm), whose signs mean nothing."""
    plus, minus = 0.0, 0.0
    for k in range(9):
        plus += (e[k] + other[k]) ** 2
        minus += (e[k] - other[k]) ** 2
    if plus < minus:
        return np.sqrt(plus)
    return np.sqrt(minus)


@FAST
def _null_space(five):
    """Whether five correspondences are independent, and the basis (4, 9) of the rest of space that OpenCV takes.

    With another basis the solutions would be the same, but not how much rounding changes them.
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


@FAST
def _constraints(basis):
    """Ten cubic equations (10, 20) in x, y, z: E E^T E = trace(E E^T) E / 2 and det E = 0, E = (x, y, z, 1) basis."""
    squares, minors = np.zeros((3, 3, 10)), np.zeros((3, 10))
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                for p in range(4):
                    for q in range(4):
                        squares[i, j, TO_QUADRATIC[p, q]] += basis[p, 3 * i + k] * basis[q, 3 * j + k]
        for j in range(i):
            squares[j, i] = squares[i, j]
        first, second = 3 + (i + 1) % 3, 6 + (i + 2) % 3
        for p in range(4):
            for q in range(4):
                minors[i, TO_QUADRATIC[p, q]] += (basis[p, first] * basis[q, second]
                                                  - basis[p, 3 + (i + 2) % 3] * basis[q, 6 + (i + 1) % 3])
    half = 0.5 * (squares[0, 0] + squares[1, 1] + squares[2, 2])
    for i in range(3):
        squares[i, i] -= half
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


@FAST
def _eliminate(a):
    """Nister's B (3, 13): three rows of three polynomials in z, to which (x, y, 1) is normal. Overwrites a (10, 20)."""
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
        for start, stop, place in ((10, 13, 0), (13, 16, 4), (16, 20, 8)):
            for j in range(start, stop):
                b[i, place + j - start + 1] += a[4 + 2 * i, j]
                b[i, place + j - start] -= a[5 + 2 * i, j]
    return b


@FAST
def _determinant(b):
    """Coefficients (11, highest power first) of the determinant of B."""
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


@FAST
def _horner(polynomial, degree, z):
    """A polynomial's value and slope at z."""
    value, slope = polynomial[0], 0.0
    for k in range(1, degree + 1):
        slope = slope * z + value
        value = value * z + polynomial[k]
    return value, slope


@FAST
def real_roots(polynomial, error, other):
    """Whether these are surely all real roots of a polynomial of degree ten (11, highest power first), and the roots.

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


@FAST
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


@FAST
def _essential(b, basis, z, matrix):
    """Write the essential matrix (9, unit norm) that belongs to a root z."""
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
