"""The tracker in lanes returns the same bits as OpenCV's, in all kinds of frames."""

import itertools
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from trials import succeed

from opencv_exact import lucas_kanade, reason_for_opencv, track

pytestmark = [pytest.mark.slow, pytest.mark.bits]
SHARED = Path(__file__).parents[3] / "shared" / "data" / "kitti" / "sequences"
EIGENVALUES = cv2.OPTFLOW_LK_GET_MIN_EIGENVALS


def differences(previous, current, points, flags=(0, EIGENVALUES), **options):
    """Return the numbers of points compared, of those lost, and of those that differ."""
    points = np.ascontiguousarray(points, np.float32)
    counts = np.zeros(3, int)
    for flag in flags:
        expected = cv2.calcOpticalFlowPyrLK(previous, current, points, None, flags=flag, **options)
        results = track(previous, current, points, flags=flag, **options)
        for result, other in zip(results, expected, strict=True):
            assert result.dtype == other.dtype and result.shape == other.shape
        found = expected[1].ravel() == 1
        same = (results[0].view(np.int32) == expected[0].view(np.int32)) | (
            np.isnan(results[0]) & np.isnan(expected[0])
        )
        same = same.all(axis=1) & (results[1] == expected[1]).ravel()
        # OpenCV leaves the mean difference of a lost point undefined
        same &= (results[2] == expected[2]).ravel() | (~found & (flag == 0))
        counts += len(points), (~found).sum(), (~same).sum()
    return counts


def compared(pairs):
    """Return the sum of `differences` over pairs of frames with points."""
    return np.sum([differences(*pair) for pair in pairs], axis=0)


def near_borders(random, shape, count):
    """Points within twelve pixels of one of the four sides, in and out."""
    height, width = shape
    points = random.uniform((0, 0), (width, height), (count, 2))
    side, distance = random.integers(0, 4, count), random.uniform(-12, 12, count)
    points[side == 0, 0] = distance[side == 0]
    points[side == 1, 1] = distance[side == 1]
    points[side == 2, 0] = width - distance[side == 2]
    points[side == 3, 1] = height - distance[side == 3]
    return points


def street(random, count=3, shape=(200, 333)):
    """Blurred noise that moves by a few pixels a frame, with noise of its own."""
    picture = cv2.GaussianBlur(random.integers(0, 256, shape).astype(np.float32), (0, 0), 2)
    picture = 8 * (picture - 128) + 128
    for number in range(count):
        moved = np.roll(picture, (2 * number, 5 * number), (0, 1))
        yield np.clip(moved + random.normal(0, 3, shape), 0, 255).astype(np.uint8)


def all_kinds(random, previous, current, count):
    """Points of all kinds on two frames."""
    height, width = previous.shape
    corners = cv2.goodFeaturesToTrack(previous, count, 1e-4, 3)
    if corners is not None:
        yield previous, current, corners.reshape(-1, 2)
    yield previous, current, random.uniform((-30, -30), (width + 30, height + 30), (count, 2))
    borders = near_borders(random, previous.shape, count)
    yield previous, current, borders
    yield previous, current, np.round(borders)


def made_up(random, count):
    """Pairs of frames that no camera takes, with points."""
    first, second = random.integers(0, 256, (2, 200, 333), np.uint8)
    points = random.uniform((0, 0), (333, 200), (count, 2))
    yield first, second, points
    black_and_white = [(side > 127).astype(np.uint8) * 255 for side in (first, second)]
    yield *black_and_white, points
    blocks = [
        cv2.resize(side[:40, :60], (333, 200), interpolation=cv2.INTER_NEAREST)
        for side in black_and_white
    ]
    yield *blocks, points
    yield blocks[0], np.roll(blocks[0], 3, 1), points
    for height, width in ((22, 22), (30, 50), (45, 44), (89, 200), (21, 60), (5, 7), (1, 1)):
        sides = [np.ascontiguousarray(side[:height, :width]) for side in (first, second)]
        yield *sides, random.uniform((-5, -5), (width + 5, height + 5), (count // 15, 2))
    yield first, first, points
    yield 0 * first, 0 * first + 7, points


def test_rendered_and_made_up_frames_give_opencvs_bits():
    random = np.random.default_rng(0)
    frames = list(street(random))
    pairs = [
        pair
        for previous, current in itertools.pairwise(frames)
        for pair in all_kinds(random, previous, current, 400)
    ]
    points, lost, different = compared([*pairs, *made_up(random, 300)])
    assert points > 10_000 and 1_000 < lost < points / 2 and different == 0


@pytest.mark.real
@pytest.mark.torture
def test_300000_points_of_real_and_made_up_frames_give_opencvs_bits(kitti_real):
    random, totals = np.random.default_rng(1), np.zeros(3, int)
    for name in ("00", "01", "04", "06", "07"):
        paths = sorted((SHARED / name / "image_0").glob("*.png"))[:9]
        frames = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
        far = zip(frames, frames[5:])
        for previous, current in [*itertools.pairwise(frames), *far]:
            totals += compared(all_kinds(random, previous, current, 2000))
    for _ in range(6):
        totals += compared(made_up(random, 1500))
    print(f"{totals[0]} points compared, {totals[1]} lost, {totals[2]} different")
    assert totals[0] > 300_000 and totals[1] > 20_000 and totals[2] == 0


ODD_POINTS = {
    "one": [[0, 0]],
    "fifteen": [[50.5 + k, 40.25] for k in range(15)],  # one lane is free
    "sixteen": [[50.5 + k, 40.25] for k in range(16)],
    "equal": [[50.5, 50.5]] * 17,
    "far outside": [[1e9, 5], [-1e9, 5], [5, 1e30], [3e38, -3e38]],
    "not numbers": [[np.nan, 5], [5, np.nan], [np.inf, 5], [5, -np.inf], [100, 100]],
}


@pytest.mark.parametrize("kind", ODD_POINTS)
def test_odd_points_give_opencvs_bits(kind):
    previous, current = street(np.random.default_rng(2), 2)
    count, _, different = differences(previous, current, ODD_POINTS[kind])
    assert count == 2 * len(ODD_POINTS[kind]) and different == 0


OPTIONS = [
    {"maxLevel": 0},
    {"maxLevel": 6},
    {"criteria": (1, 7, 0.5)},
    {"criteria": (2, 7, 0.5)},
    {"criteria": (3, 100, 1e-4)},
    {"criteria": (3, 1, 0.01)},
    {"criteria": (3, 0, 0.01)},
    {"minEigThreshold": 0.05},
    {"winSize": (15, 15)},
    {"winSize": (21, 15)},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_other_arguments_give_opencvs_bits(options):
    random = np.random.default_rng(3)
    previous, current = street(random, 2)
    points = random.uniform((-9, -9), (342, 209), (300, 2))
    count, _, different = differences(previous, current, points, **options)
    assert count == 600 and different == 0


def test_inputs_of_other_kinds_are_left_to_opencv():
    previous, current = street(np.random.default_rng(4), 2)
    points = np.array([[[50, 60]], [[70.5, 90]]], np.float32)
    for frames in (
        (previous, current),
        (np.dstack([previous] * 3), np.dstack([current] * 3)),
        (previous[::2, ::2], current[::2, ::2]),
        (previous, np.asfortranarray(current)),
    ):
        expected = cv2.calcOpticalFlowPyrLK(*frames, points, None)
        for result, other in zip(track(*frames, points), expected, strict=True):
            np.testing.assert_array_equal(result, other)
    with pytest.raises(cv2.error):
        track(previous, current[1:], points)
    with pytest.raises(ValueError, match="first guesses"):
        track(previous, current, points, points)
    with pytest.raises(ValueError, match="first guesses"):
        track(previous, current, points, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
    nothing = np.empty((0, 2), np.float32)
    assert track(previous, current, nothing) == cv2.calcOpticalFlowPyrLK(
        previous, current, nothing, None
    )


def test_a_frame_that_changes_is_not_remembered():
    previous, current, other = street(np.random.default_rng(5))
    points = np.random.default_rng(5).uniform(40, 160, (50, 2)).astype(np.float32)
    buffer = previous.copy()
    track(previous, buffer, points)
    for frame in (current, other):
        buffer[:] = frame
        assert differences(previous, buffer, points)[2] == 0
        assert differences(buffer, previous, points)[2] == 0


@pytest.mark.parametrize(
    "named, environment",
    [
        ("NUMBA_DISABLE_JIT", {"NUMBA_DISABLE_JIT": "1"}),
        ("AVX2", {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}),
    ],
)
def test_opencv_is_called_where_the_lanes_do_not_pay(tmp_path, named, environment):
    code = "from opencv_exact import reason_for_opencv; print(reason_for_opencv())"
    assert named in succeed([sys.executable, "-c", code], tmp_path, **environment).stdout


@pytest.mark.skipif(not lucas_kanade._has_avx2(), reason="the lanes are for x86 with AVX2")
@pytest.mark.skipif(cv2.__version__ < "4.14", reason="this OpenCV adds in another order")
def test_lanes_are_used_where_they_can_be():
    """Else a mistake in them would be hidden, since OpenCV would be called."""
    assert reason_for_opencv() == ""


def test_opencv_is_called_where_it_adds_in_another_order(monkeypatch):
    real = cv2.calcOpticalFlowPyrLK

    def another(*arguments, **options):
        points, status, errors = real(*arguments, **options)
        return np.nextafter(points, np.float32(0)), status, errors

    previous, current = street(np.random.default_rng(7), 2)
    points = np.random.default_rng(7).uniform(40, 160, (50, 2)).astype(np.float32)
    monkeypatch.setattr(cv2, "calcOpticalFlowPyrLK", another)
    reason_for_opencv.cache_clear()
    try:
        if lucas_kanade._has_avx2():
            assert cv2.__version__ in reason_for_opencv()
        else:
            assert reason_for_opencv()
        np.testing.assert_array_equal(
            track(previous, current, points)[0], another(previous, current, points, None)[0]
        )
    finally:
        reason_for_opencv.cache_clear()


def test_no_pyramid_is_kept_of_memory_that_others_can_change():
    random = np.random.default_rng(9)
    images, memory = [*street(random, 2, (90, 120))], bytearray(90 * 120)
    view = np.frombuffer(memoryview(memory).toreadonly(), np.uint8).reshape(90, 120)
    points = random.uniform((20, 20), (100, 70), (40, 2)).astype(np.float32)
    for image in images:
        memory[:] = image.tobytes()
        expected = cv2.calcOpticalFlowPyrLK(image, images[1], points, None)[0]
        np.testing.assert_array_equal(track(view, images[1], points)[0], expected)


@pytest.mark.skipif(bool(reason_for_opencv()), reason=reason_for_opencv() or "lanes")
def test_lanes_are_faster_than_opencv():
    random = np.random.default_rng(8)
    previous, current = street(random, 2, (376, 1241))
    for frame in (previous, current):
        frame.setflags(write=False)
    points = random.uniform((20, 20), (1220, 350), (1000, 2)).astype(np.float32)
    threads, least = cv2.getNumThreads(), np.full(2, np.inf)
    try:
        cv2.setNumThreads(1)
        for _ in range(5):
            for k, call in enumerate((track, cv2.calcOpticalFlowPyrLK)):
                started = time.thread_time()
                call(previous, current, points, None, flags=EIGENVALUES)
                least[k] = min(least[k], time.thread_time() - started)
    finally:
        cv2.setNumThreads(threads)
    assert least[0] < 0.6 * least[1]
