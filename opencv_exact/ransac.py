"""cv2.findEssentialMat with RANSAC: the same bits, several times faster.

OpenCV spends nearly all of its time in the five-point solver. It finds all ten complex roots of a
polynomial by an iteration that goes on long after the roots have converged. But RANSAC keeps only
one of all solutions. So this search solves few samples with OpenCV:

1. Draw samples of five correspondences with OpenCV's random number generator, LANES at a time.
2. Solve them quickly with `rounding.solve`. The last digits differ from OpenCV's, but the
   difference is within a margin. The margin gives bounds of OpenCV's number of inliers. A test in
   single precision rules out most solutions.
3. Let OpenCV solve a sample if the bounds do not decide whether it beats the best one so far. Let
   OpenCV also solve the winner.
4. If the winner's number of inliers is outside its bounds, let OpenCV do the whole search.

The margin is a generous estimate, not a proof. The tests compare the results with OpenCV's.
"""

import math
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from opencv_exact import epipolar
from opencv_exact.compiling import compiled, inlined
from opencv_exact.five_point import SAMPLE_SIZE
from opencv_exact.real_roots import LANES
from opencv_exact.rounding import Solutions, no_solutions, solve

MAX_SAMPLES = 1000
MIN_FOR_SHORTCUT = 8  # correspondences; with fewer, OpenCV does the whole search
OPENCV_SEED = 2**64 - 1  # of its RANSAC's random number generator
# correspondences scored between two checks whether the best can still be beaten
SCORING_BLOCK = 128
SMALLEST = np.finfo(float).tiny  # normal number


class _Solution(NamedTuple):
    """OpenCV's best solution for a sample of five."""

    inliers: int  # among all correspondences
    matrix: np.ndarray | None  # 3x3
    mask: np.ndarray | None  # (N, 1) uint8


class _Candidate(NamedTuple):
    """A sample of five, and bounds of the number of inliers of OpenCV's best solution for it."""

    sample: np.ndarray  # five indices
    fewest: int
    most: int


class _Block(NamedTuple):
    """LANES samples that were drawn and solved together."""

    state: np.ndarray  # (1,) uint64, of the random number generator after them
    samples: np.ndarray  # (LANES, 5)
    fives: np.ndarray  # (5, 4, LANES), their correspondences
    solutions: Solutions


def find_essential_matrix(
    current: np.ndarray, previous: np.ndarray, threshold: float, probability: float
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Essential matrix and inliers, (E, mask), with the bits of OpenCV's own search.

    That is cv2.findEssentialMat(current, previous, focal=1, pp=(0, 0), cv2.RANSAC, probability,
    threshold).

    current, previous: correspondences (N, 2), float64, normalised coordinates. E: 3x3, or OpenCV's
    stack of solutions for N = 5, or None. mask: (N, 1) uint8, or None.
    """
    columns = np.stack([*current.T, *previous.T])
    solution = None
    if len(current) >= MIN_FOR_SHORTCUT and np.isfinite(columns).all():
        solution = _search(columns, threshold, probability)
    if solution is None:
        return _opencv(current, previous, threshold, probability)
    return solution.matrix, solution.mask


def _search(columns: np.ndarray, threshold: float, probability: float) -> _Solution | None:
    """OpenCV's solution for the winning sample, or None if OpenCV has to do the whole search.

    columns: correspondences (4, N), rows x, y, u, v. None: no sample won, or the bounds were wrong.
    """
    limit = np.float32(threshold * threshold)
    extents = np.abs(columns).max(axis=1)
    with np.errstate(over="ignore"):
        rough = columns.astype(np.float32)
    block = first_block()
    drawn = 0
    # as in OpenCV, a sample counts only if its own five correspondences are inliers
    best = _Candidate(np.zeros(SAMPLE_SIZE, np.int64), SAMPLE_SIZE - 1, SAMPLE_SIZE - 1)
    solution = None  # of the best sample, once OpenCV has computed it
    while True:
        drawn, is_new, best, challenger = _next_doubtful(
            columns, rough, extents, float(limit), probability, block, drawn, best
        )
        if is_new:
            solution = None
        is_over = challenger.most == 0
        if is_over and (best.most < SAMPLE_SIZE or solution is not None):
            return solution
        # Now the exact number of inliers of the best sample matters: it decides whether the search
        # ends, or whether the challenger is better.
        if is_over or best.fewest < best.most:
            solution = _opencv_solution(columns, best.sample, threshold, probability, limit)
            if not best.fewest <= solution.inliers <= best.most:
                return None
            best = _Candidate(best.sample, solution.inliers, solution.inliers)
        if challenger.most > best.fewest:
            other = _opencv_solution(columns, challenger.sample, threshold, probability, limit)
            if other.inliers > best.fewest:
                best = _Candidate(challenger.sample, other.inliers, other.inliers)
                solution = other


def first_block() -> _Block:
    """Space for the samples of a search, with OpenCV's generator at its start."""
    return _Block(
        np.array([OPENCV_SEED], np.uint64),
        np.empty((LANES, SAMPLE_SIZE), np.int64),
        np.empty((SAMPLE_SIZE, 4, LANES)),
        no_solutions(),
    )


def _opencv(
    current: np.ndarray, previous: np.ndarray, threshold: float, probability: float
) -> tuple[np.ndarray | None, np.ndarray | None]:
    return cv2.findEssentialMat(
        current,
        previous,
        focal=1.0,
        pp=(0.0, 0.0),
        method=cv2.RANSAC,
        prob=probability,
        threshold=threshold,
    )


def _opencv_solution(
    columns: np.ndarray,
    sample: np.ndarray,
    threshold: float,
    probability: float,
    limit: np.float32,
) -> _Solution:
    """OpenCV's best solution for a sample of five, and its inliers among all correspondences."""
    five = np.ascontiguousarray(columns[:, sample].T)
    stack, _ = _opencv(five[:, :2], five[:, 2:], threshold, probability)
    if stack is None:
        return _Solution(0, None, None)
    masks = _inlier_masks(stack.reshape(-1, 9), columns, limit)
    inliers = masks.sum(axis=1)
    best = int(inliers.argmax())  # the first one if several are equal, as in OpenCV
    matrix = stack[3 * best : 3 * best + 3].copy()
    return _Solution(int(inliers[best]), matrix, masks[best].reshape(-1, 1))


@inlined
def _samples_needed(probability, outliers):
    """Number of samples among which one is free of outliers with the given probability.

    outliers: their share of the correspondences.
    """
    # probability that a sample has an outlier
    missed = 1.0 - math.pow(1.0 - outliers, float(SAMPLE_SIZE))
    if missed < SMALLEST:
        return 0
    log_missed = math.log(missed)
    log_failure = math.log(max(1.0 - probability, SMALLEST))
    if log_missed >= 0 or -log_failure >= MAX_SAMPLES * -log_missed:
        return MAX_SAMPLES
    return round(log_failure / log_missed)


@compiled
def _inlier_masks(matrices, columns, limit):
    """Inlier masks (K, N) of K matrices.

    A mask is 1 where the squared Sampson distance, as float32, is within the limit.
    """
    masks = np.empty((len(matrices), columns.shape[1]), np.uint8)
    for index in range(len(matrices)):
        matrix = epipolar.entries(matrices[index])
        for k in range(columns.shape[1]):
            algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(
                matrix, columns[0, k], columns[1, k], columns[2, k], columns[3, k]
            )
            distance = algebraic * algebraic / (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)
            masks[index, k] = np.float32(distance) <= limit
    return masks


@compiled
def draw(columns, block):
    """Draw the next LANES samples as OpenCV does."""
    count = np.uint64(columns.shape[1])
    low_bits = np.uint64(0xFFFFFFFF)
    state = block.state[0]
    for lane in range(LANES):
        sample = block.samples[lane]
        taken = 0
        while taken < SAMPLE_SIZE:
            state = (state & low_bits) * np.uint64(4164903690) + (state >> np.uint64(32))
            index = np.int64((state & low_bits) % count)
            new = True
            for k in range(taken):
                new = new and sample[k] != index
            if new:
                sample[taken] = index
                for j in range(4):
                    block.fives[taken, j, lane] = columns[j, index]
                taken += 1
    block.state[0] = state


@compiled
def _next_doubtful(columns, rough, extents, limit, probability, block, drawn, best):
    """Draw samples until one may or may not be better than the best one, or the search is over.

    rough: the columns in single precision. extents: largest absolute values of the four columns.
    drawn: number of samples so far, of which the last ones are in `block`.
    Returns the number of samples, whether the best one is another one, the best one, and the one in
    doubt (no inliers if the search is over).
    """
    count = columns.shape[1]
    sample, fewest, most = best
    is_new = False
    needed = MAX_SAMPLES
    if most >= SAMPLE_SIZE:
        needed = _samples_needed(probability, (count - most) / count)
    while drawn < needed:
        lane = drawn % LANES
        if lane == 0:
            draw(columns, block)
            solve(block.fives, block.solutions)
        drawn += 1
        low, high = _inliers_of_sample(
            columns, rough, extents, limit, block.solutions, lane, fewest
        )
        if low > most:  # surely better
            sample, fewest, most = block.samples[lane].copy(), low, high
            is_new = True
            needed = _samples_needed(probability, (count - most) / count)
        elif high > fewest:
            challenger = _Candidate(block.samples[lane].copy(), low, high)
            return drawn, is_new, _Candidate(sample, fewest, most), challenger
    return drawn, is_new, _Candidate(sample, fewest, most), _Candidate(sample, 0, 0)


@inlined
def _inliers_of_sample(columns, rough, extents, limit, solutions, lane, best):
    """Bounds of the number of inliers of a sample's best solution.

    (0, 0) if it never has more than `best`.
    """
    if not solutions.sure[lane]:
        return 0, columns.shape[1]
    low, high = 0, 0
    for k in range(solutions.counts[lane]):
        matrix, margin = solutions.matrices[lane, k], solutions.margins[lane, k]
        if _may_beat(matrix, margin, rough, extents, limit, max(best, low)):
            fewest, most = _bounds(matrix, margin, columns, limit, max(best, low))
            low = max(low, fewest)
            high = max(high, most)
    return low, high


@inlined
def _may_beat(e, margin, rough, extents, limit, best):
    """False if surely no matrix within the margin of e has more than `best` inliers.

    This test runs in single precision. It compares `algebraic` alone with the largest value that
    an inlier anywhere within the extents can have. That decides nearly always, because most
    solutions are far off.
    """
    count = rough.shape[1]
    allowed = count - best  # outliers
    largest = np.float32(1.00001 * _largest_of_inliers(e, margin, extents, limit))
    e0, e1, e2 = np.float32(e[0]), np.float32(e[1]), np.float32(e[2])
    e3, e4, e5 = np.float32(e[3]), np.float32(e[4]), np.float32(e[5])
    e6, e7, e8 = np.float32(e[6]), np.float32(e[7]), np.float32(e[8])
    matrix = e0, e1, e2, e3, e4, e5, e6, e7, e8
    outliers = 0
    for start in range(0, count, SCORING_BLOCK):
        stop = min(start + SCORING_BLOCK, count)
        outliers += _surely_out(
            matrix,
            largest,
            rough[0, start:stop],
            rough[1, start:stop],
            rough[2, start:stop],
            rough[3, start:stop],
        )
        if outliers >= allowed:
            return False
    return True


@inlined
def _largest_of_inliers(e, margin, extents, limit):
    """Bound of |algebraic| of an inlier, as computed from e in single precision.

    extents: largest |x|, |y|, |u| and |v|.
    """
    x, y, u, v = extents[0], extents[1], extents[2], extents[3]
    l0, l1 = abs(e[0]) * x + abs(e[1]) * y + abs(e[2]), abs(e[3]) * x + abs(e[4]) * y + abs(e[5])
    m0, m1 = abs(e[0]) * u + abs(e[3]) * v + abs(e[6]), abs(e[1]) * u + abs(e[4]) * v + abs(e[7])
    root = np.sqrt(limit)
    # nine roundings of 2^-24
    rounding = 1e-6 * (1 + root) * (1 + x + y) * (1 + u + v)
    doubt = _change(margin, root, x, y, u, v) + rounding
    return root * np.sqrt(l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1) + doubt


@partial(inlined, fastmath={"contract"})
def _surely_out(matrix, largest, x, y, u, v):
    """Number of correspondences whose |algebraic| is larger than that of any inlier.

    A product and a sum may become one operation, rounded once, which is faster. `largest` has room
    for either rounding, so no result depends on it.
    """
    e0, e1, e2, e3, e4, e5, e6, e7, e8 = matrix
    outliers = np.int32(0)  # of the same width as the distances, so that the loop is vectorised
    for k in range(len(x)):
        l0 = e0 * x[k] + (e1 * y[k] + e2)
        l1 = e3 * x[k] + (e4 * y[k] + e5)
        l2 = e6 * x[k] + (e7 * y[k] + e8)
        algebraic = u[k] * l0 + (v[k] * l1 + l2)
        outliers = np.int32(outliers + np.int32(abs(algebraic) > largest))
    return outliers


@inlined
def _bounds(e, margin, columns, limit, best):
    """Least and most inliers that any matrix within the margin of e has.

    (0, 0) if it never has more than `best`.
    """
    count = columns.shape[1]
    low, high = 0, 0
    for start in range(0, count, SCORING_BLOCK):
        stop = min(start + SCORING_BLOCK, count)
        few, many = _bounds_of_block(
            e,
            margin,
            columns[0, start:stop],
            columns[1, start:stop],
            columns[2, start:stop],
            columns[3, start:stop],
            limit,
        )
        low += few
        high += many
        if high + count - stop <= best:
            return 0, 0
    return low, high


@inlined
def _bounds_of_block(e, margin, x, y, u, v, limit):
    """Least and most inliers of `_bounds` among the correspondences of one block."""
    root = np.sqrt(limit)
    matrix = epipolar.entries(e)
    low, high = 0, 0
    for k in range(len(x)):
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(matrix, x[k], y[k], u[k], v[k])
        # |algebraic| of an inlier is at most this
        largest = root * np.sqrt(l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)
        doubt = _change(margin, root, x[k], y[k], u[k], v[k]) + 1e-6 * (abs(algebraic) + largest)
        low += abs(algebraic) < largest - doubt
        high += abs(algebraic) <= largest + doubt
    return low, high


@inlined
def _change(margin, root, x, y, u, v):
    """How much |algebraic| minus `largest` (_bounds_of_block) may change within the margin.

    By Cauchy and Schwarz: a matrix of norm `margin` changes (u, v, 1) E (x, y, 1)^T by at most the
    margin times the lengths of both vectors, and each epipolar line by at most the margin times
    the length of its vector.
    """
    current = 1 + x * x + y * y
    previous = 1 + u * u + v * v
    return margin * (np.sqrt(current * previous) + root * np.sqrt(current + previous))
