"""The five-point algorithm: the steps from five correspondences to the essential matrices through them.

After Nister (2004), An efficient solution to the five-point relative pose problem, PAMI 26(6), in his steps:

1. the epipolar constraints of five correspondences leave E = x X + y Y + z Z + W (`null_space`);
2. the trace constraint and the determinant constraint make E essential: ten cubics in x, y, z (`constraints`);
3. elimination leaves three equations B(z) (x, y, 1)^T = 0 (`eliminate`);
4. det B(z) = 0, a polynomial of degree ten (`determinant`);
5. its roots (`real_roots`): a complex root is no motion, so only the real ones are computed;
6. x, y and with them E for each root (`essential`).

`rounding.solve` takes these steps one after the other. Nister's last step, rotation and translation from E and the
vote, is pose.recover_pose.
"""

import math

import numpy as np

from thesis_repro.compiled import fast, inner

SAMPLE_SIZE = 5
MIN_INDEPENDENCE = 1e-8  # of the five epipolar constraints


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


@inner
def null_space(five):
    """Step 1: how independent the epipolar constraints of five correspondences, (u, v, 1) E (x, y, 1)^T = 0, are, from
    0 to 1, and the basis X, Y, Z, W (4, 9) that OpenCV takes of the matrices that meet them, each row by row.

    Where Nister has a QR factorisation this is Gram and Schmidt's, done twice because of rounding. Another basis would
    have the same solutions, but rounding would change them by other amounts.
    """
    rows, independence = np.empty((9, 9)), 1.0
    for k in range(9):
        if k < SAMPLE_SIZE:
            x, y, u, v = five[k, 0], five[k, 1], five[k, 2], five[k, 3]
            rows[k, 0], rows[k, 1], rows[k, 2] = x * u, y * u, u
            rows[k, 3], rows[k, 4], rows[k, 5] = x * v, y * v, v
            rows[k, 6], rows[k, 7], rows[k, 8] = x, y, 1.0
        else:
            for i in range(9):
                rows[k, i] = SIGNS[k - SAMPLE_SIZE, i]
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
        independence = min(independence, norm / np.sqrt(before))
        if not independence > MIN_INDEPENDENCE:
            return 0.0, rows[SAMPLE_SIZE:]
        for i in range(9):
            rows[k, i] /= norm
    return independence, rows[SAMPLE_SIZE:]


@inner
def constraints(basis):
    """Step 2: ten cubic equations (10, 20) in x, y, z for E = x X + y Y + z Z + W.

    Rows 0 to 8, the trace constraint: E E^T E - trace(E E^T) E / 2 = 0. Row 9, the determinant constraint: det E = 0.
    """
    squares, minors = np.zeros((9, 10)), np.zeros((3, 10))
    for i in range(3):
        for j in range(i + 1):
            for k in range(3):
                for p in range(4):
                    for q in range(4):
                        squares[3 * i + j, TO_QUADRATIC[p, q]] += basis[p, 3 * i + k] * basis[q, 3 * j + k]  # E E^T
        for j in range(i):
            for p in range(10):
                squares[3 * j + i, p] = squares[3 * i + j, p]
        first, second = 3 + (i + 1) % 3, 6 + (i + 2) % 3  # for the minors of E's first row, of the determinant
        for p in range(4):
            for q in range(4):
                minors[i, TO_QUADRATIC[p, q]] += (basis[p, first] * basis[q, second]
                                                  - basis[p, 3 + (i + 2) % 3] * basis[q, 6 + (i + 1) % 3])
    for p in range(10):
        half = 0.5 * (squares[0, p] + squares[4, p] + squares[8, p])
        for i in range(3):
            squares[4 * i, p] -= half  # E E^T - trace(E E^T) / 2, which times E is the trace constraint
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
def eliminate(a, b):
    """Step 3: whether it could be done, and written to b (3, 13, given as zeros): Nister's B(z), three rows of three
    polynomials in z, to which (x, y, 1) is normal.

    Gauss and Jordan's elimination with partial pivoting of the ten equations a (10, 20), which it overwrites. A row
    of B is one row less z times the next, in which nothing but x, y and 1 is left; a polynomial has its highest power
    first, of degree 3, 3 and 4.
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
    return True


@inner
def row_values(c, z):
    """One row c (13) of B(z) at z: its three polynomials."""
    return (((c[0] * z + c[1]) * z + c[2]) * z + c[3], ((c[4] * z + c[5]) * z + c[6]) * z + c[7],
            (((c[8] * z + c[9]) * z + c[10]) * z + c[11]) * z + c[12])


@inner
def determinant(b):
    """Step 4: coefficients (11, highest power first) of det B(z), expanded along its last column."""
    polynomial = np.zeros(11)
    minor = np.empty(7)
    for i in range(3):
        first, second = (i + 1) % 3, (i + 2) % 3
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
    """Step 5: whether a polynomial of degree ten (11, highest power first) could be solved, its real roots, and the
    places of its extrema. An extremum that is nearly 0 may be a double root or none at all.

    Between two roots of the derivative lies at most one root, so the derivatives are solved one after the other. Those
    of low degree are solved less precisely: their roots only bound the intervals of the next.
    """
    edges, roots, bends = np.empty(12), np.empty(11), np.empty(12)
    bound = 0.0
    for k in range(1, 11):
        if not abs(polynomial[k]) < 1e15 * abs(polynomial[0]):
            return False, roots[:0], edges[:0]
        bound = max(bound, 2 * (abs(polynomial[k]) / abs(polynomial[0])) ** (1.0 / k))
    if abs(polynomial[0]) < 1e-12:  # OpenCV drops a leading coefficient of 2e-16
        return False, roots[:0], edges[:0]
    derivatives = np.empty((11, 11))
    for k in range(11):
        derivatives[10, k] = polynomial[k]
    for degree in range(10, 0, -1):
        for k in range(degree):
            derivatives[degree - 1, k] = derivatives[degree, k] * (degree - k)
    count, intervals = 0, 0
    for degree in range(1, 11):
        derivative, slopes = derivatives[degree], derivatives[degree - 1]
        edges[0], edges[count + 1] = -bound, bound
        for k in range(count):
            edges[k + 1] = roots[k]
        intervals, count = count + 1, 0
        left = value(derivative, degree, -bound)
        for k in range(intervals):
            right = value(derivative, degree, edges[k + 1])
            if (left < 0) != (right < 0):
                start = 0.5 * (edges[k] + edges[k + 1])
                if 0 < k < intervals - 1:  # between two extrema, where a cubic that shares them is 0
                    part = 0.5 - math.sin(math.asin((left + right) / (left - right)) / 3)
                    start = edges[k] + part * (edges[k + 1] - edges[k])
                elif k > 0:  # beyond one, where a parabola would be
                    start = edges[k] + math.sqrt(abs(2 * left / bends[k]))
                elif intervals > 1:
                    start = edges[1] - math.sqrt(abs(2 * right / bends[1]))
                roots[count] = _root_between(derivative, slopes, degree, edges[k], edges[k + 1], left < 0, start,
                                             1e-14 if degree > 8 else 1e-6)
                count += 1
            left = right
        for k in range(count):
            bends[k + 1] = value(slopes, degree - 1, roots[k])
    return True, roots[:count], edges[1:intervals]


@inner
def value(polynomial, degree, z):
    """A polynomial at z. Even and odd powers are summed separately: a processor works on both at the same time."""
    square = z * z
    first, second = polynomial[0], polynomial[1] if degree else 0.0
    for k in range(2, degree, 2):
        first = first * square + polynomial[k]
        second = second * square + polynomial[k + 1]
    if degree % 2:
        return first * z + second
    return first * square + polynomial[degree] + second * z if degree else first


@inner
def _root_between(polynomial, slopes, degree, left, right, rising, start, precision):
    """Newton's iteration, with bisection where it would leave the interval or is slow."""
    z = start if left < start < right else 0.5 * (left + right)
    before = right - left
    for _ in range(100):
        height, slope = value(polynomial, degree, z), value(slopes, degree - 1, z)
        if (height < 0) == rising:
            left = z
        else:
            right = z
        step = height / slope if slope != 0 else np.inf
        if not (left <= z - step <= right) or abs(step) > 0.5 * before:
            step = z - 0.5 * (left + right)
        before = abs(step)
        z -= step
        if before <= precision * abs(z) + 1e-300:
            break
    return z


@inner
def essential(normal, basis, z, matrix):
    """Step 6: write the essential matrix (9, unit norm) that belongs to a root z and to the normal (3) of B(z)."""
    total = 0.0
    for j in range(9):
        matrix[j] = normal[0] * basis[0, j] + normal[1] * basis[1, j] + normal[2] * (z * basis[2, j] + basis[3, j])
        total += matrix[j] * matrix[j]
    total = np.sqrt(total)
    for j in range(9):
        matrix[j] /= total
