"""Fixtures that several test modules share."""

import fcntl
import os
import signal
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("SM_FRAMEWORK", "tf.keras")
os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
SHARED = ROOT.parent / "shared"
# what these make or read takes seconds
SLOW_FIXTURES = {"small_world", "small_labels", "kitti_real", "camvid_real", "reference"}


def pytest_collection_modifyitems(items):
    for item in items:
        marked = item.get_closest_marker("notebooks") or item.get_closest_marker("torture")
        if marked or SLOW_FIXTURES & set(item.fixturenames):
            item.add_marker(pytest.mark.slow)
    # what takes minutes begins first, so that no process is left alone with it at the end
    items.sort(key=lambda item: item.path.name != "test_notebooks.py")


def _shared(*parts):
    folder = SHARED.joinpath(*parts)
    if not folder.is_dir():
        pytest.skip(f"no real data: ../shared/{'/'.join(parts)} does not exist")
    return folder


@pytest.fixture(scope="session")
def kitti_real():
    """Excerpts of real KITTI sequences in the official layout."""
    return _shared("data", "kitti")


@pytest.fixture(scope="session")
def camvid_real():
    """Real street images with label maps in the flat layout."""
    return _shared("data", "camvid")


@pytest.fixture(scope="session")
def reference():
    """What PySLAM itself did on the real frames."""
    return _shared("reference")


@pytest.fixture
def kill_when():
    """kill_when(command, condition): start a command, and kill it with all that it started once the condition holds."""
    def start(command, condition):
        process = subprocess.Popen(list(map(str, command)), cwd=ROOT, stderr=subprocess.DEVNULL, start_new_session=True)
        end = time.monotonic() + 600
        while not condition():
            assert process.poll() is None and time.monotonic() < end, "it ended before it could be killed"
            time.sleep(0.002)
        os.killpg(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL

    return start


@contextmanager
def _held(tmp_path_factory, name):
    """A folder that all processes of a test run share (pytest -n), held by one of them while it is filled."""
    root = tmp_path_factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    with open(root / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield root / name


@pytest.fixture(scope="session")
def small_world(tmp_path_factory):
    """A small embedded world: two sequences of 12 frames and a few street images. It must not be changed."""
    from thesis_repro.settings import PROFILES
    from thesis_repro.world import dataset

    with _held(tmp_path_factory, "small_world") as folder:  # what another process has rendered is left as it is
        dataset.write(folder, **PROFILES["smoke"].world, seed=0)
    return folder


@pytest.fixture(scope="session")
def small_labels(small_world, tmp_path_factory):
    """Label maps of the small world as notebook 5 leaves them, one folder a sequence: here the true ones, 320x320."""
    from thesis_repro import stages

    with _held(tmp_path_factory, "small_labels") as root:
        for path in small_world.glob("kitti/sequences/*/labels_0/*.png") if not root.exists() else ():
            folder = root / path.parent.parent.name
            stages.stage(folder, model="none")
            label_map = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(folder / path.name), cv2.resize(label_map, (320, 320), interpolation=cv2.INTER_NEAREST))
    return root


@pytest.fixture
def tiny_kitti(tmp_path):
    """Sequence 00 with four 64x48 frames of noise, written by hand, for tests of reading and of faults."""
    root = tmp_path / "kitti"
    images = root / "sequences" / "00" / "image_0"
    images.mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (48, 80), np.uint8)
    for index in range(4):
        cv2.imwrite(str(images / f"{index:06d}.png"), noise[:, index:index + 64])
    (root / "sequences" / "00" / "calib.txt").write_text("P0: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    (root / "sequences" / "00" / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    (root / "poses").mkdir()
    (root / "poses" / "00.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {index}\n" for index in range(4)))
    return root


@pytest.fixture
def tiny_cityscapes(tmp_path):
    """Four training and two validation pairs in the flat layout, 32x16, with ids 7, 11 and 23."""
    root = tmp_path / "cityscapes"
    for split, count in (("train", 4), ("val", 2)):
        (root / split).mkdir(parents=True)
        (root / f"{split}annot").mkdir()
        for index in range(count):
            label = np.repeat(np.array([23, 11, 7, 7], np.uint8), 4)[:, None].repeat(32, axis=1)
            cv2.imwrite(str(root / f"{split}annot" / f"street_{index}.png"), label)
            cv2.imwrite(str(root / split / f"street_{index}.png"), label * 10 + index)
    return root
