"""The five-point algorithm: essential matrices from five correspondences.

The steps follow Nister (2004), An efficient solution to the five-point relative pose problem, PAMI
26(6):

1. `null_space`: five epipolar constraints leave E = x X + y Y + z Z + W with unknown x, y, z;
2. `constraints`: the trace constraint and the determinant constraint on E are ten cubic equations
   in x, y, z;
3. `eliminate`: Gauss-Jordan elimination leaves three equations B(z) (x, y, 1)^T = 0;
4. `determinant`: det B(z) is a polynomial of degree ten in z;
5. `real_roots.real_roots`: the real roots of det B(z) = 0 (a complex root gives no motion);
6. `essential`: x, y and E for one root.

A single sample keeps the processor waiting, because most operations need the one before. So LANES
samples are solved side by side. Their arrays end with an axis of lanes, and the compiler vectorises
the loops over it: those with nothing but numbers, or loops of constant length, inside.

`solver.solve` runs these steps. Nister's last step, rotation and translation from E, is
pose.recover_pose.
"""

import numpy as np

from opencv_exact.compiling import inlined
from opencv_exact.real_roots import LANES

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


@inlined
def null_space(fives, rows, independences):
    """Step 1: basis X, Y, Z, W of the matrices that meet five epipolar constraints.

    fives: (5, 4, LANES), correspondences x, y, u, v. A constraint is (u, v, 1) E (x, y, 1)^T = 0.
    Writes the constraints to the first five rows (9, 9, LANES), made orthonormal, and the basis to
    the others, each a matrix row by row. Writes the constraints' independences (LANES; 0 to 1).
    Nister uses a QR factorisation. This is Gram-Schmidt, run twice against rounding. It gives
    OpenCV's basis: in another basis, rounding would change the solutions by other amounts.
    """
    row = np.empty((9, LANES))
    norms, norms_left = np.empty(LANES), np.empty(LANES)
    for lane in range(LANES):
        independences[lane] = 1.0
    for k in range(9):
        if k < SAMPLE_SIZE:
            _write_constraint(fives[k], row)
        else:
            for i in range(9):
                for lane in range(LANES):
                    row[i, lane] = SIGNS[k - SAMPLE_SIZE, i]
        _write_norms(row, norms)
        for _ in range(2):
            for j in range(k):
                _make_normal(row, rows[j])
        _write_norms(row, norms_left)
        _write_unit_row(row, norms_left, rows[k])
        for lane in range(LANES):
            share = norms_left[lane] / norms[lane]
            independences[lane] = share if share < independences[lane] else independences[lane]


@inlined
def _write_constraint(five, row):
    """Write the factors (9, LANES) of E's entries in one epipolar constraint."""
    for lane in range(LANES):
        x, y, u, v = five[0, lane], five[1, lane], five[2, lane], five[3, lane]
        row[0, lane], row[1, lane], row[2, lane] = x * u, y * u, u
        row[3, lane], row[4, lane], row[5, lane] = x * v, y * v, v
        row[6, lane], row[7, lane], row[8, lane] = x, y, 1.0


@inlined
def _write_norms(row, norms):
    for lane in range(LANES):
        total = 0.0
        for i in range(9):
            total += row[i, lane] * row[i, lane]
        norms[lane] = np.sqrt(total)


@inlined
def _make_normal(row, other):
    """Make a row normal to another one of unit norm."""
    for lane in range(LANES):
        along = 0.0
        for i in range(9):
            along += row[i, lane] * other[i, lane]
        for i in range(9):
            row[i, lane] -= along * other[i, lane]


@inlined
def _write_unit_row(row, norms, unit_row):
    for lane in range(LANES):
        for i in range(9):
            unit_row[i, lane] = row[i, lane] / norms[lane]


@inlined
def constraints(basis, equations):
    """Step 2: ten cubic equations in x, y, z for E = x X + y Y + z Z + W.

    equations: (10, 20, LANES), given as zeros. Rows 0 to 8 become the trace constraint: E E^T E -
    trace(E E^T) E / 2 = 0. Row 9 becomes the determinant constraint: det E = 0.
    """
    squares = np.zeros((10, 9, LANES))  # entries of E E^T, quadratic in x, y, z
    minors = np.zeros((10, 3, LANES))  # of the first row of E, quadratic in x, y, z
    for k in range(3):
        for p in range(4):
            for q in range(4):
                _add_squares(basis[p], basis[q], k, squares[TO_QUADRATIC[p, q]])
    for p in range(4):
        for q in range(4):
            _add_minors(basis[p], basis[q], minors[TO_QUADRATIC[p, q]])
    for p in range(10):
        _finish_squares(squares[p])
    for p in range(10):
        for q in range(4):
            _add_products(squares[p], minors[p], basis[q], equations[:, TO_CUBIC[p, q]])


@inlined
def _add_squares(a, b, k, squares):
    """Add the products of the k-th columns of matrices a and b (9, LANES): the lower triangle."""
    for lane in range(LANES):
        squares[0, lane] += a[k, lane] * b[k, lane]
        squares[3, lane] += a[3 + k, lane] * b[k, lane]
        squares[4, lane] += a[3 + k, lane] * b[3 + k, lane]
        squares[6, lane] += a[6 + k, lane] * b[k, lane]
        squares[7, lane] += a[6 + k, lane] * b[3 + k, lane]
        squares[8, lane] += a[6 + k, lane] * b[6 + k, lane]


@inlined
def _finish_squares(squares):
    """Fill the upper triangle, and make of E E^T what gives the trace constraint.

    That is E E^T - trace(E E^T) / 2, which times E is the constraint.
    """
    for lane in range(LANES):
        squares[1, lane] = squares[3, lane]
        squares[2, lane] = squares[6, lane]
        squares[5, lane] = squares[7, lane]
        half = 0.5 * (squares[0, lane] + squares[4, lane] + squares[8, lane])
        squares[0, lane] -= half
        squares[4, lane] -= half
        squares[8, lane] -= half


@inlined
def _add_minors(a, b, minors):
    """Add the minors (3) of the second row of a and the third row of b."""
    for lane in range(LANES):
        minors[0, lane] += a[4, lane] * b[8, lane] - a[5, lane] * b[7, lane]
        minors[1, lane] += a[5, lane] * b[6, lane] - a[3, lane] * b[8, lane]
        minors[2, lane] += a[3, lane] * b[7, lane] - a[4, lane] * b[6, lane]


@inlined
def _add_products(squares, minors, matrix, equations):
    """Add the products with a matrix of the basis to one place of the equations (10, LANES)."""
    for lane in range(LANES):
        for i in range(3):
            equations[9, lane] += minors[i, lane] * matrix[i, lane]
            for j in range(3):
                total = equations[3 * i + j, lane]
                for k in range(3):
                    total += squares[3 * i + k, lane] * matrix[3 * k + j, lane]
                equations[3 * i + j, lane] = total


@inlined
def eliminate(a, b):
    """Step 3: write B(z) to b (3, 13, LANES; given as zeros).

    The equations a (10, 20, LANES) are eliminated in place. Singular ones leave infinite numbers or
    NaN. A row of B(z) is one eliminated row minus z times the next one, so that only x, y and 1 are
    left. It holds their factors: polynomials in z of degree 3, 3 and 4, each with its highest power
    first.
    """
    _make_triangular(a)
    _substitute_back(a)
    for i in range(3):
        # the columns of x z^2 to x, y z^2 to y, z^3 to 1
        for start, stop, place in ((10, 13, 0), (13, 16, 4), (16, 20, 8)):
            for j in range(start, stop):
                for lane in range(LANES):
                    b[i, place + j - start + 1, lane] += a[4 + 2 * i, j, lane]
                    b[i, place + j - start, lane] -= a[5 + 2 * i, j, lane]


@inlined
def _make_triangular(a):
    """Gauss-Jordan elimination with partial pivoting. Nothing uses what is left of the diagonal."""
    factors = np.empty(LANES)
    for k in range(10):
        _swap_pivot(a, k)
        for i in range(k + 1, 10):
            for lane in range(LANES):
                factors[lane] = a[i, k, lane] / a[k, k, lane]
            _subtract(a[i, :10], a[k, :10], factors)
            _subtract(a[i, 10:], a[k, 10:], factors)


@inlined
def _substitute_back(a):
    """Solve the triangular equations for the last six unknowns: B(z) needs no others."""
    factors = np.empty(LANES)
    for k in range(9, 3, -1):
        for i in range(k + 1, 10):
            for lane in range(LANES):
                factors[lane] = a[k, i, lane]
            _subtract(a[k, 10:], a[i, 10:], factors)
        _divide(a[k], k)


@inlined
def _swap_pivot(a, k):
    """Swap row k of each lane with the one that has the largest number in column k."""
    for lane in range(LANES):
        pivot = k
        for i in range(k + 1, 10):
            if abs(a[i, k, lane]) > abs(a[pivot, k, lane]):
                pivot = i
        if pivot != k:
            for j in range(k, 20):
                a[k, j, lane], a[pivot, j, lane] = a[pivot, j, lane], a[k, j, lane]


@inlined
def _subtract(row, top, factors):
    """Subtract a multiple of half a row from half a row, (10, LANES)."""
    for lane in range(LANES):
        factor = factors[lane]
        for j in range(10):
            row[j, lane] -= factor * top[j, lane]


@inlined
def _divide(row, k):
    for lane in range(LANES):
        diagonal = row[k, lane]
        for j in range(10, 20):
            row[j, lane] /= diagonal


@inlined
def determinant(b, polynomials):
    """Step 4: write the coefficients (11, LANES; lowest power first; given as zeros) of det B(z).

    The determinant is expanded along the last column.
    """
    minor = np.empty((7, LANES))
    for i in range(3):
        for p in range(7):
            for lane in range(LANES):
                minor[p, lane] = 0.0
        _add_minor(b[(i + 1) % 3], b[(i + 2) % 3], minor)
        _add_expansion(minor, b[i], polynomials)


@inlined
def _add_minor(first, second, minor):
    for lane in range(LANES):
        for p in range(4):
            for q in range(4):
                minor[p + q, lane] += (
                    first[p, lane] * second[4 + q, lane] - second[p, lane] * first[4 + q, lane]
                )


@inlined
def _add_expansion(minor, row, polynomials):
    for lane in range(LANES):
        for p in range(7):
            for q in range(5):
                polynomials[10 - p - q, lane] += minor[p, lane] * row[8 + q, lane]


@inlined
def row_values(c, z):
    """Values at z of the three polynomials in one row c (13) of B(z)."""
    return (
        ((c[0] * z + c[1]) * z + c[2]) * z + c[3],
        ((c[4] * z + c[5]) * z + c[6]) * z + c[7],
        (((c[8] * z + c[9]) * z + c[10]) * z + c[11]) * z + c[12],
    )


@inlined
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
