"""The layout of TUM RGB-D: rgb.txt, which lists times and frames, and groundtruth.txt.

The camera is that of calib.txt, written as for own frames, or known from the folder's name.
"""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from thesis_repro.data import kitti_odometry
from thesis_repro.data.cameras import Camera, pinhole_matrix
from thesis_repro.data.frames import Files, camera_folder
from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError

LAYOUT = "TUM RGB-D (rgb.txt)"
LIST = "rgb.txt"
# The cameras that the data set's page states: fx fy cx cy, and distortion in OpenCV's order.
FREIBURG = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
SIZE = 480, 640


def is_mine(folder: Path) -> bool:
    """Whether a folder has a list of frames."""
    return (folder / LIST).is_file()


def poses(folder: Path) -> Path:
    """File of the camera's poses."""
    return folder / "groundtruth.txt"


def files(folder: Path, camera: str | None) -> Files:
    """Files of a sequence. camera: "rgb", the only one."""
    camera_folder(folder, ("rgb",), camera)
    listed = _rows(folder / LIST)
    frames = [folder / name for _, name in listed]
    missing = [frame for frame in frames if not frame.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: no such file, but {LIST} lists it")
    times = np.array([time for time, _ in listed])
    return Files(
        frames,
        folder / "calib.txt",
        _read_camera,
        folder / LIST,
        poses(folder),
        lambda path: times,
    )


def _rows(path: Path) -> list[tuple[float, str]]:
    """Return time and name of each frame. Raises InputError unless the times increase."""
    lines = [line.split() for line in read_text(path).splitlines() if not line.startswith("#")]
    try:
        rows = [(float(time), name) for time, name in filter(None, lines)]
    except ValueError:
        rows = []
    if not rows or not all(row[0] < later[0] for row, later in pairwise(rows)):
        raise InputError(
            f"{path}: must hold a time in seconds, later than the one before, and the name of a frame in "
            "each line"
        )
    return rows


def _read_camera(path: Path) -> Camera:
    """Read calib.txt, or know the camera. Raises InputError if there is neither."""
    if path.exists():
        return kitti_odometry.read_camera(path)
    known = re.search("freiburg([123])", path.parent.name)
    if known is None:
        raise InputError(
            f"{path}: no such file, and the folder's name has no freiburg1, 2 or 3, whose cameras are "
            "known; give --calibration FILE, or write this file with a line P0:"
        )
    numbers, distortion = FREIBURG[known[1]]
    return Camera(pinhole_matrix(numbers), np.array(distortion), SIZE)
