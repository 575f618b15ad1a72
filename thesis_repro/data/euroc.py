"""The layout of EuRoC, TUM-VI and others (ASL): mav0/cam0/data, sensor.yaml, poses of the body.

The times of frames are those of cam0/data.csv or else their names, nanoseconds. `Sequence` makes
poses of the camera of those of the body.
"""

from functools import partial
from pathlib import Path

import numpy as np

from thesis_repro.data import trajectories
from thesis_repro.data.cameras import read_camera
from thesis_repro.data.frames import Files, camera_folder, frames_in
from thesis_repro.errors import InputError

LAYOUT = "EuRoC (mav0/cam0/data)"
CAMERAS = ("cam0", "cam1")
TRUTHS = ("state_groundtruth_estimate0", "mocap0")  # EuRoC's, TUM-VI's


def _mav(folder: Path) -> Path:
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def is_mine(folder: Path) -> bool:
    """Whether a folder, or mav0 in it, has a camera's frames."""
    return any((_mav(folder) / name / "data").is_dir() for name in CAMERAS)


def poses(folder: Path) -> Path:
    """File of the body's poses."""
    files = [_mav(folder) / name / "data.csv" for name in TRUTHS]
    return next(filter(Path.exists, files), files[0])


def files(folder: Path, camera: str | None) -> Files:
    """Files of a sequence. camera: one of CAMERAS."""
    image_folder = camera_folder(_mav(folder), CAMERAS, camera, "data") or folder
    sensor = image_folder.parent
    frames, times = frames_in(image_folder), sensor / "times.txt"
    is_listed = not times.exists() and (sensor / "data.csv").exists()
    return Files(
        frames,
        sensor / "sensor.yaml",
        partial(read_camera, name=sensor.name),
        sensor / "data.csv" if is_listed else times,
        poses(folder),
        partial(_read_times, frames=frames) if is_listed else trajectories.read_times,
        camera=sensor.name,
    )


def _read_times(path: Path, frames: list[Path]) -> np.ndarray:
    """Times of frames, (n,), seconds, from lines of nanoseconds and a name.

    Frames of other names have the times in their order, if these are as many. Raises InputError if
    a frame has no time, and unless they increase.
    """
    lines = [line.strip() for line in trajectories.read_text(path).splitlines()]
    rows = [line.partition(",") for line in lines if line and line[0] != "#"]
    listed = {name.strip(): time for time, _, name in rows}
    if len(rows) == len(frames) and not listed.keys() & {frame.name for frame in frames}:
        listed = {frame.name: row[0] for frame, row in zip(frames, rows)}
    missing = [frame.name for frame in frames if frame.name not in listed]
    if missing:
        raise InputError(
            f"{path}: has no time of {missing[0]} ({len(missing)} of {len(frames)} frames)"
        )
    try:
        times = 1e-9 * np.array([listed[frame.name] for frame in frames], np.float64)
    except ValueError:
        times = np.zeros(2)
    if not (np.diff(times) > 0).all():
        raise InputError(
            f"{path}: must hold a time in nanoseconds and the name of a frame in each line; the times must "
            "increase"
        )
    return times
