"""Frames, poses and label maps as people bring them from other tools and data sets."""

import re
import shutil

import cv2
import numpy as np
import pytest
from as_downloaded import write_euroc_truth

from thesis_repro import odometry
from thesis_repro.command.cli import main
from thesis_repro.data import cameras, kitti
from thesis_repro.data.cityscapes import read_image, resize_bilinear
from thesis_repro.data.frames import white_level
from thesis_repro.data.sequence import Sequence
from thesis_repro.data.trajectories import read_poses, write_tum
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


def test_names_of_unlike_decimals_are_refused(own):
    paths = sorted(own.glob("*.png"))
    for path, stem in zip(paths, ["0.10", "0.15", "0.20", "0.90"]):
        path.rename(own / f"{stem}.png")
    stems = [path.stem for path in Sequence(None, own).frame_paths]
    assert stems == ["0.10", "0.15", "0.20", "0.90"]
    (own / "0.10.png").rename(own / "0.1.png")
    with pytest.raises(InputError, match="own: 0.*png and others have 1 and 2 digits"):
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


@pytest.mark.parametrize("rows", [POSES[:, :3].reshape(4, 12), POSES.reshape(4, 16)])
def test_poses_have_three_or_four_rows(own, rows):
    (own / "poses.txt").write_text(lines(rows))
    assert np.array_equal(Sequence(None, own).poses, POSES)
    for other in (rows + np.eye(*rows.shape), np.column_stack([range(4), rows])):
        (own / "poses.txt").write_text(lines(other))
        with pytest.raises(InputError, match="poses.txt, line 1: must"):
            read_poses(own / "poses.txt")


def test_poses_in_the_folder_of_a_sequence(tiny_kitti):
    expected = Sequence(tiny_kitti, "00").poses
    folder = (tiny_kitti / "sequences/00").rename(tiny_kitti / "sequences/mine")
    (tiny_kitti / "poses/00.txt").rename(folder / "poses.txt")
    assert kitti.sequences(tiny_kitti) == ["mine"]
    for root, name in ((tiny_kitti, "mine"), (None, folder)):
        sequence = Sequence(root, name)
        assert sequence.name == "mine" and np.array_equal(sequence.poses, expected)


def euroc(path, poses, times):
    write_euroc_truth(path, poses, np.round(1e9 * times))


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


NUMBERS = [50.0, 51.0, 32.0, 24.0, -0.3, 0.1, 0.01, -0.02]
OPENCV = """%YAML:1.0
---
calibration_time: "Sat 28 Nov 2026"
image_width: 64
image_height: 48
fisheye_model: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 50., 0., 32., 0., 51., 24., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -3.0000000000000000e-01, 0.1, 1e-2, -0.02 ]
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
  camera_model: pinhole
  distortion_coeffs: [0, 0, 0, 0]
  distortion_model: radtan
  intrinsics: [60, 61, 31, 23]
  resolution: [64, 48]
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


@pytest.mark.parametrize(
    "name, text",
    [
        ("camera.txt", "# fx fy cx cy k1 k2 p1 p2\n" + " ".join(map(str, NUMBERS))),
        ("camera.txt", ", ".join(map(str, NUMBERS))),
        ("camera.yml", OPENCV),
        ("camera.yaml", ROS),
        ("camera.yaml", EUROC),
        ("camera.yaml", KALIBR),
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


def refused(path, text, said):
    path.write_text(text)
    with pytest.raises(InputError, match=f"{path.name}: {said}"):
        Sequence(None, path.parent, calibration=path)


@pytest.mark.parametrize(
    "name, text",
    [
        ("camera.txt", "50 50 32 24 0.1"),
        ("camera.txt", "50 0 32 0 51 24 0 0 1"),  # a matrix
        ("camera.txt", "50 nan 32 24"),
        ("camera.txt", "50 50 32 24 inf 0 0 0"),
        ("camera.txt", "-50 50 32 24"),
        *(("camera.yaml", text) for text in ("a: [1", "", "- 1", "7", "T_BS: [1]", "\t")),
        ("camera.yaml", "Camera.fx: 50\nCamera.fy: 51\nCamera.cx: 32\nCamera.cy: 24\n"),
        ("camera.yaml", EUROC.replace("distortion_coefficients", "lens")),
        ("camera.yaml", EUROC.replace("4\n  data: [0.0", "4\n  data: [[0.0")),
        ("camera.yaml", OPENCV.replace("0.1, 1e-2, -0.02 ]", "0.1 ]")),
        ("camera.yaml", ROS.replace("50.0, 0.0", "50.0, 2.0")),  # skew
        ("camera.yaml", KALIBR.replace("intrinsics", "extrinsics")),
        ("camera.yaml", KALIBR.replace("32, 24", "32")),
    ],
)
def test_another_file_is_no_camera(own, name, text):
    refused(own / name, text, "must hold fx fy cx cy.*OpenCV, ROS, EuRoC")


def test_a_camera_without_a_model_of_distortion_needs_no_coefficients(own):
    text = EUROC.replace("radial-tangential", "none")
    for without in (
        text.replace("[-0.3, 0.1, 0.01, -0.02]", "[]"),
        text[: text.index("distortion_c")],
    ):
        (own / "camera.yaml").write_text(without)
        assert not len(Sequence(None, own, calibration=own / "camera.yaml").lens.distortion)


@pytest.mark.parametrize(
    "text, said",
    [
        (OPENCV.replace("fisheye_model: 0", "fisheye_model: 1"), "fisheye_model is 1"),
        (KALIBR.replace("radtan", "equidistant"), "distortion_model is equidistant"),
        (KALIBR.replace("pinhole", "omni"), "camera_model is omni"),
        (ROS.replace("plumb_bob", "fisheye"), "distortion_model is fisheye"),
        (EUROC.replace("[0.0, -1.0", "[0.0, -1.5"), "T_BS or T_cam_imu must be"),
        (KALIBR.replace("cam0:", "cam2:"), "holds cam2, cam1, but no cam0"),
    ],
)
def test_a_camera_that_cannot_be_used_is_named(own, text, said):
    refused(own / "camera.yaml", text, said)


@pytest.mark.parametrize(
    "text",
    [
        OPENCV.replace("image_height: 48", "image_height: 50"),
        EUROC.replace("64, 48", "48, 64"),
        KALIBR.replace("64, 48", "640, 480"),
    ],
)
def test_a_camera_of_frames_of_another_size_is_named(own, text):
    (own / "camera.yaml").write_text(text)
    sequence = Sequence(None, own, calibration=own / "camera.yaml")
    with pytest.raises(InputError, match=r"camera.yaml: .*, but .*000000.png has 64x48"):
        sequence.frame(0)


def test_kalibrs_file_is_read_for_the_camera_that_is_used(own):
    (own / "chain.yaml").write_text(KALIBR)
    body = cameras.read_camera(own / "chain.yaml", "image_0").body
    np.testing.assert_allclose(body[:3, 3], [0.01, -0.06, 0.01])
    right = cameras.read_camera(own / "chain.yaml", "cam1")
    assert right.matrix[0, 0] == 60 and right.body is None


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
    path = tmp_path / "objects.png"
    cv2.imwrite(str(path), objects(*values))
    masks = folders.MaskFolder(path, Sequence(tiny_kitti, "00"), invert=True)
    assert np.array_equal(masks[2], np.where(objects(1, 1, 1), 0, 255))


def test_soft_masks_have_one_limit_for_all_frames(tmp_path):
    for brightness in (1, 0.92):
        darker = (brightness * cv2.GaussianBlur(BINARY, (9, 9), 1)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "a.png"), darker)
        assert np.array_equal(folders.read_mask(tmp_path / "a.png") > 0, darker > 127)


def test_what_is_no_mask_is_named(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, BINARY.shape, np.uint8)
    for pixels, text in (
        (np.dstack([0 * BINARY, 0 * BINARY, 0 * BINARY, BINARY]), "an alpha channel"),
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
        ("--sequence drive.mp4", "drive.mp4: is a file; .*own-data.md"),
    ],
)
def test_names_and_numbers_that_cannot_be_are_one_line(own, options, said, monkeypatch, capsys):
    monkeypatch.chdir(own.parent)
    (own.parent / "drive.mp4").write_bytes(b"video")
    assert main(["odometry", "--sequence", str(own), *options.split()]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(f"error: .*{said}", line)
    assert not (own.parent / "path.txt").exists()
