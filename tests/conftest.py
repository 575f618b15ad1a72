"""Fixtures that several test modules share."""

import fcntl
import gc
import os
from contextlib import contextmanager

# Tests run in as many processes as there are cores, so threads of a library would only compete. The
# variables are read when the libraries are loaded, here and in the commands that tests start.
os.environ |= dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)

# settings of another Keras, as a user may have them, do no harm
os.environ |= {"TF_USE_LEGACY_KERAS": "1", "KERAS_BACKEND": "jax", "SM_FRAMEWORK": "keras"}

from thesis_repro import segmentation  # noqa: F401  sets what TensorFlow reads at its import

# isort: split
import cv2
import numpy as np
import pytest
import trials
from joblib import cpu_count

from thesis_repro.odometry import runs

# The files that take longest, longest first. The evidence waits for the notebooks, which the first
# file executes.
LONGEST = (
    "test_executed.py",
    "test_odometry.py",
    "test_training.py",
    "test_study.py",
    "test_street_world.py",
    "test_opencv_exact.py",
    "test_prediction.py",
    "test_docs.py",
    "test_runner.py",
    "test_own_sources.py",
    # these need what the first one executes, and would wait for it
    "test_exercises.py",
    "test_tools.py",
)
# all their tests are slow, and they load TensorFlow, which takes four seconds
TENSORFLOW = {
    "test_camvid.py",
    "test_exact.py",
    "test_prediction.py",
    "test_tools.py",
    "test_training.py",
    "test_unet.py",
}
# fixtures that take seconds
SLOW_FIXTURES = {
    "small_world",
    "small_labels",
    "small_model",
    "kitti_real",
    "camvid_real",
    "reference",
    "executed",
}


def pytest_ignore_collect(collection_path, config):
    if config.option.markexpr == "not slow" and collection_path.name in TENSORFLOW:
        return True
    return None


def pytest_collection_modifyitems(items):
    for item in items:
        marked = item.get_closest_marker("notebooks") or item.get_closest_marker("torture")
        if marked or SLOW_FIXTURES & set(item.fixturenames):
            item.add_marker(pytest.mark.slow)
    # the longest files begin first, so that all processes have work until the end
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.name, len(places)))


def pytest_xdist_auto_num_workers():
    return cpu_count()  # as many as the package uses: those of a container


def pytest_collection_finish():
    # spares a tenth of the time: garbage is looked for more rarely, and not in modules
    gc.freeze()
    gc.set_threshold(20_000)


@pytest.fixture(autouse=True, scope="module")
def short_runs_take_faster_calls(request):
    """They have the bits of OpenCV's, as the tests of the odometry show, which take OpenCV's."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != "odometry":
            patch.setattr(runs, "FRAMES_TO_LOAD", 1)
        yield


def _real_data(*parts):
    folder = trials.ROOT.parent.joinpath("shared", *parts)
    if not folder.is_dir():
        pytest.skip(f"no real data: ../shared/{'/'.join(parts)} does not exist")
    return folder


@pytest.fixture(scope="session")
def kitti_real():
    """Excerpts of real KITTI sequences in the official layout."""
    return _real_data("data", "kitti")


@pytest.fixture(scope="session")
def camvid_real():
    """Real street images with label maps in the flat layout."""
    return _real_data("data", "camvid")


@pytest.fixture(scope="session")
def reference():
    """PySLAM's own results on the real frames."""
    return _real_data("reference")


@contextmanager
def _shared_folder(tmp_path_factory, name):
    """A folder shared by all processes of a test run (pytest -n).

    It is locked while one of them fills it.
    """
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    with open(root / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield root / name


@pytest.fixture(scope="session")
def small_world(tmp_path_factory):
    """A small embedded world: two sequences of 12 frames and a few street images.

    Tests must not change it.
    """
    import street_world

    with _shared_folder(tmp_path_factory, "small_world") as folder:  # rendered once
        street_world.write(folder, **street_world.SIZES["smoke"], seed=0, jobs=1)
    return folder


@pytest.fixture(scope="session")
def executed(small_world, tmp_path_factory):
    """A folder with build and figures of a run in which every notebook was executed.

    Tests must not change it.
    """
    import executing

    with _shared_folder(tmp_path_factory, "executed") as folder:
        if not folder.exists():
            executing.execute(folder, small_world)
            (folder / "done").touch()
        assert (folder / "done").exists(), "a notebook failed in another process"
    return folder


@pytest.fixture(scope="session")
def small_labels(small_world, tmp_path_factory):
    """Exact label maps of the small world, 320x320, one folder a sequence.

    They are laid out as notebook 5 does.
    """
    from thesis_repro.running import provenance

    with _shared_folder(tmp_path_factory, "small_labels") as root:
        if root.exists():
            return root
        for path in small_world.glob("kitti/sequences/*/labels_0/*.png"):
            folder = root / path.parent.parent.name
            provenance.stage(folder, model="none")
            label_map = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            resized = cv2.resize(label_map, (320, 320), interpolation=cv2.INTER_NEAREST)
            cv2.imwrite(str(folder / path.name), resized)
    return root


@pytest.fixture(scope="session")
def small_model(tmp_path_factory):
    """The thesis's network at 64x64 with 4 filters, untrained, as a file."""
    from thesis_repro.data.cityscapes import N_CLASSES
    from thesis_repro.segmentation.unet import build_unet

    path = tmp_path_factory.mktemp("model") / "model.keras"
    build_unet((64, 64, 1), N_CLASSES, 4).save(path)
    return path


@pytest.fixture
def tiny_kitti(tmp_path):
    """Sequence 00 with four 64x48 frames of noise, for tests of reading and of faults."""
    root = tmp_path / "kitti"
    images = root / "sequences" / "00" / "image_0"
    images.mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 256, (48, 80), np.uint8)
    for index in range(4):
        cv2.imwrite(str(images / f"{index:06d}.png"), noise[:, index : index + 64])
    (root / "sequences" / "00" / "calib.txt").write_text("P0: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    (root / "sequences" / "00" / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    (root / "poses").mkdir()
    (root / "poses" / "00.txt").write_text(
        "".join(f"1 0 0 0 0 1 0 0 0 0 1 {index}\n" for index in range(4))
    )
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
