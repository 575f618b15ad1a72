"""The layout of KITTI's odometry benchmark, and folders of own frames.

A sequence is sequences/NN with image_0, calib.txt and times.txt; its poses are poses/NN.txt. Own
frames lie in image_0 or in the folder itself, and poses.txt beside them.
"""

import re
from functools import partial
from pathlib import Path

import numpy as np

from thesis_repro.data.cameras import Camera
from thesis_repro.data.frames import Files, camera_folder, frames_in
from thesis_repro.data.geometry import is_camera_matrix
from thesis_repro.data.trajectories import read_line, read_truth
from thesis_repro.errors import InputError
from thesis_repro.running.files import images

LAYOUT = "KITTI odometry (image_0, calib.txt), or frames in the folder itself"
# left gray, left colour, then the right ones
IMAGE_FOLDERS = ("image_0", "image_2", "image_1", "image_3")
KEYS = {name: f"P{name[-1]}" for name in IMAGE_FOLDERS}  # their lines in the calibration
RIGHT = re.compile("P(_rect_0)?[13]")  # lines of the right cameras


def is_mine(folder: Path) -> bool:
    """Whether a folder has a camera's, or holds images itself."""
    return any((folder / name).is_dir() for name in IMAGE_FOLDERS) or bool(images(folder))


def poses(folder: Path) -> Path:
    """File of the poses: poses/NN.txt beside sequences, or else poses.txt in the folder."""
    own = folder / "poses.txt"
    official = folder.parent.parent / "poses" / f"{folder.name}.txt"
    if folder.parent.name == "sequences" and (official.exists() or not own.exists()):
        return official
    return own


def files(folder: Path, camera: str | None) -> Files:
    """Files of a sequence. camera: one of IMAGE_FOLDERS."""
    image_folder = camera_folder(folder, IMAGE_FOLDERS, camera) or folder
    calibration, key = folder / "calib.txt", KEYS.get(image_folder.name, "P0")
    return Files(
        frames_in(image_folder),
        calibration,
        partial(read_camera, key=key),
        folder / "times.txt",
        poses(folder),
        read_poses=partial(_read_poses, calibration=calibration, key=key),
        camera=image_folder.name,
    )


def read_camera(path: Path, key: str = "P0") -> Camera:
    """Read the camera (Equation 2.4) of a line such as P0: its first three columns.

    Raises InputError if the line is missing, or if the camera has distortion or skew.
    """
    return Camera(_projection(path, key)[:, :3], np.empty(0))


def _projection(path: Path, key: str) -> np.ndarray:
    """Return the projection matrix, (3, 4), pixels, of a line."""
    form = ", f 0 u 0 0 f v 0 0 0 1 0, of a camera without distortion"
    projection = read_line(path, f"{key}:", 12, form).reshape(3, 4)
    if not is_camera_matrix(projection[:, :3]):
        raise InputError(f"{path}: line '{key}:' must hold 12 numbers{form}")
    return projection


def _read_poses(
    path: Path, times: np.ndarray | None, within: float, calibration: Path, key: str
) -> tuple:
    indices, found = read_truth(path, times, within)
    return indices, moved(found, calibration, key)


def moved(poses: np.ndarray, calibration: Path, key: str) -> np.ndarray:
    """Poses of camera 0, moved to a right camera.

    It sees a point X of camera 0 at K X + p, so its centre is -K^-1 p, half a metre to the right.
    (The left colour camera, 6 cm beside, has the poses of camera 0.)
    """
    if not RIGHT.fullmatch(key):
        return poses
    projection, offset = _projection(calibration, key), np.eye(4)
    offset[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return poses @ offset
