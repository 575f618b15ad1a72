"""The search of cv2.calcOpticalFlowPyrLK (pyramidal Lucas-Kanade): sixteen points side by side.

The tracker compares a window around a point of the previous frame, its template, with a window of
the current frame, and moves the latter by least squares until it hardly moves (Bouguet, 2001).
OpenCV computes several columns of one window at a time. Here each of LANES points has a lane, and
an operation of `vectors` does the same for all lanes.

1. `_take_points` fills the lanes from the queue of a level of the pyramid.
2. `_write_templates` computes their templates, `_write_matrices` how well these can be tracked.
3. `_read_windows`, `_advance` and `_move` move all windows by one step.
4. Once few lanes are still at work, their points go back into the queue.

Pixels lie in pairs of neighbours, for `dot`. A pixel between four is the sum of two products of
pairs. Each lane adds in OpenCV's order, which decides the last bits: columns that it takes eight at
a time go into four partial sums, column k of these and k + 4 together, the last ones into a fifth.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from opencv_exact.compiling import compiled
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

# Numba puts these into their callers before LLVM sees them.
inlined = partial(compiled, inline="always", no_cpython_wrapper=True)
inner = partial(compiled, no_cpython_wrapper=True)  # not called by Python

WINDOW = 21  # side, pixels
PATCH = WINDOW + 3  # side of the pixels that a template is made from; `read_pairs` reads as many
MARGIN = PATCH  # mirrored pixels around a frame; a window may lie outside, if it touches the frame
TAIL = WINDOW // 8 * 8  # the first column that OpenCV adds alone
TWOS = TAIL // 2  # units of two columns, k and k + 4, in a row of a template
UNITS = TWOS + WINDOW - TAIL  # and of one of the last columns
PIXEL, ACROSS, DOWN = range(3)  # of a template: pixels times 32, slopes across and down
GO_ON = 6  # fewer lanes at work are not worth a step while other points wait
HALF = np.float32((WINDOW - 1) / 2)  # from the corner of a window to its middle
ZERO, ONE, TWO, FOUR = np.float32(0), np.float32(1), np.float32(2), np.float32(4)
WEIGHT_BITS = 14  # OpenCV's weights of four pixels are whole numbers whose sum is 2^14
UNIT = np.float32(1 << WEIGHT_BITS)
PIXEL_BITS = WEIGHT_BITS - 5  # cut off a weighted sum of pixels: 32 times a pixel stays
SCALE = np.float32(1 / (1 << 20))  # of OpenCV's sums
EPSILON = np.float32(np.finfo(np.float32).eps)
BACK_AND_FORTH = 0.01  # pixels; a step that undoes the last one up to this ends the search
GOES_ON, CONVERGED, OSCILLATES = 0, 1, 2  # news of a lane after a step
IDLE = -1  # in place of a point, in a lane without one
NOWHERE = np.float32(-1e9)  # the place of a window whose pixels have not been read
assert PATCH == ROW

# The numbers of LANES points: a vector for each index of the first axes. Corners are upper left
# ones of windows. One record, so that the compiler sees that its parts do not overlap.
BLOCK = np.dtype(
    [
        ("pairs", np.int16, (PATCH, PATCH - 1, LANES, 2)),  # pixels, each with its right neighbour
        ("slopes", np.int16, (2, 2, WINDOW, LANES, 2)),  # of two rows of pairs, across and down
        ("template", np.int16, (WINDOW, UNITS, 3, LANES, 2)),
        ("columns", np.int16, (WINDOW, LANES, 2)),  # -1 where pairs of a template lie in the frame
        ("rows", np.int16, (WINDOW + 1, LANES, 2)),  # the same of rows
        ("weights", np.int32, (4, LANES)),  # of four neighbouring pixels
        ("sums", np.float32, (5, 3, LANES)),  # OpenCV's partial sums
        ("matrix", np.float32, (4, LANES)),  # sums of products of slopes; 1 / determinant
        ("eigenvalue", np.float32, (LANES,)),  # the smaller one of the matrix
        ("search", np.float32, (5, LANES)),  # corner x, y in the current frame, step x, y, steps
        ("starts", np.int64, (LANES,)),  # of the pixels, in those of the pyramid
        ("place", np.float32, (2, LANES)),  # x, y of the first of the four pixels at the corner
        ("news", np.int32, (LANES,)),
    ]
)


class Pyramid(NamedTuple):
    """A frame and its halves, each with a margin of mirrored pixels, one after the other."""

    pixels: np.ndarray  # uint8
    levels: np.ndarray  # (n, 3): rows, columns, index of the first pixel of the margin


class Criteria(NamedTuple):
    """When a search ends, and what is computed."""

    most_steps: int
    squared_step: float  # of a step that ends it, pixels^2
    least_eigenvalue: np.float32  # of a template that can be tracked
    eigenvalues: bool  # whether eigenvalues or mean differences of pixels are wanted as errors


def new_block() -> Any:
    """A record of LANES points, which begins at a multiple of 64 bytes: a register's width."""
    memory = np.zeros(BLOCK.itemsize + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + BLOCK.itemsize].view(BLOCK)


@compiled
def track_points(block, previous, current, points, criteria):
    """Track points (N, 2) float32 from one pyramid into another.

    block: of `new_block`. Returns the points (N, 2), whether they were found, (N,), and their
    errors (N,), 0 where OpenCV leaves them undefined.
    """
    tracked = points.copy()
    # Those of the last level hold: OpenCV goes on with a point that a coarse level has lost.
    found, errors = np.empty(len(points), np.bool_), np.empty(len(points), np.float32)
    templates = points.copy()  # corners
    searches = np.empty((len(points), 5), np.float32)  # of the points that wait, see BLOCK
    top = len(previous.levels) - 1
    for level in range(top, -1, -1):
        scale = ONE / np.float32(1 << level)
        # Loops, because Numba compiles a sum of arrays and an assignment of one for seconds.
        for i in range(len(points)):
            found[i], errors[i] = False, 0
            for k in range(2):
                tracked[i, k] = points[i, k] * scale if level == top else tracked[i, k] * TWO
                templates[i, k] = points[i, k] * scale - HALF
                searches[i, k] = tracked[i, k] - HALF
            for k in range(2, 5):
                searches[i, k] = 0
        frames = previous.pixels, current.pixels, previous.levels[level]
        _track_level(
            block[0], frames, templates, searches, tracked, found, errors, criteria, level == 0
        )
    return tracked, found, errors


@inlined
def _track_level(block, frames, templates, searches, tracked, found, errors, criteria, is_last):
    """Move the tracked points (N, 2) on one level of the pyramid.

    frames: pixels of both pyramids, and the level's row. templates: corners (N, 2).
    """
    before, after, level = frames
    queue = _queue(templates, level)
    for i in queue:
        found[i] = True
    lanes = np.empty(LANES, np.int64)  # the point in each lane, or IDLE
    first, waiting = 0, len(queue)
    while waiting > 0:
        active = min(LANES, waiting)
        lanes[:] = IDLE
        for lane in range(active):
            lanes[lane] = queue[(first + lane) % len(queue)]
        first, waiting = (first + active) % len(queue), waiting - active
        _take_points(block, level, lanes, templates, searches)
        _write_templates(block, before, level)
        _write_matrices(block)
        _drop_weak(block, lanes, found, errors, criteria)
        taken = lanes.copy()
        while active > 0:
            _read_windows(block, after, level, lanes, found)
            _advance(block)
            _move(block, criteria.most_steps, criteria.squared_step)
            active = _write_results(block, lanes, tracked)
            if active <= GO_ON and waiting >= LANES:
                _keep_searches(block, lanes, taken, searches)
                for lane in range(LANES):
                    if lanes[lane] != IDLE:
                        queue[(first + waiting) % len(queue)] = lanes[lane]
                        waiting += 1
                active = 0
        if is_last and not criteria.eigenvalues:
            _write_differences(block, after, level, taken, tracked, found, errors)


@inner
def _queue(corners, level):
    """Indices of the points whose template touches the frame."""
    queue = np.empty(len(corners), np.int64)
    count = 0
    for i in range(len(corners)):
        if _touches(corners[i, 0], corners[i, 1], level):
            queue[count] = i
            count += 1
    return queue[:count]


@inlined
def _touches(x, y, level):
    """Whether a window touches the frame (NaN: no)."""
    return x >= -WINDOW and x < level[1] and y >= -WINDOW and y < level[0]


@inlined
def _find_pixels(block, level, x, y, before, lane):
    """Write where a lane's pixels begin: `before` rows and columns before a corner."""
    row, column = int(np.floor(y)) + MARGIN - before, int(np.floor(x)) + MARGIN - before
    block.starts[lane] = level[2] + row * (level[1] + 2 * MARGIN) + column


@inlined
def _locate(block, x, y, lane):
    """Write OpenCV's weights of the four pixels between which a corner lies, and their place."""
    a, b = x - np.floor(x), y - np.floor(y)
    first = np.rint((ONE - a) * (ONE - b) * UNIT)
    second = np.rint(a * (ONE - b) * UNIT)
    third = np.rint((ONE - a) * b * UNIT)
    block.weights[0, lane] = np.int32(first)
    block.weights[1, lane] = np.int32(second)
    block.weights[2, lane] = np.int32(third)
    block.weights[3, lane] = np.int32(UNIT - first - second - third)
    block.place[0, lane], block.place[1, lane] = np.floor(x), np.floor(y)


@inlined
def _weights(block):
    """Pairs of weights, of the two upper ones of four pixels and of the two lower ones."""
    upper = join(load(block.weights, (0,)), load(block.weights, (1,)))
    return upper, join(load(block.weights, (2,)), load(block.weights, (3,)))


@inlined
def _between(array, above, below, weights, bits):
    """Numbers between four neighbours in pairs, rounded, without the last `bits` of the weights."""
    blend = dot(load(array, above), weights[0]) + dot(load(array, below), weights[1])
    return (blend + (1 << (bits - 1))) >> bits


@inlined
def _first_column(unit):
    """The first column of a unit: 0 to 3, 8 to 11, or one of the last."""
    return unit + 4 * min(unit // 4, TWOS // 4)


# Templates


@inner
def _take_points(block, level, lanes, templates, searches):
    """Write where the points in the lanes are, and how far their searches are."""
    for lane in range(LANES):
        i = lanes[lane]
        block.starts[lane] = 0
        if i != IDLE:
            _find_pixels(block, level, templates[i, 0], templates[i, 1], 1, lane)
            for k in range(2):
                block.place[k, lane] = templates[i, k]
            for k in range(5):
                block.search[k, lane] = searches[i, k]
    for lane in range(LANES):
        _locate(block, block.place[0, lane], block.place[1, lane], lane)
    _mark_frame(block, np.float32(level[0]), np.float32(level[1]))


@inlined
def _mark_frame(block, rows, columns):
    """Write which pixels of the templates lie in the frame."""
    for k in range(WINDOW + 1):
        for lane in range(LANES):
            x, y = block.place[0, lane] + np.float32(k), block.place[1, lane] + np.float32(k)
            column = -((x >= ZERO) & (x < columns))
            row = -((y >= ZERO) & (y < rows))
            block.rows[k, lane, 0], block.rows[k, lane, 1] = row, row
            if k < WINDOW:
                block.columns[k, lane, 0] = column
            if k > 0:
                block.columns[k - 1, lane, 1] = column


@inner
def _write_templates(block, pixels, level):
    """Compute the templates, row by row: the slopes of pixels, then what lies between four."""
    stride = level[1] + 2 * MARGIN
    weights = _weights(block)
    for row in range(2):
        read_pairs(pixels, block.starts, row * stride, block.pairs, row)
    for row in range(WINDOW + 1):
        read_pairs(pixels, block.starts, (row + 2) * stride, block.pairs, row + 2)
        _write_slopes(block, row)
        if row > 0:
            for unit in range(UNITS):
                _write_unit(block, row - 1, unit, weights)


@inlined
def _write_slopes(block, row):
    """Write Scharr's slopes of a row of pixels, which OpenCV takes for 0 outside the frame."""
    sum0, step0 = _sum_and_step(block, row, 0)
    sum1, step1 = _sum_and_step(block, row, 1)
    in_row = load(block.rows, (row,))
    for column in range(WINDOW):
        sum2, step2 = _sum_and_step(block, row, column + 2)
        inside = in_row & load(block.columns, (column,))
        across = sum2 - sum0
        down = (step0 + step2) * 3 + step1 * 10
        store(block.slopes, (row % 2, 0, column), across & inside)
        store(block.slopes, (row % 2, 1, column), down & inside)
        sum0, sum1, step0, step1 = sum1, sum2, step1, step2


@inlined
def _sum_and_step(block, row, column):
    """Weighted sum of three pixels below each other, and the step from the first to the last."""
    first, second = load(block.pairs, (row, column)), load(block.pairs, (row + 1, column))
    third = load(block.pairs, (row + 2, column))
    return (first + third) * 3 + second * 10, third - first


@inlined
def _write_unit(block, row, unit, weights):
    """Write the pixels and slopes of a unit of the templates."""
    column = _first_column(unit)
    first = _template(block, row, column, weights)
    second = zeros(), zeros(), zeros()
    if unit < TWOS:
        second = _template(block, row, column + 4, weights)
    for kind in range(3):
        store(block.template, (row, unit, kind), join(first[kind], second[kind]))


@inlined
def _template(block, row, column, weights):
    """Pixels, slopes across and slopes down of a column of the templates."""
    above, below = (row + 1, column + 1), (row + 2, column + 1)
    pixel = _between(block.pairs, above, below, weights, PIXEL_BITS)
    one, two = row % 2, (row + 1) % 2  # where slopes of this row and of the next one lie
    across = _between(block.slopes, (one, 0, column), (two, 0, column), weights, WEIGHT_BITS)
    down = _between(block.slopes, (one, 1, column), (two, 1, column), weights, WEIGHT_BITS)
    return pixel, across, down


@inner
def _write_matrices(block):
    """Write the sums of products of slopes, the determinants and the eigenvalues."""
    for part in range(4):
        _add_products(block, part, range(part, TWOS, 4))
    _add_products(block, 4, range(TWOS, UNITS))
    for lane in range(LANES):
        xx, xy, yy = (
            _total(block.sums, 0, lane),
            _total(block.sums, 1, lane),
            _total(block.sums, 2, lane),
        )
        root = np.sqrt((xx - yy) * (xx - yy) + FOUR * xy * xy)
        block.eigenvalue[lane] = (yy + xx - root) / np.float32(2 * WINDOW * WINDOW)
        block.matrix[0, lane] = xx
        block.matrix[1, lane] = xy
        block.matrix[2, lane] = yy
        block.matrix[3, lane] = xx * yy - xy * xy
        block.place[0, lane] = NOWHERE


@inlined
def _add_products(block, part, units):
    """Write a partial sum of the products of slopes: across, of both kinds, down."""
    sums = floats(zeros()), floats(zeros()), floats(zeros())
    for row in range(WINDOW):
        for unit in units:
            across = both(load(block.template, (row, unit, ACROSS)))
            down = both(load(block.template, (row, unit, DOWN)))
            sums = _with_products(sums, across[0], down[0])
            if unit < TWOS:
                sums = _with_products(sums, across[1], down[1])
    for k in range(3):
        store(block.sums, (part, k), sums[k])


@inlined
def _with_products(sums, across, down):
    """Sums with the products of two slopes, which are exact."""
    x, y = floats(across), floats(down)
    return sums[0] + x * x, sums[1] + x * y, sums[2] + y * y


@inlined
def _total(sums, k, lane):
    """Add the partial sums in OpenCV's order."""
    pairs = (sums[0, k, lane] + sums[2, k, lane]) + (sums[1, k, lane] + sums[3, k, lane])
    return (sums[4, k, lane] + pairs) * SCALE


@inner
def _drop_weak(block, lanes, found, errors, criteria):
    """Let the points leave whose template is too even or has edges of one direction only."""
    for lane in range(LANES):
        i = lanes[lane]
        if i != IDLE:
            eigenvalue = block.eigenvalue[lane]
            if criteria.eigenvalues:
                errors[i] = eigenvalue
            if eigenvalue < criteria.least_eigenvalue or block.matrix[3, lane] < EPSILON:
                found[i] = False
                lanes[lane] = IDLE


# Searches


@inner
def _read_windows(block, pixels, level, lanes, found):
    """Read the windows if one has moved to other pixels. Those outside the frame are lost."""
    for lane in range(LANES):
        x, y = np.floor(block.search[0, lane]), np.floor(block.search[1, lane])
        block.news[lane] = (x != block.place[0, lane]) | (y != block.place[1, lane])
        _locate(block, block.search[0, lane], block.search[1, lane], lane)
    changed = False
    for lane in range(LANES):
        if lanes[lane] != IDLE and block.news[lane]:
            x, y = block.place[0, lane], block.place[1, lane]
            if _touches(x, y, level):
                _find_pixels(block, level, x, y, 0, lane)
                changed = True
            else:
                found[lanes[lane]] = False
                lanes[lane] = IDLE
    if changed:
        for row in range(WINDOW + 1):
            offset = row * (level[1] + 2 * MARGIN)
            read_pairs(pixels, block.starts, offset, block.pairs, row)


@inner
def _advance(block):
    """Sum the differences of windows and templates times the slopes, in OpenCV's parts."""
    weights = _weights(block)
    for part in range(4):
        _add_mismatches(block, part, range(part, TWOS, 4), weights)
    _add_mismatches(block, 4, range(TWOS, UNITS), weights)


@inlined
def _add_mismatches(block, part, units, weights):
    """Write a partial sum of the differences times the slopes, across and down."""
    right, below = floats(zeros()), floats(zeros())
    for row in range(WINDOW):
        for unit in units:
            difference = _difference(block, row, unit, weights)
            across = dot(difference, load(block.template, (row, unit, ACROSS)))
            down = dot(difference, load(block.template, (row, unit, DOWN)))
            right, below = right + floats(across), below + floats(down)
    store(block.sums, (part, 0), right)
    store(block.sums, (part, 1), below)


@inlined
def _difference(block, row, unit, weights):
    """Pixels of the windows minus those of the templates, times 32, of a unit."""
    column = _first_column(unit)
    first = _between(block.pairs, (row, column), (row + 1, column), weights, PIXEL_BITS)
    second = zeros()
    if unit < TWOS:
        column += 4
        second = _between(block.pairs, (row, column), (row + 1, column), weights, PIXEL_BITS)
    return join(first, second) - load(block.template, (row, unit, PIXEL))


@inner
def _move(block, most_steps, squared_step):
    """Solve for the steps and take them. News: whether the searches go on."""
    sums, matrix, search = block.sums, block.matrix, block.search
    for lane in range(LANES):
        right, below = _total(sums, 0, lane), _total(sums, 1, lane)
        xx, xy, yy = matrix[0, lane], matrix[1, lane], matrix[2, lane]
        inverse = ONE / matrix[3, lane]
        dx, dy = (xy * below - yy * right) * inverse, (xy * right - xx * below) * inverse
        is_small = float(dx) * float(dx) + float(dy) * float(dy) <= squared_step
        is_back = float(abs(dx + search[2, lane])) < BACK_AND_FORTH
        is_back &= float(abs(dy + search[3, lane])) < BACK_AND_FORTH
        is_back &= search[4, lane] > 0
        steps = search[4, lane] + ONE
        search[0, lane] += dx
        search[1, lane] += dy
        search[2, lane] = dx
        search[3, lane] = dy
        search[4, lane] = steps
        is_over = is_small | (steps >= most_steps)
        block.news[lane] = OSCILLATES if is_back & ~is_small else np.int32(is_over)


@inner
def _write_results(block, lanes, tracked):
    """Write the points of the lanes at work, and let those leave whose search is over.

    Returns how many stay.
    """
    active = 0
    for lane in range(LANES):
        i = lanes[lane]
        if i != IDLE:
            for k in range(2):
                tracked[i, k] = block.search[k, lane] + HALF
                if block.news[lane] == OSCILLATES:  # the middle of both places
                    tracked[i, k] -= block.search[k + 2, lane] * np.float32(0.5)
            if block.news[lane] == GOES_ON:
                active += 1
            else:
                lanes[lane] = IDLE
    return active


@inner
def _keep_searches(block, lanes, taken, searches):
    """Keep how far the searches of the lanes at work are. They are no longer taken."""
    for lane in range(LANES):
        if lanes[lane] != IDLE:
            taken[lane] = IDLE
            for k in range(5):
                searches[lanes[lane], k] = block.search[k, lane]


@inner
def _write_differences(block, pixels, level, lanes, tracked, found, errors):
    """Write the mean difference of pixels between template and window as the points' errors.

    OpenCV calls a point lost, too, if its window has left the frame by the last step.
    """
    for lane in range(LANES):
        block.place[0, lane] = NOWHERE
        i = lanes[lane]
        if i != IDLE and found[i]:
            for k in range(2):
                block.search[k, lane] = tracked[i, k] - HALF
        else:
            lanes[lane] = IDLE
    _read_windows(block, pixels, level, lanes, found)
    weights = _weights(block)
    total = zeros()
    for row in range(WINDOW):
        for unit in range(UNITS):
            first, second = both(magnitudes(_difference(block, row, unit, weights)))
            total = total + first + second
    store(block.sums, (0, 0), floats(total))
    for lane in range(LANES):
        if lanes[lane] != IDLE:
            errors[lanes[lane]] = block.sums[0, 0, lane] / np.float32(32 * WINDOW * WINDOW)
