"""The layout of EuRoC, TUM-VI and others (ASL): mav0/cam0/data, sensor.yaml, poses of the body.

The names of frames are their times in nanoseconds. `Sequence` makes poses of the camera of those
of the body.
"""

from pathlib import Path

from thesis_repro.data.cameras import read_camera
from thesis_repro.data.frames import Files, camera_folder, frames_in

LAYOUT = "EuRoC (mav0/cam0/data)"
CAMERAS = ("cam0", "cam1")


def _mav(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def is_mine(folder: Path) -> bool:
    """Whether a folder, or mav0 in it, has a camera's frames."""
    return any((_mav(folder) / name / "data").is_dir() for name in CAMERAS)


def poses(folder: Path) -> Path:
    """File of the body's poses."""
    return _mav(folder) / "state_groundtruth_estimate0/data.csv"


def files(folder: Path, camera: str | None) -> Files:
    """Files of a sequence. camera: one of CAMERAS."""
    image_folder = camera_folder(_mav(folder), CAMERAS, camera, "data") or folder
    sensor = image_folder.parent
    return Files(
        frames_in(image_folder),
        sensor / "sensor.yaml",
        read_camera,
        sensor / "times.txt",
        poses(folder),
    )
