"""The embedded world: exact poses and label maps, equal bytes for equal seeds, both layouts.

Also its errors and resuming.
"""

import shutil
import sys
from itertools import product

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from trials import contents, succeed

import street_world
from street_world import dataset, drives, raster, street, textures
from street_world.things import Faces
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.cityscapes import ID
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import OPENCV, THESIS
from thesis_repro.odometry.loop import normalise

pytestmark = pytest.mark.slow

SMALL = street_world.SIZES["smoke"] | {"scale": 0.2, "jobs": 1}


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("world") / "out"
    dataset.write(folder, **SMALL)
    return folder


def test_layouts_are_read_by_the_readers_of_real_data(out):
    assert kitti.sequences(out / "kitti") == list(SMALL["sequences"])
    for name in SMALL["sequences"]:
        sequence = Sequence(out / "kitti", name)
        assert len(sequence) == SMALL["frames"]
        np.testing.assert_allclose(np.diff(sequence.times), 0.1, atol=1e-9)
        for index, frame in enumerate(sequence):
            labels = cityscapes.read_label_map(sequence.folder / "labels_0" / f"{index:06d}.png")
            assert labels.shape == frame.shape == sequence.size
    for split, count in (("train", SMALL["train_images"]), ("val", SMALL["validation_images"])):
        pairs = cityscapes.pairs(out / "cityscapes", split)
        assert len(pairs) == count
        _, labels = cityscapes.load(pairs, 64)
        assert {ID["road"], ID["sky"]} <= set(np.unique(labels))


@pytest.mark.parametrize("frames", [12, None, 400])
@pytest.mark.parametrize("name", dataset.SEQUENCES)
def test_drives_are_realistic(name, frames):
    frames = frames or drives.DRIVES[name].frames
    poses = drives.relative_to_first(drives.way(name, frames, seed=0)[1])
    assert np.array_equal(poses[0], np.eye(4))
    rotations = poses[:, :3, :3]
    inverses = rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(rotations @ inverses, np.tile(np.eye(3), (frames, 1, 1)), atol=1e-12)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < (2.6 if name == "01" else 1.7)  # 94 and 61 km/h
    turns = Rotation.from_matrix(inverses[:-1] @ rotations[1:]).magnitude()
    assert np.degrees(turns).max() < 4.5
    standing = int((steps == 0).sum())
    assert standing >= 4 if name == "07" else standing == 0
    # The camera moves forwards along z, on a level road.
    assert (np.diff(poses[:3, 2, 3]) > 0.1).all()
    assert np.abs(poses[:, 1, 3]).max() < 0.03 + 0.002 * steps.sum()


def sampson_distances(previous, current, motion, intrinsics):
    """The Sampson distances (n,) of matched pixels (n, 2) under a 4x4 motion, in focal lengths."""
    essential = np.cross(np.eye(3), motion[:3, 3]) @ motion[:3, :3]
    rays = (
        np.column_stack([normalise(points, intrinsics), np.ones(len(points))])
        for points in (current, previous)
    )
    return [cv2.sampsonDistance(*pair, essential) ** 0.5 for pair in zip(*rays, strict=True)]


def test_tracked_points_agree_with_the_poses():
    frames = 30
    _, poses, _ = drives.way("05", frames, seed=0)
    _, intrinsics = drives.scaled_camera("05", 0.5)
    wrong = np.eye(4)
    wrong[:3, :3] = cv2.Rodrigues(np.radians([0.3, 0, 0]))[0]
    true, turned = [], []
    for index in (3, 8, 20, 26):
        before, labels = dataset.render_frame("05", index, frames)
        after, _ = dataset.render_frame("05", index + 1, frames)
        still = np.isin(labels, (ID["building"], ID["wall"], ID["road"], ID["vegetation"]))
        points = OPENCV.detect(before, THESIS, still.astype(np.uint8))
        moved, tracked = OPENCV.track(before, after, points)
        motion = np.linalg.inv(poses[index]) @ poses[index + 1]
        for distances, relative in ((true, motion), (turned, motion @ wrong)):
            matches = points[tracked], moved[tracked]
            distances.extend(sampson_distances(*matches, relative, intrinsics))
    assert len(true) > 500
    assert np.median(true) * intrinsics[0, 0] < 0.16  # pixels
    assert np.median(turned) * intrinsics[0, 0] > 0.3  # a rotation of 0.3 degrees is noticed


def test_every_class_occurs_in_each_part_of_the_world():
    needed = (
        "road, sidewalk, building, wall, fence, pole, traffic sign, vegetation, terrain, sky, "
        "person, car"
    )
    for render, views in (
        (dataset.render_image, product(["train"], range(20))),
        (dataset.render_image, product(["val"], range(20))),
        (dataset.render_frame, product(dataset.SEQUENCES, (0, 25))),
    ):
        labels = [render(*view, scale=0.25)[1].ravel() for view in views]
        assert {ID[name] for name in needed.split(", ")} <= set(np.concatenate(labels))


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


def test_same_seed_gives_the_same_bytes_for_any_number_of_processes(out, tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "PICTURES_OF_A_WORKER", 20)
    dataset.write(tmp_path / "again", **SMALL | {"jobs": 2})
    assert contents(tmp_path / "again") == contents(out)
    first, other = (dataset.render_frame("00", 3, 12, 0.2, seed)[0] for seed in (0, 1))
    assert not np.array_equal(first, other)


def test_a_stopped_run_resumes_and_keeps_complete_files(out, tmp_path):
    folder = shutil.copytree(out, tmp_path / "stopped")
    for path in (
        folder / "kitti/sequences/01/image_0/000004.png",
        folder / "kitti/sequences/00/labels_0/000011.png",
        folder / "kitti/poses/00.txt",
        sorted((folder / "cityscapes").rglob("*.png"))[0],
    ):
        path.unlink()
    untouched = folder / "kitti/sequences/01/image_0/000005.png"
    age = untouched.stat().st_mtime_ns
    dataset.write(folder, **SMALL)
    with pytest.raises(InputError):  # results of other parameters are not replaced
        dataset.write(folder, **{**SMALL, "frames": 13})
    assert contents(folder) == contents(out)
    assert untouched.stat().st_mtime_ns == age


@pytest.mark.parametrize("parts", [("cityscapes", "kitti"), ("kitti", "cityscapes")])
def test_the_two_halves_make_the_whole_in_either_order(out, tmp_path, parts):
    for count, part in enumerate(parts, 1):
        dataset.write(tmp_path, **SMALL, only=part)
        folders = {path.name for path in tmp_path.iterdir() if path.is_dir()}
        assert folders == set(parts[:count])
    assert contents(tmp_path) == contents(out)


def test_it_runs_where_nobody_may_write_a_cache(tmp_path):
    """As for an unknown user of a container, whose home is /."""
    code = "import numba.core.caching as c; c.CacheImpl._locator_classes = []; import street_world.raster"
    succeed([sys.executable, "-c", code], tmp_path)
