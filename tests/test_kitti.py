import cv2
import numpy as np
import pytest

from thesis_repro import InputError
from thesis_repro.kitti import Sequence, read_poses, sequences, write_kitti_poses


def test_reads_a_sequence(tiny_kitti):
    assert sequences(tiny_kitti) == ["00"]
    sequence = Sequence(tiny_kitti, "00")
    assert len(sequence) == 4 and sequence.size == (48, 64) and len(list(sequence.frames())) == 4
    assert np.array_equal(sequence.intrinsics, [[50, 0, 32], [0, 50, 24], [0, 0, 1]])
    assert np.array_equal(sequence.poses[:, 2, 3], [0, 1, 2, 3]) and sequence.times[-1] == 0.3
    assert np.array_equal(sequence.frame(1)[:, :63], sequence.frame(0)[:, 1:])


def test_what_a_killed_run_left_is_no_frame(tiny_kitti):
    (tiny_kitti / "sequences/00/image_0/.000002.4711.png").write_bytes(b"half")
    assert len(Sequence(tiny_kitti, "00")) == 4


def test_subset_is_the_start_and_never_longer(tiny_kitti):
    sequence = Sequence(tiny_kitti, "00")
    short = sequence.subset(2)
    assert len(short) == len(short.poses) == len(short.times) == 2
    assert len(sequence.subset(99)) == len(sequence.subset(None)) == 4


def test_poses_are_written_to_the_last_bit(tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3] = np.random.default_rng(0).normal(size=(3, 3, 4)) / 3
    write_kitti_poses(tmp_path / "poses.txt", poses)
    assert np.array_equal(read_poses(tmp_path / "poses.txt"), poses)


@pytest.mark.real
def test_reads_real_sequences(kitti_real):
    for name, frames in (("00", 200), ("02", 300), ("05", 200), ("06", 51)):
        sequence = Sequence(kitti_real, name)
        assert len(sequence) == frames and sequence.frame(frames - 1).shape == sequence.size
    assert Sequence(kitti_real, "00").intrinsics[0, 0] == 718.856


def drop(name):
    return lambda root: (root / name).unlink()


def write(name, text):
    return lambda root: (root / name).write_text(text)


def other_size(root):
    cv2.imwrite(str(root / "sequences/00/image_0/000002.png"), np.zeros((20, 20), np.uint8))


def truncate(root):
    path = root / "sequences/00/image_0/000002.png"
    path.write_bytes(path.read_bytes()[:-30])


def empty(root):
    for path in (root / "sequences/00/image_0").iterdir():
        path.unlink()


@pytest.mark.parametrize("damage, says", [
    (empty, "image_0: holds no PNG frames; sequence 00 is empty"),
    (truncate, "000002.png: the image is truncated"),
    (other_size, "000002.png: 20x20 pixels, but the first frame of the sequence has 64x48"),
    (drop("sequences/00/calib.txt"), "calib.txt: no such file"),
    (write("sequences/00/calib.txt", "P1: 1 2 3\n"), "calib.txt: has no line 'P0:'"),
    (write("sequences/00/calib.txt", "P0: 1 2 x\n"), "calib.txt: P0 must be 12 finite numbers"),
    (write("sequences/00/times.txt", "0\n0.1\n"), "times.txt: 2 lines for 4 frames"),
    (write("sequences/00/times.txt", "0\nsoon\n"), "times.txt, line 2: expected 1 finite number, found 'soon'"),
    (drop("poses/00.txt"), "00.txt: no such file"),
    (write("poses/00.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 3), "00.txt: 3 lines for 4 frames"),
    (write("poses/00.txt", "1 0 0 0 0 1 0 0 0 0 1 nan\n" * 4), "00.txt, line 1: expected 12 finite numbers"),
    (write("poses/00.txt", "1 0 0\n" * 4), "00.txt, line 1: expected 12 finite numbers"),
    (write("poses/00.txt", ""), "00.txt: is empty"),
])
def test_faults_are_named(tiny_kitti, damage, says):
    damage(tiny_kitti)
    with pytest.raises(InputError, match=says) as error:
        list(Sequence(tiny_kitti, "00").frames())
    assert "\n" not in str(error.value)


def test_sequences_without_published_poses_are_left_out(tiny_kitti):
    for name in ("03", "11"):
        (tiny_kitti / "sequences" / name / "image_0").mkdir(parents=True)
    assert sequences(tiny_kitti) == ["00", "03"]


def test_missing_folders_are_named(tmp_path, tiny_kitti):
    with pytest.raises(InputError, match="holds no folder 'sequences'"):
        sequences(tmp_path)
    with pytest.raises(InputError, match="07/image_0: no such folder"):
        Sequence(tiny_kitti, "07")
