"""cv2.findEssentialMat with RANSAC: the same bits, several times faster.

OpenCV spends nearly all of its time in the five-point solver. It finds all ten complex roots of a
polynomial by an iteration that goes on long after the roots have converged. But RANSAC keeps only
one of all solutions. So this search solves few samples with OpenCV:

1. Draw samples of five correspondences with OpenCV's random number generator, LANES at a time.
2. Solve them quickly with `solver.solve`. The last digits differ from OpenCV's, but the difference
   is within a margin. The margin gives bounds of OpenCV's number of inliers. A test in single
   precision rules out most solutions.
3. Follow OpenCV's search as if each sample had the most inliers that its bounds allow. Let OpenCV
   solve the sample that wins, which gives its exact number, and follow the search again, until the
   winner's number is exact.
4. If a number is outside its bounds, let OpenCV do the whole search.

The margin is a generous estimate, not a proof. The tests compare the results with OpenCV's.
"""

import math
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np

from opencv_exact import epipolar, lucas_kanade
from opencv_exact.compiling import compiled, inlined, is_on_disk
from opencv_exact.five_point import SAMPLE_SIZE
from opencv_exact.points import as_pairs
from opencv_exact.real_roots import LANES
from opencv_exact.solver import correspondences, solve

MAX_SAMPLES = 1000
MIN_FOR_SHORTCUT = 8  # correspondences; with fewer, OpenCV does the whole search
OPENCV_SEED = 2**64 - 1  # of its RANSAC's random number generator
# correspondences scored between two checks whether the best can still be beaten
SCORING_BLOCK = 128
SMALLEST = np.finfo(float).tiny  # normal number


class _Points(NamedTuple):
    """What a search looks through: N correspondences, and when one of them is an inlier."""

    columns: np.ndarray  # (4, N), rows x, y, u, v
    columns32: np.ndarray  # (4, N), in single precision
    max_abs: np.ndarray  # (4,), largest absolute values of the columns
    limit: float  # of the squared Sampson distance, rounded to single precision
    threshold: float
    probability: float


class _Samples(NamedTuple):
    """The samples of a search, in the order in which OpenCV draws them.

    lower, upper: bounds of the number of inliers of OpenCV's best solution for a sample. They are 0
    if an earlier sample has surely as many, and -1 if the sample is not drawn yet.
    """

    indices: np.ndarray  # (MAX_BLOCKS * LANES, 5), of correspondences
    lower: np.ndarray  # (MAX_BLOCKS * LANES,)
    upper: np.ndarray
    random_state: np.ndarray  # (1,) uint64


MAX_BLOCKS = -(-MAX_SAMPLES // LANES)
RANDOM_STATE = np.array([OPENCV_SEED], np.uint64)
NO_WINNER = -1


class _Solution(NamedTuple):
    """OpenCV's best solution for a sample of five."""

    inliers: int  # among all correspondences
    matrix: np.ndarray | None  # 3x3
    mask: np.ndarray | None  # (N, 1) uint8


def find_essential_matrix(
    points1: np.ndarray,
    points2: np.ndarray,
    focal: float = 1.0,
    pp: tuple[float, float] = (0.0, 0.0),
    method: int = cv2.RANSAC,
    prob: float = 0.999,
    threshold: float = 1.0,
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Essential matrix and inliers, (E, mask), with the bits of cv2.findEssentialMat.

    The arguments are OpenCV's, but only normalised coordinates and RANSAC are served. points1,
    points2: correspondences (N, 2) or (N, 1, 2). E: 3x3, or OpenCV's stack of solutions for N = 5,
    or None. mask: (N, 1) uint8, or None.
    Raises ValueError for another camera or method, and for points that OpenCV refuses.
    """
    # OpenCV's other signature has a camera matrix in place of `focal`
    if np.ndim(focal) or focal != 1 or np.ravel(pp).tolist() != [0, 0] or method != cv2.RANSAC:
        raise ValueError(
            "find_essential_matrix: serves RANSAC on normalised coordinates, (pixel - pp) / focal, "
            "with the threshold divided by focal"
        )
    current, previous = as_pairs(points1, points2)
    columns = np.empty((4, len(current)))
    columns[:2], columns[2:] = current.T, previous.T
    solution, max_abs = None, np.abs(columns).max(axis=1, initial=0.0)
    if len(current) >= MIN_FOR_SHORTCUT and np.isfinite(max_abs).all():
        with np.errstate(over="ignore"):
            columns32 = columns.astype(np.float32)
        limit = float(np.float32(threshold * threshold))
        solution = _search(_Points(columns, columns32, max_abs, limit, threshold, prob))
    if solution is None:
        return _opencv(current, previous, threshold, prob)
    return solution.matrix, solution.mask


def is_compiled() -> bool:
    """Return whether an earlier use has compiled search and tracker, so that they only load."""
    return is_on_disk(_winner) and lucas_kanade.is_ready()


def draw_samples(points: int, samples: int) -> np.ndarray:
    """Indices (samples, 5) of the first samples that OpenCV's RANSAC draws from so many points."""
    indices, _ = _draw(RANDOM_STATE, points, samples)
    return indices


def _search(points: _Points) -> _Solution | None:
    """OpenCV's solution for the winning sample, or None if OpenCV has to do the whole search.

    None: no sample won, or the bounds were wrong.
    """
    not_drawn = np.full(MAX_BLOCKS * LANES, -1)
    indices = np.empty((MAX_BLOCKS * LANES, SAMPLE_SIZE), np.int64)
    samples = _Samples(indices, not_drawn, not_drawn.copy(), RANDOM_STATE.copy())
    solutions: dict[int, _Solution | None] = {NO_WINNER: None}  # OpenCV's, by sample
    while (winner := _winner(points, samples)) not in solutions:
        solution = _opencv_solution(points, indices[winner])
        if not samples.lower[winner] <= solution.inliers <= samples.upper[winner]:
            return None
        samples.lower[winner] = samples.upper[winner] = solution.inliers
        solutions[winner] = solution
    return solutions[winner]


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


def _opencv_solution(points: _Points, sample: np.ndarray) -> _Solution:
    """OpenCV's best solution for a sample of five, and its inliers among all correspondences."""
    five = np.ascontiguousarray(points.columns[:, sample].T)
    stack, _ = _opencv(five[:, :2], five[:, 2:], points.threshold, points.probability)
    if stack is None:
        return _Solution(0, None, None)
    masks = _inlier_masks(stack.reshape(-1, 9), points.columns, points.limit)
    inliers = masks.sum(axis=1)
    best = int(inliers.argmax())  # the first one if several are equal, as in OpenCV
    matrix = stack[3 * best : 3 * best + 3].copy()
    return _Solution(int(inliers[best]), matrix, masks[best].reshape(-1, 1))


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
def _draw(random_state, points, samples):
    """Draw samples as OpenCV does: indices (samples, 5), and the state of the generator (1,)."""
    low_bits = np.uint64(0xFFFFFFFF)
    state = random_state[0]
    indices = np.empty((samples, SAMPLE_SIZE), np.int64)
    for row in range(samples):
        taken = 0
        while taken < SAMPLE_SIZE:
            state = (state & low_bits) * np.uint64(4164903690) + (state >> np.uint64(32))
            index = np.int64((state & low_bits) % np.uint64(points))
            is_new = True
            for k in range(taken):
                is_new = is_new and indices[row, k] != index
            if is_new:
                indices[row, taken] = index
                taken += 1
    return indices, np.array([state])


@compiled
def _winner(points, samples):
    """The sample that wins if each has the most inliers that its bounds allow, or NO_WINNER.

    The real search goes at least as far: it stops later, the fewer inliers it has found. So a
    winner whose bounds are equal wins the real search, too. Samples are drawn when needed.
    """
    winner, most, needed = NO_WINNER, SAMPLE_SIZE - 1, MAX_SAMPLES
    for number in range(MAX_SAMPLES):
        if number >= needed:
            break
        if samples.upper[number] < 0:
            _draw_block(points, samples, number)
        if samples.upper[number] > most:  # the first one if several are equal, as in OpenCV
            winner, most = number, samples.upper[number]
            needed = _samples_needed(points, most)
    return winner


@inlined
def _samples_needed(points, inliers):
    """Number of samples among which one is free of outliers with the wanted probability."""
    count = points.columns.shape[1]
    outliers = (count - inliers) / count
    # probability that a sample has an outlier
    missed = 1.0 - math.pow(1.0 - outliers, float(SAMPLE_SIZE))
    if missed < SMALLEST:
        return 0
    log_missed = math.log(missed)
    log_failure = math.log(max(1.0 - points.probability, SMALLEST))
    if log_missed >= 0 or -log_failure >= MAX_SAMPLES * -log_missed:
        return MAX_SAMPLES
    return round(log_failure / log_missed)


@partial(compiled, inline="always")  # which compiles `solve` into one function less
def _draw_block(points, samples, start):
    """Draw LANES samples, the first one being number `start`, and solve them for their bounds."""
    indices, state = _draw(samples.random_state, points.columns.shape[1], LANES)
    samples.random_state[0] = state[0]
    for lane in range(LANES):
        for k in range(SAMPLE_SIZE):  # an assignment of the array would take seconds to compile
            samples.indices[start + lane, k] = indices[lane, k]
    solutions = solve(correspondences(points.columns, indices))
    # as in OpenCV, a sample counts only if its own five correspondences are inliers
    best = max(SAMPLE_SIZE - 1, samples.lower.max())
    for lane in range(LANES):
        lower, upper = _inliers_of_sample(points, solutions, lane, best)
        samples.lower[start + lane], samples.upper[start + lane] = lower, upper
        best = max(best, lower)


@inlined
def _inliers_of_sample(points, solutions, lane, best):
    """Bounds of the number of inliers of a sample's best solution.

    (0, 0) if it never has more than `best`.
    """
    if not solutions.sure[lane]:
        return 0, points.columns.shape[1]
    lower, upper = 0, 0
    for k in range(solutions.counts[lane]):
        matrix, margin = solutions.matrices[lane, k], solutions.margins[lane, k]
        if _may_beat(matrix, margin, points, max(best, lower)):
            low, high = _bounds(matrix, margin, points, max(best, lower))
            lower = max(lower, low)
            upper = max(upper, high)
    return lower, upper


@inlined
def _may_beat(e, margin, points, best):
    """False if surely no matrix within the margin of e has more than `best` inliers.

    This test runs in single precision. It compares `algebraic` alone with the largest value that
    an inlier anywhere within max_abs can have. That decides nearly always, because most solutions
    are far off.
    """
    x, y, u, v = points.columns32[0], points.columns32[1], points.columns32[2], points.columns32[3]
    count = len(x)
    allowed = count - best  # outliers
    largest = np.float32(1.00001 * _largest_of_inliers(e, margin, points.max_abs, points.limit))
    e0, e1, e2 = np.float32(e[0]), np.float32(e[1]), np.float32(e[2])
    e3, e4, e5 = np.float32(e[3]), np.float32(e[4]), np.float32(e[5])
    e6, e7, e8 = np.float32(e[6]), np.float32(e[7]), np.float32(e[8])
    matrix = e0, e1, e2, e3, e4, e5, e6, e7, e8
    outliers = 0
    for start in range(0, count, SCORING_BLOCK):
        stop = min(start + SCORING_BLOCK, count)
        outliers += _surely_out(
            matrix, largest, x[start:stop], y[start:stop], u[start:stop], v[start:stop]
        )
        if outliers >= allowed:
            return False
    return True


@inlined
def _largest_of_inliers(e, margin, max_abs, limit):
    """Bound of |algebraic| of an inlier, as computed from e in single precision."""
    x, y, u, v = max_abs[0], max_abs[1], max_abs[2], max_abs[3]
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
def _bounds(e, margin, points, best):
    """Least and most inliers that any matrix within the margin of e has.

    (0, 0) if it never has more than `best`.
    """
    x, y, u, v = points.columns[0], points.columns[1], points.columns[2], points.columns[3]
    count = len(x)
    matrix, root = epipolar.entries(e), np.sqrt(points.limit)
    lower, upper = 0, 0
    for start in range(0, count, SCORING_BLOCK):
        stop = min(start + SCORING_BLOCK, count)
        low, high = _bounds_of_block(
            matrix, margin, root, x[start:stop], y[start:stop], u[start:stop], v[start:stop]
        )
        lower += low
        upper += high
        if upper + count - stop <= best:
            return 0, 0
    return lower, upper


@inlined
def _bounds_of_block(matrix, margin, root, x, y, u, v):
    """Least and most inliers of `_bounds` in one block, whose loop is vectorised."""
    lower, upper = 0, 0
    for k in range(len(x)):
        is_surely, is_maybe = _is_inlier(matrix, margin, root, x[k], y[k], u[k], v[k])
        lower += is_surely
        upper += is_maybe
    return lower, upper


@inlined
def _is_inlier(matrix, margin, root, x, y, u, v):
    """Whether a correspondence is an inlier of all matrices within the margin, and of any of them.

    root: of the limit.
    """
    algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(matrix, x, y, u, v)
    largest = root * np.sqrt(l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)  # |algebraic| of an inlier
    doubt = _change(margin, root, x, y, u, v) + 1e-6 * (abs(algebraic) + largest)
    return abs(algebraic) < largest - doubt, abs(algebraic) <= largest + doubt


@inlined
def _change(margin, root, x, y, u, v):
    """How much |algebraic| minus `largest` (_is_inlier) may change within the margin.

    By Cauchy and Schwarz: a matrix of norm `margin` changes (u, v, 1) E (x, y, 1)^T by at most the
    margin times the lengths of both vectors, and each epipolar line by at most the margin times
    the length of its vector.
    """
    current = 1 + x * x + y * y
    previous = 1 + u * u + v * v
    return margin * (np.sqrt(current * previous) + root * np.sqrt(current + previous))
