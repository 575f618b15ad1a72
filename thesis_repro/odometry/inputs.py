"""What a caller gives to the odometry, checked: camera, start, frame, step length and mask."""

from typing import Any

import numpy as np

from thesis_repro.data.geometry import are_poses, check_camera, is_camera_matrix
from thesis_repro.errors import InputError

MIN_CONTRAST = 4.0  # standard deviation in gray levels; real frames have more than 50
MANY = 20  # keypoints from which on they are in pixels, not in fractions
EQUAL = "equal frame"  # flag of a frame that equals the one before


def camera_matrix(intrinsics: Any) -> np.ndarray:
    """Return a camera matrix, (fx, 0, u), (0, fy, v), (0, 0, 1) in pixels, or raise InputError."""
    matrix = np.array(intrinsics, np.float64)
    if not is_camera_matrix(matrix):
        raise InputError(
            "intrinsics: must be (fx, 0, u), (0, fy, v), (0, 0, 1) in pixels, not "
            f"{matrix.tolist()}"
        )
    return matrix


def first_pose(start: Any) -> np.ndarray:
    """Return the pose of the first frame, 4x4 (None: the identity), or raise InputError."""
    if start is None:
        return np.eye(4)
    pose = np.array(start, np.float64)
    if pose.shape != (4, 4) or not are_poses(pose[None]).all():
        raise InputError("start: must be a pose, 4x4: a right-handed rotation and a position")
    return pose


def gray_frame(
    frame: Any, number: int, intrinsics: np.ndarray, previous: np.ndarray | None
) -> np.ndarray:
    """Return frame `number` as (height, width) uint8 that nobody changes, or raise InputError."""
    frame = np.asarray(frame)  # cv2.imread returns None for a missing file
    if frame.dtype != np.uint8 or frame.ndim != 2:
        raise InputError(
            f"frame {number}: {frame.dtype} of shape {frame.shape}; "
            "the odometry needs 8-bit gray, (height, width)"
        )
    check_camera("intrinsics", intrinsics, f"frame {number}", frame.shape)
    if previous is not None and frame.shape != previous.shape:
        raise InputError(
            f"frame {number}: shape {frame.shape}, earlier frames {previous.shape}; "
            "all frames must have the same size"
        )
    return unchangeable(frame)


def unchangeable(frame: np.ndarray) -> np.ndarray:
    """Return a frame that nobody changes: a copy, unless it is read-only and owns its memory.

    A caller may read the next frame into the same array, or a camera into the memory below a view.
    """
    if frame.flags.writeable or not frame.flags.owndata:
        frame = frame.copy()
        frame.setflags(write=False)
    return frame


def reasons_to_skip(frame: np.ndarray, previous: np.ndarray | None) -> list[str]:
    """Return the flag of a frame without contrast, or of one that equals the frame before."""
    if frame[::8, ::8].std() < MIN_CONTRAST:
        return ["flat frame"]
    if previous is not None and np.array_equal(frame, previous):
        return [EQUAL]
    return []


def step_length(scale: Any, number: int) -> float:
    """Return the length of the step to frame `number`, metres, or raise InputError."""
    if scale is None:
        if number == 0:
            return 0.0
        raise InputError(
            f"frame {number}: step(frame, scale) needs the metres moved since the frame before, which "
            "one camera cannot measure; 1.0 for steps of equal length"
        )
    try:
        metres = float(scale)
    except (TypeError, ValueError):
        metres = np.nan
    if not np.isfinite(metres) or metres < 0:
        raise InputError(f"frame {number}: scale {scale!r} is not a distance in metres")
    return metres


def allowed_pixels(mask: Any, number: int, frame: np.ndarray) -> np.ndarray | None:
    """Return the mask of frame `number`, (height, width) uint8 or None, or raise InputError."""
    if mask is None:
        return None
    mask = np.asarray(mask)
    if mask.dtype == bool:
        mask = mask.view(np.uint8)
    if mask.shape != frame.shape or mask.dtype != np.uint8:
        raise InputError(
            f"frame {number}: the mask is {mask.dtype} of shape {mask.shape}, the frame uint8 of "
            f"shape {frame.shape}; masks must be 8-bit and as large as their frames"
        )
    if np.count_nonzero(mask) > np.count_nonzero(mask == mask.max()):
        raise InputError(
            f"frame {number}: the mask holds {len(np.unique(mask))} different values; a mask has "
            "0 and 255 (keypoint_mask makes masks from label maps)"
        )
    return mask


def keypoints(points: Any, frame: np.ndarray, detector: str) -> np.ndarray:
    """Return keypoints of a frame, float32 (N, 2), or raise InputError.

    What lies outside of the frame cannot be (u, v). detector: the name of what found them, for the
    messages.
    """
    returned = f"{detector} returned"
    if getattr(points, "dtype", None) != np.float32 or np.shape(points)[1:] != (2,):
        raise InputError(
            f"{returned} {described(points)}; must be float32 (N, 2), (u, v) in pixels"
        )
    height, width = frame.shape
    u, v = points.T
    # NaN is not below anything; less than a tenth of the time of a test point by point
    if not (
        points.min(initial=0) >= -1 and u.max(initial=0) <= width and v.max(initial=0) <= height
    ):
        inside = ((points >= -1) & (points <= [width, height])).all(axis=1)
        u, v = points[inside.argmin()]
        raise InputError(
            f"{returned} u {u:g}, v {v:g}, outside the frame of {width}x{height} pixels; u is the "
            "column, v the row"
        )
    if len(points) >= MANY and points.max() <= 1:
        raise InputError(f"{returned} fractions from 0 to 1; must be (u, v) in pixels")
    return points


def matches(returned: Any, points: np.ndarray, tracker: str) -> tuple[np.ndarray, np.ndarray]:
    """Return tracked points, float32 (N, 2), and which were found, or raise InputError.

    What was found must be (N,) booleans: NumPy takes OpenCV's 0 and 1 for the numbers of points.
    points: (N, 2), those that were to be tracked. tracker: as the detector of `keypoints`.
    """
    booleans = f"bool {points.shape[:1]}"
    wanted = f"must be float32 {points.shape} and {booleans}, for as many points"
    try:
        tracked, was_found = returned
    except (TypeError, ValueError):
        raise InputError(f"{tracker} returned {described(returned)}; {wanted}") from None
    told = described(tracked), described(was_found)
    if told not in [(f"float{bits} {points.shape}", booleans) for bits in (32, 64)]:
        raise InputError(f"{tracker} returned {' and '.join(told)}; {wanted}")
    if not np.isfinite(tracked[was_found]).all():
        raise InputError(f"{tracker} returned points that are found, but no finite numbers")
    return tracked.astype(np.float32, copy=False), was_found


def described(value: Any) -> str:
    """Return the kind of an array, such as "int64 (500, 2)", or the type of something else."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return type(value).__name__
