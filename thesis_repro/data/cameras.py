"""Cameras of own frames, with distortion as OpenCV describes it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from thesis_repro.data.geometry import are_poses
from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError

# k3 may be left out, or all of the distortion
NAMES = "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"
COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's coefficients
MATRICES = "camera_matrix", "K", "k"  # keys of a YAML file
DISTORTIONS = (
    *("distortion_coefficients", "distortion_coeffs", "distortion", "D", "d"),
    *("dist_coeffs", "dist_coeff", "distCoeffs"),
)
# {what a YAML file may say of its camera: the values that mean OpenCV's model}
MODELS = {
    "fisheye_model": ("0",),
    "camera_model": ("pinhole", "plumb_bob"),
    "distortion_model": ("radtan", "radial-tangential", "plumb_bob", "rational_polynomial", "none"),
    "Camera.type": ("PinHole", "Pinhole", "Rectified"),
}


class Camera(NamedTuple):
    """A camera of a file.

    matrix: (3, 3) pixels. distortion: coefficients in OpenCV's order, (n,). size: (height, width)
    of its frames, if the file says so. body: pose, 4x4, of the camera in the body that carries it
    (EuRoC's T_BS), if the file says so.
    """

    matrix: np.ndarray
    distortion: np.ndarray
    size: tuple[int, int] | None = None
    body: np.ndarray | None = None


def read_camera(path: str | Path) -> Camera:
    """Read a camera from a file.

    The file holds the numbers of NAMES, or is YAML as OpenCV's calibration, ROS (camera_info),
    EuRoC (sensor.yaml), Kalibr (its cam0) or ORB-SLAM have it. Raises InputError for any other
    file, for a camera of another model, such as a fisheye, and for a YAML file whose distortion is
    not understood.
    """
    text = read_text(path)
    size, body = None, None
    try:
        if Path(path).suffix in (".yaml", ".yml"):
            stated = _stated(text)
            _check_model(path, stated)
            numbers = _numbers(path, stated)
            size, body = _size(stated), _body(path, stated)
        else:
            numbers = np.array(text.split(), np.float64)
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        numbers = np.empty(0)
    if len(numbers) - 4 not in COUNTS or not np.isfinite(numbers).all():
        raise InputError(
            f"{path}: must hold {' '.join(NAMES[:-1])}, only the first four, or be YAML of OpenCV's "
            "calibration, ROS, EuRoC, Kalibr or ORB-SLAM (pinhole, radtan)"
        )
    fx, fy, cx, cy = numbers[:4]
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), numbers[4:], size, body)


def _stated(text: str) -> dict[str, Any]:
    """Return what the first document of a YAML file says; of Kalibr's file, what cam0 has."""
    # OpenCV begins with a directive and marks matrices in ways that YAML does not know
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    documents = yaml.safe_load_all("\n".join(lines).replace("!!opencv-matrix", ""))
    stated: dict[str, Any] = next(filter(None, documents), {})
    return stated.get("cam0", stated)


def _check_model(path: str | Path, stated: dict[str, Any]) -> None:
    for key, known in MODELS.items():
        model = stated.get(key)
        if model not in (None, "") and str(model) not in known:
            raise InputError(
                f"{path}: {key} is {model}; only pinhole cameras with radial and tangential distortion "
                "are read, so undistort the frames first"
            )


def _numbers(path: str | Path, stated: dict[str, Any]) -> np.ndarray:
    """Numbers in the order of NAMES."""
    matrix = _first(stated, MATRICES)
    if matrix is not None:
        numbers = matrix.reshape(3, 3)[[0, 1, 0, 1], [0, 1, 2, 2]]
    elif "intrinsics" in stated:  # EuRoC's, Kalibr's
        numbers = np.array(stated["intrinsics"], np.float64)
    else:  # ORB-SLAM2's and 3's
        keys = [f"{camera}.{name}" for name in NAMES for camera in ("Camera", "Camera1")]
        return np.array([stated[key] for key in keys if key in stated], np.float64)
    distortion = _first(stated, DISTORTIONS)
    if distortion is None and stated.get("distortion_model") != "none":
        raise InputError(
            f"{path}: has no distortion that is understood; its key is {DISTORTIONS[0]}, with [0, 0, 0, 0] "
            "for frames without distortion"
        )
    return np.concatenate([numbers, [] if distortion is None else distortion])


def _first(stated: dict[str, Any], keys: tuple[str, ...]) -> np.ndarray | None:
    """Return the numbers, (n,), of the first key that there is, nested, or "data" of a matrix."""
    for value in (stated[key] for key in keys if key in stated):
        if isinstance(value, dict):
            value = value["data"]
        return np.array(value, np.float64).ravel()
    return None


def _size(stated: dict[str, Any]) -> tuple[int, int] | None:
    """(height, width) of the frames."""
    if "resolution" in stated:  # EuRoC's, Kalibr's
        width, height = stated["resolution"]
        return int(height), int(width)
    for prefix in ("image_", "", "Camera.", "Camera1."):
        if {f"{prefix}height", f"{prefix}width"} <= stated.keys():
            return int(stated[f"{prefix}height"]), int(stated[f"{prefix}width"])
    return None


def _body(path: str | Path, stated: dict[str, Any]) -> np.ndarray | None:
    body = _first(stated, ("T_BS",))
    if body is None:
        return None
    pose = body.reshape(1, 4, 4)
    if not are_poses(pose).all():
        raise InputError(f"{path}: T_BS must be a right-handed rotation and a position in metres")
    return pose[0]
