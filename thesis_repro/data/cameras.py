"""Cameras of own frames, with distortion as OpenCV describes it."""

import re
from pathlib import Path

import cv2
import numpy as np

from thesis_repro.data.trajectories import text_of
from thesis_repro.errors import InputError

# k3 may be left out, or all of the distortion
NAMES = "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"


def read_camera(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera matrix, (3, 3) pixels, and distortion coefficients in OpenCV's order, (n,).

    The file holds the numbers of NAMES, or is a YAML file as OpenCV's calibration or ORB-SLAM has
    it, or Kalibr for cam0. Raises InputError for any other file, such as that of a fisheye camera.
    """
    text = text_of(path)
    try:
        if Path(path).suffix in (".yaml", ".yml"):
            numbers = _numbers_of_yaml(text)
        else:
            numbers = np.array(text.split(), np.float64)
    except (ValueError, cv2.error, SystemError):  # the last one is OpenCV's for damaged YAML
        numbers = np.empty(0)
    if len(numbers) < 4 or len(numbers) in (5, 6, 7):
        raise InputError(
            f"{path}: must hold {' '.join(NAMES[:-1])}, or be YAML of OpenCV's calibration, ORB-SLAM or "
            "Kalibr (pinhole, radtan)"
        )
    fx, fy, cx, cy = numbers[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), numbers[4:]


def _numbers_of_yaml(text: str) -> np.ndarray:
    # Kalibr's; OpenCV does not read all its lists
    fields = dict(re.findall(r"(\w+): *\[?([^]\n]*)", text.partition("cam1:")[0]))
    if (fields.get("camera_model"), fields.get("distortion_model")) == ("pinhole", "radtan"):
        numbers = f"{fields.get('intrinsics')},{fields.get('distortion_coeffs')}"
        return np.array(numbers.split(","), np.float64)
    if not text.startswith("%YAML"):  # OpenCV reads only files that begin with it
        text = f"%YAML:1.0\n---\n{text}"
    file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    matrix = file.getNode("camera_matrix").mat()
    distortion = file.getNode("distortion_coefficients").mat()
    if matrix is not None and distortion is not None:
        return np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], distortion.ravel()])
    # as ORB-SLAM2 and ORB-SLAM3 name them
    nodes = [file.getNode(f"{key}.{name}") for name in NAMES for key in ("Camera", "Camera1")]
    return np.array([node.real() for node in nodes if not node.empty()])
