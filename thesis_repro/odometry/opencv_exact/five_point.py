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

import math

import numpy as np

from thesis_repro.compiled import fast

SAMPLE = 5
ROUNDING = 2.0**-52  # of a number of the size of 1
# This many times the estimate of what rounding does to a solution is granted to OpenCV's: of 200,000 solutions, of real
# and of degenerate scenes, none needed more than 1.4 times.
SAFETY = 3.0
TOGETHER = 0.1  # of the errors of B(z), which largely move its rows alike, in det B(z): measured
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
TO_QUADRATIC, TO_CUBIC = _products()


@fast
def solve(five: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Essential matrices through five correspondences (5, 4: x, y in the current frame, u, v in the previous one).

    Returns whether these are surely all that OpenCV finds, the matrices (K, 9) of unit norm, and K margins within
    which (Frobenius norm, up to sign) OpenCV's rounding leaves its own.
    """
    nothing, no_margins = np.empty((0, 9)), np.empty(0)
    independence, basis = _null_space(five)  # step 1
    if not independence > 1e-8:
        return False, nothing, no_margins
    b, errors = _eliminate(_constraints(basis))  # steps 2 and 3
    polynomial = _determinant(b)  # step 4
    sure, roots, extrema = real_roots(polynomial)  # step 5
    if not sure:
        return False, nothing, no_margins
    terms, work = np.abs(b), np.empty((4, 3, 3))
    for z in extrema:  # one as small as rounding may be a double root or none at all
        if not abs(_value(polynomial, 10, z)) > SAFETY * ROUNDING * _at(b, terms, errors, z, work):
            return False, nothing, no_margins
    # Step 6
    found, margins = np.empty((len(roots), 9)), np.empty(len(roots))
    for k in range(len(roots)):
        _essential(b, basis, roots[k], found[k])
        change = 1 / independence + _change(b, terms, errors, roots[k], polynomial, work)
        margins[k] = LEAST_MARGIN + SAFETY * ROUNDING * change
        if not margins[k] < LARGEST_MARGIN:
            return False, nothing, no_margins
    return True, found, margins


@fast
def _null_space(five):
    """Step 1: how independent the epipolar constraints of five correspondences, (u, v, 1) E (x, y, 1)^T = 0, are, from
    0 to 1, and the basis X, Y, Z, W (4, 9) that OpenCV takes of the matrices that meet them, each row by row.

    Where Nister has a QR factorisation this is Gram and Schmidt's, twice over for the rounding. With another basis the
    solutions would be the same, but not how much rounding changes them.
    """
    rows, independence = np.empty((9, 9)), 1.0
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
        independence = min(independence, norm / before)
        if not independence > 1e-8:
            return 0.0, rows[SAMPLE:]
        rows[k] /= norm
    return independence, rows[SAMPLE:]


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
    first, of degree 3, 3 and 4. With it the errors of the six rows of which it is made (see _elimination_errors).
    """
    b = np.zeros((3, 13))
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(a[i, k]) > abs(a[pivot, k]):
                pivot = i
        if a[pivot, k] == 0:
            return np.full((3, 13), np.nan), np.full(6, np.nan)
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
    largest = 1.0
    for k in range(4, 10):
        for j in range(10, 20):
            largest = max(largest, abs(a[k, j]))
    errors = _elimination_errors(a[4:, 4:10], largest)
    for i in range(3):
        # the columns of x z^2 to x, y z^2 to y, z^3 to 1
        for start, stop, place in ((10, 13, 0), (13, 16, 4), (16, 20, 8)):
            for j in range(start, stop):
                b[i, place + j - start + 1] += a[4 + 2 * i, j]
                b[i, place + j - start] -= a[5 + 2 * i, j]
    return b, errors


@fast
def _elimination_errors(u, largest):
    """By how many units of rounding the six rows from which B(z) is made may be wrong, OpenCV's among them.

    u: the triangle U (6, 6) that elimination leaves of the last six unknowns; largest: of the result's entries.
    Equations that are wrong by a unit make the result wrong by |U^-1| times its size. Besides, OpenCV inverts the
    matrix and multiplies, where elimination would do, which adds |U^-1| |U| |U^-1|: with ill-conditioned equations far
    more. Of their products with what is of the size of 1 only sums of rows are needed.
    """
    inverse, sums, total = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for i in range(5, -1, -1):
        inverse[i, i] = 1 / u[i, i]
        for j in range(i + 1, 6):
            for k in range(i + 1, j + 1):
                inverse[i, j] -= u[i, k] * inverse[k, j]
            inverse[i, j] /= u[i, i]
        for j in range(i, 6):
            sums[i] += abs(inverse[i, j])
    for j in range(6):
        error = largest
        for k in range(j, 6):
            error += abs(u[j, k]) * sums[k]
        for i in range(j + 1):
            total[i] += abs(inverse[i, j]) * error
    return total


@fast
def _at(b, terms, errors, z, work):
    """By how many units of rounding det B(z) may be wrong, after Wilkinson: the sizes of all terms, whatever cancels.

    terms: the sizes of B(z)'s coefficients. Written to work (4, 3, 3): B(z), the sizes of its terms, by how many units
    it may be wrong, its cofactors.
    """
    values, sizes, wrong, cofactors = work[0], work[1], work[2], work[3]
    size = abs(z)
    powers = 1 + size + size * size
    for i in range(3):
        values[i, 0], values[i, 1], values[i, 2] = _row(b[i], z)
        sizes[i, 0], sizes[i, 1], sizes[i, 2] = _row(terms[i], size)
        error = errors[2 * i] + size * errors[2 * i + 1]
        wrong[i, 0], wrong[i, 1] = error * powers + sizes[i, 0], error * powers + sizes[i, 1]
        wrong[i, 2] = error * (1 + size * powers) + sizes[i, 2]
    error = 0.0
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            m, n = (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = values[p, m] * values[q, n] - values[p, n] * values[q, m]
            error += TOGETHER * abs(cofactors[i, j]) * wrong[i, j]
        error += sizes[i, 0] * (sizes[p, 1] * sizes[q, 2] + sizes[p, 2] * sizes[q, 1])
    return error


@fast
def _change(b, terms, errors, z, polynomial, work):
    """By how many units of rounding the essential matrix (unit norm) of a root z may be wrong, to the first order.

    As coordinates in the orthonormal basis it is (x, y, w z, w), (x, y, w) normal to B(z). It changes as z does, by the
    error of det B(z) over its slope, and as the plane of B(z)'s rows does, by their errors over its second singular
    value, which is about the norm of the cofactors over that of B(z).
    """
    error = _at(b, terms, errors, z, work)
    values, wrong, cofactors = work[0], work[2], work[3]
    best, largest, cofactor_norm, norm = 0, -1.0, 0.0, 0.0
    for i in range(3):
        square = 0.0
        for j in range(3):
            square += cofactors[i, j] * cofactors[i, j]
            norm += values[i, j] * values[i, j]
        cofactor_norm += square
        if square > largest:
            best, largest = i, square
    p, q, (x, y, w) = values[(best + 1) % 3], values[(best + 2) % 3], cofactors[best]
    p0, p1, p2 = _row_slopes(b[(best + 1) % 3], z)
    q0, q1, q2 = _row_slopes(b[(best + 2) % 3], z)
    dx = p1 * q[2] - p2 * q[1] + p[1] * q2 - p[2] * q1
    dy = p2 * q[0] - p0 * q[2] + p[2] * q0 - p[0] * q2
    dw = p0 * q[1] - p1 * q[0] + p[0] * q1 - p[1] * q0
    dwz = dw * z + w
    square = x * x + y * y + w * w * (1 + z * z)
    along = (x * dx + y * dy + w * dw + w * z * dwz) / square  # what a unit norm undoes
    speed = (dx - along * x)**2 + (dy - along * y)**2 + (dw - along * w)**2 + (dwz - along * w * z)**2
    tilt = 0.0
    for i in range(3):
        tilt += (abs(x) * wrong[i, 0] + abs(y) * wrong[i, 1] + abs(w) * wrong[i, 2])**2
    tilt *= norm / cofactor_norm * (1 + z * z)
    return (error / abs(_slope(polynomial, z)) * np.sqrt(speed) + np.sqrt(tilt)) / np.sqrt(square)


@fast
def _row(c, z):
    """One row of B(z)."""
    return (((c[0] * z + c[1]) * z + c[2]) * z + c[3], ((c[4] * z + c[5]) * z + c[6]) * z + c[7],
            (((c[8] * z + c[9]) * z + c[10]) * z + c[11]) * z + c[12])


@fast
def _row_slopes(c, z):
    return ((3 * c[0] * z + 2 * c[1]) * z + c[2], (3 * c[4] * z + 2 * c[5]) * z + c[6],
            ((4 * c[8] * z + 3 * c[9]) * z + 2 * c[10]) * z + c[11])


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
def _slope(polynomial, z):
    """The slope at z of a polynomial of degree ten."""
    value, slope = polynomial[0], 0.0
    for k in range(1, 11):
        slope = slope * z + value
        value = value * z + polynomial[k]
    return slope


@fast
def real_roots(polynomial: np.ndarray) -> tuple[bool, np.ndarray, np.ndarray]:
    """Step 5: whether a polynomial of degree ten (11, highest power first) could be solved, its real roots, and the
    places of its extrema, of which one that is nearly 0 may be a double root or none at all.

    Between two roots of the derivative lies at most one, so the derivatives are solved one after the other: those of
    low degree, whose roots only part those of the next, no more precisely than that needs.
    """
    bound = 0.0
    for k in range(1, 11):
        if not abs(polynomial[k]) < 1e15 * abs(polynomial[0]):
            return False, np.empty(0), np.empty(0)
        bound = max(bound, 2 * (abs(polynomial[k]) / abs(polynomial[0])) ** (1.0 / k))
    if abs(polynomial[0]) < 1e-12:  # OpenCV drops a leading coefficient of 2e-16
        return False, np.empty(0), np.empty(0)
    derivatives = np.empty((11, 11))
    derivatives[10] = polynomial
    for degree in range(10, 0, -1):
        for k in range(degree):
            derivatives[degree - 1, k] = derivatives[degree, k] * (degree - k)
    edges, roots, bends = np.empty(12), np.empty(11), np.empty(12)
    found, intervals = 0, 0
    for degree in range(1, 11):
        derivative, slopes = derivatives[degree], derivatives[degree - 1]
        edges[0], edges[found + 1] = -bound, bound
        for k in range(found):
            edges[k + 1] = roots[k]
        intervals, found = found + 1, 0
        left = _value(derivative, degree, -bound)
        for k in range(intervals):
            right = _value(derivative, degree, edges[k + 1])
            if (left < 0) != (right < 0):
                start = 0.5 * (edges[k] + edges[k + 1])
                if 0 < k < intervals - 1:  # between two extrema, where a cubic that shares them is 0
                    part = 0.5 - math.sin(math.asin((left + right) / (left - right)) / 3)
                    start = edges[k] + part * (edges[k + 1] - edges[k])
                elif k > 0:  # beyond one, where a parabola would be
                    start = edges[k] + math.sqrt(abs(2 * left / bends[k]))
                elif intervals > 1:
                    start = edges[1] - math.sqrt(abs(2 * right / bends[1]))
                roots[found] = _root_between(derivative, slopes, degree, edges[k], edges[k + 1], left < 0, start,
                                             1e-14 if degree > 8 else 1e-6)
                found += 1
            left = right
        for k in range(found):
            bends[k + 1] = _value(slopes, degree - 1, roots[k])
    return True, roots[:found].copy(), edges[1:intervals].copy()


@fast
def _value(polynomial, degree, z):
    """A polynomial at z: even and odd powers apart, which a processor works on at the same time."""
    square = z * z
    first, second = polynomial[0], polynomial[1] if degree else 0.0
    for k in range(2, degree, 2):
        first = first * square + polynomial[k]
        second = second * square + polynomial[k + 1]
    if degree % 2:
        return first * z + second
    return first * square + polynomial[degree] + second * z if degree else first


@fast
def _root_between(polynomial, slopes, degree, left, right, rising, start, precision):
    """Newton's iteration, with bisection where it would leave the interval or is slow."""
    z = start if left < start < right else 0.5 * (left + right)
    before = right - left
    for _ in range(100):
        value, slope = _value(polynomial, degree, z), _value(slopes, degree - 1, z)
        if (value < 0) == rising:
            left = z
        else:
            right = z
        step = value / slope if slope != 0 else np.inf
        if not (left <= z - step <= right) or abs(step) > 0.5 * before:
            step = z - 0.5 * (left + right)
        before = abs(step)
        z -= step
        if before <= precision * abs(z) + 1e-300:
            break
    return z


@fast
def _essential(b, basis, z, matrix):
    """Step 6: write the essential matrix (9, unit norm) that belongs to a root z: (x, y, 1) is normal to B(z)."""
    rows = np.empty((3, 3))
    for i in range(3):
        rows[i, 0], rows[i, 1], rows[i, 2] = _row(b[i], z)
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
