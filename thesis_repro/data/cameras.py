"""Cameras in files of many kinds, with distortion as OpenCV describes it."""

import re
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from thesis_repro.data.geometry import are_poses, is_camera_matrix
from thesis_repro.data.trajectories import read_line, read_text
from thesis_repro.errors import InputError
from thesis_repro.running import program

# The numbers of a camera in OpenCV's order; k3 to k6 may be left out, or all of the distortion.
NAMES = "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"
COUNTS = (0, 4, 5, 8, 12, 14)  # of OpenCV's coefficients
# How YAML files call what a camera has. Of each table, the first entry all of whose keys a file has
# is read; without a matrix, NAMES with a prefix (ORB-SLAM, stella_vslam, VINS-Fusion, none).
MATRICES = (
    *(("camera_matrix",), ("K",), ("k",)),
    *(("intrinsics",), ("focal_length", "principal_point")),  # EuRoC and Kalibr; OKVIS
)
PREFIXES = "Camera.", "Camera1.", "projection_parameters.", "distortion_parameters.", ""
DISTORTIONS = (
    *(("distortion_coefficients",), ("distortion_coeffs",), ("distortion",), ("D",), ("d",)),
    *(("dist_coeffs",), ("dist_coeff",), ("distCoeffs",)),
)
SIZES = (
    *(("resolution",), ("image_dimension",), ("image_width", "image_height"), ("width", "height")),
    *(("Camera.width", "Camera.height"), ("Camera1.width", "Camera1.height")),
    ("Camera.cols", "Camera.rows"),
)
# Kalibr states the body's pose in the camera, the others (EuRoC, OKVIS, ORB-SLAM2 and 3, OpenVINS)
# the camera's in the body.
INVERSE_BODY = "T_cam_imu"
BODIES = "T_BS", "T_SC", "Tbc", "IMU.T_b_c1", "T_imu_cam", INVERSE_BODY
# Which keys name a camera's model, and the values, in small letters, that mean OpenCV's.
MODELS = (
    *("fisheye_model", "camera_model", "model_type", "distortion_model", "distortion_type"),
    *("Camera.type", "Camera.model", "Camera.bFishEye"),
)
OPENCVS = (
    *("0", "none", "pinhole", "pinhole_full", "perspective", "rectified", "plumb_bob"),
    *("rational_polynomial", "radtan", "radial-tangential", "radialtangential"),
    "radialtangential8",
)


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

    The file holds the numbers of NAMES, or a camera matrix (3x3, 3x4 or 4x4), or KITTI's lines P0
    or P_rect_00, or is YAML as OpenCV's calibration, ROS (camera_info), EuRoC, Kalibr, OKVIS,
    VINS-Fusion or ORB-SLAM have it. name: of the camera in its layout, such as cam1 or image_2,
    which tells those of a file with several apart. Raises InputError for any other file, for a
    camera of another model, such as a fisheye, and for YAML whose distortion is not understood.
    """
    text = read_text(path)
    size, body = None, None
    try:
        if Path(path).suffix in (".yaml", ".yml"):
            stated = _stated(path, text, name)
            _check_model(path, stated)
            numbers = _of_keys(path, stated)
            size, body = _size(stated), _body(path, stated)
        elif kittis := re.search(r"^(P|P_rect_0)\d:", text, re.MULTILINE):
            camera = kittis[1] + (name[-1] if name.startswith("image") else "0")
            numbers = _of_matrix(read_line(path, f"{camera}:", 12))
            if kittis[1] != "P":
                width, height = read_line(path, f"S{camera[1:]}:", 2)
                size = int(height), int(width)
        else:
            numbers = _of_matrix(_numbers(re.sub("#.*", "", text)))
    except InputError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        numbers = np.empty(0)
    if len(numbers) - 4 not in COUNTS or not np.isfinite(numbers).all() or min(numbers[:2]) <= 0:
        raise InputError(
            f"{path}: must hold {' '.join(NAMES[:8])}, only the first four, or a camera matrix (fx 0 cx, 0 fy cy, "
            "0 0 1), or be YAML of OpenCV's calibration, ROS, EuRoC, Kalibr, OKVIS, VINS-Fusion or ORB-SLAM "
            "(pinhole, radtan)"
        )
    fx, fy, cx, cy = numbers[:4]
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), numbers[4:], size, body)


def read_body(path: Path) -> np.ndarray | None:
    """Pose, 4x4, of the camera in the body (T_BS), if a YAML file of one camera states it."""
    if path.suffix != ".yaml" or not path.is_file():
        return None
    try:
        return _body(path, _stated(path, read_text(path), "cam0"))
    except (ValueError, AttributeError, yaml.YAMLError):
        return None


# Numbers


def _numbers(value: Any) -> np.ndarray:
    """Numbers, (n,), of a text or of nested lists, in which OpenCV lets commas be missing."""
    words = re.split(r"[\s,;()'\"\[\]]+", str(value))
    return np.array([word for word in words if word], np.float64)


def _of_matrix(numbers: np.ndarray) -> np.ndarray:
    """Return fx, fy, cx, cy of a camera matrix, row by row; other numbers stay as they are."""
    rows, columns = {9: (3, 3), 12: (3, 4), 16: (4, 4)}.get(len(numbers), (0, 0))
    if not rows:
        return numbers
    matrix = numbers.reshape(rows, columns)[:3, :3]
    if matrix[1, 0] or not np.array_equal(matrix[2], [0, 0, 1]):
        return numbers
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]] if is_camera_matrix(matrix) else np.empty(0)


# YAML


def _stated(path: str | Path, text: str, name: str) -> dict[str, Any]:
    """Return what the first document of a YAML file says of a camera, {key: value}.

    The keys of nested values are joined by dots.
    """
    # OpenCV begins with a directive, marks matrices in ways that YAML does not know, and wants no
    # blank after a colon
    lines = [line for line in text.expandtabs().splitlines() if not line.startswith("%")]
    text = "\n".join(re.sub(r"^( *[\w.]+):(?=[^\s:])", r"\1: ", line) for line in lines)
    documents = yaml.safe_load_all(text.replace("!!opencv-matrix", ""))
    stated: dict[str, Any] = next(filter(None, documents), {})
    wanted = name if name.startswith("cam") else "cam0"
    cameras = stated.get("cameras")  # OKVIS's
    if isinstance(cameras, list):
        stated |= {f"cam{index}": camera for index, camera in enumerate(cameras)}
    chain = [key for key, of in stated.items() if key[:3] == "cam" and isinstance(of, dict)]
    chain = [key for key in chain if key[3:].isdigit()]
    if chain and wanted not in chain:
        raise InputError(f"{path}: holds {', '.join(chain)}, but no {wanted}")
    flat = _flat(stated[wanted] if chain else stated)
    if wanted != "cam0":  # the right camera of ORB-SLAM3
        flat |= {f"Camera1{key[7:]}": flat[key] for key in flat if key.startswith("Camera2.")}
    return flat


def _flat(stated: dict[str, Any]) -> dict[str, Any]:
    flat = {}
    for key, value in stated.items():
        if isinstance(value, dict) and "data" in value:
            flat[key] = value["data"]
        elif isinstance(value, dict):
            flat |= {f"{key}.{inner}": of for inner, of in _flat(value).items()}
        else:
            flat[key] = value
    return flat


def _check_model(path: str | Path, stated: dict[str, Any]) -> None:
    if calibration := stated.get("cam0_calib"):
        raise InputError(f"{path}: holds no camera, but names {calibration}; give that file")
    for key in MODELS:
        model = stated.get(key)
        if model not in (None, "") and str(model).lower() not in OPENCVS:
            raise InputError(
                f"{path}: {key} is {model}; only pinhole cameras with radial and tangential distortion "
                "are read, so undistort the frames first"
            )
    if "LEFT.K" in stated:
        program.log.warning(
            f"{path}: Camera.fx and the others are those of rectified frames; raw ones have LEFT.K and LEFT.D"
        )


def _of_keys(path: str | Path, stated: dict[str, Any]) -> np.ndarray:
    """Numbers in the order of NAMES."""
    matrix, distortion = _first(stated, MATRICES), _first(stated, DISTORTIONS)
    if matrix is None:
        keys = {name: [prefix + name for prefix in PREFIXES] for name in NAMES}
        single = {name: stated[key] for name in NAMES for key in keys[name] if key in stated}
        if tuple(single) != NAMES[: len(single)]:
            return np.empty(0)
        numbers = _numbers(list(single.values()))
        return numbers if distortion is None else np.concatenate([numbers[:4], distortion])
    if distortion is None and stated.get("distortion_model") != "none":
        raise InputError(
            f"{path}: has no distortion that is understood; its key is {DISTORTIONS[0][0]}, with [0, 0, 0, 0] "
            "for frames without distortion"
        )
    return np.concatenate([_of_matrix(matrix), [] if distortion is None else distortion])


def _first(stated: dict[str, Any], forms: tuple[tuple[str, ...], ...]) -> np.ndarray | None:
    """Return the numbers, (n,), of the first form whose keys there are."""
    for keys in forms:
        if stated.keys() >= {*keys}:
            return np.concatenate([_numbers(stated[key]) for key in keys])
    return None


def _size(stated: dict[str, Any]) -> tuple[int, int] | None:
    """(height, width) of the frames."""
    size = _first(stated, SIZES)
    return None if size is None else (int(size[1]), int(size[0]))


def _body(path: str | Path, stated: dict[str, Any]) -> np.ndarray | None:
    for key in BODIES:
        if key in stated:
            pose = _numbers(stated[key]).reshape(1, 4, 4)
            if not are_poses(pose).all():
                raise InputError(
                    f"{path}: {key} must be a right-handed rotation and a position in metres"
                )
            return np.linalg.inv(pose[0]) if key == INVERSE_BODY else pose[0]
    return None
