"""KITTI's sequences, and its raw drives as they are downloaded.

Drives are read alone, as a folder of drives, or through a link.
"""

import shutil

import cv2
import numpy as np
import pytest

from thesis_repro import checks, odometry
from thesis_repro.command import cli
from thesis_repro.data import kitti, kitti_odometry, kitti_raw, trajectories
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError


def test_reads_a_sequence(tiny_kitti):
    # a temporary file of a killed run
    (tiny_kitti / "sequences/00/image_0/.000002.4711.png").write_bytes(b"half")
    assert kitti.sequences(tiny_kitti) == ["00"]
    sequence = Sequence(tiny_kitti, "00")
    assert len(sequence) == 4 and sequence.size == (48, 64) and len(list(sequence)) == 4
    assert np.array_equal(sequence.intrinsics, [[50, 0, 32], [0, 50, 24], [0, 0, 1]])
    assert np.array_equal(sequence.poses[:, 2, 3], [0, 1, 2, 3]) and sequence.times[-1] == 0.3
    assert np.array_equal(sequence.frame(1)[:, :63], sequence.frame(0)[:, 1:])
    short = sequence.subset(2)
    assert len(short) == len(short.poses) == len(short.times) == 2
    assert len(sequence.subset(99)) == len(sequence.subset(None)) == 4
    assert repr(short).startswith("Sequence 00: 2 frames with true poses")
    with pytest.raises(InputError, match="subset"):
        sequence[:2]
    for count in (0, -1):
        with pytest.raises(InputError, match="subset"):
            sequence.subset(count)


def test_colour_jpeg_frames_are_read_as_gray_with_the_colour_camera(tiny_kitti):
    calibration = tiny_kitti / "sequences/00/calib.txt"
    calibration.write_text(calibration.read_text() + "P2: 60 0 30 5 0 60 20 0 0 0 1 0\n")
    before = Sequence(tiny_kitti, "00").frame(3)
    images = (tiny_kitti / "sequences/00/image_0").rename(tiny_kitti / "sequences/00/image_2")
    for path in images.glob("*.png"):
        blurred = cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 2)
        cv2.imwrite(str(path.with_suffix(".JPG")), blurred)
        path.unlink()
    assert kitti.sequences(tiny_kitti) == ["00"]
    sequence = Sequence(tiny_kitti, "0")  # "0" stands for "00"
    assert sequence.name == "00"
    assert np.array_equal(sequence.intrinsics, [[60, 0, 30], [0, 60, 20], [0, 0, 1]])
    assert sequence.frame(3).shape == (48, 64) and sequence.frame(3).dtype == np.uint8
    assert np.abs(sequence.frame(3).astype(int) - cv2.GaussianBlur(before, (0, 0), 2)).max() < 8
    assert sequence.label_names == [f"{index:06d}.png" for index in range(4)]


def test_without_ground_truth_steps_are_assumed(tiny_kitti):
    (tiny_kitti / "poses/00.txt").rename(tiny_kitti / "poses/away.txt")
    (tiny_kitti / "sequences/00/times.txt").write_text("0\n0.1\n0.3\n0.4\n")
    sequence = Sequence(tiny_kitti, "00")
    assert not sequence.has_truth and np.array_equal(sequence.scales, [0, 1, 1, 1])
    assert np.array_equal(odometry.start_pose(sequence), np.eye(4))
    np.testing.assert_allclose(Sequence(tiny_kitti, "00", speed=5).subset(3).scales, [0, 0.5, 1])
    with pytest.raises(InputError, match="poses/00.txt"):
        sequence.poses  # noqa: B018
    (tiny_kitti / "sequences/00/times.txt").unlink()
    assert np.allclose(Sequence(tiny_kitti, "00").times, [0, 0.1, 0.2, 0.3])
    with pytest.raises(InputError, match=r"times.txt.*--fps"):
        Sequence(tiny_kitti, "00", speed=5)


def test_a_right_camera_has_poses_of_its_own(tiny_kitti):
    folder = tiny_kitti / "sequences/00"
    shutil.copytree(folder / "image_0", folder / "image_1")
    with open(folder / "calib.txt", "a") as file:
        file.write("P1: 50 0 32 -25 0 50 24 0 0 0 1 0\n")
    left, right = Sequence(tiny_kitti, "00/"), Sequence(tiny_kitti, "0/", "image_1")
    np.testing.assert_allclose(right.poses[:, :3, 3], left.poses[:, :3, 3] + [0.5, 0, 0])


def test_frames_a_second_replace_a_missing_file_of_times(tiny_kitti):
    with pytest.raises(InputError, match="times.txt"):
        Sequence(tiny_kitti, "00", fps=25)
    (tiny_kitti / "sequences/00/times.txt").unlink()
    (tiny_kitti / "poses/00.txt").unlink()
    sequence = Sequence(tiny_kitti, "00", speed=5, fps=25)
    np.testing.assert_allclose(sequence.times, [0, 0.04, 0.08, 0.12])
    np.testing.assert_allclose(sequence.scales, [0, 0.2, 0.2, 0.2])
    for fps in (0, -1, np.nan, np.inf):
        with pytest.raises(InputError, match="fps"):
            Sequence(tiny_kitti, "00", fps=fps)


def test_a_folder_of_frames_needs_no_layout(tiny_kitti, tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(tiny_kitti / "sequences/00/image_0", folder)
    shutil.copy(tiny_kitti / "sequences/00/calib.txt", folder)
    sequence = Sequence(None, folder)
    assert sequence.name == "mine" and len(sequence) == 4
    assert not sequence.has_truth and not sequence.has_times
    official = Sequence(None, tiny_kitti / "sequences/00")
    assert official.has_truth and official.name == "00"


@pytest.mark.parametrize("size", [(1024, 320), (1226, 370)])
def test_kittis_calibration_with_frames_of_another_size_is_refused(tiny_kitti, size):
    (tiny_kitti / "sequences/00/calib.txt").write_text(
        "P0: 718.856 0 607.1928 0 0 718.856 185.2157 0 0 0 1 0\n"
    )
    for path in tiny_kitti.glob("sequences/00/image_0/*"):
        cv2.imwrite(str(path), np.zeros(size[::-1], np.uint8))
    with pytest.raises(InputError, match=rf"calib.txt.*1241x376.*{size[0]}x{size[1]}"):
        Sequence(tiny_kitti, "00").frame(0)


# Raw drives

NAME = "2011_09_26_drive_0001_sync"
METRE = np.degrees(1 / kitti_raw.EARTH_RADIUS)  # degrees of latitude
# the camera is turned as in the car: ahead is its z axis; R_rect_00 turns by 90 degrees about z
CALIBRATION = {
    "imu_to_velo": "R: 1 0 0 0 1 0 0 0 1\nT: -1 0.5 -2\n",
    "velo_to_cam": "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.25\n",
    "cam_to_cam": "calib_time: 09-Jan-2012 13:57:47\nR_rect_00: 0 -1 0 1 0 0 0 0 1\n"
    "P_rect_00: 50 0 32 0 0 50 24 0 0 0 1 0\nP_rect_02: 60 0 30 5 0 60 20 0 0 0 1 0\n",
}


@pytest.fixture
def drive(tmp_path, tiny_kitti):
    """A drive of four frames: north by a metre a frame, then a turn of 90 degrees to the left."""
    day = tmp_path / "2011_09_26"
    stamps = [f"2011-09-26 23:59:59.{n}00000123\n" for n in (6, 7, 9)]
    for name in ("image_00", "image_02"):
        shutil.copytree(tiny_kitti / "sequences/00/image_0", day / NAME / name / "data")
        times = "".join([*stamps, "2011-09-27 00:00:00.000000123\n"])
        (day / NAME / name / "timestamps.txt").write_text(times)
    (day / NAME / "oxts/data").mkdir(parents=True)
    for index in range(4):
        north, yaw = METRE * min(index, 2), np.pi / 2 * (1 + (index == 3))
        numbers = f"{north:.17g} 8.5 100 0 0 {yaw:.17g}" + " 0" * 24
        (day / NAME / f"oxts/data/{index:010d}.txt").write_text(numbers)
    for name, text in CALIBRATION.items():
        (day / f"calib_{name}.txt").write_text(text)
    return day / NAME


def test_a_drive_has_poses_times_and_cameras(drive):
    sequence = Sequence(None, drive)
    assert (sequence.name, len(sequence), sequence.size) == (NAME, 4, (48, 64))
    np.testing.assert_allclose(sequence.times, [0, 0.1, 0.3, 0.4], atol=1e-9)
    assert np.array_equal(sequence.intrinsics, [[50, 0, 32], [0, 50, 24], [0, 0, 1]])
    np.testing.assert_allclose(sequence.poses[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(sequence.poses[:3, :3, 3], [[0, 0, n] for n in range(3)], atol=1e-9)
    # The camera lies 1.25 m ahead of the inertial unit and 0.5 m right of it. It is on its side: x
    # points up and y to the right, so a turn to the left is a positive one about x.
    turn = cv2.Rodrigues(sequence.poses[3, :3, :3])[0][:, 0]
    np.testing.assert_allclose(turn, [np.pi / 2, 0, 0], atol=1e-9)
    np.testing.assert_allclose(sequence.poses[3, :3, 3], [0, -1.75, 1.25], atol=1e-9)
    colour = Sequence(None, drive, camera="image_02")
    assert colour.intrinsics[0, 0] == 60 and colour.frame_paths[0].parts[-3] == "image_02"
    assert np.array_equal(colour.poses, sequence.poses)
    assert set(sequence.files) >= {*drive.glob("oxts/data/*"), *drive.parent.glob("calib*")}


def test_a_folder_of_drives_is_a_root_and_a_link_a_sequence(drive, tiny_kitti):
    assert kitti.sequences(drive.parent) == [NAME]
    (tiny_kitti / "sequences/drive0001").symlink_to(drive)
    hidden = tiny_kitti / "sequences/.AppleDouble/000000.png"
    hidden.parent.mkdir()
    hidden.write_bytes(b"what Finder leaves")
    assert kitti.sequences(tiny_kitti) == ["00", "drive0001"]
    expected = Sequence(None, drive)
    for root, name in ((drive.parent, NAME), (tiny_kitti, "drive0001")):
        sequence = Sequence(root, name)
        assert sequence.name == name and np.array_equal(sequence.poses, expected.poses)
        assert checks.check_kitti(root) == []
    assert [folder for folder, *_ in cli._image_folders(drive.parent)] == [drive]


def test_a_calibration_may_lie_beside_a_link_to_a_drive(drive, tmp_path):
    expected = Sequence(None, drive)
    links = tmp_path / "links"
    links.mkdir()
    (links / "mine").symlink_to(drive)
    other = CALIBRATION["cam_to_cam"].replace("P_rect_00: 50", "P_rect_00: 70")
    (links / "calib_cam_to_cam.txt").write_text(other)
    for place in ((links, "mine"), (None, links / "mine")):  # that of the drive's day comes first
        assert np.array_equal(Sequence(*place).intrinsics, expected.intrinsics)
    for name in CALIBRATION:
        (drive.parent / f"calib_{name}.txt").replace(links / f"calib_{name}.txt")
    for place in ((links, "mine"), (None, links / "mine"), (None, f"{links}/./mine/")):
        sequence = Sequence(*place)
        assert sequence.name == "mine" and np.array_equal(sequence.poses, expected.poses)
        assert np.array_equal(sequence.intrinsics, expected.intrinsics)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("../calib_imu_to_velo.txt", None),
        ("../calib_velo_to_cam.txt", "R: 1 2 3\n"),
        ("../calib_cam_to_cam.txt", "P_rect_00: 50 0 32 0 0 50 24 0 0 0 1 0\n"),
        ("image_00/timestamps.txt", "2011-09-26 10:00:00\n" * 4),
        ("image_00/timestamps.txt", "0.1\n0.2\n0.3\n0.4\n"),
        ("oxts/data/0000000002.txt", "49.0 8.5 nan" + " 0" * 27),
        ("oxts/data/0000000002.txt", b"\xff\xfe"),
    ],
)
def test_a_damaged_file_is_named(drive, file, text):
    (drive / file).unlink()
    if text is not None:
        (drive / file).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=file.split("/")[-1]):
        Sequence(None, drive)
    assert any(file.split("/")[-1] in line for line in checks.check_kitti(drive.parent))


@pytest.mark.real
@pytest.mark.parametrize("number", ["0005", "0095"])
def test_real_drives_agree_with_their_odometry_files(kitti_real, number):
    raw = kitti_real.parent / "kitti_raw"
    sequence = Sequence(raw / "2011_09_26", f"2011_09_26_drive_{number}_sync")
    files = raw / f"sequences/drive{number}"
    # the file has seven digits of up to 46 m
    np.testing.assert_allclose(
        sequence.poses, trajectories.read_poses(raw / f"poses/drive{number}.txt"), rtol=0, atol=6e-6
    )
    # the file has microseconds
    np.testing.assert_allclose(
        sequence.times, trajectories.read_times(files / "times.txt"), atol=2e-6
    )
    expected = kitti_odometry.read_camera(files / "calib.txt", "P2").matrix
    assert np.array_equal(sequence.intrinsics, expected) and sequence.frame(49).shape == (375, 1242)
