"""Cameras in files: numbers, or YAML of OpenCV, ROS, EuRoC or Kalibr."""

import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from thesis_repro.data.geometry import are_poses, is_camera_matrix
from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError

COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's coefficients: k1 k2 p1 p2 k3 ...
# Which keys of YAML name a camera's model, and the values, in small letters, that mean OpenCV's.
MODELS = "fisheye_model", "camera_model", "distortion_model"
OPENCVS = "0", "pinhole", "none", "plumb_bob", "rational_polynomial", "radtan", "radial-tangential"


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

    def record(self) -> list[float]:
        """What label maps of frames without its distortion depend on; nothing without any."""
        numbers = [*self.matrix.ravel(), *self.distortion]
        return [float(number) for number in numbers] if self.distortion.any() else []


def undistorted(image: np.ndarray, lens: Camera) -> np.ndarray:
    """Image without a camera's distortion, with the same camera matrix."""
    if not lens.distortion.any():
        return image
    size = image.shape[1], image.shape[0]
    maps = _undistortion(tuple(lens.matrix.ravel()), tuple(lens.distortion), size)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR)


@lru_cache(maxsize=4)
def _undistortion(matrix: tuple, distortion: tuple, size: tuple[int, int]) -> tuple:
    camera = np.reshape(matrix, (3, 3))
    return cv2.initUndistortRectifyMap(
        camera, np.array(distortion), None, camera, size, cv2.CV_16SC2
    )


def read_camera(path: str | Path, name: str = "") -> Camera:
    """Read a camera from a file.

    The file holds fx fy cx cy, and distortion in OpenCV's order, or is YAML as OpenCV's
    calibration, ROS, EuRoC (sensor.yaml) or Kalibr write it. name: of the camera in its layout,
    such as cam1, which tells those of Kalibr's file apart. Raises InputError for any other file,
    and for a camera of another model, such as a fisheye.
    """
    text = read_text(path)
    try:
        if Path(path).suffix in (".yaml", ".yml"):
            camera = _of_yaml(path, _stated(path, text, name))
        else:
            numbers = np.array(re.sub("#.*", "", text).replace(",", " ").split(), np.float64)
            camera = Camera(pinhole_matrix(numbers[:4]), numbers[4:])
        is_camera = is_camera_matrix(camera.matrix) and len(camera.distortion) in COUNTS
        is_camera = is_camera and bool(np.isfinite(camera.distortion).all())
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        is_camera = False
    if not is_camera:
        raise InputError(
            f"{path}: must hold fx fy cx cy k1 k2 p1 p2 or only the first four, or be YAML of OpenCV, ROS, "
            "EuRoC or Kalibr; docs/own-data.md writes it for other cameras"
        )
    return camera


def pinhole_matrix(numbers: Iterable[float]) -> np.ndarray:
    """Camera matrix, (3, 3), of fx, fy, cx, cy."""
    fx, fy, cx, cy = numbers
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


# YAML


def _stated(path: str | Path, text: str, name: str) -> dict[str, Any]:
    """Return what the first document of a YAML file says of a camera, {key: value}."""
    # OpenCV begins with a directive, and marks matrices in a way that YAML does not know
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    documents = yaml.safe_load_all("\n".join(lines).replace("!!opencv-matrix", ""))
    stated: dict[str, Any] = next(filter(None, documents), {})
    chain = [key for key in stated if re.fullmatch(r"cam\d+", str(key))]  # Kalibr's
    if not chain:
        return stated
    wanted = name if name.startswith("cam") else "cam0"
    if wanted not in chain:
        raise InputError(f"{path}: holds {', '.join(chain)}, but no {wanted}")
    return stated[wanted]


def _of_yaml(path: str | Path, stated: dict[str, Any]) -> Camera:
    for key in MODELS:
        if str(stated.get(key, "none")).lower() not in OPENCVS:
            raise InputError(
                f"{path}: {key} is {stated[key]}; only pinhole cameras with radial and tangential distortion "
                "are read, so undistort the frames first"
            )
    size = None
    if "camera_matrix" in stated:  # OpenCV, ROS
        matrix = _numbers(stated["camera_matrix"]).reshape(3, 3)
        if "image_width" in stated:
            size = int(stated["image_height"]), int(stated["image_width"])
    else:  # EuRoC, Kalibr
        matrix = pinhole_matrix(_numbers(stated["intrinsics"]))
        if "resolution" in stated:
            width, height = stated["resolution"]
            size = int(height), int(width)
    coefficients = "distortion_coefficients"
    if coefficients not in stated:
        coefficients = "distortion_coeffs"  # Kalibr
    if stated.get("distortion_model") == "none":
        stated = {coefficients: []} | stated
    return Camera(matrix, _numbers(stated[coefficients]), size, _body(path, stated))


def _numbers(value: Any) -> np.ndarray:
    """Numbers, (n,), of nested lists, or of the data of a matrix."""
    if isinstance(value, dict):
        value = value["data"]
    return np.array(value, np.float64).ravel()


def _body(path: str | Path, stated: dict[str, Any]) -> np.ndarray | None:
    """Pose of the camera in the body: T_BS of EuRoC, or the inverse of Kalibr's T_cam_imu."""
    if "T_BS" in stated:
        pose = _numbers(stated["T_BS"]).reshape(4, 4)
    elif "T_cam_imu" in stated:
        pose = np.linalg.inv(_numbers(stated["T_cam_imu"]).reshape(4, 4))
    else:
        return None
    if not are_poses(pose[None]).all():
        raise InputError(
            f"{path}: T_BS or T_cam_imu must be a right-handed rotation and a position in metres"
        )
    return pose
