"""Cameras of own frames, with distortion as OpenCV describes it."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError

# k3 may be left out, or all of the distortion
NAMES = "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"
COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's coefficients
# {what a YAML file may say of its camera: the values that mean OpenCV's model}
MODELS = {
    "fisheye_model": ("0",),
    "camera_model": ("pinhole",),
    "distortion_model": ("radtan", "radial-tangential", "plumb_bob", "rational_polynomial", "none"),
    "Camera.type": ("PinHole", "Pinhole", "Rectified"),
}


class Camera(NamedTuple):
    """A camera of a file.

    matrix: (3, 3) pixels. distortion: coefficients in OpenCV's order, (n,). size: (height, width)
    of its frames, if the file says so.
    """

    matrix: np.ndarray
    distortion: np.ndarray
    size: tuple[int, int] | None = None


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a file.

    The file holds the numbers of NAMES, or is YAML as OpenCV's calibration, ROS (camera_info),
    EuRoC (sensor.yaml), Kalibr (its cam0) or ORB-SLAM have it. Raises InputError for any other
    file, and for a camera of another model, such as a fisheye.
    """
    text = read_text(path)
    is_yaml = Path(path).suffix in (".yaml", ".yml")
    if is_yaml:
        text = text.partition("cam1:")[0]
        _check_model(path, text)
    try:
        numbers = _numbers_of_yaml(text) if is_yaml else np.array(text.split(), np.float64)
        size = _size_of_yaml(text)
    except ValueError:
        numbers, size = np.empty(0), None
    if len(numbers) - 4 not in COUNTS:
        raise InputError(
            f"{path}: must hold {' '.join(NAMES[:-1])}, only the first four, or be YAML of OpenCV's "
            "calibration, ROS, EuRoC, Kalibr or ORB-SLAM (pinhole, radtan)"
        )
    fx, fy, cx, cy = numbers[:4]
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), numbers[4:], size)


def _check_model(path: str | Path, text: str) -> None:
    for key, known in MODELS.items():
        model = _value(text, key)
        if model and model not in known:
            raise InputError(
                f"{path}: {key} is {model}; only pinhole cameras with radial and tangential distortion "
                "are read, so undistort the frames first"
            )


def _numbers_of_yaml(text: str) -> np.ndarray:
    """Numbers in the order of NAMES."""
    matrix = _list(text, "camera_matrix|K|k")
    numbers = _list(text, "intrinsics")  # EuRoC's, Kalibr's
    if len(matrix) == 9:
        numbers = matrix[[0, 4, 2, 5]]
    if len(numbers):
        distortion = _list(text, "distortion_coeff(?:icient)?s|D|d")
        return np.concatenate([numbers, distortion])
    values = [_value(text, rf"Camera1?\.{name}") for name in NAMES]  # ORB-SLAM2's and 3's
    return np.array([value for value in values if value], np.float64)


def _size_of_yaml(text: str) -> tuple[int, int] | None:
    """(height, width) of the frames."""
    resolution = _list(text, "resolution")  # EuRoC's, Kalibr's: width, height
    if len(resolution) == 2:
        return int(resolution[1]), int(resolution[0])
    sides = [_value(text, rf"(?:image_|Camera1?\.)?{side}") for side in ("height", "width")]
    if not all(sides):
        return None
    return int(sides[0]), int(sides[1])


def _value(text: str, key: str) -> str:
    found = re.search(rf'^ *{key}: *"?([^\s"#]+)', text, re.MULTILINE)
    return found[1] if found else ""


def _list(text: str, key: str) -> np.ndarray:
    """Numbers in brackets after a key, or after the "data" of a matrix."""
    of_matrix = r"(?:!!opencv-matrix\s*)?(?:\s*(?:rows|cols|dt|data): *\w*)*"
    found = re.search(rf"^ *(?:{key}): *{of_matrix}\s*\[([^]]*)\]", text, re.MULTILINE)
    return np.array(found[1].split(",") if found and found[1].strip() else [], np.float64)
