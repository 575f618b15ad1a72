"""How much label maps flicker from frame to frame: the thesis blames its errors on it (Section 5.1)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import InputError, files, masks
from thesis_repro.cityscapes import ID
from thesis_repro.odometry import THESIS, keypoints

Box = tuple[int, int, int, int]  # left, top, right, bottom, pixels; the last two just outside

EXACT = "exact label maps"  # what the flicker of those of a world is called; it is the floor of the measure
CONSISTENT = 1.0  # pixels; forward and backward flow must cancel to this, or the pixel is left out


def flicker(label_maps: Sequence[np.ndarray], frames: Sequence[np.ndarray]) -> pd.DataFrame:
    """The share of pixels whose class changes between consecutive frames, after the motion has been taken out.

    label_maps: (h, w) uint8 each, any size; frames: (height, width) uint8 each, as many. Returns a DataFrame with a
    row for each pair of frames: `frame` (the later one), `changed` and `compared`, both shares from 0 to 1.

    The embedded world knows its camera's motion, but the displacement of a pixel needs its depth too, and that of a
    moving car its speed. So the displacement is measured: dense optical flow both ways, and only pixels whose two
    flows cancel are compared, which drops what is occluded, enters or leaves. Run on the exact label maps of the
    embedded world it gives the floor of the measure: flow that is off by a pixel at a boundary.

    Raises InputError for fewer than two frames or another number of label maps.
    """
    if len(frames) != len(label_maps) or len(frames) < 2:
        raise InputError(f"flicker: {len(label_maps)} label maps for {len(frames)} frames; it needs at least two "
                         "frames and a label map for each")
    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    rows = []
    for number in files.progress(range(1, len(frames)), "flicker"):
        before, after = (np.ascontiguousarray(frame) for frame in frames[number - 1:number + 1])
        old, new = (cv2.resize(label_map, after.shape[::-1], interpolation=cv2.INTER_NEAREST)
                    for label_map in label_maps[number - 1:number + 1])
        forward, backward = flow.calc(before, after, None), flow.calc(after, before, None)
        changed, compared = _compare(old, new, forward, backward)
        rows.append({"frame": number, "changed": changed, "compared": compared})
    return pd.DataFrame(rows)


def _compare(old: np.ndarray, new: np.ndarray, forward: np.ndarray, backward: np.ndarray) -> tuple[float, float]:
    """(share of the compared pixels that changed, share of all pixels that could be compared)."""
    height, width = new.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    came_from = columns + backward[..., 0], rows + backward[..., 1]
    there = cv2.remap(forward, *came_from, cv2.INTER_LINEAR, borderValue=(np.inf, np.inf))
    with np.errstate(invalid="ignore"):
        compared = np.linalg.norm(there + backward, axis=-1) <= CONSISTENT
    warped = cv2.remap(old, *came_from, cv2.INTER_NEAREST)
    changed = (warped != new) & compared
    return changed.sum() / max(compared.sum(), 1), compared.mean()


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
    """How the masked keypoints of one object jump between consecutive frames (Section 4.2): a list of Views.

    frames: (height, width) uint8 each; label_maps: (h, w) uint8 each, any size, as many; first: number of the first
    frame. The object is the connected patch of a label, away from the image's border, from which most keypoints jump
    from the first to the second frame; the window follows the median motion of its keypoints. Where no label map holds
    such a patch, the window is the middle of the frame.
    """
    shape = frames[0].shape
    edge_images = [masks.edges(label_map, shape) for label_map in label_maps]
    points = [keypoints.detect(frame, THESIS, masks.dilate(edge_image, dilation_width))
              for frame, edge_image in zip(frames, edge_images, strict=True)]
    moved = [keypoints.track(before, after, some) if len(some) else (some, np.zeros(0, bool))
             for before, after, some in zip(frames, frames[1:], points)]  # where to, and whether they were found
    boxes = [box for box in _boxes(label_maps[0], shape) if _inside(points[0], box).sum() >= FEW]
    tracked, found = moved[0]
    half, jumping = min(shape) // 8, _far(tracked, points[1]) & found
    center = np.array(shape[::-1]) / 2
    if boxes:
        left, top, right, bottom = max(boxes, key=lambda box: (_inside(points[0], box) & jumping).sum())
        center = np.array([left + right, top + bottom]) / 2
        half = int(np.clip(0.65 * max(right - left, bottom - top), half, min(shape) // 2))
    views: list[View] = []
    expected = None  # where the keypoints in the window of the frame before are now
    for index, frame in enumerate(frames):
        corner = np.clip(np.round(center - half).astype(int), 0, np.array(shape[::-1]) - 2 * half)
        left, top, right, bottom = box = (*corner, *(corner + 2 * half))
        window = np.s_[top:bottom, left:right]
        inside = _inside(points[index], box)
        if expected is not None:
            expected = expected[_inside(expected, box)]
        views.append(View(
            first + index, frame[window], edge_images[index][window], points[index][inside] - corner,
            None if expected is None else expected - corner,
            0 if expected is None else int(_far(expected, points[index]).sum())))
        if index < len(moved):
            tracked, found = moved[index]
            used = inside & found
            expected = tracked[used]
            if used.any():
                center = center + np.median(expected - points[index][used], axis=0)
    return views


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
    if not len(before):
        return before, before, before, after
    tracked, found = keypoints.track(first, second, before)
    kept = found & ~_far(tracked, after)
    return before[kept], tracked[kept], before[~kept], after[_far(after, tracked[kept])]
