"""RANSAC returns the same bits as cv2.findEssentialMat."""

import cv2
import numba
import numpy as np
import pytest

from opencv_exact import ransac, real_roots, rounding
from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import THESIS, pose


def opencv(current, previous, threshold=THESIS.threshold, probability=pose.PROBABILITY):
    return cv2.findEssentialMat(
        current,
        previous,
        focal=1.0,
        pp=(0.0, 0.0),
        method=cv2.RANSAC,
        prob=probability,
        threshold=threshold,
    )


def scene(random, count, outliers=0.3, noise=2e-4, motion=1.0, depth=(4, 40), turn=0.02):
    """Correspondences (current, previous) of a camera that moves forward by `motion`.

    The first ones are outliers.
    """
    points = random.uniform([-10, -3, depth[0]], [10, 3, depth[1]], (count, 3))
    rotation = cv2.Rodrigues(random.normal(0, turn, 3))[0]
    moved = points @ rotation.T - motion * (np.array([0, 0, 1]) + random.normal(0, 0.05, 3))
    previous, current = (side[:, :2] / side[:, 2:] for side in (points, moved))
    current = current + random.normal(0, noise, current.shape)
    wrong = int(outliers * count)
    current[:wrong] = random.permutation(current[:wrong])
    return current, previous


def assert_same_bits(current, previous, threshold=THESIS.threshold, probability=pose.PROBABILITY):
    expected, expected_mask = opencv(current, previous, threshold, probability)
    matrix, mask = ransac.find_essential_matrix(current, previous, threshold, probability)
    if expected is None:
        assert matrix is None
        return False
    np.testing.assert_array_equal(matrix, expected)
    np.testing.assert_array_equal(mask, expected_mask)
    assert mask.dtype == expected_mask.dtype
    return True


@pytest.mark.parametrize("count", [5, 6, 7, 8, 9, 20, 100, 700, 2000])
@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_same_bits_as_opencv(count, outliers):
    random = np.random.default_rng((count, int(10 * outliers)))
    assert any(
        [
            assert_same_bits(*scene(random, count, outliers, noise))
            for noise in (0.0, 1e-6, 1e-4, 1e-3)
        ]
    )


KINDS = {
    "sideways, flat": lambda random: scene(random, 300, depth=(20, 20)),
    "hardly moving": lambda random: scene(random, 300, motion=1e-3),
    "turning only": lambda random: scene(random, 300, motion=0.0, turn=0.1),
    "turning only, exact": lambda random: scene(
        random, 300, outliers=0.0, noise=0.0, motion=0.0, turn=0.1
    ),
    "standing": lambda random: scene(random, 300, outliers=0.0, noise=1e-6, motion=0.0, turn=0.0),
    "standing exactly": lambda random: scene(
        random, 300, outliers=0.0, noise=0.0, motion=0.0, turn=0.0
    ),
    "nonsense": lambda random: (random.uniform(-1, 1, (100, 2)), random.uniform(-1, 1, (100, 2))),
    "all equal": lambda random: (np.full((50, 2), 0.25), np.full((50, 2), 0.25)),
    "on a line": lambda random: (np.repeat(random.uniform(-1, 1, (60, 1)), 2, axis=1),) * 2,
    "in pairs": lambda random: tuple(np.repeat(side, 2, axis=0) for side in scene(random, 100)),
    "three places": lambda random: tuple(np.repeat(side, 20, axis=0) for side in scene(random, 3)),
    "on a grid": lambda random: tuple(np.round(side, 1) for side in scene(random, 200)),
    "not a number": lambda random: tuple(
        np.where(np.arange(100)[:, None] == 7, np.nan, side) for side in scene(random, 100)
    ),
    "far": lambda random: tuple(side * 1e6 for side in scene(random, 100)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_degenerate_correspondences_give_opencvs_bits(kind):
    for seed in range(3):
        assert_same_bits(*KINDS[kind](np.random.default_rng(seed)))


def test_other_thresholds_and_probabilities():
    random = np.random.default_rng(0)
    for threshold in (1e-17, 1e-6, 1e-4, 4e-4, 1e-2):  # nothing meets the first
        for count in (8, 60, 400):
            assert_same_bits(*scene(random, count), threshold)
    for probability in (0.5, 0.99, 0.999999):
        assert_same_bits(*scene(random, 400), probability=probability)


def test_few_samples_are_solved_by_opencv(monkeypatch):
    """This makes the search fast: OpenCV never does the whole search."""
    real, sizes = cv2.findEssentialMat, []

    def noting(points, *arguments, **options):
        sizes.append(len(points))
        return real(points, *arguments, **options)

    current, previous = scene(np.random.default_rng(1), 1000, outliers=0.5)
    monkeypatch.setattr(cv2, "findEssentialMat", noting)
    ransac.find_essential_matrix(current, previous, THESIS.threshold, pose.PROBABILITY)
    assert 0 < len(sizes) < 60 and set(sizes) == {5}  # of about 200 samples


def test_opencv_does_the_whole_search_if_the_bounds_were_wrong(monkeypatch):
    wrong = ransac._Solution(1, None, None)
    monkeypatch.setattr(ransac, "_opencv_solution", lambda *arguments: wrong)
    assert assert_same_bits(*scene(np.random.default_rng(2), 500))


@pytest.mark.parametrize(
    ("options", "fewest", "most_unsure"),
    [
        ({}, 1200, 20),
        ({"depth": (20, 20)}, 600, 90),
        ({"motion": 1e-2}, 450, 200),
        ({"motion": 0.0, "turn": 0.1}, 350, 210),
    ],
    ids=["ahead", "flat", "hardly moving", "turning only"],
)
def test_solutions_lie_well_within_their_margins_of_opencvs(options, fewest, most_unsure):
    random, shares, unsure, ill_conditioned = np.random.default_rng(3), [], 0, 0
    solutions = rounding.no_solutions()
    for _ in range(19):
        samples = [scene(random, 5, outliers=0.0, **options) for _ in range(real_roots.LANES)]
        rounding.solve(np.stack([np.hstack(sample) for sample in samples], axis=-1), solutions)
        for lane, sample in enumerate(samples):
            count = solutions.counts[lane]
            margins = solutions.margins[lane, :count]
            if not solutions.sure[lane] or (margins >= rounding.WELL_CONDITIONED).any():
                unsure += 1
            if not solutions.sure[lane]:
                assert not count
                continue
            stack, _ = opencv(*sample, 1e-3)
            matrices = np.empty((0, 9)) if stack is None else stack.reshape(-1, 9)
            assert len(matrices) == count
            ours = solutions.matrices[lane, :count]
            ill_conditioned += (margins >= rounding.WELL_CONDITIONED).sum()
            for matrix in matrices:
                distances = np.minimum(
                    np.linalg.norm(ours - matrix, axis=1), np.linalg.norm(ours + matrix, axis=1)
                )
                shares.append((distances / margins).min())
    assert len(shares) > fewest and max(shares) < 0.7 and unsure < most_unsure
    assert ill_conditioned > 0  # these are among the shares


def test_a_sample_has_the_same_solutions_in_every_lane_and_company():
    random, lanes = np.random.default_rng(5), real_roots.LANES
    samples = [np.hstack(scene(random, 5, outliers=0.0)) for _ in range(lanes)]
    fives = np.stack(samples, axis=-1)
    fives[1, :, 3] = fives[0, :, 3]  # not solvable
    together = rounding.no_solutions()
    rounding.solve(fives, together)
    assert not together.sure[3] and together.sure.sum() >= lanes - 2
    for shift in range(1, lanes):
        moved = rounding.no_solutions()
        rounding.solve(np.roll(fives, shift, axis=-1), moved)
        np.testing.assert_array_equal(np.roll(together.counts, shift), moved.counts)
        for lane in range(lanes):
            kept = moved.counts[(lane + shift) % lanes]
            np.testing.assert_array_equal(
                together.matrices[lane, :kept], moved.matrices[(lane + shift) % lanes, :kept]
            )


@numba.njit(error_model="numpy")
def bounds(e, margin, columns, limit):
    return ransac._bounds(e, margin, columns, limit, -1)


@numba.njit(error_model="numpy")
def may_beat(e, margin, columns, limit, best):
    extents = np.array([np.abs(columns[k]).max() for k in range(4)])
    return ransac._may_beat(e, margin, columns.astype(np.float32), extents, limit, best)


def test_bounds_hold_for_the_worst_matrices_within_the_margin():
    """The matrices are moved by the margin in the direction that changes one point most."""
    margin, limit = 3e-5, np.float32(THESIS.threshold**2)
    random = np.random.default_rng(4)
    current, previous = scene(random, 400)
    matrix, _ = ransac.find_essential_matrix(current, previous, THESIS.threshold, pose.PROBABILITY)
    e = matrix.ravel() / np.linalg.norm(matrix)
    columns = np.vstack([current.T, previous.T])
    low, high = bounds(e, margin, columns, limit)
    assert 100 < low < high < 350
    sure = 0
    for k in range(columns.shape[1]):
        direction = np.outer([*previous[k], 1], [*current[k], 1]).ravel()
        direction *= margin / np.linalg.norm(direction)
        masks = ransac._inlier_masks(np.stack([e - direction, e + direction]), columns, limit)
        for inliers in masks.sum(axis=1):
            assert low <= inliers <= high
            assert may_beat(e, margin, columns, limit, inliers - 1)
        fewest, most = bounds(e, margin, columns[:, k : k + 1].copy(), limit)
        assert fewest <= masks[:, k].min() and masks[:, k].max() <= most
        sure += fewest == most
    assert sure == 400 - (high - low)
    assert not may_beat(e, margin, columns, limit, 399)


@pytest.mark.real
@pytest.mark.parametrize("name", ["00", "05", "06"])
def test_same_bits_on_real_frames(kitti_real, name, monkeypatch):
    # now, so that it adds no pair; lru_cache knows only the positional call
    odometry.odometry.warm_up(False)
    pairs, real = [], ransac.find_essential_matrix

    def noting(current, previous, *arguments):
        pairs.append((current, previous))
        return real(current, previous, *arguments)

    monkeypatch.setattr(ransac, "find_essential_matrix", noting)
    odometry.run(Sequence(kitti_real, name).subset(12))
    monkeypatch.undo()
    assert len(pairs) == 11
    random = np.random.default_rng(0)
    for current, previous in pairs:
        order = random.permutation(len(current))
        assert assert_same_bits(current, previous)
        assert assert_same_bits(current[order[:200]], previous[order[:200]])
