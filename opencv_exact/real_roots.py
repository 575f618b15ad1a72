"""Real roots of polynomials of degree ten, several at once (step 5 of `five_point`).

Newton's method keeps the processor waiting, because each step needs the one before. So LANES
polynomials are solved side by side, and the compiler vectorises the loops over the lanes.
"""

import math
from typing import NamedTuple

import numpy as np

from opencv_exact.compiling import inlined

# Samples solved side by side, one in each lane. Loops over fewer than 16 are not vectorised; with
# more, more samples are solved in vain when a search ends.
LANES = 16
# Rows of a search for one root of each lane. The coefficients of the polynomial come first, then
# those of its derivative from SLOPES on. PLACE is where the search is; LEFT and RIGHT are the ends
# of the interval; LAST_STEP is the size of the last step. RISES and GOES_ON are 1 or 0: whether the
# polynomial rises at the root, and whether the lane goes on. They are rows of one array, so that
# the compiler sees that they do not overlap.
SLOPES = 11
PLACE, LEFT, RIGHT, LAST_STEP, RISES, GOES_ON = range(22, 28)


class RealRoots(NamedTuple):
    """Real roots and extrema of LANES polynomials, one in each lane."""

    solved: np.ndarray  # (LANES,) booleans
    counts: np.ndarray  # (LANES,), numbers of roots
    roots: np.ndarray  # (10, LANES)
    extremum_counts: np.ndarray  # (LANES,)
    extrema: np.ndarray  # (10, LANES), places
    heights: np.ndarray  # (10, LANES), values at the extrema


@inlined
def real_roots(polynomials):
    """Solve LANES polynomials of degree ten (11, LANES; lowest power first).

    At most one root lies between two neighbouring extrema. The extrema are the roots of the
    derivative, so all derivatives are solved, the lowest degree first and less precisely. The
    caller must look at the extrema: where the polynomial is nearly 0 there, it has a double root or
    none.
    """
    solved, bounds, derivatives = _prepare(polynomials)
    brackets = np.empty((4, 10, LANES))  # start, left end, right end, and whether it rises (1 or 0)
    counts, new_counts = np.zeros(LANES, np.int64), np.zeros(LANES, np.int64)
    roots, extrema = np.empty((10, LANES)), np.empty((10, LANES))
    # of the next polynomial and of its second derivative, at its extrema
    heights, bends = np.empty((10, LANES)), np.empty((10, LANES))
    first_heights, last_heights = np.empty(LANES), np.empty(LANES)  # at the bounds
    search = np.zeros((GOES_ON + 1, LANES))
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
        for power in range(11):
            for lane in range(LANES):
                search[power, lane] = polynomial[power, lane]
                search[SLOPES + power, lane] = slopes[power, lane]
        for k in range(most):
            _start_search(search, brackets[:, k], k, counts)
            for _ in range(100):
                if not _newton_step(search, precision):
                    break
            for lane in range(LANES):
                roots[k, lane] = search[PLACE, lane]
            _values(slopes, roots[k], bends[k])
            if degree < 10:
                _values(derivatives[degree + 1], roots[k], heights[k])
    return RealRoots(solved, counts, roots, new_counts, extrema, heights)


@inlined
def _prepare(polynomials):
    """Which polynomials can be solved, bounds of their roots, and all their derivatives.

    derivatives: (11, 11, LANES). Row d is the one of degree d, its lowest power first; row 10 is
    the polynomial itself. One that cannot be solved is replaced by the constant 1.
    """
    solved, bounds = np.zeros(LANES, np.bool_), np.ones(LANES)
    derivatives = np.zeros((11, 11, LANES))
    for lane in range(LANES):
        bound = _root_bound(polynomials, lane)
        derivatives[10, 0, lane] = 1.0
        if bound >= 0:
            solved[lane] = True
            bounds[lane] = bound
            for power in range(11):
                derivatives[10, power, lane] = polynomials[power, lane]
    for degree in range(10, 0, -1):
        for power in range(1, degree + 1):
            for lane in range(LANES):
                coefficient = derivatives[degree, power, lane]
                derivatives[degree - 1, power - 1, lane] = coefficient * power
    return solved, bounds, derivatives


@inlined
def _root_bound(polynomials, lane):
    """Bound of the absolute values of all roots; -1 if the leading coefficient is too small."""
    bound = 0.0
    leading = abs(polynomials[10, lane])
    for k in range(1, 11):
        size = abs(polynomials[10 - k, lane])
        if not size < 1e15 * leading:
            return -1.0
        bound = max(bound, 2 * (size / leading) ** (1.0 / k))
    if leading < 1e-12:  # OpenCV drops a leading coefficient of 2e-16
        return -1.0
    return bound


@inlined
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


@inlined
def value(polynomial, z, lane):
    """Value at z of one of several polynomials (11, LANES; lowest power first).

    Even and odd powers are summed apart, so the processor runs both sums at once.
    """
    square = z * z
    even = polynomial[10, lane] * square + polynomial[8, lane]
    even = (even * square + polynomial[6, lane]) * square + polynomial[4, lane]
    even = (even * square + polynomial[2, lane]) * square + polynomial[0, lane]
    odd = polynomial[9, lane] * square + polynomial[7, lane]
    odd = (odd * square + polynomial[5, lane]) * square + polynomial[3, lane]
    odd = odd * square + polynomial[1, lane]
    return even + odd * z


@inlined
def _values(polynomial, places, values):
    """Write the values (LANES) of polynomials (11, LANES) at a place of each."""
    for lane in range(LANES):
        values[lane] = value(polynomial, places[lane], lane)


@inlined
def _start_search(search, brackets, k, counts):
    """Prepare the search for root k of each lane, see `_newton_step`."""
    for lane in range(LANES):
        left, right = brackets[1, lane], brackets[2, lane]
        search[PLACE, lane], search[LEFT, lane], search[RIGHT, lane] = (
            brackets[0, lane],
            left,
            right,
        )
        search[LAST_STEP, lane], search[RISES, lane] = right - left, brackets[3, lane]
        search[GOES_ON, lane] = 1.0 if k < counts[lane] else 0.0


@inlined
def _newton_step(search, precision):
    """Make one step of Newton's method in each lane. Returns the number of lanes that go on.

    Bisection replaces a step that leaves the interval or converges slowly.
    search: (28, LANES), rows from PLACE on. Lanes that do not go on keep their places.
    """
    going_on = 0
    for lane in range(LANES):
        z = search[PLACE, lane]
        height = value(search, z, lane)
        step = height / value(search[SLOPES:], z, lane)
        is_left = (height < 0) == (search[RISES, lane] > 0)
        left = z if is_left else search[LEFT, lane]
        right = search[RIGHT, lane] if is_left else z
        is_inside = (left <= z - step) & (z - step <= right)
        is_shorter = abs(step) <= 0.5 * search[LAST_STEP, lane]
        step = step if is_inside & is_shorter else z - 0.5 * (left + right)
        moved = z - step
        goes_on = search[GOES_ON, lane]
        search[PLACE, lane] = moved if goes_on > 0 else z
        search[LEFT, lane], search[RIGHT, lane], search[LAST_STEP, lane] = left, right, abs(step)
        goes_on = 0.0 if abs(step) <= precision * abs(moved) + 1e-300 else goes_on
        search[GOES_ON, lane] = goes_on
        going_on += 1 if goes_on > 0 else 0
    return going_on
