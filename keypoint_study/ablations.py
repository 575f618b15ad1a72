"""Ablations: masks that differ from the thesis's in one thing.

They are functions of a sequence or of masks, of more values, and of the number of a frame
(`controls.MadeMasks`). Some use the ground truth, which an odometry does not have.
"""

from functools import lru_cache

import cv2
import numpy as np

from thesis_repro.data.cityscapes import ID
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks.folders import LabelMasks
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.loop import detect, normalise, track

VEGETATION = (ID["vegetation"], ID["terrain"])
HELD = 5  # frames that have one mask, where boundaries hold still


def without_vegetation(label_masks: LabelMasks, index: int) -> np.ndarray:
    """Return the whole frame but trees and bushes (Section 5.2.2)."""
    label_map = label_masks.label_map(index)
    enlarged = cv2.resize(label_map, label_masks.size[::-1], interpolation=cv2.INTER_NEAREST)
    return np.where(np.isin(enlarged, VEGETATION), np.uint8(0), np.uint8(255))


@lru_cache(maxsize=2)  # several masks of one frame use it
def all_keypoints(sequence: Sequence, index: int) -> np.ndarray:
    """Return the thesis's keypoints (n, 2) of a frame."""
    return detect(sequence.frame(index), THESIS)


def random_keypoints(sequence: Sequence, amount: int | float, index: int) -> np.ndarray:
    """Return a mask that keeps randomly drawn keypoints of a frame, one pixel each.

    amount: their number (int), or their share of all keypoints (float).
    """
    points = all_keypoints(sequence, index).astype(int)
    if isinstance(amount, float):
        amount = round(amount * len(points))
    return _kept(sequence, points, amount, index)


def random_keypoints_on(
    label_masks: LabelMasks, sequence: Sequence, number: int, index: int
) -> np.ndarray:
    """Return a mask that keeps randomly drawn keypoints on the mask of a frame, one pixel each."""
    points = detect(sequence.frame(index), THESIS, label_masks[index]).astype(int)
    return _kept(sequence, points, number, index)


def _kept(sequence: Sequence, points: np.ndarray, number: int, index: int) -> np.ndarray:
    """Return a mask that keeps so many of some keypoints of a frame, one pixel each."""
    shuffled = np.random.default_rng((0, index)).permutation(points)
    columns, rows = shuffled[:number].T
    mask = np.zeros(sequence.size, np.uint8)
    mask[rows, columns] = 255
    return mask


@lru_cache(maxsize=2)  # several masks of one frame use it
def parallax(sequence: Sequence, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the keypoints (n, 2) of a frame that are tracked into the next, and their parallax.

    Parallax (pixels): how far a point moves beyond what the true rotation explains. It is large for
    near points and small for distant ones. Uses the ground truth, which an odometry does not have.
    """
    points = all_keypoints(sequence, index)
    moved, tracked = track(sequence.frame(index), sequence.frame(index + 1), points)
    motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
    rays = np.column_stack([normalise(points, sequence.intrinsics), np.ones(len(points))])
    turned = rays @ motion[:3, :3] @ sequence.intrinsics.T  # of points at infinity
    distances = np.linalg.norm(moved - turned[:, :2] / turned[:, 2:], axis=1)
    return points[tracked], distances[tracked]


def with_parallax(sequence: Sequence, least: float, most: float, index: int) -> np.ndarray:
    """Return a mask that keeps the keypoints with a parallax in a range, one pixel each.

    (Section 5.2.2: keypoints that are far away, or close to the camera, are left out.)
    """
    mask = np.zeros(sequence.size, np.uint8)
    if index + 1 < len(sequence):  # those of the last frame are not used
        points, distances = parallax(sequence, index)
        columns, rows = points[(distances >= least) & (distances < most)].astype(int).T
        mask[rows, columns] = 255
    return mask


def as_many(sequence: Sequence, least: float, most: float, index: int) -> np.ndarray:
    """Return a mask that keeps as many keypoints as `with_parallax`, drawn at random."""
    number = int(np.count_nonzero(with_parallax(sequence, least, most, index)))
    return random_keypoints(sequence, number, index)


def half_in_turns(sequence: Sequence, into: bool, index: int) -> np.ndarray:
    """Return a mask that keeps one half of the frame in a turn, and elsewhere all of it.

    into: whether it is the half that the camera turns into (Section 5.2.2). Which steps turn is
    known from the ground truth (`metrics.TURN_RATE`).
    """
    mask = np.full(sequence.size, 255, np.uint8)
    following = sequence.poses[index : index + 2]
    motion = np.linalg.inv(following[0]) @ following[-1]
    if metrics.angles(motion) > metrics.TURN_RATE:
        middle = sequence.size[1] // 2
        turns_right = motion[0, 2] > 0  # the optical axis moves to the right
        mask[np.s_[:, :middle] if turns_right == into else np.s_[:, middle:]] = 0
    return mask


def earlier_mask(label_masks: LabelMasks, steady: bool, index: int) -> np.ndarray:
    """Return the mask of one of the HELD last frames, to see what changing boundaries do.

    steady: HELD frames in turn have the mask of the first of them. Otherwise each draws its own of
    the last HELD ones. Masks are then off by as many frames, but jump in each.
    """
    lag = index % HELD if steady else int(np.random.default_rng((0, index)).integers(HELD))
    return label_masks[max(index - lag, 0)]
