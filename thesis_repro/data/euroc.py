"""The layout of EuRoC: mav0/cam0/data, data.csv and sensor.yaml beside it, poses of the body.

`Sequence` makes poses of the camera of those of the body.
"""

from functools import partial
from pathlib import Path

import numpy as np

from thesis_repro.data.cameras import read_camera
from thesis_repro.data.frames import Files, camera_folder, frames_in
from thesis_repro.data.trajectories import read_text
from thesis_repro.errors import InputError

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
    sensor, frames = image_folder.parent, frames_in(image_folder)
    return Files(
        frames,
        sensor / "sensor.yaml",
        partial(read_camera, name=sensor.name),
        sensor / "data.csv",
        poses(folder),
        partial(_read_times, frames=frames),
        camera=sensor.name,
    )


def _read_times(path: Path, frames: list[Path]) -> np.ndarray:
    """Times of frames, (n,), seconds, from lines of nanoseconds and a name.

    A name may have a folder before it, and another ending. Raises InputError if a frame has no
    time, and unless they increase.
    """
    listed = {}
    for line in read_text(path).splitlines():
        time, _, name = line.partition(",")
        if not line.startswith("#"):
            listed[Path(name.strip()).stem] = time
    missing = [frame.name for frame in frames if frame.stem not in listed]
    if missing:
        raise InputError(
            f"{path}: has no time of {missing[0]} ({len(missing)} of {len(frames)} frames)"
        )
    try:
        times = 1e-9 * np.array([listed[frame.stem] for frame in frames], np.float64)
    except ValueError:
        times = np.zeros(2)
    if not (np.diff(times) > 0).all():
        raise InputError(
            f"{path}: must hold a time in nanoseconds and the name of a frame in each line; the times must "
            "increase"
        )
    return times
