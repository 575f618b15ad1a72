"""The exact search and the vote return the same bits as OpenCV's, in all kinds of scenes."""

import os
import platform
import sys
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest
from trials import succeed

from opencv_exact import find_essential_matrix, ransac, recover_pose, solve_five_points
from opencv_exact.real_roots import LANES
from opencv_exact.solver import WELL_CONDITIONED

pytestmark = pytest.mark.slow
THRESHOLD, PROBABILITY = 0.0003, 0.999
REFERENCE = Path(__file__).parents[1] / "reference"  # matched points of real frames


def opencv(current, previous, threshold=THRESHOLD, probability=PROBABILITY):
    return cv2.findEssentialMat(
        current, previous, 1.0, (0.0, 0.0), cv2.RANSAC, probability, threshold
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


def assert_same_bits(current, previous, threshold=THRESHOLD, probability=PROBABILITY):
    expected, expected_mask = opencv(current, previous, threshold, probability)
    matrix, mask = find_essential_matrix(current, previous, prob=probability, threshold=threshold)
    if expected is None:
        assert matrix is None
        return False
    np.testing.assert_array_equal(matrix, expected)
    np.testing.assert_array_equal(mask, expected_mask)
    assert mask.dtype == expected_mask.dtype
    if matrix.shape == (3, 3):  # of five points there may be several
        ours = recover_pose(matrix, current, previous)
        for own, other in zip(ours, cv2.recoverPose(matrix, current, previous), strict=True):
            np.testing.assert_array_equal(own, other)
            assert np.shape(own) == np.shape(other)
        assert ours[3].dtype == np.uint8
    return True


@pytest.mark.bits
@pytest.mark.parametrize("path", sorted(REFERENCE.glob("*.npz")), ids=lambda path: path.stem)
def test_matched_points_of_real_frames_give_opencvs_bits(path):
    """All points of each step, and 200 of them in another order."""
    random, steps = np.random.default_rng(0), np.load(path)
    camera, ends = steps["camera"], np.cumsum(steps["matches"])[:-1]
    sides = [
        np.split((steps[side] - camera[:2, 2]) / np.diag(camera)[:2], ends)
        for side in ("current", "previous")
    ]
    for current, previous in zip(*sides, strict=True):
        few = random.permutation(len(current))[:200]
        assert assert_same_bits(current, previous)
        assert_same_bits(current[few], previous[few])


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
    "backwards": lambda random: scene(random, 300, depth=(4, 80))[::-1],
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
    thresholds = [1e-6, 1e-4, 4e-4, 1e-2]
    if platform.machine() == "x86_64":  # elsewhere rounding decides what meets this one
        thresholds.append(1e-17)
    for threshold in thresholds:
        for count in (8, 60, 200):
            assert_same_bits(*scene(random, count), threshold)
    for probability in (0.5, 0.99, 0.999999):
        assert_same_bits(*scene(random, 200), probability=probability)


def test_other_inputs_are_served_as_opencv_does_or_refused():
    current, previous = scene(np.random.default_rng(5), 100)
    stacked = [np.float32(side).reshape(-1, 1, 2) for side in (current, previous)]
    assert assert_same_bits(*stacked)
    camera = np.diag([700.0, 700, 1])  # cv2 takes one in the place of the focal length
    for options in (
        {"focal": 700.0},
        {"focal": camera},
        {"pp": (600.0, 180.0)},
        {"method": cv2.LMEDS},
    ):
        with pytest.raises(ValueError, match="normalised"):
            find_essential_matrix(current, previous, **options)


def test_few_samples_are_solved_by_opencv(monkeypatch):
    """This makes the search fast: OpenCV never does the whole search."""
    real, sizes = cv2.findEssentialMat, []

    def noting(points, *arguments, **options):
        sizes.append(len(points))
        return real(points, *arguments, **options)

    current, previous = scene(np.random.default_rng(1), 1000, outliers=0.5)
    monkeypatch.setattr(cv2, "findEssentialMat", noting)
    find_essential_matrix(current, previous, prob=PROBABILITY, threshold=THRESHOLD)
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
    random, shares = np.random.default_rng(3), []
    samples = [scene(random, 5, outliers=0.0, **options) for _ in range(19 * LANES)]
    solutions = solve_five_points(*(np.array(side) for side in zip(*samples)))
    unsure = 0
    for k, sample in enumerate(samples):
        count = solutions.counts[k]
        margins = solutions.margins[k, :count]
        unsure += not solutions.sure[k] or (margins >= WELL_CONDITIONED).any()
        if not solutions.sure[k]:
            assert not count
            continue
        stack, _ = opencv(*sample, 1e-3)
        matrices = np.empty((0, 9)) if stack is None else stack.reshape(-1, 9)
        assert len(matrices) == count
        ours = solutions.matrices[k, :count]
        for matrix in matrices:
            same_sign = np.linalg.norm(ours - matrix, axis=1)
            distances = np.minimum(same_sign, np.linalg.norm(ours + matrix, axis=1))
            shares.append((distances / margins).min())
    assert len(shares) > fewest and max(shares) < 0.7 and unsure < most_unsure


@numba.njit(error_model="numpy")
def bounds(e, margin, points):
    return ransac._bounds(e, margin, points, -1)


@numba.njit(error_model="numpy")
def may_beat(e, margin, points, best):
    return ransac._may_beat(e, margin, points, best)


def searched(columns):
    limit = float(np.float32(THRESHOLD**2))
    max_abs = np.abs(columns).max(axis=1)
    return ransac._Points(
        columns, columns.astype(np.float32), max_abs, limit, THRESHOLD, PROBABILITY
    )


def test_bounds_hold_for_the_worst_matrices_within_the_margin():
    """The matrices are moved by the margin in the direction that changes one point most."""
    margin = 3e-5
    current, previous = scene(np.random.default_rng(4), 400)
    matrix, _ = find_essential_matrix(current, previous, prob=PROBABILITY, threshold=THRESHOLD)
    e = matrix.ravel() / np.linalg.norm(matrix)
    points = searched(np.vstack([current.T, previous.T]))
    lower, upper = bounds(e, margin, points)
    assert 100 < lower < upper < 350
    sure = 0
    for k in range(400):
        direction = np.outer([*previous[k], 1], [*current[k], 1]).ravel()
        direction *= margin / np.linalg.norm(direction)
        matrices = np.stack([e - direction, e + direction])
        masks = ransac._inlier_masks(matrices, points.columns, points.limit)
        for inliers in masks.sum(axis=1):
            assert lower <= inliers <= upper
            assert may_beat(e, margin, points, inliers - 1)
        fewest, most = bounds(e, margin, searched(points.columns[:, k : k + 1].copy()))
        assert fewest <= masks[:, k].min() and masks[:, k].max() <= most
        sure += fewest == most
    assert sure == 400 - (upper - lower)
    assert not may_beat(e, margin, points, 399)


def test_a_change_in_another_module_is_compiled_and_a_new_date_is_not(tmp_path):
    outer = "from opencv_exact.compiling import compiled\nfrom adding import add\n"
    (tmp_path / "outer.py").write_text(f"{outer}@compiled\ndef f(x):\n    return add(x)\n")
    inner = "from opencv_exact.compiling import inlined\n@inlined\ndef add(x):\n    return x + "
    results = []
    for number, date in ((1, 1), (1, 2), (2, 2)):
        (tmp_path / "adding.py").write_text(f"{inner}{number}\n")
        for name in ("outer.py", "adding.py"):
            os.utime(tmp_path / name, (date, date))
        result = succeed(
            [sys.executable, "-c", "from outer import f; print(f(1.0), len(f.stats.cache_hits))"],
            tmp_path,
            PYTHONDONTWRITEBYTECODE=1,  # Python's own cache goes by date and size
        )
        results.append(result.stdout.strip())
    assert results == ["2.0 0", "2.0 1", "3.0 0"]
