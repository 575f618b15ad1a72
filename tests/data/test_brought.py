"""Frames, poses and label maps as people bring them from other tools and data sets."""

import re
import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thesis_repro import odometry
from thesis_repro.command.cli import main
from thesis_repro.data import cameras, kitti, trajectories
from thesis_repro.data.cameras import DISTORTIONS
from thesis_repro.data.cityscapes import read_image, resize_bilinear
from thesis_repro.data.frames import times_in_names, white_level
from thesis_repro.data.sequence import Sequence
from thesis_repro.data.trajectories import read_poses, read_poses_at, write_tum
from thesis_repro.errors import InputError
from thesis_repro.masks import folders


@pytest.fixture
def own(tmp_path, tiny_kitti):
    """A folder of four frames, with calibration and times."""
    folder = tmp_path / "own"
    shutil.copytree(tiny_kitti / "sequences/00/image_0", folder)
    for name in ("calib.txt", "times.txt"):
        shutil.copy(tiny_kitti / "sequences/00" / name, folder)
    return folder


@pytest.mark.parametrize(
    "stems, said",
    [
        (["0.1", "0.15", "0.2", "10.0"], "decimal numbers"),
        (["1305031102.17", "1305031102.2", "1305031102.31", "1305031103.05"], "decimal numbers"),
        (["0.103774", "0.20755", "0.5", "0.61132521234"], "decimal numbers"),
        (["10.37800000", "10.141574000", "10.245347000", "11.3"], "seconds and nanoseconds"),
        (["1.5", "2.25", "3.75", "4.0"], "decimal numbers"),  # one order
        (["0.10", "0.15", "0.20", "0.90"], None),
        (["rgb.0009", "rgb.0010", "rgb.0011", "rgb.0012"], None),
    ],
)
def test_names_that_are_numbers_are_in_their_order(own, caplog, stems, said):
    for path, stem in zip(sorted(own.glob("*.png")), stems):
        path.rename(own / f"{stem}.png")
    caplog.set_level("INFO")
    for _ in range(2):
        assert [path.stem for path in Sequence(None, own).frame_paths] == stems
    lines = [line for line in caplog.messages if "in the order of" in line]
    assert len(lines) == bool(said) and all(f"names as {said}, " in line for line in lines)


def test_names_in_two_possible_orders_are_refused(own):
    for path, stem in zip(own.glob("*.png"), ["7.37811111", "7.141574123", "7.2453477", "8.3"]):
        path.rename(own / f"{stem}.png")
    with pytest.raises(InputError, match="own: 7.*png and the like may be decimal numbers, or"):
        Sequence(None, own)


def test_assumed_times_are_said_once(own, caplog):
    (own / "times.txt").unlink()
    caplog.set_level("INFO")
    for fps in (None, None, 25):
        Sequence(None, own, fps=fps)
    (line,) = caplog.messages
    assert "times.txt: no such file, so 10 frames a second" in line and "--fps" in line


POSES = np.tile(np.eye(4), (4, 1, 1))
POSES[:, :3, :3] = [cv2.Rodrigues(np.array([0, 0.1 * index, 0]))[0] for index in range(4)]
POSES[:, 2, 3] = [0, 1, 2, 4]


def lines(rows):
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())


@pytest.mark.parametrize(
    "rows",
    [
        POSES[:, :3].reshape(4, 12),
        POSES.reshape(4, 16),
        np.column_stack([np.arange(7.0, 11), POSES[:, :3].reshape(4, 12)]),
        np.column_stack([np.arange(4.0), POSES.reshape(4, 16)]),
    ],
)
def test_poses_with_the_number_of_the_frame_and_with_four_rows(own, rows):
    (own / "poses.txt").write_text(lines(rows))
    assert np.array_equal(Sequence(None, own).poses, POSES)
    rows = rows + np.eye(*rows.shape)  # another number, rotation or last row
    (own / "poses.txt").write_text(lines(rows))
    with pytest.raises(InputError, match="poses.txt"):
        read_poses(own / "poses.txt")


def test_poses_in_the_folder_of_a_sequence(tiny_kitti):
    expected = Sequence(tiny_kitti, "00").poses
    folder = (tiny_kitti / "sequences/00").rename(tiny_kitti / "sequences/mine")
    (tiny_kitti / "poses/00.txt").rename(folder / "poses.txt")
    assert kitti.sequences(tiny_kitti) == ["mine"]
    for root, name in ((tiny_kitti, "mine"), (None, folder)):
        assert np.array_equal(Sequence(root, name).poses, expected)


def euroc(path, poses, times):
    """Write the ground truth of EuRoC: nanoseconds, and quaternions with w first."""
    write_tum(path, poses, times)
    rows = np.loadtxt(path)[:, [0, 1, 2, 3, 7, 4, 5, 6]]
    rows = np.column_stack([np.round(rows[:, 0] * 1e9), rows[:, 1:], np.zeros((len(rows), 9))])
    path.write_text("#timestamp, p_RS_R_x [m], ...\n" + lines(rows).replace(" ", ","))


@pytest.mark.parametrize("name, write", [("truth.txt", write_tum), ("data.csv", euroc)])
def test_ground_truth_with_times_is_given_to_the_frames_of_these_times(own, name, write, caplog):
    # at 200 Hz, from 0.1 s on, so the first frame has none; off by 2 ms
    times = np.arange(0.102, 0.35, 0.005)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 2, 3] = np.arange(len(times))
    write(own / name, poses, times)
    caplog.set_level("INFO")
    sequence = Sequence(None, own, truth=own / name)
    assert [path.stem for path in sequence.frame_paths] == ["000001", "000002", "000003"]
    np.testing.assert_allclose(sequence.times, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(sequence.poses[:, 2, 3], [0, 20, 40])
    assert "3 of 4 frames" in caplog.text
    kept = np.abs(times - 0.2) > 0.02  # a gap around the third frame
    write(own / name, poses[kept], times[kept])
    sequence = Sequence(None, own, truth=own / name)
    assert [path.stem for path in sequence.frame_paths] == ["000001", "000003"]
    np.testing.assert_allclose(sequence.poses[:, 2, 3], [0, 40])
    assert "2 of 4 frames, which are used; 1 between them, the first one 000002.png" in caplog.text
    sequence = Sequence(None, own, truth=own / name, truth_within=0.03)
    np.testing.assert_allclose(sequence.poses[:, 2, 3], [0, 24, 40])
    sequence = Sequence(None, own, speed=2)  # needs no pose
    np.testing.assert_allclose(sequence.scales, [0, 0.2, 0.2, 0.2])
    write(own / name, poses, times + 100)
    with pytest.raises(InputError, match=rf"{name}: no pose .*100.102 to 100.347.*0 to 0.3"):
        Sequence(None, own, truth=own / name)
    with pytest.raises(InputError, match="gone.txt: cannot be read"):
        Sequence(None, own, truth=own / "gone.txt")


def test_quaternions_need_their_length(own):
    write_tum(own / "truth.txt", POSES, 0.1 * np.arange(4))
    rows = np.loadtxt(own / "truth.txt")
    for factor in (0, 2):
        scaled = np.column_stack([rows[:, :4], factor * rows[:, 4:]])
        (own / "truth.txt").write_text(lines(scaled))
        with pytest.raises(InputError, match="truth.txt: .*length 1"):
            Sequence(None, own, truth=own / "truth.txt")


NED = np.eye(4)[[1, 2, 0, 3]].T  # of the camera: x forward, y right, z down
MATRICES = {
    "Virtual KITTI 2": np.column_stack(
        [
            np.repeat(np.arange(4), 2),
            np.tile([0, 1], 4),
            np.linalg.inv(POSES).repeat(2, 0).reshape(8, 16),
        ]
    ),
    "TartanAir": np.column_stack(
        [POSES[:, :3, 3], Rotation.from_matrix((POSES @ np.linalg.inv(NED))[:, :3, :3]).as_quat()]
    ),
    "KITTI-360": np.column_stack([[1.0, 3, 4, 7], POSES.reshape(4, 16)]),
}


@pytest.mark.parametrize("name, header", zip(MATRICES, ["frame cameraID r1,1\n", "", ""]))
def test_poses_of_other_data_sets_come_with_what_converts_them(own, name, header, monkeypatch):
    path = own / re.search(r"loadtxt\('(.*?)'", trajectories.CONVERSIONS[name])[1]
    path.write_text(header + lines(MATRICES[name]))
    with pytest.raises(InputError, match=f"{path.name}: .*{name}") as told:
        Sequence(None, own, truth=path)
    code = str(told.value).split("in Python: ")[1]
    monkeypatch.chdir(own)
    copied = []
    copies = SimpleNamespace(copy=lambda path, folder: copied.append(path))
    exec(code, {"np": np, "Rotation": Rotation, "shutil": copies})
    np.testing.assert_allclose(Sequence(None, own).poses, POSES, atol=1e-9)
    assert len(copied) == (4 if name == "KITTI-360" else 0)


CAMERA = "fx 50\nfy 51\ncx 32\ncy 24\nk1 -0.3\nk2 0.1\np1 0.01\np2 -0.02"
NUMBERS = [float(line.split()[1]) for line in CAMERA.splitlines()]
ORB_SLAM = "".join(f"Camera.{line.replace(' ', ': ')}\n" for line in CAMERA.splitlines())
OPENCV = """camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 50., 0., 32., 0., 51., 24., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 4
   dt: d
   data: [ -0.3, 0.1, 0.01, -0.02 ]
"""


KALIBR = """cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.06]
  - [-1.0, 0.0, 0.0, 0.01]
  - [0.0, 0.0, 1.0, -0.01]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.3, 0.1, 0.01, -0.02]
  distortion_model: radtan
  intrinsics: [50, 51.0, 32, 24]
  resolution: [64, 48]
  rostopic: /cam0/image_raw
cam1:
  camera_model: omni
  intrinsics: [1.1, 60, 61, 31, 23]
"""
ROS = """image_width: 64
image_height: 48
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [50.0, 0.0, 32.0, 0.0, 51.0, 24.0,
    0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 4
  data: [-0.3, 0.1, 0.01, -0.02]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
CAMERA_INFO = """header: {frame_id: "front"}
height: 48
width: 64
distortion_model: "plumb_bob"
D: [-0.3, 0.1, 0.01, -0.02]
K: [50.0, 0.0, 32.0, 0.0, 51.0, 24.0, 0.0, 0.0, 1.0]
"""
EUROC = """sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02, 1.0, 0.0, 0.0, -0.06, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50.0, 51.0, 32.0, 24.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.3, 0.1, 0.01, -0.02]
"""


INDENTED = "".join(f"  {line.replace(' ', ': ')}\n" for line in CAMERA.splitlines())
VINS = f"""%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 64
image_height: 48
distortion_parameters:
{"".join(INDENTED.splitlines(keepends=True)[4:])}projection_parameters:
{"".join(INDENTED.splitlines(keepends=True)[:4])}"""
OKVIS = """%YAML:1.0
cameras:
     - {T_SC:
        [ 0.0, -1.0, 0.0, -0.02, 1.0, 0.0, 0.0, -0.06, 0.0, 0.0, 1.0, 0.01, 0.0, 0.0, 0.0, 1.0],
        image_dimension: [64, 48],
        distortion_coefficients: [-0.3, 0.1, 0.01, -0.02],
        distortion_type: radialtangential,
        focal_length: [50, 51.0],
        principal_point: [32, 24]}
     - {image_dimension: [64, 48], distortion_coefficients: [0, 0, 0, 0],
        focal_length: [60, 61], principal_point: [31, 23]}
imu_params:
    T_BS: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
"""
K = [50.0, 0.0, 32.0, 0.0, 51.0, 24.0, 0.0, 0.0, 1.0]
D = NUMBERS[4:]


def block(numbers):
    return "".join(f"- {number}\n" for number in numbers)


@pytest.mark.parametrize(
    "name, text",
    [
        ("camera.txt", " ".join(map(str, NUMBERS))),
        ("camera.yaml", KALIBR),
        ("camera.yaml", f"%YAML:1.0\n---\n{ORB_SLAM}"),
        ("camera.yaml", f'%YAML:1.0\nCamera.type: "PinHole"\n{ORB_SLAM}'),
        ("camera.yaml", ORB_SLAM.replace("Camera.", "Camera1.")),
        ("camera.yml", f"%YAML:1.0\n---\n{OPENCV}"),
        ("camera.yml", f"image_width: 64\nimage_height: 48\nfisheye_model: 0\n{OPENCV}"),
        ("camera.yaml", ROS),
        ("camera.yaml", CAMERA_INFO),
        ("camera.yaml", EUROC),
        *(("camera.yaml", f"K: {K}\n{key}: {D}\n") for (key,) in DISTORTIONS),
        ("camera.yaml", "".join(f"{key}:\n{block(of)}" for key, of in (("k", K), ("d", D)))),
        ("camera.yaml", f"camera_matrix: {[K[:3], K[3:6], K[6:]]}\ndist_coeff: {[D]}\n"),
        ("camera.yaml", f"camera_model: plumb_bob\n{CAMERA_INFO}"),
        ("camera.yaml", f"{ORB_SLAM}Viewer.PointSize:2\nCamera.cols:64\nCamera.rows:\t48\n"),
        ("camera.yaml", f"%YAML:1.0\n{ORB_SLAM.replace(': ', ':')}"),
        ("camera.yaml", "Camera:\n  model: perspective\n" + INDENTED),
        ("camera.yaml", VINS),
        ("camera.yaml", OKVIS),
    ],
)
def test_distortion_is_taken_out_as_opencv_does(own, name, text):
    raw = Sequence(None, own).frame(2)
    (own / "calib.txt").unlink()
    (own / name).write_text(text)
    sequence = Sequence(None, own, calibration=own / name)
    assert np.array_equal(sequence.intrinsics, [[50, 0, 32], [0, 51, 24], [0, 0, 1]])
    expected = cv2.undistort(raw, sequence.intrinsics, np.array(NUMBERS[4:]))
    assert np.array_equal(sequence.frame(2), expected) and (expected != raw).any()
    assert own / name in sequence.files


@pytest.mark.parametrize(
    "name, text",
    [
        ("camera.txt", "50 50 32 24 0.1"),
        ("camera.txt", "50 2 32 0 51 24 0 0 1"),  # skew
        ("camera.txt", "50 0 0 0 51 0 32 24 1"),  # transposed
        *(("camera.yaml", text) for text in ("a: [1", "", "- 1", "K: {a: 1}", "T_BS: [1]", "\t")),
        ("camera.yaml", OPENCV.replace(".1, 0.01, -0.02 ]", ".1 ]")),
        ("camera.yaml", KALIBR.replace("intrinsics", "extrinsics")),
        ("camera.yaml", KALIBR.replace("32, 24", "32")),
        ("camera.yaml", ORB_SLAM.replace("p1", "k3").replace("p2", "k4")),  # a fisheye camera
    ],
)
def test_another_file_is_no_camera(own, name, text):
    (own / name).write_text(text)
    with pytest.raises(InputError, match=f"{name}: must hold fx fy cx cy"):
        Sequence(None, own, calibration=own / name)


@pytest.mark.parametrize(
    "text, model",
    [
        (f"fisheye_model: 1\n{OPENCV}", "fisheye_model is 1"),
        (f"K: {K}\n", "has no distortion that is understood"),
        (f"K: {K}\nlens: {D}\n", "has no distortion that is understood"),
        (KALIBR.replace("radtan", "equidistant"), "distortion_model is equidistant"),
        (KALIBR.replace("pinhole", "omni"), "camera_model is omni"),
        (ROS.replace("plumb_bob", "fisheye"), "distortion_model is fisheye"),
        (f'Camera.type: "KannalaBrandt8"\n{ORB_SLAM}', "Camera.type is KannalaBrandt8"),
        (VINS.replace("PINHOLE", "MEI"), "model_type is MEI"),
        (OKVIS.replace("radialtangential", "equidistant"), "distortion_type is equidistant"),
        ('%YAML:1.0\nimu: 1\ncam0_calib: "left.yaml"\n', "holds no camera, but names left.yaml"),
    ],
)
def test_a_camera_of_another_model_is_named(own, text, model):
    (own / "camera.yaml").write_text(text)
    with pytest.raises(InputError, match=f"camera.yaml: {model}"):
        Sequence(None, own, calibration=own / "camera.yaml")


@pytest.mark.parametrize(
    "text",
    [
        f"image_width: 80\nimage_height: 60\n{OPENCV}",
        ROS.replace("image_width: 64", "image_width: 128"),
        CAMERA_INFO.replace("height: 48", "height: 50"),
        EUROC.replace("64, 48", "48, 64"),
        KALIBR.replace("64, 48", "640, 480"),
        f"Camera.width: 63\nCamera.height: 48\n{ORB_SLAM}",
        f"Camera.cols: 63\nCamera.rows: 48\n{ORB_SLAM}",
        OKVIS.replace("[64, 48]", "[752, 480]"),
    ],
)
def test_a_camera_of_frames_of_another_size_is_named(own, text):
    (own / "camera.yaml").write_text(text)
    sequence = Sequence(None, own, calibration=own / "camera.yaml")
    with pytest.raises(InputError, match=r"camera.yaml: .*, but .*000000.png has 64x48"):
        sequence.frame(0)


KITTIS = """S_00: 1.392e+03 5.12e+02
P_rect_00: 50 0 32 0 0 51 24 0 0 0 1 0
S_rect_00: 64 48
P_rect_02: 60 0 31 5 0 61 23 0 0 0 1 0
S_rect_02: 65 48
"""


@pytest.mark.parametrize(
    "text",
    [
        "50 0 32\n0 51 24\n0 0 1\n",
        "# K\n[[50, 0, 32],\n [0, 51, 24],\n [0, 0, 1]]\n",
        "50,0,32,0\n0,51,24,0\n0,0,1,0\n0,0,0,1\n",
        "50 0 32 0 0 51 24 0 0 0 1 0\n",
        "P0: 50 0 32 0 0 51 24 0 0 0 1 0\nP1: 50 0 32 -25 0 51 24 0 0 0 1 0\n",
        KITTIS,
    ],
)
def test_a_camera_is_a_matrix(own, text):
    (own / "camera.txt").write_text(text)
    sequence = Sequence(None, own, calibration=own / "camera.txt")
    assert np.array_equal(sequence.intrinsics, [[50, 0, 32], [0, 51, 24], [0, 0, 1]])
    assert not sequence.distortion.any() and sequence.size == (48, 64)


def test_a_file_of_several_cameras_is_read_for_the_one_that_is_used(own):
    (own / "chain.yaml").write_text(KALIBR.replace("omni", "pinhole"))
    (own / "okvis.yaml").write_text(OKVIS)
    (own / "raw.txt").write_text(KITTIS)
    assert cameras.read_camera(own / "okvis.yaml", "cam1").matrix[0, 0] == 60
    assert cameras.read_camera(own / "raw.txt", "image_02").size == (48, 65)
    np.testing.assert_allclose(
        cameras.read_camera(own / "chain.yaml", "cam0").body[:3, 3], [0.01, -0.06, 0.01]
    )
    for name, camera in (("chain.yaml", "cam2"), ("okvis.yaml", "cam2"), ("raw.txt", "image_01")):
        with pytest.raises(InputError, match=name):
            cameras.read_camera(own / name, camera)


@pytest.mark.parametrize(
    "stems, times",
    [
        (["1403636579763555584", "1403636579813555584"], 0.05),
        (["1403636579763555", "1403636579813555"], 0.05),
        (["frame_1403636579763", "frame_1403636579813"], 0.05),
        (["cam0_0001_1403636579763555584", "cam0_0002_1403636579813555584"], 0.05),
        (["rgb-1305031102.175304_left", "rgb-1305031102.225304_left"], 0.05),
        (["1403636579_763555584", "1403636579_813555584"], 0.05),
        (["1403636579_63555584", "1403636579_113555584"], 0.05),
        (["1403636579_763555", "1403636579_813555"], 0.05),
        (["1403636579813555", "frame_7"], None),
        (["20110926_130225", "20110926_130226"], None),
    ],
)
def test_times_in_names(own, stems, times):
    found = times_in_names([own / f"{stem}.png" for stem in stems])
    if times is None:
        assert found is None
        return
    np.testing.assert_allclose(np.diff(found), times, atol=1e-6)
    assert 1.3e9 < found[0] < 1.5e9


def test_what_has_no_stated_times_is_not_matched_by_time(own):
    write_tum(own / "truth.txt", POSES, np.arange(4) / 30)
    (own / "times.txt").unlink()
    with pytest.raises(InputError, match="truth.txt: .*--fps"):
        Sequence(None, own, truth=own / "truth.txt")
    poses = Sequence(None, own, truth=own / "truth.txt", fps=30).poses
    np.testing.assert_allclose(poses, POSES, atol=1e-9)


def test_a_rough_camera_is_four_numbers(own):
    (own / "camera.txt").write_text("64 64 32 24")
    sequence = Sequence(None, own, calibration=own / "camera.txt")
    assert np.array_equal(sequence.intrinsics, [[64, 0, 32], [0, 64, 24], [0, 0, 1]])
    assert np.array_equal(sequence.frame(0), Sequence(None, own).frame(0))


def test_hot_pixels_do_not_make_16_bit_frames_dark(own, caplog):
    expected = Sequence(None, own).frame(0)
    for path in sorted(own.glob("*.png")):
        frame = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16) * 16
        frame[5, 5] = 65535
        cv2.imwrite(str(path), frame)
    frame = Sequence(None, own).frame(0)
    assert np.abs(np.delete(frame, 5, 0).astype(int) - np.delete(expected, 5, 0)).max() <= 2
    path = own / "000000.png"
    resized = read_image(path, 24, 32, white=white_level(path))  # as a network gets it
    assert np.array_equal(resized[..., 0], resize_bilinear(frame, (24, 32)))
    assert not any(record.levelname == "WARNING" for record in caplog.records)


def test_thermal_frames_are_told_before_they_are_flat(own, caplog):
    for path in sorted(own.glob("*.png")):
        frame = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.uint16)
        cv2.imwrite(str(path), 20000 + 4 * frame)
    assert Sequence(None, own).frame(0).min() > 230
    (record,) = [record for record in caplog.records if record.levelname == "WARNING"]
    assert "gray levels" in record.getMessage()


@pytest.mark.parametrize("kinds", [("left_", "right_"), ("rgb", "depth"), ("", "d")])
def test_frames_of_two_cameras_in_one_folder_are_refused(own, kinds):
    for index, path in enumerate(sorted(own.glob("*.png"))):
        path.rename(own / f"{kinds[index % 2]}{index // 2:03d}.png")
    with pytest.raises(InputError, match=rf"own: holds .*{kinds[1]}\*.png"):
        Sequence(None, own)


def test_frames_of_16_bits_are_scaled_by_their_maximum(own, caplog):
    caplog.set_level("INFO")
    expected = [Sequence(None, own).frame(index) for index in range(4)]
    for path, frame in zip(sorted(own.glob("*.png")), expected):
        cv2.imwrite(str(path), frame.astype(np.uint16) * 16)
    sequence = Sequence(None, own)
    white = int(expected[0].max())
    for index, frame in enumerate(sequence):
        exact = np.minimum(expected[index].astype(float) * 255 / white, 255)
        assert frame.dtype == np.uint8 and np.abs(frame - exact).max() <= 0.5
    assert sum("16 bits" in line for line in caplog.messages) == 1
    assert str(16 * white) in caplog.text


BINARY = np.zeros((48, 64), np.uint8)
BINARY[:36, 8:-8] = 255


@pytest.mark.parametrize(
    "name, pixels",
    [
        ("a.png", np.dstack([0 * BINARY, 0 * BINARY, 0 * BINARY, BINARY])),
        ("a.png", np.dstack([BINARY | 255, BINARY | 255, BINARY | 255, BINARY])),
        ("a.png", np.dstack([0 * BINARY, 0 * BINARY, BINARY])),
        ("a.png", BINARY.astype(np.uint16) * 257),
        ("a.png", BINARY // 255),
        ("a.png", cv2.GaussianBlur(BINARY, (3, 3), 0.5)),
        ("a.JPG", BINARY),
    ],
)
def test_masks_of_other_tools(tmp_path, name, pixels):
    data = cv2.imencode(name[1:].lower(), pixels)[1]
    (tmp_path / name).write_bytes(data.tobytes())
    path = folders._images_by_name(tmp_path)["a.png"]
    assert path.name == name and np.array_equal(folders.read_mask(path), BINARY)


def objects(*values):
    """Three objects on a ground of 0."""
    picture = np.zeros((48, 64, *np.shape(values[0])), np.uint16)
    for index, value in enumerate(values):
        picture[10:20, 20 * index : 20 * index + 10] = value
    return picture.astype(np.uint8 if picture.max() < 256 else np.uint16)


@pytest.mark.parametrize(
    "values",
    [(1, 2, 3), (255, 1, 40), (1001, 2002, 10000), [(0, 0, 1), (0, 128, 0), (128, 128, 0)]],
)
def test_inverted_masks_leave_out_every_object(tiny_kitti, tmp_path, values):
    frames = Sequence(tiny_kitti, "00")
    cv2.imwrite(str(tmp_path / "objects.png"), objects(*values))
    expected = np.where(objects(1, 1, 1), 0, 255)
    masks = folders.MaskFolder(tmp_path / "objects.png", frames, invert=True)
    assert np.array_equal(masks[2], expected)


def test_soft_masks_have_one_limit_for_all_frames(tmp_path):
    soft = cv2.GaussianBlur(BINARY, (9, 9), 1)
    for brightness in (1, 0.92):
        darker = (brightness * soft).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "a.png"), darker)
        assert np.array_equal(folders.read_mask(tmp_path / "a.png") > 0, darker > 127)


@pytest.mark.parametrize("name", ["masks.npz", "masks.mp4", "masks.json"])
def test_masks_that_are_no_images_are_named(tiny_kitti, tmp_path, name):
    frames = Sequence(tiny_kitti, "00")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / name).write_bytes(b"masks")
    for path in (tmp_path / "masks", tmp_path / "masks" / name):
        with pytest.raises(InputError, match=rf"{path}: .*PNG"):
            folders.MaskFolder(path, frames)[0]


def test_what_is_no_mask_is_named(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, BINARY.shape, np.uint8)
    for pixels, text in (
        (np.dstack([noise, noise, noise, BINARY]), "a picture and an alpha channel"),
        (noise, "--labels"),
        (np.repeat([[23, 11, 7, 0]], 48, axis=0).astype(np.uint8), "--labels"),
        (objects(3, 200, 255), "--invert"),
        (objects(1, 2, 3), "--invert"),
    ):
        cv2.imwrite(str(tmp_path / "a.png"), pixels)
        with pytest.raises(InputError, match=f"a.png: .*{text}"):
            folders.read_mask(tmp_path / "a.png")
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="a.png: "):
        folders.read_mask(tmp_path / "a.png")


def test_no_keypoints_in_transparent_parts(own):
    hidden = np.zeros((48, 64), bool)
    hidden[:5], hidden[:, 60:] = True, True
    assert Sequence(None, own).visible(0) is None
    for path in sorted(own.glob("*.png")):
        pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        opaque = np.where(hidden, 0, 255).astype(np.uint8)
        cv2.imwrite(str(path), np.dstack([pixels, pixels, pixels, opaque]))
    sequence = Sequence(None, own)
    expected = np.zeros((48, 64), np.uint8)
    expected[15:, :50] = 255  # ten pixels away
    assert np.array_equal(sequence.subset(2).visible(1), expected)
    detected = []

    def detect(frame, settings, mask):
        detected.append(mask)
        return odometry.OPENCV.detect(frame, settings, mask)

    calls = odometry.OPENCV._replace(detect=detect)
    for masks, inner in ((None, expected), ([BINARY] * 4, expected & BINARY)):
        odometry.run(sequence, masks=masks, calls=calls)
        assert all(np.array_equal(mask, inner) for mask in detected) and len(detected) > 1
        detected.clear()
    alone = odometry.run(sequence, masks=[BINARY] * 4)
    together = odometry.run_many(sequence, {1: (odometry.THESIS, [BINARY] * 4)})[1]
    assert np.array_equal(alone.poses, together.poses)
    assert alone.frames["detected"].equals(together.frames["detected"])


def test_what_the_camera_did_not_see_has_no_keypoints(own):
    (own / "camera.txt").write_text("50 50 32 24 0.4 0 0 0")
    sequence = Sequence(None, own, calibration=own / "camera.txt")
    black = sequence.undistorted(np.full((48, 64), 255, np.uint8)) == 0
    visible = sequence.visible(0) > 0
    assert black.any() and visible.any() and not visible[black].any()


@pytest.mark.parametrize(
    "options, said",
    [
        ("--output path.txt --tum path.txt", "--output, --tum: both are path.txt"),
        ("--tum ./path.txt --output path.txt", "--output, --tum: both are"),
        ("--speed -3", "speed -3: must be"),
        ("--speed 0", "speed 0: must be"),
        ("--sequence drive.mp4", "drive.mp4: is a file; .*own-masks.md"),
    ],
)
def test_names_and_numbers_that_cannot_be_are_one_line(own, options, said, monkeypatch, capsys):
    monkeypatch.chdir(own.parent)
    (own.parent / "drive.mp4").write_bytes(b"video")
    assert main(["odometry", "--sequence", str(own), *options.split()]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(f"error: .*{said}", line)
    assert not (own.parent / "path.txt").exists()


def test_times_of_frames_in_whole_seconds(tmp_path):
    written = np.tile(np.eye(4), (3, 1, 1))
    write_tum(tmp_path / "poses.txt", written, np.arange(3.0))
    frames, poses = read_poses_at(tmp_path / "poses.txt", np.arange(1, 5))
    assert list(frames) == [0, 1]  # at seconds 1 and 2
    np.testing.assert_array_equal(poses, written[1:])
