"""How masked keypoints jump from frame to frame, on which the thesis blames its errors (Sections 4.2 and 5.1)."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from thesis_repro import masks
from thesis_repro.cityscapes import ID
from thesis_repro.odometry import THESIS, keypoints

OBJECTS = [ID[name] for name in ("pole", "traffic light", "traffic sign", "vegetation", "person", "rider", "car",
                                 "truck", "bus", "motorcycle", "bicycle")]
SAME = 2.0  # pixels; a keypoint this near to where it was tracked to is the same one
FEW = 8  # keypoints; an object with fewer shows nothing


class View(NamedTuple):
    """One object in one frame: crop (h, w), its edges (h, w), and points (n, 2) in pixels of the crop."""

    frame: int
    crop: np.ndarray
    edges: np.ndarray
    keypoints: np.ndarray
    expected: np.ndarray | None  # where the keypoints of the frame before are now; None for the first frame
    jumped: int  # how many of these have no keypoint of this frame within SAME pixels


def follow(frames: Sequence[np.ndarray], label_maps: Sequence[np.ndarray], dilation_width: int,
           first: int = 0) -> list[View]:
    """How the masked keypoints of one object jump between consecutive frames (Figure 4.8): a View of each frame.

    frames: (height, width) uint8 each; label_maps: (h, w) uint8 each, any size, as many; first: number of the first
    frame. The object is the connected patch of a label, away from the image's border, from which most keypoints jump
    between the first two frames. A window follows the median motion of its keypoints. Where the first label map has no
    such patch, the window starts in the middle of the frame.
    """
    size = np.array(frames[0].shape[::-1])
    edge_images = [masks.edges(label_map, frames[0].shape) for label_map in label_maps]
    points = [keypoints.detect(frame, THESIS, masks.dilate(edge_image, dilation_width))
              for frame, edge_image in zip(frames, edge_images, strict=True)]
    tracks = [_track(before, after, corners) for before, after, corners in zip(frames, frames[1:], points)]
    tracked, followed = tracks[0]
    low, high = _most_jumping(label_maps[0], size, points[0], followed & _far(tracked, points[1]))
    center, half = (low + high) / 2, int(np.clip(0.65 * (high - low).max(), size.min() // 8, size.min() // 2))
    views: list[View] = []
    expected = None  # where the keypoints in the window of the frame before are now
    for index, (frame, edge_image) in enumerate(zip(frames, edge_images, strict=True)):
        low = np.clip(np.round(center - half).astype(int), 0, size - 2 * half)
        inside = _inside(points[index], low, low + 2 * half)
        crop = np.s_[low[1]:low[1] + 2 * half, low[0]:low[0] + 2 * half]
        if expected is not None:
            expected = expected[_inside(expected, low, low + 2 * half)]
        views.append(View(first + index, frame[crop], edge_image[crop], points[index][inside] - low,
                          None if expected is None else expected - low,
                          0 if expected is None else int(_far(expected, points[index]).sum())))
        if index < len(tracks):
            tracked, followed = tracks[index]
            used = inside & followed
            expected = tracked[used]
            if used.any():
                center = center + np.median(expected - points[index][used], axis=0)
    return views


def _most_jumping(label_map: np.ndarray, size: np.ndarray, points: np.ndarray, jumping: np.ndarray) -> np.ndarray:
    """The corners [(left, top), (right, bottom)] of the object from which most points jump, or the frame's middle."""
    best, most = np.array([size, size]) / 2, -1
    enlarged = cv2.resize(label_map, size, interpolation=cv2.INTER_NEAREST)
    for label in OBJECTS:
        for *low, width, height, _ in cv2.connectedComponentsWithStats((enlarged == label).astype(np.uint8))[2][1:]:
            corners = np.array([low, np.add(low, (width, height))])
            inside = _inside(points, *corners)
            whole = (corners[0] > 0).all() and (corners[1] < size).all()
            if (whole and size.min() // 8 <= max(width, height) <= 0.7 * size.min() and inside.sum() >= FEW
                    and (inside & jumping).sum() > most):
                best, most = corners, (inside & jumping).sum()
    return best


def _track(before: np.ndarray, after: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the keypoints of a frame are in the next one, and which of them were found there."""
    return keypoints.track(before, after, corners) if len(corners) else (corners, np.zeros(0, bool))


def _inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.all((points >= low) & (points < high), axis=1)


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
