"""Each operation of vectors does in all lanes what it does with plain numbers."""

import numba
import numpy as np
import pytest
from numba.extending import is_jitted

from opencv_exact import lucas_kanade
from opencv_exact.lanes import new_block, track_points
from opencv_exact.vectors import (
    LANES,
    ROW,
    both,
    dot,
    floats,
    join,
    load,
    magnitudes,
    read_pairs,
    store,
    zeros,
)

CAN_RUN = is_jitted(track_points) and lucas_kanade._has_avx2()
pytestmark = [
    pytest.mark.slow,
    pytest.mark.bits,
    pytest.mark.skipif(not CAN_RUN, reason="not compiled for x86 with AVX2"),
]
RANDOM = np.random.default_rng(0)
LEAST, MOST = -(2**15), 2**15 - 1
LIMITS = np.resize([LEAST, MOST, -1, 0, 1], (LANES, 2))
PAIRS = [RANDOM.integers(LEAST, MOST + 1, (2, LANES, 2)), np.stack([LIMITS, LIMITS[::-1]])]
NUMBERS = RANDOM.integers(-(2**31), 2**31, (2, LANES))


def vectors(numbers, kind):
    """Return an array of vectors that begins at a multiple of 64 bytes."""
    size = np.size(numbers) * np.dtype(kind).itemsize
    memory = np.zeros(size + 64, np.uint8)
    array = memory[-memory.ctypes.data % 64 :][:size].view(kind).reshape(np.shape(numbers))
    array[:] = numbers
    return array


def room(count, kind):
    """Return an array for so many vectors."""
    return vectors(np.zeros((count, LANES, 2) if kind == np.int16 else (count, LANES)), kind)


@numba.njit
def operators(sides, results):
    a, b = load(sides, (0,)), load(sides, (1,))
    store(results, (0,), a + b)
    store(results, (1,), a - b)
    store(results, (2,), a * b)


@numba.njit
def operators_of_whole_numbers(sides, results):
    a, b = load(sides, (0,)), load(sides, (1,))
    store(results, (0,), a & b)
    store(results, (1,), a + 256)
    store(results, (2,), a * 3)
    store(results, (3,), a >> 9)


@numba.njit
def of_pairs(sides, numbers, pairs):
    a, b = load(sides, (0,)), load(sides, (1,))
    first, second = both(a)
    store(numbers, (0,), dot(a, b))
    store(numbers, (1,), first)
    store(numbers, (2,), second)
    store(pairs, (0,), magnitudes(a))


@numba.njit
def of_numbers(sides, pairs, singles):
    a, b = load(sides, (0,)), load(sides, (1,))
    store(pairs, (0,), join(a, b))
    store(singles, (0,), floats(a))
    store(singles, (1,), floats(zeros()))


@numba.njit
def read(pixels, starts, offset, block):
    read_pairs(pixels, starts, offset, block[0].pairs, 1)


@pytest.mark.parametrize(
    ("kind", "sides"),
    [
        (np.int16, PAIRS[0]),
        (np.int16, PAIRS[1]),
        (np.int32, NUMBERS),
        (np.float32, RANDOM.normal(0, 1e3, (2, LANES)).astype(np.float32)),
    ],
)
def test_operators_are_those_of_numbers(kind, sides):
    """Bits that do not fit are lost; floats are rounded."""
    a, b = sides
    results = room(3, kind)
    operators(vectors(sides, kind), results)
    np.testing.assert_array_equal(results, np.stack([a + b, a - b, a * b]).astype(kind))
    if kind != np.float32:
        results = room(4, kind)
        operators_of_whole_numbers(vectors(sides, kind), results)
        expected = np.stack([a & b, a + 256, a * 3, a >> 9])
        np.testing.assert_array_equal(results, expected.astype(kind))


@pytest.mark.parametrize("sides", PAIRS)
def test_pairs_are_multiplied_and_taken_apart(sides):
    a, b = sides
    numbers, pairs = room(3, np.int32), room(1, np.int16)
    of_pairs(vectors(sides, np.int16), numbers, pairs)
    expected = np.stack([(a * b).sum(1), a[:, 0], a[:, 1]])
    np.testing.assert_array_equal(numbers, expected.astype(np.int32))
    np.testing.assert_array_equal(pairs[0], np.abs(a).astype(np.int16))


def test_numbers_become_pairs_and_floats():
    pairs, singles = room(1, np.int16), room(2, np.float32)
    of_numbers(vectors(NUMBERS, np.int32), pairs, singles)
    np.testing.assert_array_equal(pairs[0], NUMBERS.T.astype(np.int16))
    np.testing.assert_array_equal(singles, [NUMBERS[0].astype(np.float32), np.zeros(LANES)])


def test_pixels_of_all_lanes_are_read_in_pairs():
    pixels = RANDOM.integers(0, 256, 5000, np.uint8)
    starts, block = RANDOM.integers(0, 4000, LANES), new_block()
    read(pixels, starts, 700, block)
    row = pixels[starts[:, None] + 700 + np.arange(ROW)].T
    np.testing.assert_array_equal(block[0]["pairs"][1], np.stack([row[:-1], row[1:]], 2))
    assert not block[0]["pairs"][[0, 2]].any()
