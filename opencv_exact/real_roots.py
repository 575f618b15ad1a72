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
# Rows of a search in all lanes: the coefficients of the polynomial, those of its derivative from
# SLOPES on, and a _Search from STATE on. They are rows of one array, so that the compiler sees that
# they do not overlap.
SLOPES, STATE, ROWS = 11, 22, 28


class RealRoots(NamedTuple):
    """Real roots and extrema of LANES polynomials, one in each lane."""

    solved: np.ndarray  # (LANES,) booleans
    counts: np.ndarray  # (LANES,), numbers of roots
    roots: np.ndarray  # (10, LANES)
    extremum_counts: np.ndarray  # (LANES,)
    extrema: np.ndarray  # (10, LANES), places
    heights: np.ndarray  # (10, LANES), values at the extrema


class _Search(NamedTuple):
    """How far the search for one root of one polynomial is. All are numbers, 1 or 0 for a truth."""

    place: float
    left: float  # ends of the interval
    right: float
    last_step: float  # its size
    rises: float  # whether the polynomial rises at the root
    goes_on: float


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
    search = np.zeros((ROWS, LANES))
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
                if not _search_step(search, precision):
                    break
            for lane in range(LANES):
                roots[k, lane] = search[STATE, lane]
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
    """Prepare the search for root k in each lane. brackets (4, LANES): see `real_roots`."""
    for lane in range(LANES):
        left, right = brackets[1, lane], brackets[2, lane]
        goes_on = 1.0 if k < counts[lane] else 0.0
        state = _Search(brackets[0, lane], left, right, right - left, brackets[3, lane], goes_on)
        _store(search, lane, state)


@inlined
def _search_step(search, precision):
    """Make one step in each lane. Returns the number of lanes that go on."""
    going_on = 0
    for lane in range(LANES):
        state = _Search(
            search[STATE, lane],
            search[STATE + 1, lane],
            search[STATE + 2, lane],
            search[STATE + 3, lane],
            search[STATE + 4, lane],
            search[STATE + 5, lane],
        )
        height = value(search, state.place, lane)
        slope = value(search[SLOPES:], state.place, lane)
        state = _newton_step(state, height, slope, precision)
        _store(search, lane, state)
        going_on += 1 if state.goes_on > 0 else 0
    return going_on


@inlined
def _store(search, lane, state):
    search[STATE, lane], search[STATE + 1, lane] = state.place, state.left
    search[STATE + 2, lane], search[STATE + 3, lane] = state.right, state.last_step
    search[STATE + 4, lane], search[STATE + 5, lane] = state.rises, state.goes_on


@inlined
def _newton_step(state, height, slope, precision):
    """The state after one step of Newton's method, for a polynomial's value and slope at the place.

    Bisection replaces a step that leaves the interval or converges slowly. A search that does not
    go on keeps its place.
    """
    place = state.place
    step = height / slope
    is_left = (height < 0) == (state.rises > 0)
    left = place if is_left else state.left
    right = state.right if is_left else place
    is_inside = (left <= place - step) & (place - step <= right)
    is_shorter = abs(step) <= 0.5 * state.last_step
    step = step if is_inside & is_shorter else place - 0.5 * (left + right)
    moved = place - step
    goes_on = 0.0 if abs(step) <= precision * abs(moved) + 1e-300 else state.goes_on
    place = moved if state.goes_on > 0 else place
    return _Search(place, left, right, abs(step), state.rises, goes_on)
