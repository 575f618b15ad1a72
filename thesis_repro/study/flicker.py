"""How masked keypoints jump from frame to frame, on which the thesis blames its errors (Sections 4.2 and 5.1)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from thesis_repro import masks
from thesis_repro.cityscapes import ID
from thesis_repro.odometry import THESIS, keypoints

Box = tuple[int, int, int, int]  # left, top, right, bottom, pixels; the last two just outside

OBJECTS = [ID[name] for name in ("pole", "traffic light", "traffic sign", "vegetation", "person", "rider", "car",
                                 "truck", "bus", "motorcycle", "bicycle")]
SAME = 2.0  # pixels; a keypoint this near to where it was tracked to is the same one
FEW = 8  # keypoints; an object with fewer shows nothing


@dataclass(frozen=True)
class View:
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
    shape = frames[0].shape
    edge_images = [masks.edges(label_map, shape) for label_map in label_maps]
    points = [keypoints.detect(frame, THESIS, masks.dilate(edge_image, dilation_width))
              for frame, edge_image in zip(frames, edge_images, strict=True)]
    tracks = [_track(before, after, corners) for before, after, corners in zip(frames, frames[1:], points)]
    center, half = _window(label_maps[0], shape, points[0], tracks[0], points[1])
    views: list[View] = []
    expected = None  # where the keypoints in the window of the frame before are now
    for index, (frame, edge_image) in enumerate(zip(frames, edge_images, strict=True)):
        corner = np.clip(np.round(center - half).astype(int), 0, np.array(shape[::-1]) - 2 * half)
        left, top, right, bottom = box = (*corner, *(corner + 2 * half))
        window, inside = np.s_[top:bottom, left:right], _inside(points[index], box)
        if expected is not None:
            expected = expected[_inside(expected, box)]
        jumped = 0 if expected is None else int(_far(expected, points[index]).sum())
        views.append(View(first + index, frame[window], edge_image[window], points[index][inside] - corner,
                          None if expected is None else expected - corner, jumped))
        if index < len(tracks):
            tracked, followed = tracks[index]
            used = inside & followed
            expected = tracked[used]
            if used.any():
                center = center + np.median(expected - points[index][used], axis=0)
    return views


def _track(before: np.ndarray, after: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the keypoints of a frame are in the next one, and which of them were found there."""
    return keypoints.track(before, after, corners) if len(corners) else (corners, np.zeros(0, bool))


def _window(label_map: np.ndarray, shape: tuple[int, ...], points: np.ndarray, tracks: tuple[np.ndarray, np.ndarray],
            later: np.ndarray) -> tuple[np.ndarray, int]:
    """The middle (x, y) and half the side of the window on the object whose keypoints jump most."""
    half, (tracked, followed) = min(shape) // 8, tracks
    boxes = [box for box in _boxes(label_map, shape) if _inside(points, box).sum() >= FEW]
    if not boxes:
        return np.array(shape[::-1]) / 2, half
    jumping = _far(tracked, later) & followed
    left, top, right, bottom = max(boxes, key=lambda box: (_inside(points, box) & jumping).sum())
    half = int(np.clip(0.65 * max(right - left, bottom - top), half, min(shape) // 2))
    return np.array([left + right, top + bottom]) / 2, half


def _boxes(label_map: np.ndarray, shape: tuple[int, ...]) -> Iterator[Box]:
    """The patches of objects in a label map at the frame's shape."""
    enlarged = cv2.resize(label_map, shape[::-1], interpolation=cv2.INTER_NEAREST)
    for label in OBJECTS:
        _, _, boxes, _ = cv2.connectedComponentsWithStats((enlarged == label).astype(np.uint8))
        for left, top, width, height, _ in boxes[1:]:
            if left > 0 and top > 0 and left + width < shape[1] and top + height < shape[0] and (
                    min(shape) // 8 <= max(width, height) <= 0.7 * min(shape)):
                yield left, top, left + width, top + height


def _inside(points: np.ndarray, box: Box) -> np.ndarray:
    left, top, right, bottom = box
    return np.all((points >= (left, top)) & (points < (right, bottom)), axis=1)


def _far(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which points have none of the others within SAME pixels."""
    if not len(points) or not len(others):
        return np.ones(len(points), bool)
    return np.asarray(np.linalg.norm(points[:, None] - others, axis=-1).min(axis=1) > SAME)


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
