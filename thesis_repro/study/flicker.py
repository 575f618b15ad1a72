"""How masked keypoints jump from frame to frame, on which the thesis blames its errors (Sections 4.2 and 5.1)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from thesis_repro import masks
from thesis_repro.odometry import THESIS, keypoints

SAME = 2.0  # pixels; a keypoint this near to where it was tracked to is the same one


class View(NamedTuple):
    """One place in one frame: crop (h, w), its edges (h, w), and points (n, 2) in pixels of the crop."""

    frame: int
    crop: np.ndarray
    edges: np.ndarray
    keypoints: np.ndarray
    expected: np.ndarray | None  # where the keypoints of the frame before are now; None for the first frame
    jumped: int  # how many of these have no keypoint of this frame within SAME pixels


def follow(frames: Sequence[np.ndarray], label_maps: Sequence[np.ndarray], dilation_width: int,
           first: int = 0) -> list[View]:
    """How the masked keypoints of one place jump between consecutive frames (Figure 4.8): a View of each frame.

    frames: (height, width) uint8 each; label_maps: (h, w) uint8 each, any size, as many; first: number of the first
    frame. The place is a window of a quarter of the frame's height, around the keypoint that jumps between the first
    two frames with most others around it, or the frame's middle where none does. It follows its keypoints' median.
    """
    size = np.array(frames[0].shape[::-1])
    half = size.min() // 8
    edge_images = [masks.edges(label_map, frames[0].shape) for label_map in label_maps]
    points = [keypoints.detect(frame, THESIS, masks.dilate(edge_image, dilation_width))
              for frame, edge_image in zip(frames, edge_images, strict=True)]
    tracked, followed = _track(frames[0], frames[1], points[0])
    jumping = points[0][followed & _far(tracked, points[1])]
    near = np.abs(jumping[:, None] - jumping).max(axis=-1) < half
    center = jumping[near.sum(axis=1).argmax()] if len(jumping) else size / 2
    views: list[View] = []
    expected = None  # where the keypoints in the window of the frame before are now
    for index, (frame, edge_image) in enumerate(zip(frames, edge_images, strict=True)):
        low = np.clip(np.round(center - half).astype(int), 0, size - 2 * half)
        crop = np.s_[low[1]:low[1] + 2 * half, low[0]:low[0] + 2 * half]
        here = _inside(points[index], low, low + 2 * half)
        if expected is not None:
            expected = _inside(expected, low, low + 2 * half)
        views.append(View(first + index, frame[crop], edge_image[crop], here - low,
                          None if expected is None else expected - low,
                          0 if expected is None else int(_far(expected, points[index]).sum())))
        if index + 1 < len(frames):
            tracked, followed = _track(frame, frames[index + 1], here)
            expected = tracked[followed]
            if len(expected):
                center = center + np.median(expected - here[followed], axis=0)
    return views


def _track(before: np.ndarray, after: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the keypoints of a frame are in the next one, and which were found there and from there again: others may
    have been hidden by something that moves."""
    if not len(corners):
        return corners, np.zeros(0, bool)
    tracked, followed = keypoints.track(before, after, corners)
    back, returned = keypoints.track(after, before, tracked)
    return tracked, followed & returned & (np.linalg.norm(back - corners, axis=1) < SAME)


def _inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The points between two corners of a window."""
    return points[((points >= low) & (points < high)).all(axis=1)]


def _far(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which points have none of the others within SAME pixels."""
    distances = np.linalg.norm(points[:, None] - others, axis=-1)
    return np.asarray(distances.min(axis=1, initial=np.inf) > SAME)


def found_again(first: np.ndarray, second: np.ndarray, first_mask: np.ndarray | None = None,
                second_mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Which keypoints of a frame are found again in a later one: arrays of (n, 2) pixels.

    Returns those found again where they lie in the first and in the second frame, those of the first frame that are
    lost, and those of the second that are new. Found again is what Lucas-Kanade tracks to within SAME pixels of a
    keypoint of the second frame. The masks are for the detector, (height, width) uint8.
    """
    before, after = keypoints.detect(first, THESIS, first_mask), keypoints.detect(second, THESIS, second_mask)
    tracked, followed = _track(first, second, before)
    again = followed & ~_far(tracked, after)
    return before[again], tracked[again], before[~again], after[_far(after, tracked[again])]
