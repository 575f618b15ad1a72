"""What OpenCV refuses is refused, and what it takes gives its results."""

import cv2
import numpy as np
import pytest

from opencv_exact import find_essential_matrix, recover_pose, track

pytestmark = pytest.mark.slow
THRESHOLD = 0.001
RANDOM = np.random.default_rng(0)
OLD = RANDOM.uniform(-0.5, 0.5, (60, 2))
NEW = OLD * 1.02 + RANDOM.normal(0, 1e-3, OLD.shape)
FRAME = cv2.GaussianBlur(RANDOM.integers(0, 256, (90, 120), np.uint8), (0, 0), 2)
LATER = np.roll(FRAME, 1, 1)
CORNERS = cv2.goodFeaturesToTrack(FRAME, 60, 0.01, 3).reshape(-1, 2)
SHAPES = {
    "(N, 2)": lambda points: points,
    "(N, 1, 2)": lambda points: points[:, None],
    "(1, N, 2)": lambda points: points[None],
    "(2, N)": lambda points: points.T.copy(),
    "(N, 3)": lambda points: np.hstack([points, points[:, :1]]),
    "(2N,)": np.ravel,
    "(N, 2, 1)": lambda points: points[..., None],
    "(2, N/2, 2)": lambda points: points.reshape(2, -1, 2),
    "()": lambda points: points[0, 0],
    "(1, 1, N, 2)": lambda points: points[None, None],
}


def cv2_essential(new, old):
    return cv2.findEssentialMat(new, old, 1.0, (0, 0), cv2.RANSAC, 0.999, THRESHOLD)


MATRIX, _ = cv2_essential(NEW, OLD)
OWN = lambda new, old: find_essential_matrix(new, old, threshold=THRESHOLD)  # noqa: E731
CALLS = {  # OpenCV's, the own, and points to call them with
    "search": (cv2_essential, OWN, (NEW, OLD)),
    "vote": (
        lambda new, old: cv2.recoverPose(MATRIX, new, old),
        lambda new, old: recover_pose(MATRIX, new, old),
        (NEW, OLD),
    ),
    "track": (
        lambda points: cv2.calcOpticalFlowPyrLK(FRAME, LATER, points, None)[:2],
        lambda points: track(FRAME, LATER, points)[:2],
        (CORNERS,),
    ),
}


def is_taken(theirs, own, *values):
    """What is taken gives OpenCV's result; what it refuses is refused (and (N, 2, 1), too)."""
    try:
        results = own(*values)
    except ValueError:
        return False
    for one, other in zip(results, theirs(*values), strict=True):
        np.testing.assert_array_equal(one, other)
    return True


@pytest.mark.parametrize("call", CALLS)
def test_points_of_any_shape_are_taken_or_refused_as_by_opencv(call):
    theirs, own, points = CALLS[call]
    taken = []
    for name, shape in SHAPES.items():
        shaped = [np.ascontiguousarray(shape(side)) for side in points]
        if is_taken(theirs, own, *shaped):
            taken.append(name)
    assert taken == ["(N, 2)", "(N, 1, 2)", "(1, N, 2)"]


@pytest.mark.parametrize("call", ["search", "vote"])
@pytest.mark.parametrize("fewer", [0, 1, 59])
def test_unequal_numbers_are_refused_before_compiled_code_reads_past_an_end(call, fewer):
    theirs, own, _ = CALLS[call]
    for pair in ((NEW, OLD[:fewer]), (NEW[:fewer], OLD)):
        assert not is_taken(theirs, own, *pair)


def test_arrays_of_a_graphics_card_are_refused_by_name():
    card = cv2.UMat
    for call in (
        lambda: find_essential_matrix(card(NEW), OLD),
        lambda: recover_pose(MATRIX, NEW, card(OLD)),
        lambda: track(card(FRAME), LATER, CORNERS),
        lambda: track(FRAME, card(LATER), CORNERS),
        lambda: track(FRAME, LATER, card(CORNERS)),
    ):
        with pytest.raises(ValueError, match="UMat"):
            call()
