import shutil

import cv2
import numpy as np
import pytest
from evo.tools import file_interface

from thesis_repro import InputError, odometry
from thesis_repro.kitti import Sequence, name_of, sequences, true_path, with_frames
from thesis_repro.trajectories import write_tum


def test_reads_a_sequence(tiny_kitti):
    # a temporary file of a killed run
    (tiny_kitti / "sequences/00/image_0/.000002.4711.png").write_bytes(b"half")
    assert sequences(tiny_kitti) == ["00"]
    sequence = Sequence(tiny_kitti, "00")
    assert len(sequence) == 4 and sequence.size == (48, 64) and len(list(sequence.frames())) == 4
    assert np.array_equal(sequence.intrinsics, [[50, 0, 32], [0, 50, 24], [0, 0, 1]])
    assert np.array_equal(sequence.poses[:, 2, 3], [0, 1, 2, 3]) and sequence.times[-1] == 0.3
    assert np.array_equal(sequence.frame(1)[:, :63], sequence.frame(0)[:, 1:])
    short = sequence.subset(2)
    assert len(short) == len(short.poses) == len(short.times) == 2
    assert len(sequence.subset(99)) == len(sequence.subset(None)) == 4


def test_tum_files_are_read_by_evo(tmp_path):
    random = np.random.default_rng(0)
    poses, times = np.tile(np.eye(4), (50, 1, 1)), np.sort(random.random(50))
    poses[:, :3, 3] = random.normal(size=(50, 3))
    # up to half a turn
    poses[1:, :3, :3] = [cv2.Rodrigues(vector)[0] for vector in random.normal(size=(49, 3))]
    write_tum(tmp_path / "path.tum", poses, times)
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "path.tum")
    assert np.array_equal(trajectory.timestamps, times) and np.array_equal(
        trajectory.positions_xyz, poses[:, :3, 3]
    )
    np.testing.assert_allclose(trajectory.poses_se3, poses, rtol=0, atol=1e-12)
    assert (trajectory.orientations_quat_wxyz[:, 0] >= 0).all()


def test_sequences_with_and_without_published_poses(tiny_kitti):
    for name in ("03", "11"):
        (tiny_kitti / "sequences" / name / "image_0").mkdir(parents=True)
    assert sequences(tiny_kitti) == ["00", "03"] and with_frames(tiny_kitti) == ["00", "03", "11"]


def test_colour_jpeg_frames_are_read_as_gray_with_the_colour_camera(tiny_kitti):
    calibration = tiny_kitti / "sequences/00/calib.txt"
    calibration.write_text(calibration.read_text() + "P2: 60 0 30 5 0 60 20 0 0 0 1 0\n")
    before = Sequence(tiny_kitti, "00").frame(3)
    images = (tiny_kitti / "sequences/00/image_0").rename(tiny_kitti / "sequences/00/image_2")
    for path in images.glob("*.png"):
        cv2.imwrite(
            str(path.with_suffix(".JPG")), cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 2)
        )
        path.unlink()
    sequence = Sequence(tiny_kitti, "0")  # "0" stands for "00"
    assert sequence.name == name_of(tiny_kitti, "0") == "00" and sequences(tiny_kitti) == ["00"]
    assert np.array_equal(sequence.intrinsics, [[60, 0, 30], [0, 60, 20], [0, 0, 1]])
    assert sequence.frame(3).shape == (48, 64) and sequence.frame(3).dtype == np.uint8
    assert np.abs(sequence.frame(3).astype(int) - cv2.GaussianBlur(before, (0, 0), 2)).max() < 8
    assert sequence.label_names == [f"{index:06d}.png" for index in range(4)]


def test_the_camera_can_be_chosen(tiny_kitti):
    folder = tiny_kitti / "sequences/00"
    shutil.copytree(folder / "image_0", folder / "image_2")
    assert Sequence(tiny_kitti, "00").frame_paths[0].parent.name == "image_0"
    with pytest.raises(InputError, match="calib.txt"):
        Sequence(tiny_kitti, "00", camera="image_2")
    (folder / "calib.txt").write_text("P2: 60 0 30 5 0 60 20 0 0 0 1 0\n")
    colour = Sequence(tiny_kitti, "00", camera="image_2")
    assert colour.frame_paths[0].parent.name == "image_2" and colour.intrinsics[0, 0] == 60


def test_frames_are_ordered_by_number_and_a_missing_one_is_named(tiny_kitti):
    images = tiny_kitti / "sequences/00/image_0"
    for index, path in enumerate(sorted(images.glob("*.png"))):
        path.rename(images / f"drive_{index + 8}.png")
    assert [path.stem for path in Sequence(tiny_kitti, "00").frame_paths] == [
        f"drive_{n}" for n in (8, 9, 10, 11)
    ]
    (images / "drive_11.png").rename(images / "drive_15.png")
    with pytest.raises(InputError, match="drive_11.png"):
        Sequence(tiny_kitti, "00")


def test_without_ground_truth_steps_are_assumed(tiny_kitti):
    (tiny_kitti / "poses/00.txt").rename(tiny_kitti / "poses/away.txt")
    (tiny_kitti / "sequences/00/times.txt").write_text("0\n0.1\n0.3\n0.4\n")
    sequence = Sequence(tiny_kitti, "00")
    assert not sequence.has_truth and np.array_equal(odometry.scales(sequence), [0, 1, 1, 1])
    assert np.array_equal(odometry.start_pose(sequence), np.eye(4))
    np.testing.assert_allclose(
        odometry.scales(Sequence(tiny_kitti, "00", speed=5).subset(3)), [0, 0.5, 1]
    )
    with pytest.raises(InputError, match="poses/00.txt"):
        sequence.poses  # noqa: B018
    for speed in (0, -1, np.nan):
        with pytest.raises(InputError):
            Sequence(tiny_kitti, "00", speed=speed)
    (tiny_kitti / "sequences/00/times.txt").unlink()
    assert np.allclose(Sequence(tiny_kitti, "00").times, [0, 0.1, 0.2, 0.3])
    with pytest.raises(InputError, match="times.txt"):
        Sequence(tiny_kitti, "00", speed=5)


def test_a_folder_of_frames_needs_no_layout(tiny_kitti, tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(tiny_kitti / "sequences/00/image_0", folder)
    shutil.copy(tiny_kitti / "sequences/00/calib.txt", folder)
    sequence = Sequence(None, folder)
    assert (
        sequence.name == "mine"
        and len(sequence) == 4
        and not sequence.has_truth
        and not sequence.has_times
    )
    shutil.copy(tiny_kitti / "poses/00.txt", folder / "poses.txt")
    assert np.array_equal(Sequence(None, folder).poses, Sequence(tiny_kitti, "00").poses)
    assert np.array_equal(true_path(None, folder)[0], true_path(tiny_kitti, "0")[0])
    official = Sequence(None, tiny_kitti / "sequences/00")
    assert official.has_truth and official.name == "00"
