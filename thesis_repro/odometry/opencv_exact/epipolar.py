"""The epipolar lines of a correspondence, on which the estimator, its shortcut and the refinement are all built."""

from thesis_repro.compiled import fast


@fast
def entries(matrix):
    """The nine entries of a 3x3 matrix, row by row: as numbers of their own they stay in registers."""
    return (matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[1, 0], matrix[1, 1], matrix[1, 2],
            matrix[2, 0], matrix[2, 1], matrix[2, 2])


@fast
def lines(e, x, y, u, v):
    """What an essential matrix (its nine entries) makes of (x, y) in the current frame and (u, v) in the previous one.

    The epipolar constraint (u, v, 1) E (x, y, 1)^T, which is 0 where they agree; and the first two coordinates of the
    epipolar lines: l = E (x, y, 1)^T in the previous frame, m = E^T (u, v, 1)^T in the current one. The constraint's
    square over l0^2 + l1^2 + m0^2 + m1^2 is the squared Sampson distance.
    """
    l0 = e[0] * x + e[1] * y + e[2]
    l1 = e[3] * x + e[4] * y + e[5]
    l2 = e[6] * x + e[7] * y + e[8]
    m0 = e[0] * u + e[3] * v + e[6]
    m1 = e[1] * u + e[4] * v + e[7]
    return u * l0 + v * l1 + l2, l0, l1, m0, m1
