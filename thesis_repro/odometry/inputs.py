"""What a caller gives to the odometry, checked: camera, start, frame, step length and mask."""

from typing import Any

import numpy as np

from thesis_repro.data.geometry import are_poses, check_camera, is_camera_matrix
from thesis_repro.errors import InputError

MIN_CONTRAST = 4.0  # standard deviation in gray levels; real frames have more than 50
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


def start_pose(start: Any) -> np.ndarray:
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
    if frame.flags.writeable:  # the caller may read the next frame into the same array
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
