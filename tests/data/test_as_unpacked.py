"""EuRoC and TUM RGB-D as the data sets have them: distortion, T_BS, times and gaps of the truth.

A rendered street, seen through the lenses of both. What is right is computed by evo and OpenCV
alone.
"""

import json
import shutil

import cv2
import numpy as np
import pytest
from as_downloaded import (
    T_BS,
    write_euroc,
    write_euroc_truth,
    write_images,
    write_tum_frames,
)
from evo.core.metrics import PoseRelation
from evo.core.sync import associate_trajectories
from evo.core.trajectory import PoseTrajectory3D
from evo.main_ape import ape
from evo.tools import file_interface
from scipy.spatial.transform import Rotation, Slerp
from street import Street

from thesis_repro.command.cli import main
from thesis_repro.data import layout, trajectories
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks.folders import LabelMasks, MaskFolder

COUNT = 30
LENSES = {
    "euroc": [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    "tum": [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
}
START_NS = 1403715273262142976


def seen_through(image, camera, distortion):
    """Image as a lens shows it: without its distortion, it is the image again."""
    height, width = image.shape
    pixels = np.mgrid[:height, :width][::-1].reshape(2, -1).T.astype(float)[:, None]
    precise = 3, 100, 1e-9
    straight = cv2.undistortPointsIter(pixels, camera, np.array(distortion), None, camera, precise)
    u, v = np.float32(straight[:, 0]).T.reshape(2, height, width)
    return cv2.remap(image, u, v, cv2.INTER_CUBIC)


def between(poses, times, wanted):
    """Poses at other times."""
    made = np.tile(np.eye(4), (len(wanted), 1, 1))
    for axis in range(3):
        made[:, axis, 3] = np.interp(wanted, times, poses[:, axis, 3])
    made[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(wanted).as_matrix()
    return made


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """A street in both layouts, {name: folder}."""
    root, street = tmp_path_factory.mktemp("drives"), Street(COUNT)
    camera = street.intrinsics
    (fx, _, cx), (_, fy, cy), _ = camera.tolist()
    world = np.eye(4)  # z up, as the data sets have it
    world[:3] = [[0, 0, 1, 2], [-1, 0, 0, -1], [0, -1, 0, 1.5]]
    true = world @ street.poses
    # EuRoC: 20 frames a second, 200 poses of the body, which begin later and end earlier
    stamps = START_NS + 50_000_000 * np.arange(COUNT)
    images = [seen_through(image, camera, LENSES["euroc"]) for image in street.images]
    write_euroc(root / "MH_01", images, camera, stamps, LENSES["euroc"])
    at = np.arange(0.1021, 1.3, 0.005)
    body = between(true @ np.linalg.inv(T_BS), 0.05 * np.arange(COUNT), at)
    truth = layout.poses(root / "MH_01")
    # six digits, as the data set has them, so quaternions have a length of nearly 1
    write_euroc_truth(truth, body, [START_NS + round(1e9 * time) for time in at], digits=6)
    # TUM: 30 frames a second, 100 poses of the camera, with two gaps of 0.11 s
    folder = root / "rgbd_dataset_freiburg1_street"
    seconds = 1305031102.175304 + np.arange(COUNT) / 30
    images = [seen_through(image, camera, LENSES["tum"]) for image in street.images]
    write_tum_frames(folder, [cv2.merge([image] * 3) for image in images], seconds)
    at = np.arange(seconds[0] + 0.0042, seconds[-1], 0.01)
    for gap in seconds[[11, 20]] + 0.003:
        at = at[np.abs(at - gap) > 0.05]
    trajectories.write_tum(folder / "groundtruth.txt", between(true, seconds, at), at.round(4))
    numbers = [fx, fy, cx, cy, *LENSES["tum"]]
    (root / "tum.txt").write_text(" ".join(map(str, numbers)))
    return {
        "euroc": (root / "MH_01", [], stamps / 1e9, truth),
        "tum": (
            folder,
            ["--calibration", str(root / "tum.txt")],
            np.array([float(f"{second:.6f}") for second in seconds]),
            folder / "groundtruth.txt",
        ),
    }


def by_evo(name, times, truth):
    """True poses of the camera at the times of frames that have one, as evo has them."""
    if name == "euroc":
        poses = file_interface.read_euroc_csv_trajectory(str(truth))
        poses.transform(T_BS, right_mul=True)
    else:
        poses = file_interface.read_tum_trajectory_file(str(truth))
    still = np.zeros((len(times), 3)), np.tile([1.0, 0, 0, 0], (len(times), 1))
    frames, poses = associate_trajectories(PoseTrajectory3D(*still, times), poses, max_diff=0.01)
    return frames.timestamps, np.array(poses.poses_se3)


@pytest.mark.parametrize("name, missing", [("euroc", 5), ("tum", 6)])
def test_poses_and_errors_are_those_of_evo(drives, name, missing, tmp_path, capsys):
    folder, options, times, truth = drives[name]
    calibration = options[1] if options else None
    sequence = Sequence(None, folder, calibration=calibration)
    at, poses = by_evo(name, times, truth)
    np.testing.assert_allclose(sequence.times, at, rtol=0, atol=3e-7)  # of seconds since 1970
    np.testing.assert_allclose(sequence.poses, poses, rtol=0, atol=1e-12)
    assert len(sequence) == COUNT - missing
    # the lens is taken out
    street = Street(COUNT)
    place = {f"{time:.4f}": index for index, time in enumerate(times)}
    for index in (0, 9, len(sequence) - 1):
        image = street.images[place[f"{sequence.times[index]:.4f}"]]
        visible = sequence.visible(index)
        inside = np.full(image.shape, True) if visible is None else visible > 0
        assert inside.mean() > 0.5
        difference = np.abs(sequence.frame(index).astype(int) - image)[inside]
        assert np.median(difference) <= 4 and difference.mean() < 8
    # errors of the run, as evo has them
    path = tmp_path / "path.tum"
    words = ["odometry", "--sequence", str(folder), *options, "--scale-gate", "0", "--json"]
    assert main([*words, "--estimator", "refined", "--tum", str(path)]) == 0
    record = json.loads(capsys.readouterr().out)
    estimate = file_interface.read_tum_trajectory_file(str(path))
    reference = PoseTrajectory3D(poses_se3=list(poses), timestamps=at)
    reference, estimate = associate_trajectories(reference, estimate, max_diff=0.001)
    assert record["frames"] == len(at) == len(estimate.timestamps)
    shift = np.eye(4)  # to the position of frame 1, as in PySLAM
    shift[:3, 3] = reference.positions_xyz[1] - estimate.positions_xyz[1]
    estimate.transform(shift)
    for path in (reference, estimate):
        path.reduce_to_ids(range(1, len(at)))
    error = ape(reference, estimate, PoseRelation.translation_part).stats["rmse"]
    assert record["rmse_m"] == pytest.approx(error, rel=1e-9)
    assert error < 0.2  # of eleven metres


@pytest.mark.parametrize(
    "times, at, indices, found",
    [
        # fewer poses than frames, but closer together: evo alone gives a frame the first of them
        (np.arange(40) / 30, [*np.arange(0, 0.05, 0.004), 1.3], [0, 1, 39], [0, 0.032, 1.3]),
        (np.arange(1, 5), np.arange(3.0), [0, 1], [1, 2]),  # in whole seconds
    ],
)
def test_each_frame_has_the_nearest_pose(tmp_path, times, at, indices, found):
    poses = np.tile(np.eye(4), (len(at), 1, 1))
    poses[:, 2, 3] = at
    trajectories.write_tum(tmp_path / "short.txt", poses, np.array(at))
    read, nearest = trajectories.read_poses_at(tmp_path / "short.txt", times)
    assert read.tolist() == indices
    np.testing.assert_allclose(nearest[:, 2, 3], found)


@pytest.fixture
def euroc(drives, tmp_path):
    """A copy of EuRoC's drive that a test may change."""
    return shutil.copytree(drives["euroc"][0], tmp_path / "MH_01")


def test_another_calibration_leaves_the_body_as_it_is(euroc, tmp_path, caplog):
    caplog.set_level("INFO")
    expected = Sequence(None, euroc)
    sensor = euroc / "mav0/cam0/sensor.yaml"
    text = sensor.read_text()
    without = text[: text.index("T_BS")] + text[text.index("rate_hz") :]
    (tmp_path / "own.yaml").write_text(without)
    (tmp_path / "own.txt").write_text("300 300 239.5 79.5")
    for name in ("own.yaml", "own.txt"):
        sequence = Sequence(None, euroc, calibration=tmp_path / name)
        assert np.array_equal(sequence.poses, expected.poses) and sensor in sequence.files
    inverse = np.linalg.inv(T_BS).tolist()
    chain = {"cam0": dict(intrinsics=[9, 9, 9, 9], distortion_coeffs=[0] * 4, T_cam_imu=inverse)}
    (tmp_path / "chain.yaml").write_text(json.dumps(chain))
    sequence = Sequence(None, euroc, calibration=tmp_path / "chain.yaml")
    np.testing.assert_allclose(sequence.poses, expected.poses, atol=1e-12)
    assert not any(record.levelname == "WARNING" for record in caplog.records)
    # poses in another form are the camera's
    trajectories.write_tum(tmp_path / "camera.tum", expected.poses, expected.times)
    sequence = Sequence(None, euroc, truth=tmp_path / "camera.tum")
    np.testing.assert_allclose(sequence.poses, expected.poses, atol=1e-9)
    assert "camera.tum: poses are the camera's" in caplog.text
    sensor.write_text(without)
    Sequence(None, euroc)
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "data.csv: holds poses of a body" in line


def test_times_of_frames_are_those_that_are_listed(euroc):
    expected = Sequence(None, euroc).times
    frames, listed = euroc / "mav0/cam0/data", euroc / "mav0/cam0/data.csv"
    text = listed.read_text()
    for index, path in enumerate(sorted(frames.iterdir())):
        path.rename(frames / f"{index:06d}.png")
    lines = text.splitlines()
    named = [f"{line.split(',')[0]},{index:06d}.png" for index, line in enumerate(lines[1:])]
    listed.write_text("\n".join([lines[0], *named, "1500000000000000000,gone.png", ""]))
    assert np.array_equal(Sequence(None, euroc).times, expected)
    for form in ("data/{}.png", "{}.jpg", "{}", " cam0/data/{}.PNG "):  # as other tools list them
        told = [f"{line.split(',')[0]},{form.format(line[-10:-4])}" for line in named]
        listed.write_text("\n".join([lines[0], *told, "1500000000000000000,data/000077.png"]))
        assert np.array_equal(Sequence(None, euroc).times, expected)
    early = named[3].replace(named[3].split(",")[0], "14037")
    for lines, said in (
        (named[:-1], "has no time of 000029.png"),
        ([named[1], *named[1:]], "has no time of 000000.png"),
        ([*named[:3], early, *named[4:]], ".*must increase"),
    ):
        listed.write_text("\n".join(lines))
        with pytest.raises(InputError, match=f"data.csv: {said}"):
            Sequence(None, euroc)
    listed.unlink()  # no times are stated, so poses cannot belong to frames by time
    with pytest.raises(InputError, match="data.csv: .*--fps"):
        Sequence(None, euroc)


def test_masks_and_label_maps_belong_to_frames_without_distortion(
    euroc, small_model, tmp_path, capsys
):
    sequence = Sequence(None, euroc).subset(4)
    one = np.full(sequence.size, 255, np.uint8)
    one[:40] = 0
    masks = [np.where(frame > 20, one, 0) for frame in sequence]
    write_images(tmp_path / "each", sequence.label_names, masks)
    write_images(tmp_path / "straight", sequence.label_names, sequence)
    write_images(tmp_path / "one", ["bonnet.png"], [one])
    assert np.array_equal(
        MaskFolder(tmp_path / "each", sequence)[1] > 0, (sequence[1] > 20) & (one > 0)
    )
    keypoints = []
    for masks in ("one", "one/bonnet.png"):
        words = ["odometry", "--sequence", str(euroc), "--frames", "4", "--json"]
        assert main([*words, "--masks", str(tmp_path / masks)]) == 0
        captured = capsys.readouterr()
        assert "masks must be of frames without distortion" in captured.err
        keypoints.append(json.loads(captured.out)["mean_keypoints"])
    assert keypoints[0] == keypoints[1]
    # `predict` makes them of the frames as the odometry sees them
    for images, output in ((euroc, "maps"), (tmp_path / "straight", "expected")):
        words = ["predict", "--images", str(images), "--model", str(small_model)]
        assert main([*words, "--output", str(tmp_path / output)]) == 0
    first = len(sorted((euroc / "mav0/cam0/data").iterdir())) - len(Sequence(None, euroc))
    assert first > 0 and len(list((tmp_path / "maps").glob("*.png"))) == COUNT
    source = LabelMasks(tmp_path / "maps", sequence, 3)
    for index, path in enumerate(sequence.frame_paths):
        expected = cv2.imread(str(tmp_path / "expected" / path.name), 0)
        same = source.label_map(index) == expected
        assert same.mean() > 0.999  # batches of other frames may round otherwise
    # those of raw frames do not fit, nor those of another lens
    from thesis_repro.segmentation import prediction

    model = prediction.training.load_model(small_model)
    prediction.write_label_maps(model, sequence.frame_paths, tmp_path / "raw")
    with pytest.raises(InputError, match="raw: made of frames with other distortion"):
        LabelMasks(tmp_path / "raw", sequence, 3)
    (tmp_path / "lens.txt").write_text("300 300 239.5 79.5 -0.2 0 0 0")
    other = Sequence(None, euroc, calibration=tmp_path / "lens.txt").subset(4)
    with pytest.raises(InputError, match="maps: made of frames with other distortion"):
        LabelMasks(tmp_path / "maps", other, 3)


def test_label_maps_and_masks_know_whose_pictures_they_are(euroc, small_model, tmp_path, capsys):
    """The second camera's frames have the names of the first one's."""
    cam0, cam1 = euroc / "mav0/cam0", euroc / "mav0/cam1"
    shutil.copytree(cam0, cam1)
    for path in (cam1 / "data").iterdir():
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path), 0), 1))
    camera = cam1 / "sensor.yaml"
    camera.write_text(camera.read_text().replace("-0.283", "-0.3"))
    right = Sequence(None, euroc, "cam1").subset(4)
    write_images(tmp_path / "straight", right.label_names, right)

    def command(name, *words):
        return main([name, *map(str, words)])

    def predict(output, images, *words):
        words = *words, "--model", small_model, "--output", tmp_path / output
        assert command("predict", "--images", images, *words) == 0

    predict("left", euroc)
    predict("right", euroc, "--camera", "cam1")
    predict("straight labels", tmp_path / "straight")
    predict("left, right lens", euroc, "--calibration", camera)
    source = LabelMasks(tmp_path / "right", right, 3)
    for index, name in enumerate(right.label_names):
        expected = cv2.imread(str(tmp_path / "straight labels" / name), 0)
        assert (source.label_map(index) == expected).mean() > 0.999
    own = "--sequence", euroc, "--camera", "cam1", "--frames", 4
    for name, words in (("masks 1", own), ("masks 0", ("--sequence", euroc))):
        labels = tmp_path / ("right" if name == "masks 1" else "left")
        words = *words, "--labels", labels, "--dilation", 3, "--output", tmp_path / name
        assert command("masks", *words) == 0
    capsys.readouterr()
    for words, fits in (
        (("--labels", tmp_path / "right", "--dilation", 3), True),
        (("--labels", tmp_path / "left", "--dilation", 3), False),
        (("--labels", tmp_path / "left, right lens", "--dilation", 3), False),
        (("--masks", tmp_path / "masks 1"), True),
        (("--masks", tmp_path / "masks 0"), False),
    ):
        assert command("odometry", *own, *words) == int(not fits)
        last = capsys.readouterr().err.splitlines()[-1]
        assert fits or f"{words[1]}: " in last and "another camera" in last
