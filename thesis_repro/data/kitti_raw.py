"""KITTI's raw drives, read as they are downloaded ("synced and rectified").

Read are calibration, times and poses of a folder such as 2011_09_26/2011_09_26_drive_0005_sync.
The three calibration files lie in the folder of the day, beside the drives. A drive may also be a
link, and they may lie beside it. Poses follow KITTI's development kit (Geiger et al., Vision meets
robotics: The KITTI dataset, 2013).
"""

from functools import partial
from pathlib import Path

import numpy as np

from thesis_repro.data import kitti_odometry
from thesis_repro.data.frames import Files, camera_folder, frames_in
from thesis_repro.data.trajectories import read_line, read_text
from thesis_repro.errors import InputError
from thesis_repro.running.files import listed

LAYOUT = "a raw drive of KITTI (image_00/data, oxts/data)"
# left gray, left colour, then the right ones; frames and time stamps lie in them
IMAGE_FOLDERS = ("image_00", "image_02", "image_01", "image_03")
FRAMES_FOLDER, TIMES, OXTS = "data", "timestamps.txt", "oxts/data"
EARTH_RADIUS = 6378137.0  # metres


def is_mine(folder: Path) -> bool:
    """Whether a folder has the measurements of the OXTS, a GPS with inertial sensors."""
    return (folder / OXTS).is_dir()


def poses(folder: Path) -> Path:
    """Folder of the measurements that the poses are made from."""
    return folder / OXTS


def files(folder: Path, camera: str | None) -> Files:
    """Files of a drive. camera: one of IMAGE_FOLDERS."""
    image_folder = camera_folder(folder, IMAGE_FOLDERS, camera, FRAMES_FOLDER)
    if image_folder is None:
        raise InputError(
            f"{folder}: must hold {IMAGE_FOLDERS[0]}/{FRAMES_FOLDER} or {IMAGE_FOLDERS[1]}/{FRAMES_FOLDER}"
        )
    key = f"P_rect_{image_folder.parent.name[-2:]}"
    used = [calibration(folder, name) for name in ("imu_to_velo", "velo_to_cam")]
    return Files(
        frames_in(image_folder),
        calibration(folder),
        partial(kitti_odometry.read_camera, key=key),
        image_folder.parent / TIMES,
        poses(folder),
        read_times,
        partial(_read_truth, key=key),
        (*used, *_measurements(folder)),
        image_folder.parent.name,
    )


def calibration(folder: Path, name: str = "cam_to_cam") -> Path:
    """Calibration file "cam_to_cam", "velo_to_cam" or "imu_to_velo" of a drive's day."""
    of_day = folder.resolve().parent / f"calib_{name}.txt"
    beside_link = folder.parent / of_day.name
    return beside_link if beside_link.is_file() and not of_day.is_file() else of_day


def _measurements(folder: Path) -> list[Path]:
    return listed(folder / OXTS, "*.txt")


def _read_truth(path: Path, times: np.ndarray, within: float, key: str) -> tuple:
    """Read the poses of all frames, as `trajectories.read_truth` does."""
    folder = path.parent.parent
    return None, kitti_odometry.moved(read_poses(folder), calibration(folder), key)


def read_times(path: str | Path) -> np.ndarray:
    """Times since the first frame, (n,), seconds, from a file of time stamps.

    Raises InputError unless they increase.
    """
    lines = read_text(path).strip().splitlines()
    try:
        stamps = np.array(lines, "datetime64[ns]")
    except ValueError as error:
        raise InputError(f"{path}: must hold one time stamp a line: {error}") from None
    times = (stamps - stamps[:1]) / np.timedelta64(1, "s")
    if not len(times) or not (np.diff(times) > 0).all():
        raise InputError(f"{path}: must hold time stamps that increase, one line a frame")
    return times


def read_poses(folder: Path) -> np.ndarray:
    """Camera-to-world poses of the rectified left gray camera, (n, 4, 4), metres.

    The first one is the identity. Raises InputError, naming the file, if a calibration or a
    measurement is missing or malformed.
    """
    # inertial unit to laser scanner to camera 0 to its rectified frame
    to_scanner = _rigid_motion(calibration(folder, "imu_to_velo"), "R", "T")
    scanner_to_camera = _rigid_motion(calibration(folder, "velo_to_cam"), "R", "T")
    rectify = _rigid_motion(calibration(folder, "cam_to_cam"), "R_rect_00")
    to_camera = rectify @ (scanner_to_camera @ to_scanner)
    measured = np.array([read_line(path, "", 30)[:6] for path in _measurements(folder)])
    if not len(measured):
        raise InputError(f"{folder / OXTS}: holds no measurements, one file a frame")
    poses = _imu_poses(measured)
    return to_camera @ np.linalg.inv(poses[0]) @ poses @ np.linalg.inv(to_camera)


def _rigid_motion(path: Path, rotation: str, translation: str | None = None) -> np.ndarray:
    """Return the 4x4 matrix of two lines of a calibration file; without the second, no shift."""
    motion = np.eye(4)
    motion[:3, :3] = read_line(path, f"{rotation}:", 9).reshape(3, 3)
    if translation is not None:
        motion[:3, 3] = read_line(path, f"{translation}:", 3)
    return motion


def _imu_poses(measured: np.ndarray) -> np.ndarray:
    """Poses of the inertial unit, (n, 4, 4), in metres east, north and up.

    measured: (n, 6), latitude and longitude (degrees), altitude (metres), roll, pitch and yaw
    (radians). Mercator's projection has the scale of the first latitude.
    """
    from scipy.spatial.transform import Rotation  # takes 0.4 s to load

    latitude, longitude = np.radians(measured[:, 0]), np.radians(measured[:, 1])
    radius = EARTH_RADIUS * np.cos(latitude[0])
    poses = np.tile(np.eye(4), (len(measured), 1, 1))
    poses[:, 0, 3] = radius * longitude
    poses[:, 1, 3] = radius * np.log(np.tan(np.pi / 4 + latitude / 2))
    poses[:, 2, 3] = measured[:, 2]
    poses[:, :3, 3] -= poses[0, :3, 3]  # metres from here, not from Greenwich, keep more digits
    # yaw, then pitch, then roll, each about the axes that the earlier ones have turned
    poses[:, :3, :3] = Rotation.from_euler("ZYX", measured[:, :2:-1]).as_matrix()
    return poses
