"""cv2.calcOpticalFlowPyrLK (pyramidal Lucas-Kanade): the same bits, several times faster.

`track` takes OpenCV's arguments and makes the pyramids. The search is in `lanes`, for processors on
which it equals OpenCV's; OpenCV does what they do not serve.
"""

from functools import cache

import cv2
import llvmlite.binding as llvm
import numpy as np
from numba.core.registry import cpu_target
from numba.extending import is_jitted

from opencv_exact.compiling import is_on_disk
from opencv_exact.lanes import MARGIN, WINDOW, Criteria, Pyramid, new_block, track_points
from opencv_exact.points import as_points, refuse_umat

USES_STEPS, USES_EPSILON = cv2.TERM_CRITERIA_COUNT, cv2.TERM_CRITERIA_EPS

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
    lanes cannot be compiled. So the first use compares 300 points with OpenCV, bit by bit, which
    takes some milliseconds: a list of versions would miss the builds of Linux distributions.
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
