"""cv2.findEssentialMat with RANSAC to the last bit, several times faster.

Nearly all of OpenCV's time goes into the five-point solver, most of it into finding all ten complex roots of a
polynomial by an iteration that runs to its last round although the roots settled long before. Of all these solutions
RANSAC keeps one. So the search goes like this:

1. Samples of five correspondences are drawn with OpenCV's generator of random numbers.
2. `rounding.solve` solves a sample quickly. Its solutions are not OpenCV's to the last bit, but it gives a margin for
   the difference, and with it bounds of the number of inliers. A look in single precision rules out most solutions.
3. OpenCV itself solves the samples for which the bounds leave open whether they are better than the best so far, and
   the winner.
4. If the winner's inliers are not as many as the bounds say, OpenCV does everything.

The margin is an estimate with room to spare, not a proof; the tests compare with OpenCV.
"""

import math

import cv2
import numpy as np

from thesis_repro.compiled import fast, inner
from thesis_repro.odometry.opencv_exact import epipolar
from thesis_repro.odometry.opencv_exact.five_point import SAMPLE_SIZE
from thesis_repro.odometry.opencv_exact.rounding import solve

MAX_SAMPLES = 1000
MIN_FOR_SHORTCUT = 8  # correspondences; with fewer there are so few samples that OpenCV solves them all
OPENCV_SEED = 2**64 - 1  # of its RANSAC
SCORING_BLOCK = 128  # correspondences scored between two looks at whether the best can still be beaten


def find_essential_matrix(current: np.ndarray, previous: np.ndarray, threshold: float,
                          probability: float) -> tuple[np.ndarray | None, np.ndarray | None]:
    """cv2.findEssentialMat(current, previous, focal=1, pp=(0, 0), cv2.RANSAC, probability, threshold): (E, mask).

    Correspondences are (N, 2) float64 in normalised coordinates. E is 3x3, or OpenCV's stack of solutions for N = 5,
    or None; mask is (N, 1) uint8 as OpenCV returns it, or None.
    """
    count = len(current)
    columns = np.stack([*current.T, *previous.T])
    if count < MIN_FOR_SHORTCUT or not np.isfinite(columns).all():
        return _opencv(current, previous, threshold, probability)
    limit = np.float32(threshold * threshold)
    rough = _single_precision(columns)

    def solve_exactly(sample):
        return _opencv_solution(columns, sample, threshold, probability, limit)

    # The best so far has between `low` and `high` inliers; which of them matters only when another comes near it, or
    # when it decides whether the search ends. `solution` is OpenCV's for the sample `winner`, once it was asked.
    state, drawn, low, high, winner, solution = OPENCV_SEED, 0, SAMPLE_SIZE - 1, SAMPLE_SIZE - 1, None, None
    while True:
        enough = MAX_SAMPLES if winner is None else _samples_needed(probability, (count - high) / count)
        state, drawn, sample, fewest, most = _next_better(columns, rough, float(limit), np.uint64(state), drawn,
                                                          enough, low)
        if most > low and fewest > high:
            low, high, winner, solution = fewest, most, sample, None
            continue
        if winner is not None and solution is None and (most == 0 or low < high):
            solution = solve_exactly(winner)
            if not low <= solution[0] <= high:
                return _opencv(current, previous, threshold, probability)
            low = high = solution[0]
        elif most == 0:
            break
        if most > low:
            challenger = solve_exactly(sample)
            if challenger[0] > low:
                low, high, winner, solution = challenger[0], challenger[0], sample, challenger
    return _opencv(current, previous, threshold, probability) if solution is None else solution[1:]


def _opencv(current, previous, threshold, probability):
    return cv2.findEssentialMat(current, previous, focal=1.0, pp=(0.0, 0.0), method=cv2.RANSAC, prob=probability,
                                threshold=threshold)


def _opencv_solution(columns, sample, threshold, probability, limit):
    """OpenCV's first best solution for five correspondences: its inliers among all, the matrix, the mask."""
    five = np.ascontiguousarray(columns[:, sample].T)
    stack, _ = _opencv(five[:, :2], five[:, 2:], threshold, probability)
    if stack is None:
        return 0, None, None
    masks = _inlier_masks(stack.reshape(-1, 9), columns, limit)
    inliers = masks.sum(axis=1)
    best = int(inliers.argmax())  # the first of equals, as in OpenCV
    return int(inliers[best]), stack[3 * best:3 * best + 3].copy(), masks[best].reshape(-1, 1)


def _samples_needed(probability, outliers):
    """Samples of five for one without outliers to be among them with that probability."""
    missed = 1.0 - math.pow(1.0 - outliers, SAMPLE_SIZE)
    if missed < np.finfo(float).tiny:
        return 0
    needed, missed = math.log(max(1.0 - probability, np.finfo(float).tiny)), math.log(missed)
    return MAX_SAMPLES if missed >= 0 or -needed >= MAX_SAMPLES * -missed else round(needed / missed)


def _single_precision(columns):
    """Correspondences in single precision, and how much an error of a matrix's entries may matter to each: (5, N)."""
    x, y, u, v = np.abs(columns)
    with np.errstate(over="ignore"):
        return np.vstack([columns, (1 + x + y) * (1 + u + v)]).astype(np.float32)


@fast
def _inlier_masks(matrices, columns, limit):
    """(K, N) of 0 or 1 for K matrices: whether the squared Sampson distance, rounded to float32, is in the limit."""
    masks = np.empty((len(matrices), columns.shape[1]), np.uint8)
    for index in range(len(matrices)):
        matrix = epipolar.entries(matrices[index])
        for k in range(columns.shape[1]):
            algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(matrix, columns[0, k], columns[1, k], columns[2, k],
                                                               columns[3, k])
            distance = algebraic * algebraic / (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)
            masks[index, k] = np.float32(distance) <= limit
    return masks


@inner
def draw(state, columns, sample, five):
    """Write five correspondences, drawn as OpenCV does: indices and rows; returns the generator's state."""
    count, taken = columns.shape[1], 0
    while taken < SAMPLE_SIZE:
        state = (state & np.uint64(0xFFFFFFFF)) * np.uint64(4164903690) + (state >> np.uint64(32))
        index = np.int64((state & np.uint64(0xFFFFFFFF)) % np.uint64(count))
        new = True
        for k in range(taken):
            new = new and sample[k] != index
        if new:
            sample[taken] = index
            for j in range(4):
                five[taken, j] = columns[j, index]
            taken += 1
    return state


@fast
def _next_better(columns, rough, limit, state, drawn, samples, best):
    """Draw samples until one may have more than `best` inliers, or until there are `samples` of them.

    Returns the generator's state, the number of samples drawn, the five indices, and the bounds between which the
    number of inliers of the sample's best solution lies, 0 and 0 where there is none that may be better.
    """
    count = columns.shape[1]
    sample = np.empty(SAMPLE_SIZE, np.int64)
    five = np.empty((SAMPLE_SIZE, 4))
    while drawn < samples:
        drawn += 1
        state = draw(state, columns, sample, five)
        sure, solutions, margins = solve(five)
        if not sure:
            return state, drawn, sample, 0, count
        low, high = 0, 0
        for k in range(len(solutions)):
            if not _may_beat(solutions[k], margins[k], rough, limit, max(best, low)):
                continue
            fewest, most = _bounds(solutions[k], margins[k], columns, limit, max(best, low))
            low, high = max(low, fewest), max(high, most)
        if high > best:
            return state, drawn, sample, low, high
    return state, drawn, sample, 0, 0


@fast
def _may_beat(e, margin, rough, limit, best):
    """False if no matrix within the margin of e has more than `best` inliers: a look in single precision."""
    count, allowed = rough.shape[1], rough.shape[1] - best
    root = np.sqrt(limit)
    # What the margin (see _bounds_of_block) and nine roundings of 2^-24 may change: `algebraic`, and `root` times the
    # root of the sum of squares. The rounding of what is made of those two is in `wide`.
    doubt = np.float32(4.001 * margin + 1e-6 * (1 + root))
    wide = np.float32(1.00001 * limit)
    matrix = epipolar.entries(e.astype(np.float32))
    outliers = 0
    for start in range(0, count, SCORING_BLOCK):
        stop = min(start + SCORING_BLOCK, count)
        outliers += _surely_out(matrix, doubt, wide, rough[0, start:stop], rough[1, start:stop], rough[2, start:stop],
                                rough[3, start:stop], rough[4, start:stop])
        if outliers >= allowed:
            return False
    return True


@inner
def _surely_out(matrix, doubt, limit, x, y, u, v, reach):
    outliers = np.int32(0)  # as wide as the numbers, so that several are counted at once
    for k in range(len(x)):
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(matrix, x[k], y[k], u[k], v[k])
        least = max(abs(algebraic) - doubt * reach[k], np.float32(0))
        outliers = np.int32(outliers + np.int32(least * least > limit * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)))
    return outliers


@inner
def _bounds(e, margin, columns, limit, best):
    """Inliers that any matrix within the margin of e has at least and at most; 0 and 0 where not above `best`."""
    count = columns.shape[1]
    low, high = 0, 0
    for start in range(0, count, SCORING_BLOCK):
        stop = min(start + SCORING_BLOCK, count)
        few, many = _bounds_of_block(e, margin, columns[0, start:stop], columns[1, start:stop], columns[2, start:stop],
                                     columns[3, start:stop], limit)
        low += few
        high += many
        if high + count - stop <= best:
            return 0, 0
    return low, high


@inner
def _bounds_of_block(e, margin, x, y, u, v, limit):
    root = np.sqrt(limit)
    matrix = epipolar.entries(e)
    low, high = 0, 0
    for k in range(len(x)):
        algebraic, l0, l1, m0, m1 = epipolar.sampson_terms(matrix, x[k], y[k], u[k], v[k])
        excess = algebraic * algebraic - limit * (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1)
        # Both |algebraic| and the root of the other term change by less than `change`.
        change = 2 * margin * (1 + abs(x[k]) + abs(y[k])) * (1 + abs(u[k]) + abs(v[k]))
        size = abs(algebraic) + root * (abs(l0) + abs(l1) + abs(m0) + abs(m1)) + change
        doubt = 2 * change * size + 1e-6 * size * size
        low += 1 if excess < -doubt else 0
        high += 1 if excess <= doubt else 0
    return low, high
