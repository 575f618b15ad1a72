"""What is a camera matrix, and of which frames; what is a pose."""

from collections import namedtuple
from pathlib import Path

import numpy as np

from thesis_repro.errors import InputError

# Intrinsics in pixels at the stated image size (Section 3.7.2); KITTI's gray images have no
# distortion.
Pinhole = namedtuple("Pinhole", "width height fx fy cx cy")
_CAMERA_00 = Pinhole(1241, 376, 718.856, 718.856, 607.1928, 185.2157)
_CAMERA_03 = Pinhole(1242, 375, 721.5377, 721.5377, 609.5593, 172.854)
_CAMERA_04 = Pinhole(1226, 370, 707.0912, 707.0912, 601.8873, 183.1104)
CAMERAS = {
    "00": _CAMERA_00,
    "01": _CAMERA_00,
    "02": _CAMERA_00,
    "03": _CAMERA_03,
    **{f"{n:02d}": _CAMERA_04 for n in range(4, 11)},
}
# width and height that go with a focal length and a centre's u, which tell KITTI's cameras apart
KNOWN_SIZES = {
    (round(camera.fx, 3), round(camera.cx, 3)): (camera.width, camera.height)
    for camera in CAMERAS.values()
}
MIN_FRAME_SIDE = 16  # pixels; keypoints cannot be tracked in smaller frames
ROTATION_TOLERANCE = 1e-3  # largest entry of R R^T - I; pose files have few digits


def is_camera_matrix(matrix: np.ndarray) -> bool:
    """Whether a matrix is that of Equation 2.4, (3, 3), without skew."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    (fx, _, u), (_, fy, v), _ = matrix
    return min(fx, fy) > 0 and np.array_equal(matrix, [[fx, 0, u], [0, fy, v], [0, 0, 1]])


def check_camera(
    path: Path | str,
    intrinsics: np.ndarray,
    frame: Path | str,
    size: tuple[int, int],
    stated: tuple[int, int] | None = None,
) -> None:
    """Raise InputError if frames are too small or do not fit the camera.

    size: height and width. stated: those that the camera's file says its frames have.
    """
    height, width = size
    if min(size) < MIN_FRAME_SIDE:
        raise InputError(
            f"{frame}: {width}x{height} pixels; each side needs {MIN_FRAME_SIDE} or more"
        )
    (fx, _, u), (_, fy, v), _ = intrinsics
    if stated is None:
        stated = KNOWN_SIZES.get((round(fx, 3), round(u, 3)), (width, height))[::-1]
    if stated != size:
        raise InputError(
            f"{path}: is for frames of {stated[1]}x{stated[0]} pixels, but {frame} has "
            f"{width}x{height}; scale or shift focal lengths and centre as the frames were"
        )
    center_fits = 0 <= u <= width and 0 <= v <= height
    focal_lengths_fit = all(width / 100 < focal < width * 100 for focal in (fx, fy))
    if not (center_fits and focal_lengths_fit):
        raise InputError(
            f"{path}: focal lengths {fx:g}, {fy:g} and centre {u:g}, {v:g} do not fit frames of "
            f"{width}x{height} pixels"
        )


def are_poses(poses: np.ndarray) -> np.ndarray:
    """Whether each of (n, 4, 4) is a right-handed rotation and a position in metres.

    Returns (n,) booleans.
    """
    rotations = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        products = rotations @ rotations.transpose(0, 2, 1)
        errors = np.abs(products - np.eye(3)).max(axis=(1, 2))
        is_right_handed = np.linalg.det(rotations) > 0
    is_pose = (poses[:, 3] == [0, 0, 0, 1]).all(axis=1)
    return is_pose & (errors <= ROTATION_TOLERANCE) & is_right_handed
