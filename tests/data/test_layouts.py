"""The same drive in each layout of `layout.LAYOUTS` gives the same steps."""

import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from street import Street

from thesis_repro import odometry
from thesis_repro.command.cli import main
from thesis_repro.data import kitti, layout, trajectories
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError

START = 1403636579.763555  # seconds since 1970
T_BS = np.eye(4)  # of EuRoC's left camera, rounded
T_BS[:3, :3] = Rotation.from_euler("zyx", [90.6, 1.4, 0.2], degrees=True).as_matrix()
T_BS[:3, 3] = [-0.02, -0.06, 0.01]
SENSOR = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: {body}
camera_model: pinhole
intrinsics: {camera}
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""


class Drive:
    """Frames (files), camera, times and poses to be written into a layout."""

    def __init__(self, frames, intrinsics, times, poses):
        self.frames, self.intrinsics, self.times, self.poses = frames, intrinsics, times, poses

    def copy(self, names):
        for frame, name in zip(self.frames, names):
            name.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(frame, name)

    def write_calibration(self, path):
        rows = np.column_stack([self.intrinsics, np.zeros(3)])
        path.write_text(f"P0: {' '.join(map(repr, rows.ravel().tolist()))}\n")


def as_kitti(folder, drive):
    drive.copy(folder / f"image_0/{index:06d}.png" for index in range(len(drive.frames)))
    drive.write_calibration(folder / "calib.txt")
    (folder / "times.txt").write_text("".join(f"{time!r}\n" for time in drive.times.tolist()))
    trajectories.write_kitti_poses(folder / "poses.txt", drive.poses)


def as_euroc(folder, drive):
    stamps = [round(1e9 * (START + time)) for time in drive.times]
    drive.copy(folder / f"mav0/cam0/data/{stamp}.png" for stamp in stamps)
    names = "".join(f"{stamp},{stamp}.png\r\n" for stamp in stamps)
    (folder / "mav0/cam0/data.csv").write_text(f"#timestamp [ns],filename\r\n{names}")
    (fx, _, cx), (_, fy, cy), _ = drive.intrinsics.tolist()
    sensor = SENSOR.format(body=T_BS.ravel().tolist(), camera=[fx, fy, cx, cy])
    (folder / "mav0/cam0/sensor.yaml").write_text(sensor)
    body = drive.poses @ np.linalg.inv(T_BS)
    quaternions = Rotation.from_matrix(body[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    rows = np.column_stack([body[:, :3, 3], quaternions, np.zeros((len(body), 9))]).tolist()
    truth = folder / "mav0/state_groundtruth_estimate0/data.csv"
    truth.parent.mkdir()
    lines = [",".join(map(repr, [stamp, *row])) for stamp, row in zip(stamps, rows)]
    truth.write_text("\n".join(["#timestamp, p_RS_R_x [m], ...", *lines, ""]))


def as_tum(folder, drive):
    names = [f"rgb/{START + time:.6f}.png" for time in drive.times]
    drive.copy(folder / name for name in names)
    lines = [f"{name[4:-4]} {name}\n" for name in names]
    (folder / "rgb.txt").write_text("".join(["# color images\n", *lines]))
    trajectories.write_tum(folder / "groundtruth.txt", drive.poses, START + drive.times)
    drive.write_calibration(folder / "calib.txt")


LAYOUTS = {"own": as_kitti, "euroc": as_euroc, "rgbd": as_tum}


def test_each_layout_has_a_writer_here():
    written = len(LAYOUTS) + 1  # raw drives of KITTI are tested in test_kitti.py
    assert written == len(layout.LAYOUTS)


@pytest.fixture
def street(tmp_path):
    """A rendered drive of twelve frames."""
    street, times = Street(12), 0.1 * np.arange(12)
    frames = [tmp_path / f"{index}.png" for index in range(12)]
    for frame, image in zip(frames, street.images):
        cv2.imwrite(str(frame), image)
    return Drive(frames, street.intrinsics, times, street.poses)


def write_all(root, drive):
    for name, write in LAYOUTS.items():
        (root / name).mkdir(parents=True)
        write(root / name, drive)


def check_equal_steps(root, drive):
    expected = None
    for name in LAYOUTS:
        sequence = Sequence(None, root / name)
        np.testing.assert_allclose(np.diff(sequence.times), np.diff(drive.times), atol=1e-6)
        np.testing.assert_allclose(sequence.poses, drive.poses, atol=1e-6)
        assert np.array_equal(sequence.intrinsics, drive.intrinsics)
        steps = odometry.run(sequence, keep_steps=True).steps
        expected = expected or (steps, sequence.scales)
        np.testing.assert_allclose(sequence.scales, expected[1], rtol=0, atol=1e-6)
        for step, right in zip(steps, expected[0], strict=True):
            for part in ("keypoints", "previous", "current", "inliers", "essential"):
                assert np.array_equal(getattr(step, part), getattr(right, part)), (name, part)
            assert np.array_equal(step.motion.rotation, right.motion.rotation)
            assert np.array_equal(step.motion.translation, right.motion.translation)


def test_the_same_drive_in_each_layout(street, tmp_path):
    write_all(tmp_path / "drives", street)
    check_equal_steps(tmp_path / "drives", street)


@pytest.mark.real
@pytest.mark.parametrize("name", ["06", "07"])
def test_real_drives_in_each_layout(kitti_real, tmp_path, name):
    real = Sequence(kitti_real, name).subset(30)
    poses = np.linalg.inv(real.poses[0]) @ real.poses
    drive = Drive(real.frame_paths, real.intrinsics, real.times, poses)
    write_all(tmp_path, drive)
    check_equal_steps(tmp_path, drive)


def test_commands_take_each_layout(street, tmp_path, capsys):
    root = tmp_path / "drives"
    as_euroc(root / "MH_01", street)
    as_tum(root / "freiburg1_xyz", street)
    assert kitti.sequences(root) == ["MH_01", "freiburg1_xyz"]
    assert main(["check-data", "--kitti", str(root)]) == 0
    assert capsys.readouterr().out.count("12 frames of 480x160; with ground truth: True") == 2
    for name in ("MH_01", "MH_01/mav0", "freiburg1_xyz"):
        assert main(["odometry", "--sequence", str(root / name), "--frames", "4"]) == 0
        assert "RMSE" in capsys.readouterr().out


def test_own_frames_with_a_truth_of_a_body(street, tmp_path):
    as_euroc(tmp_path / "euroc", street)
    frames = tmp_path / "euroc/mav0/cam0/data"
    camera, truth = frames.parent / "sensor.yaml", layout.poses(tmp_path / "euroc")
    (frames / "times.txt").write_text("".join(f"{START + time}\n" for time in street.times))
    sequence = Sequence(None, frames, calibration=camera, truth=truth)
    np.testing.assert_allclose(sequence.poses, street.poses, atol=1e-6)
    camera.write_text(camera.read_text().replace("T_BS", "T_SB"))
    with_body = Sequence(None, frames, calibration=camera, truth=truth)
    np.testing.assert_allclose(with_body.poses @ T_BS, street.poses, atol=1e-6)


@pytest.mark.parametrize("number, fx", [("1", 517.3), ("2", 520.9), ("3", 535.4), ("4", None)])
def test_cameras_of_tum_are_known_by_the_name(street, tmp_path, number, fx):
    folder = tmp_path / f"rgbd_dataset_freiburg{number}_desk"
    folder.mkdir()
    as_tum(folder, street)
    (folder / "calib.txt").unlink()
    if fx is None:
        with pytest.raises(InputError, match="calib.txt: .*--calibration"):
            Sequence(None, folder)
        return
    sequence = Sequence(None, folder)
    assert (sequence.intrinsics[0, 0], sequence.lens.size) == (fx, (480, 640))
    assert len(sequence.lens.distortion) == (0 if number == "3" else 5)


def test_another_folder_is_told_the_layouts(tmp_path):
    for folder in (tmp_path, tmp_path / "gone"):
        with pytest.raises(InputError) as told:
            Sequence(None, folder)
        assert all(known.LAYOUT in str(told.value) for known in layout.LAYOUTS)


def test_a_listed_frame_must_be_there(street, tmp_path):
    as_tum(tmp_path / "rgbd", street)
    frame = sorted((tmp_path / "rgbd/rgb").iterdir())[3]
    frame.unlink()
    with pytest.raises(InputError, match=frame.name):
        Sequence(None, tmp_path / "rgbd")
