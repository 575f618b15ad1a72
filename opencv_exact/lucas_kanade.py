"""cv2.calcOpticalFlowPyrLK (pyramidal Lucas-Kanade): the same bits, several times faster.

The tracker compares a window around a point of the previous frame, its template, with a window of
the current frame, and moves the latter by least squares until it hardly moves (Bouguet, 2001).
OpenCV vectorises over the columns of one window. Here LANES points are tracked side by side, and
the compiler vectorises the loops over the lanes. Each lane adds in OpenCV's order: columns that it
takes eight at a time go into four partial sums, the last ones into a fifth.

1. `_read_templates` reads the pixels of LANES points from the queue of a level of the pyramid.
2. `_start` computes their templates, `_advance` and `_move` move all windows by one step.
3. Once few lanes are still at work, their points go back into the queue.

What the lanes work on is one record, so that the compiler sees that its parts do not overlap.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import cv2
import llvmlite.binding as llvm
import numpy as np
from numba.core.registry import cpu_target
from numba.extending import is_jitted

from opencv_exact.compiling import compiled, is_on_disk
from opencv_exact.points import as_points, refuse_umat

# Numba inlines these before LLVM sees them. Inlined by LLVM, most loops would stay scalar.
inlined = partial(compiled, inline="always", no_cpython_wrapper=True)
inner = partial(compiled, no_cpython_wrapper=True)  # not called by Python

LANES = 16  # points tracked side by side, one in each lane
WINDOW = 21  # side, pixels; a constant, so that the loops are unrolled
GO_ON = 6  # fewer lanes at work are not worth a step while other points wait
TAIL = WINDOW // 8 * 8  # the first column that OpenCV adds alone
RING = WINDOW + 2  # side of the template with its neighbours, from which slopes are computed
PATCH = WINDOW + 3  # side of the pixels between which these lie
WORDS = (PATCH + 3) // 4  # of four pixels, in a row of a patch
MARGIN = PATCH  # mirrored pixels around a frame; a window may lie outside, if it touches the frame
HALF = np.float32((WINDOW - 1) / 2)  # from the corner of a window to its middle
ZERO, ONE, TWO, FOUR = np.float32(0), np.float32(1), np.float32(2), np.float32(4)
WEIGHT_BITS = 14  # OpenCV's weights of four pixels are whole numbers whose sum is 2^14
UNIT = np.float32(1 << WEIGHT_BITS)
TO_32 = np.float32(32 / UNIT)  # scale of the weights with which a pixel becomes 32 of it
ROUNDED = np.float32(0.5)  # start of a sum that is rounded when its fraction is cut off
SCALE = np.float32(1 / (1 << 20))  # of OpenCV's sums
EPSILON = np.float32(np.finfo(np.float32).eps)
BACK_AND_FORTH = 0.01  # pixels; a step that undoes the last one up to this ends the search
USES_STEPS, USES_EPSILON = cv2.TERM_CRITERIA_COUNT, cv2.TERM_CRITERIA_EPS
GOES_ON, CONVERGED, OSCILLATES = 0, 1, 2  # news of a lane after a step
IDLE = -1  # in place of a point, in a lane without one
NOWHERE = np.float32(-1e9)  # the place of a window whose pixels have not been read

# The numbers of LANES points; the last axis is that of the lanes. Corners are upper left ones of
# windows. Numbers of 16 bits come last: they would move the others from multiples of 64 bytes.
BLOCK = np.dtype(
    [
        ("words", np.uint32, (PATCH, WORDS, LANES)),  # pixels, four in a number
        ("image", np.float32, (PATCH, 4 * WORDS, LANES)),  # the same pixels
        ("ring", np.int32, (RING, RING, LANES)),  # pixels between four, times 2^14
        ("weights", np.float32, (4, LANES)),  # of four neighbouring pixels
        ("sums", np.float32, (5, 3, LANES)),  # OpenCV's partial sums
        ("matrix", np.float32, (4, LANES)),  # sums of products of slopes; 1 / determinant
        ("eigenvalue", np.float32, (LANES,)),  # the smaller one of the matrix
        ("search", np.float32, (5, LANES)),  # corner x, y in the current frame, step x, y, steps
        ("place", np.float32, (2, LANES)),  # x, y of the first of the four pixels at the corner
        ("news", np.int32, (LANES,)),
        ("slopes", np.int16, (2, WINDOW + 1, WINDOW + 1, LANES)),  # of pixels, across and down
        ("template", np.int16, (3, WINDOW, WINDOW, LANES)),  # pixels times 32, slopes across, down
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


_kept: list[tuple[np.ndarray, int, Pyramid]] = []  # of the last two frames


def track(
    prevImg: np.ndarray,
    nextImg: np.ndarray,
    prevPts: np.ndarray,
    nextPts: None = None,
    winSize: tuple[int, int] = (WINDOW, WINDOW),
    maxLevel: int = 3,
    criteria: tuple[int, int, float] = (USES_STEPS | USES_EPSILON, 30, 0.01),
    flags: int = 0,
    minEigThreshold: float = 1e-4,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tracked points, status and errors, with the bits of cv2.calcOpticalFlowPyrLK.

    The arguments are OpenCV's, but without first guesses (nextPts). prevPts: (N, 2) or (N, 1, 2).
    flags: OPTFLOW_LK_GET_MIN_EIGENVALS or 0. The error of a lost point, which OpenCV does not
    define, is 0. Frames of 8-bit gray and windows of 21x21 are tracked in lanes unless
    `reason_for_opencv` names a reason. OpenCV does the rest.

    Pyramids of the last two frames that nobody can change are kept: of arrays that own their memory
    and are read-only (`frame.setflags(write=False)`).
    One thread is used, without Python's lock.
    Raises ValueError for first guesses, and for points that OpenCV refuses.
    """
    if nextPts is not None or flags & cv2.OPTFLOW_USE_INITIAL_FLOW:
        raise ValueError("track: first guesses (nextPts, OPTFLOW_USE_INITIAL_FLOW) are not served")
    refuse_umat("prevImg", prevImg)
    refuse_umat("nextImg", nextImg)
    points = as_points("prevPts", prevPts, np.float32)
    steps = int(np.clip(criteria[1], 0, 100)) if criteria[0] & USES_STEPS else 30
    epsilon = float(np.clip(criteria[2], 0, 10)) if criteria[0] & USES_EPSILON else 0.01
    are_gray = prevImg.ndim == nextImg.ndim == 2 and prevImg.dtype == nextImg.dtype == np.uint8
    if (
        not (are_gray and prevImg.shape == nextImg.shape and prevImg.size)
        or not (len(points) and steps and 0 <= maxLevel <= 30)
        or tuple(winSize) != (WINDOW, WINDOW)
        or reason_for_opencv()
    ):
        return cv2.calcOpticalFlowPyrLK(
            prevImg,
            nextImg,
            prevPts,
            None,
            winSize=winSize,
            maxLevel=maxLevel,
            criteria=criteria,
            flags=flags,
            minEigThreshold=minEigThreshold,
        )
    wants_eigenvalues = bool(flags & cv2.OPTFLOW_LK_GET_MIN_EIGENVALS)
    order = np.argsort(points[:, 1])  # neighbours in turn find their pixels in the cache
    tracked, status, errors = track_points(
        new_block(),
        _kept_pyramid(prevImg, maxLevel),
        _kept_pyramid(nextImg, maxLevel),
        points[order],
        Criteria(steps, epsilon * epsilon, np.float32(minEigThreshold), wants_eigenvalues),
    )
    back = np.argsort(order)
    status = status[back].astype(np.uint8).reshape(-1, 1)
    return tracked[back].reshape(np.shape(prevPts)), status, errors[back].reshape(-1, 1)


@cache
def reason_for_opencv() -> str:
    """Return why OpenCV's own tracker is called in this process, or "" if the lanes are.

    Other builds of OpenCV add in another order (ARM, versions before 4.14), and without AVX2 the
    lanes are slower. So the first use compares 300 points with OpenCV, bit by bit, which takes some
    milliseconds: a list of versions would miss the builds of Linux distributions.
    """
    if not is_jitted(track_points):
        return "Numba is told not to compile (NUMBA_DISABLE_JIT)"
    if not _has_avx2():
        return "Numba compiles for a processor without AVX2"
    random = np.random.default_rng(0)
    frames = [cv2.GaussianBlur(random.integers(0, 256, (90, 120), np.uint8), (0, 0), 2)]
    frames.append(np.roll(frames[0], (1, 2), (0, 1)))
    points = random.uniform((-5, -5), (125, 95), (300, 2)).astype(np.float32)
    expected, status, errors = cv2.calcOpticalFlowPyrLK(*frames, points, None)
    criteria = Criteria(30, 0.01 * 0.01, np.float32(1e-4), False)
    first, second = (pyramid(frame, 3) for frame in frames)
    own = track_points(new_block(), first, second, points, criteria)
    found = status.ravel() == 1
    same = np.array_equal(own[0], expected) and np.array_equal(own[1], found)
    if not (same and np.array_equal(own[2][found], errors.ravel()[found])):
        return f"OpenCV {cv2.__version__} adds in another order here"
    return ""


def is_ready() -> bool:
    """Return whether an earlier use has compiled the lanes, or they are not used here."""
    return is_on_disk(track_points) or not _has_avx2()


def _has_avx2() -> bool:
    """Return whether the processor that Numba compiles for multiplies whole numbers in 256 bits."""
    _, name, features = cpu_target.target_context.codegen().magic_tuple()
    machine = llvm.Target.from_default_triple().create_target_machine(name, features)
    kind = "<8 x i32>"
    product = f"%c = mul {kind} %a, %b\nret {kind} %c"
    code = llvm.parse_assembly(f"define {kind} @f({kind} %a, {kind} %b) {{\n{product}\n}}")
    return "ymm" in machine.emit_assembly(code)


def _kept_pyramid(frame: np.ndarray, most_levels: int) -> Pyramid:
    """Pyramid of a frame; kept, if nobody can change the frame."""
    if frame.flags.writeable or not frame.flags.owndata:
        return pyramid(frame, most_levels)
    global _kept
    kept = _kept  # another thread may change it
    for other, levels, result in kept:
        if other is frame and levels == most_levels:
            return result
    result = pyramid(frame, most_levels)
    _kept = [*kept[-1:], (frame, most_levels, result)]
    return result


def pyramid(frame: np.ndarray, most_levels: int) -> Pyramid:
    """Halve a frame (height, width) uint8 as OpenCV does, while it is larger than the window."""
    frames = [frame]
    while len(frames) <= most_levels and min(frames[-1].shape) > 2 * WINDOW:
        frames.append(cv2.pyrDown(frames[-1]))
    sides = [MARGIN] * 4
    padded = [cv2.copyMakeBorder(frame, *sides, cv2.BORDER_REFLECT_101) for frame in frames]
    starts = np.cumsum([0, *(frame.size for frame in padded[:-1])])
    levels = [[*frame.shape, start] for frame, start in zip(frames, starts)]
    return Pyramid(np.concatenate(padded, axis=None), np.array(levels))


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
    queue, is_inside = _queue(templates, level)
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
        inside = _read_templates(block, before, level, lanes, templates, is_inside, searches)
        _place(block)
        _start(block, inside, level[0], level[1])
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
def _read_templates(block, pixels, level, lanes, templates, is_inside, searches):
    """Read the templates of the points in the lanes, and how far their searches are.

    Returns whether all templates lie inside the frame with their neighbours.
    """
    inside = True
    for lane in range(LANES):
        i = lanes[lane]
        if i != IDLE:
            inside &= is_inside[i]
            _read(block, pixels, level, templates[i, 0], templates[i, 1], 1, PATCH, lane)
            for k in range(2):
                block.place[k, lane] = templates[i, k]
            for k in range(5):
                block.search[k, lane] = searches[i, k]
    return inside


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


@inner
def _keep_searches(block, lanes, taken, searches):
    """Keep how far the searches of the lanes at work are. They are no longer taken."""
    for lane in range(LANES):
        if lanes[lane] != IDLE:
            taken[lane] = IDLE
            for k in range(5):
                searches[lanes[lane], k] = block.search[k, lane]


@inner
def _queue(corners, level):
    """Indices of the points whose template touches the frame, and whether each point's lies inside.

    Those whose pixels and slopes lie inside come first, because they take less time together.
    """
    rows, columns = level[0], level[1]
    is_inside = np.empty(len(corners), np.bool_)
    for i in range(len(corners)):
        x, y = corners[i, 0], corners[i, 1]
        is_inside[i] = (
            x >= 0 and y >= 0 and x + (WINDOW + 1) <= columns and y + (WINDOW + 1) <= rows
        )
    queue = np.empty(len(corners), np.int64)
    count = 0
    for kind in (True, False):
        for i in range(len(corners)):
            if is_inside[i] == kind and _touches(corners[i, 0], corners[i, 1], rows, columns):
                queue[count] = i
                count += 1
    return queue[:count], is_inside


@inlined
def _touches(x, y, rows, columns):
    """Whether a window touches the frame (NaN: no)."""
    return x >= -WINDOW and x < columns and y >= -WINDOW and y < rows


@inlined
def _read(block, pixels, level, x, y, before, rows, lane):
    """Read rows of a lane's pixels, from `before` rows and columns before its corner on."""
    stride = np.uintp(level[1] + 2 * MARGIN)
    row, column = int(np.floor(y)) + MARGIN - before, int(np.floor(x)) + MARGIN - before
    start = np.uintp(level[2] + row * (level[1] + 2 * MARGIN) + column)
    for row in range(rows):
        place = start
        for word in range(WORDS):
            # LLVM makes it one load
            block.words[row, word, lane] = (
                np.uint32(pixels[place])
                | np.uint32(pixels[place + np.uintp(1)]) << np.uint32(8)
                | np.uint32(pixels[place + np.uintp(2)]) << np.uint32(16)
                | np.uint32(pixels[place + np.uintp(3)]) << np.uint32(24)
            )
            place += np.uintp(4)
        start += stride


@inlined
def _unpack(block, rows):
    """Write the pixels as numbers."""
    words, image = block.words, block.image
    for row in range(rows):
        for word in range(WORDS):
            for lane in range(LANES):
                four = words[row, word, lane]
                image[row, 4 * word, lane] = np.int32(four & np.uint32(255))
                image[row, 4 * word + 1, lane] = np.int32(four >> np.uint32(8) & np.uint32(255))
                image[row, 4 * word + 2, lane] = np.int32(four >> np.uint32(16) & np.uint32(255))
                image[row, 4 * word + 3, lane] = np.int32(four >> np.uint32(24))


@inlined
def _write_weights(block, x, y, scale, lane):
    """Write OpenCV's weights of the four pixels between which a corner lies, times a scale."""
    a, b = x - np.floor(x), y - np.floor(y)
    first = np.rint((ONE - a) * (ONE - b) * UNIT)
    second = np.rint(a * (ONE - b) * UNIT)
    third = np.rint((ONE - a) * b * UNIT)
    block.weights[0, lane] = first * scale
    block.weights[1, lane] = second * scale
    block.weights[2, lane] = third * scale
    block.weights[3, lane] = (UNIT - first - second - third) * scale


@inlined
def _blend(block, row, column, start, lane):
    """Pixel between four, added to a start.

    Weights and pixels have 22 bits together, so each sum is exact in single precision.
    """
    image, weights = block.image, block.weights
    return (
        start
        + image[row, column, lane] * weights[0, lane]
        + image[row, column + 1, lane] * weights[1, lane]
        + image[row + 1, column, lane] * weights[2, lane]
        + image[row + 1, column + 1, lane] * weights[3, lane]
    )


@partial(inner, fastmath={"contract"})
def _start(block, inside, rows, columns):
    """Compute the templates.

    inside: whether all of them lie inside the frame with their neighbours.
    """
    _unpack(block, PATCH)
    for row in range(RING):
        for column in range(RING):
            for lane in range(LANES):
                block.ring[row, column, lane] = np.int32(_blend(block, row, column, ZERO, lane))
    if inside:
        _write_inner_templates(block)
    else:
        _write_slopes(block, np.float32(rows), np.float32(columns))
        _write_templates(block)


@inner
def _place(block):
    """Write the weights of the templates and where their pixels begin."""
    for lane in range(LANES):
        x, y = block.place[0, lane], block.place[1, lane]
        _write_weights(block, x, y, ONE, lane)
        block.place[0, lane], block.place[1, lane] = np.floor(x), np.floor(y)


@inlined
def _write_inner_templates(block):
    """Write the templates inside the frame."""
    for row in range(WINDOW):
        for column in range(WINDOW):
            for lane in range(LANES):
                across, down = _slopes(block.ring, row, column, lane)
                _write_template(block, row, column, lane, across, down)


@inlined
def _write_templates(block):
    """Write the templates, which may lie at the border, with the slopes of the pixels."""
    for row in range(WINDOW):
        for column in range(WINDOW):
            for lane in range(LANES):
                across = np.int32(_blend_slopes(block, 0, row, column, lane))
                down = np.int32(_blend_slopes(block, 1, row, column, lane))
                _write_template(block, row, column, lane, across, down)


@inlined
def _write_template(block, row, column, lane, across, down):
    """Write the pixel and slopes of a template, rounded as OpenCV does."""
    template = block.template
    pixel = block.ring[row + 1, column + 1, lane]
    template[0, row, column, lane] = np.int32(pixel + 256) >> np.int32(9)
    template[1, row, column, lane] = np.int32(across + 8192) >> np.int32(14)
    template[2, row, column, lane] = np.int32(down + 8192) >> np.int32(14)


@inlined
def _add_products(block, row, column, part, lane):
    """Add the products of two slopes, which are exact, to a partial sum."""
    across = np.float32(block.template[1, row, column, lane])
    down = np.float32(block.template[2, row, column, lane])
    block.sums[part, 0, lane] += across * across
    block.sums[part, 1, lane] += across * down
    block.sums[part, 2, lane] += down * down


@inlined
def _slopes(pixels, row, column, lane):
    """Scharr's slopes, across and down, in the middle of 3x3 pixels.

    Slopes between four pixels are those of the pixels between them, as both steps are linear.
    """
    a, b = np.int32(pixels[row, column, lane]), np.int32(pixels[row, column + 1, lane])
    c, d = np.int32(pixels[row, column + 2, lane]), np.int32(pixels[row + 1, column, lane])
    e, f = np.int32(pixels[row + 1, column + 2, lane]), np.int32(pixels[row + 2, column, lane])
    g, h = np.int32(pixels[row + 2, column + 1, lane]), np.int32(pixels[row + 2, column + 2, lane])
    across = np.int32(3 * ((c - a) + (h - f)) + 10 * (e - d))
    down = np.int32(3 * ((f - a) + (h - c)) + 10 * (g - b))
    return across, down


@inlined
def _write_slopes(block, rows, columns):
    """Write the slopes of the pixels, which OpenCV takes for 0 outside the frame."""
    for row in range(WINDOW + 1):
        for column in range(WINDOW + 1):
            for lane in range(LANES):
                across, down = _slopes(block.image, row, column, lane)
                x = block.place[0, lane] + np.float32(column)
                y = block.place[1, lane] + np.float32(row)
                is_inside = (x >= ZERO) & (x < columns) & (y >= ZERO) & (y < rows)
                block.slopes[0, row, column, lane] = across if is_inside else np.int32(0)
                block.slopes[1, row, column, lane] = down if is_inside else np.int32(0)


@inlined
def _blend_slopes(block, k, row, column, lane):
    """Slope between four pixels, times 2^14."""
    slopes, weights = block.slopes, block.weights
    return (
        slopes[k, row, column, lane] * np.int32(weights[0, lane])
        + slopes[k, row, column + 1, lane] * np.int32(weights[1, lane])
        + slopes[k, row + 1, column, lane] * np.int32(weights[2, lane])
        + slopes[k, row + 1, column + 1, lane] * np.int32(weights[3, lane])
    )


@inlined
def _total(sums, k, lane):
    """Add the partial sums in OpenCV's order."""
    pairs = (sums[0, k, lane] + sums[2, k, lane]) + (sums[1, k, lane] + sums[3, k, lane])
    return (sums[4, k, lane] + pairs) * SCALE


@inner
def _write_matrices(block):
    """Write the sums of products of slopes, the determinants and the eigenvalues."""
    block.sums[:] = 0
    for row in range(WINDOW):
        for group in range(0, TAIL, 4):
            for k in range(4):
                for lane in range(LANES):
                    _add_products(block, row, group + k, k, lane)
        for lane in range(LANES):
            for column in range(TAIL, WINDOW):
                _add_products(block, row, column, 4, lane)
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


@inner
def _read_windows(block, pixels, level, lanes, found):
    """Read the windows that have moved to other pixels. Those outside the frame are lost."""
    _locate(block)
    changed = False
    for lane in range(LANES):
        if lanes[lane] != IDLE and block.news[lane]:
            x, y = block.place[0, lane], block.place[1, lane]
            if _touches(x, y, level[0], level[1]):
                _read(block, pixels, level, x, y, 0, WINDOW + 1, lane)
                changed = True
            else:
                found[lanes[lane]] = False
                lanes[lane] = IDLE
    if changed:
        _unpack(block, WINDOW + 1)


@inlined
def _locate(block):
    """Write the weights of the windows. News: whether their pixels are others."""
    for lane in range(LANES):
        x, y = block.search[0, lane], block.search[1, lane]
        _write_weights(block, x, y, TO_32, lane)
        x, y = np.floor(x), np.floor(y)
        block.news[lane] = (x != block.place[0, lane]) | (y != block.place[1, lane])
        block.place[0, lane], block.place[1, lane] = x, y


@partial(inner, fastmath={"contract"})
def _advance(block):
    """Sum the differences of windows and templates times the slopes, in OpenCV's parts."""
    block.sums[:] = 0
    for row in range(WINDOW):
        for group in range(0, TAIL, 8):
            for k in range(4):
                for lane in range(LANES):
                    a, b = _mismatch(block, row, group + k, lane)
                    c, d = _mismatch(block, row, group + k + 4, lane)
                    block.sums[k, 0, lane] += np.float32(np.int32(a + c))
                    block.sums[k, 1, lane] += np.float32(np.int32(b + d))
        for column in range(TAIL, WINDOW):
            for lane in range(LANES):
                a, b = _mismatch(block, row, column, lane)
                block.sums[4, 0, lane] += np.float32(a)
                block.sums[4, 1, lane] += np.float32(b)


@inlined
def _mismatch(block, row, column, lane):
    """Difference of a window's pixel and its template, times the slopes."""
    pixel = np.int32(_blend(block, row, column, ROUNDED, lane))
    difference = np.int32(pixel - np.int32(block.template[0, row, column, lane]))
    across = np.int32(difference * np.int32(block.template[1, row, column, lane]))
    down = np.int32(difference * np.int32(block.template[2, row, column, lane]))
    return across, down


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
def _write_differences(block, pixels, level, lanes, tracked, found, errors):
    """Write the mean difference of pixels between template and window as the points' errors.

    OpenCV calls a point lost, too, if its window has left the frame by the last step.
    """
    for lane in range(LANES):
        i = lanes[lane]
        if i != IDLE and found[i]:
            for k in range(2):
                block.search[k, lane] = tracked[i, k] - HALF
        elif i != IDLE:
            lanes[lane] = IDLE
    for lane in range(LANES):
        block.place[0, lane] = NOWHERE
    _read_windows(block, pixels, level, lanes, found)
    _compare(block)
    for lane in range(LANES):
        if lanes[lane] != IDLE:
            errors[lanes[lane]] = block.eigenvalue[lane]


@inlined
def _compare(block):
    """Write the mean difference of pixels in place of the eigenvalue. The sums are exact."""
    block.sums[0] = 0
    for row in range(WINDOW):
        for column in range(WINDOW):
            for lane in range(LANES):
                pixel = np.int32(_blend(block, row, column, ROUNDED, lane))
                difference = np.int32(pixel - np.int32(block.template[0, row, column, lane]))
                block.sums[0, 0, lane] += np.float32(abs(difference))
    for lane in range(LANES):
        block.eigenvalue[lane] = block.sums[0, 0, lane] / np.float32(32 * WINDOW * WINDOW)
