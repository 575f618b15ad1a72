"""The embedded world: exact poses and label maps, equal bytes for equal seeds, both layouts,
errors and resuming.
"""

import shutil

import cv2
import numpy as np
import pytest

from thesis_repro import InputError, cityscapes, files, kitti
from thesis_repro.cityscapes import ID
from thesis_repro.world import dataset, drives, raster, street, textures
from thesis_repro.world.things import Faces

pytestmark = pytest.mark.slow

SMALL = {
    "sequences": ("00", "07"),
    "frames": 12,
    "scale": 0.2,
    "train_images": 2,
    "validation_images": 1,
    "jobs": 1,
}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world") / "out"
    dataset.write(folder, **SMALL)
    return folder


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != files.LIST
    }  # the list's order depends on the run


def test_layouts_are_read_by_the_readers_of_real_data(out):
    assert kitti.sequences(out / "kitti") == ["00", "07"]
    for name in ("00", "07"):
        sequence = kitti.Sequence(out / "kitti", name)
        assert len(sequence) == 12
        assert sequence.size == (75, 248) if name == "00" else (74, 245)
        np.testing.assert_allclose(np.diff(sequence.times), 0.1, atol=1e-9)
        for index, frame in enumerate(sequence.frames()):
            labels = cityscapes.read_label_map(sequence.folder / "labels_0" / f"{index:06d}.png")
            assert labels.shape == frame.shape
            assert frame.std() > 15
    for split, count in (("train", 2), ("val", 1)):
        pairs = cityscapes.pairs(out / "cityscapes", split)
        assert len(pairs) == count
        images, labels = cityscapes.load(pairs, 64)
        assert {ID["road"], ID["sky"]} <= set(np.unique(labels))
    parts = (
        cityscapes.pairs(out / "cityscapes", "train")[0].image.relative_to(out / "cityscapes").parts
    )
    assert (
        parts[:2] == ("leftImg8bit", "train")
        and parts[3] == f"{parts[2]}_000000_000000_leftImg8bit.png"
    )


def test_scaled_intrinsics_keep_the_rays_of_the_image_borders():
    camera = kitti.CAMERAS["00"]
    for scale in (0.2, 0.5, 1.0):
        (height, width), matrix = drives.scaled_camera("00", scale)
        for edge, full in ((-0.5, -0.5), (width - 0.5, camera.width - 0.5)):
            assert (edge - matrix[0, 2]) / matrix[0, 0] == pytest.approx(
                (full - camera.cx) / camera.fx
            )
        assert (height - 0.5 - matrix[1, 2]) / matrix[1, 1] == pytest.approx(
            (camera.height - 0.5 - camera.cy) / camera.fy
        )
    assert matrix[0].tolist() == [camera.fx, 0, camera.cx]


@pytest.mark.parametrize("frames", [12, None, 400])
@pytest.mark.parametrize("name", dataset.SEQUENCES)
def test_drives_are_realistic(name, frames):
    frames = frames or drives.DRIVES[name].frames
    poses = drives.relative_to_first(drives.way(name, frames, seed=0)[1])
    assert np.array_equal(poses[0], np.eye(4))
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12
    )
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < (2.6 if name == "01" else 1.7)  # 94 and 61 km/h
    turns = np.degrees(
        np.arccos(
            np.clip(
                (np.trace(rotations[:-1].transpose(0, 2, 1) @ rotations[1:], axis1=1, axis2=2) - 1)
                / 2,
                -1,
                1,
            )
        )
    )
    assert turns.max() < 4.5
    standing = int((steps == 0).sum())
    assert standing >= 4 if name == "07" else standing == 0
    # The camera moves forwards along z, on a level road.
    assert (np.diff(poses[:3, 2, 3]) > 0.1).all()
    assert np.abs(poses[:, 1, 3]).max() < 0.03 + 0.002 * steps.sum()


def test_drives_are_unequal_and_one_is_closed():
    paths = {
        name: drives.relative_to_first(drives.way(name, drive.frames, seed=0)[1])
        for name, drive in drives.DRIVES.items()
    }
    lengths = [
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() for poses in paths.values()
    ]
    assert (
        all(57 < length < 120 for length in lengths)
        and len({len(poses) for poses in paths.values()}) > 8
    )
    assert np.linalg.norm(paths["09"][-1, :3, 3]) < 1


def epipolar_errors(before, after, relative, intrinsics, keep):
    """Return the distances (pixels) of Lucas-Kanade tracks from the epipolar lines of a
    relative pose.
    """
    settings = {"winSize": (21, 21), "maxLevel": 3, "criteria": (3, 30, 0.01)}
    mask = np.where(keep, 255, 0).astype(np.uint8)
    points = cv2.goodFeaturesToTrack(before, 2000, 0.01, 3, mask=mask, blockSize=5)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **settings)
    back, _, _ = cv2.calcOpticalFlowPyrLK(after, before, tracked, None, **settings)
    good = (status[:, 0] == 1) & (np.linalg.norm((back - points)[:, 0], axis=1) < 0.5)
    x, y = points[good, 0].astype(float), tracked[good, 0].astype(float)
    t = relative[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    inverse = np.linalg.inv(intrinsics)
    lines = np.c_[x, np.ones(len(x))] @ (inverse.T @ cross @ relative[:3, :3] @ inverse).T
    return np.abs((lines * np.c_[y, np.ones(len(y))]).sum(axis=1)) / np.hypot(
        lines[:, 0], lines[:, 1]
    )


def test_tracked_points_agree_with_the_poses():
    frames = 30
    _, poses, _ = drives.way("05", frames, seed=0)
    _, intrinsics = drives.scaled_camera("05", 0.5)
    true, turned = [], []
    wrong = np.eye(4)
    wrong[:3, :3] = cv2.Rodrigues(np.radians([0.3, 0, 0]))[0]
    for index in (3, 8, 20, 26):
        before, labels = dataset.render_frame("05", index, frames)
        after, _ = dataset.render_frame("05", index + 1, frames)
        relative = np.linalg.inv(poses[index + 1]) @ poses[index]
        still = np.isin(labels, (ID["building"], ID["wall"], ID["road"], ID["vegetation"]))
        true.extend(epipolar_errors(before, after, relative, intrinsics, still))
        turned.extend(epipolar_errors(before, after, wrong @ relative, intrinsics, still))
    assert len(true) > 500
    assert np.median(true) < 0.16
    assert np.median(turned) > 0.3  # a rotation of 0.3 degrees is noticed


def test_every_class_occurs_in_each_part_of_the_world():
    needed = {
        ID[name]
        for name in (
            "road",
            "sidewalk",
            "building",
            "wall",
            "fence",
            "pole",
            "traffic sign",
            "vegetation",
            "terrain",
            "sky",
            "person",
            "car",
        )
    }
    for part in ("train", "val"):
        assert needed <= set().union(
            *(np.unique(dataset.render_image(part, index, 0.25)[1]) for index in range(20))
        )
    assert needed <= set().union(
        *(
            np.unique(dataset.render_frame(name, index, scale=0.25)[1])
            for name in dataset.SEQUENCES
            for index in (0, 25)
        )
    )


def one_square(z=10.0, half=2.0, texture="stone", label="building"):
    faces = Faces(textures.build(0).names)
    faces.add((-half, half, z), (2 * half, 0, 0), (0, -2 * half, 0), texture, label)
    return faces.matrix()


def view(faces, size=(80, 120)):
    intrinsics = np.array([[100.0, 0, 59.5], [0, 100.0, 39.5], [0, 0, 1]])
    environment = street.environment(drives.Style())
    return raster.render(faces, textures.build(0).packed, np.eye(4), intrinsics, size, environment)


@pytest.mark.parametrize("half", [1.9, 2.0, 2.03, 2.06, 2.1])
def test_label_of_a_pixel_is_that_of_most_of_its_samples(half):
    # The square's edges lie 10 half pixels around (39.5, 59.5); a pixel has samples a quarter pixel
    # off its centre.
    _, labels = view(one_square(half=half, label="wall"))
    inside = []
    for count, middle in ((80, 39.5), (120, 59.5)):
        samples = np.arange(count)[:, None] + np.array([-0.25, 0.25])
        inside.append(np.abs(samples - middle) <= 10 * half + 1e-6)
    covered = inside[0][:, None, :, None] & inside[1][None, :, None, :]
    # If two of four samples are inside, the nearer surface counts: the square, not the sky.
    assert np.array_equal(labels == ID["wall"], covered.sum(axis=(2, 3)) >= 2)


def test_nearer_surface_hides_the_farther_in_any_order():
    near, far = one_square(z=5.0, half=0.5, label="car"), one_square(z=10.0, half=2.0)
    image, labels = view(np.concatenate([near, far]))
    other_image, other_labels = view(np.concatenate([far, near]))
    assert np.array_equal(image, other_image) and np.array_equal(labels, other_labels)
    assert labels[40, 60] == ID["car"] and labels[25, 45] == ID["building"]


def test_neighbouring_faces_leave_no_crack():
    faces = Faces(textures.build(0).names)
    rng = np.random.default_rng(3)
    ring = [np.array([3 * np.cos(a), 3 * np.sin(a), 10.0]) for a in np.linspace(0, 2 * np.pi, 40)]
    middle = np.array([*rng.uniform(-0.5, 0.5, 2), 10.0])
    for first, second in zip(ring, ring[1:]):
        faces.add(middle, first - middle, second - middle, "stone", "building", triangle=1)
    _, labels = view(faces.matrix())
    assert (labels[20:60, 40:80] == ID["building"]).all()


def test_same_seed_gives_the_same_bytes_for_any_number_of_processes(out, tmp_path):
    dataset.write(tmp_path / "again", **{**SMALL, "jobs": 2})
    assert contents(tmp_path / "again") == contents(out)
    first = dataset.render_frame("00", 3, frames=12, scale=0.2, seed=1)[0]
    assert not np.array_equal(first, kitti.Sequence(out / "kitti", "00").frame(3))


def test_a_stopped_run_resumes_and_keeps_complete_files(out, tmp_path):
    folder = shutil.copytree(out, tmp_path / "stopped")
    missing = [
        folder / "kitti/sequences/07/image_0/000004.png",
        folder / "kitti/sequences/00/labels_0/000011.png",
        folder / "kitti/poses/00.txt",
        sorted((folder / "cityscapes").rglob("*.png"))[0],
    ]
    for path in missing:
        path.unlink()
    # a temporary file of a killed run
    (folder / "kitti/sequences/07/image_0/.000004.thesis-repro-00004711.png").write_bytes(b"half")
    untouched = folder / "kitti/sequences/07/image_0/000005.png"
    age = untouched.stat().st_mtime_ns
    dataset.write(folder, **SMALL)
    assert contents(folder) == contents(out)
    assert untouched.stat().st_mtime_ns == age


def test_the_two_halves_make_the_whole_in_either_order(out, tmp_path):
    for number, order in enumerate((("cityscapes", "kitti"), ("kitti", "cityscapes"))):
        half = tmp_path / str(number)
        for part in order:
            dataset.write(half, **SMALL, only=part)
            assert {path.name for path in half.iterdir() if path.is_dir()} == set(
                order[: order.index(part) + 1]
            )
        assert contents(half) == contents(out)


def test_a_folder_with_other_files_is_not_changed(out, tmp_path):
    before = contents(out)
    with pytest.raises(InputError):  # other parameters
        dataset.write(out, **{**SMALL, "frames": 13})
    assert contents(out) == before
    letter = tmp_path / "letter.txt"
    letter.write_text("mine")
    for folder in (tmp_path, letter):
        with pytest.raises(InputError):
            dataset.write(folder, **SMALL)
    assert letter.read_text() == "mine" and list(tmp_path.iterdir()) == [letter]
