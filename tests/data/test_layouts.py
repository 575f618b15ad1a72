"""The same drive in each layout of `layout.LAYOUTS` gives the same steps."""

import numpy as np
import pytest
from as_downloaded import (
    T_BS,
    write_euroc,
    write_euroc_truth,
    write_images,
    write_tum_frames,
)
from street import Street

from thesis_repro import odometry
from thesis_repro.command.cli import main
from thesis_repro.data import kitti, layout, trajectories
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError

START = 1403636579.763555  # seconds since 1970


def write_calibration(path, drive):
    rows = np.column_stack([drive.intrinsics, np.zeros(3)])
    path.write_text(f"P0: {' '.join(map(repr, rows.ravel().tolist()))}\n")


def as_kitti(folder, drive):
    names = [f"{index:06d}.png" for index in range(len(drive))]
    write_images(folder / "image_0", names, drive)
    write_calibration(folder / "calib.txt", drive)
    (folder / "times.txt").write_text("".join(f"{time!r}\n" for time in drive.times.tolist()))
    trajectories.write_kitti_poses(folder / "poses.txt", drive.poses)


def as_euroc(folder, drive):
    stamps = [round(1e9 * (START + time)) for time in drive.times]
    write_euroc(folder, drive, drive.intrinsics, stamps)
    write_euroc_truth(layout.poses(folder), drive.poses @ np.linalg.inv(T_BS), stamps)


def as_tum(folder, drive):
    write_tum_frames(folder, drive, START + drive.times)
    trajectories.write_tum(folder / "groundtruth.txt", drive.poses, START + drive.times)
    write_calibration(folder / "calib.txt", drive)


LAYOUTS = {"own": as_kitti, "euroc": as_euroc, "rgbd": as_tum}


def test_each_layout_has_a_writer_here():
    written = len(LAYOUTS) + 1  # raw drives of KITTI are tested in test_kitti.py
    assert written == len(layout.LAYOUTS)


@pytest.fixture(scope="module")
def street():
    """A rendered drive of twelve frames."""
    made, times = Street(12), 0.1 * np.arange(12)
    return Sequence.from_arrays(made.images, made.intrinsics, times=times, poses=made.poses)


def check_equal_steps(root, drive):
    expected = None
    for name, write in LAYOUTS.items():
        write(root / name, drive)
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
    check_equal_steps(tmp_path, street)


@pytest.mark.real
@pytest.mark.parametrize("name", ["06", "07"])
def test_real_drives_in_each_layout(kitti_real, tmp_path, name):
    real = Sequence(kitti_real, name).subset(10)
    poses = np.linalg.inv(real.poses[0]) @ real.poses
    drive = Sequence.from_arrays(list(real), real.intrinsics, times=real.times, poses=poses)
    check_equal_steps(tmp_path, drive)


def test_commands_take_each_layout(street, tmp_path, capsys):
    root = tmp_path
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


@pytest.mark.parametrize("number, fx", [("1", 517.3), ("2", 520.9), ("3", 535.4)])
def test_cameras_of_tum_are_known_by_the_name(street, tmp_path, number, fx):
    folder = tmp_path / f"rgbd_dataset_freiburg{number}_desk"
    write_tum_frames(folder, street, street.times)
    sequence = Sequence(None, folder)
    assert (sequence.intrinsics[0, 0], sequence.lens.size) == (fx, (480, 640))
    assert len(sequence.lens.distortion) == (0 if number == "3" else 5)


def test_what_a_folder_of_tum_lacks_is_named(street, tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg4_desk"
    write_tum_frames(folder, street, street.times)
    with pytest.raises(InputError, match="calib.txt: .*--calibration"):
        Sequence(None, folder)
    (folder / "rgb/0.300000.png").unlink()
    with pytest.raises(InputError, match="0.300000.png: no such file"):
        Sequence(None, folder)


def test_another_folder_is_told_the_layouts(tmp_path):
    for folder in (tmp_path, tmp_path / "gone"):
        with pytest.raises(InputError) as told:
            Sequence(None, folder)
        assert all(known.LAYOUT in str(told.value) for known in layout.LAYOUTS)
