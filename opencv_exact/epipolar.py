"""Terms of the Sampson distance, for the RANSAC search and for the refined estimator."""

from opencv_exact.compiling import inlined


@inlined
def entries(e):
    """Entries of an array (9) as a tuple: single numbers stay in registers."""
    return e[0], e[1], e[2], e[3], e[4], e[5], e[6], e[7], e[8]


@inlined
def sampson_terms(e, x, y, u, v):
    """Terms of one correspondence's Sampson distance: (algebraic, l0, l1, m0, m1).

    e: nine entries of an essential matrix E. (x, y): point in the current frame. (u, v): point in
    the previous frame. algebraic is (u, v, 1) E (x, y, 1)^T, which is 0 for an exact match
    (epipolar constraint). l0, l1 and m0, m1 are the first two coordinates of the epipolar lines l =
    E (x, y, 1)^T (previous frame) and m = E^T (u, v, 1)^T (current frame). The squared Sampson
    distance is algebraic^2 / (l0^2 + l1^2 + m0^2 + m1^2).
    """
    l0 = e[0] * x + e[1] * y + e[2]
    l1 = e[3] * x + e[4] * y + e[5]
    l2 = e[6] * x + e[7] * y + e[8]
    m0 = e[0] * u + e[3] * v + e[6]
    m1 = e[1] * u + e[4] * v + e[7]
    return u * l0 + v * l1 + l2, l0, l1, m0, m1
