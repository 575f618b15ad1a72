import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import keras
import numpy as np
import pytest

from thesis_repro import InputError, cityscapes, files, stages
from thesis_repro.segmentation import backbones, memory, prediction, quality, training
from thesis_repro.segmentation.unet import build_unet
from thesis_repro.study.flicker import flicker

pytestmark = pytest.mark.slow

SIZE = 64
random = np.random.default_rng(0)
IMAGES = random.integers(0, 256, (7, SIZE, SIZE, 1), np.uint8)


def untrained(seed, size=SIZE, channels=1):
    """A U-Net with weights as varied as after a training, batch statistics included."""
    keras.utils.set_random_seed(seed)
    model = build_unet((size, size, channels), 35, 4)
    values = np.random.default_rng(seed)
    for layer in model.layers:
        if isinstance(layer, keras.layers.BatchNormalization):
            layer.set_weights([values.uniform(0.5, 1.5, w.shape) for w in layer.get_weights()])
    return model


def most_probable(model, images):
    return model.predict(images.astype(np.float32), verbose=0).argmax(-1)


@pytest.fixture(scope="module")
def model():
    return untrained(1)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Frames of KITTI's shape, smoothed noise of different brightness."""
    folder = tmp_path_factory.mktemp("frames")
    for index in range(11):
        noise = np.random.default_rng(index).integers(0, 256, (94, 310), np.uint8)
        files.write_png(folder / f"{index:06d}.png", cv2.GaussianBlur(noise, (0, 0), 2 + index / 3))
    return sorted(folder.glob("*.png"))


def contents(folder):
    return {path.name: path.read_bytes() for path in files.listed(folder)}


def test_predict_gives_the_most_probable_class(model):
    labels = prediction.predict(model, IMAGES, batch_size=3)

    assert labels.dtype == np.uint8 and labels.shape == (7, SIZE, SIZE)
    assert len(np.unique(labels)) > 3
    assert np.array_equal(labels, most_probable(model, IMAGES))


def test_images_of_another_size(model):
    with pytest.raises(InputError, match=r"images of \(32, 32, 1\): the model takes \(64, 64, 1\)"):
        prediction.predict(model, IMAGES[:, :32, :32])


def test_written_label_maps_are_the_predictions_at_320(model, frames, tmp_path):
    prediction.write_label_maps(model, frames, tmp_path, batch_size=4)
    images = np.stack([cv2.resize(files.read_gray(path), (SIZE, SIZE)) for path in frames])[..., None]
    expected = prediction.predict(model, images, batch_size=4)

    assert sorted(contents(tmp_path)) == [path.name for path in frames]
    for path, label_map in zip(frames, expected, strict=True):
        written = cityscapes.read_label_map(tmp_path / path.name)
        assert written.shape == (320, 320) and written.dtype == np.uint8
        assert np.array_equal(written, np.kron(label_map, np.ones((5, 5), np.uint8)))


def test_a_killed_prediction_goes_on_and_ends_with_the_same_bytes(model, frames, tmp_path):
    model.save(tmp_path / "model.keras")
    code = ("import time, sys; from thesis_repro import files; from thesis_repro.segmentation import prediction, "
            "training; "
            "write = files.write_png; files.write_png = lambda *a: (time.sleep(0.2), write(*a)); "
            "prediction.write_label_maps(training.load_model(sys.argv[1]), sys.argv[3:], sys.argv[2], batch_size=2)")
    output = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-c", code, tmp_path / "model.keras", output, *frames],
                               stderr=subprocess.DEVNULL, cwd=Path(__file__).parents[2])
    deadline = time.monotonic() + 120
    while len(contents(output)) < 3 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it ended before it could be killed"
    left = contents(output)
    assert 0 < len(left) < len(frames)
    kept = {name: (output / name).stat().st_mtime_ns for name in left}

    prediction.write_label_maps(model, frames, output, batch_size=2)
    prediction.write_label_maps(model, frames, tmp_path / "undisturbed", batch_size=2)

    assert contents(output) == contents(tmp_path / "undisturbed")
    assert any((output / name).stat().st_mtime_ns == when for name, when in kept.items())


def test_label_maps_spread_over_workers_are_those_of_one_and_are_not_made_again(model, frames, tmp_path, monkeypatch):
    model.save(tmp_path / "model.keras")
    prediction.load.cache_clear()
    monkeypatch.setattr(prediction, "PART", 4)
    loaded, read = [], training.load_model
    monkeypatch.setattr(training, "load_model", lambda path: loaded.append(path) or read(path))
    sequences = [(frames, tmp_path / "spread" / "00"), (frames[:5], tmp_path / "spread" / "01")]
    made = []

    def run(function, calls):  # the last first, as a cluster might
        for index in reversed(range(len(calls))):
            made.append(len(calls[index][-1]))
            yield index, function(*calls[index])

    prediction.spread_label_maps(run, [tmp_path / "model.keras"], sequences, batch_size=2)
    assert len(made) == 5 and max(made) == 2 and len(loaded) == 1
    for paths, folder in sequences:
        prediction.write_label_maps(model, paths, tmp_path / "alone" / folder.name, batch_size=2)
        assert contents(folder) == contents(tmp_path / "alone" / folder.name) and len(contents(folder)) == len(paths)
    assert stages.record(sequences[0][1]) == stages.record(tmp_path / "alone" / "00")

    removed = sequences[0][1] / frames[3].name
    removed.unlink()
    kept = {path: path.stat().st_mtime_ns for path in files.listed(sequences[0][1])}
    made.clear()
    prediction.spread_label_maps(run, [tmp_path / "model.keras"], sequences, batch_size=2)
    again = [path.name for path, when in kept.items() if path.stat().st_mtime_ns != when]
    assert made == [1] and removed.is_file() and again == [frames[2].name]  # the other one of its batch


def test_a_worker_with_other_files_or_another_model_is_told_apart(model, frames, tmp_path):
    def elsewhere(function, calls):
        for index, (model_files, _, folder, record, batches) in enumerate(calls):
            yield index, function(model_files, "another", folder, record, batches)

    def not_shared(function, calls):
        for index, (model_files, weights, _, record, batches) in enumerate(calls):
            yield index, function(model_files, weights, tmp_path / "elsewhere", record, batches)

    def lost(function, calls):
        yield from ((index, "the worker died") for index in range(len(calls)))

    model.save(tmp_path / "model.keras")
    for run, says in ((elsewhere, "another model"), (not_shared, "same folders under the same paths"),
                      (lost, "1 of 1 parts of the label maps failed; the first: the worker died")):
        with pytest.raises(InputError, match=says):
            prediction.spread_label_maps(run, [tmp_path / "model.keras"], [(frames[:3], tmp_path / "out")])
        assert contents(tmp_path / "out") == {}


def test_label_maps_of_another_model_are_replaced(model, frames, tmp_path):
    prediction.write_label_maps(untrained(2), frames[:3], tmp_path / "a")
    prediction.write_label_maps(model, frames[:3], tmp_path / "a")
    prediction.write_label_maps(model, frames[:3], tmp_path / "b")

    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_an_unreadable_image_leaves_whole_files_only(model, frames, tmp_path):
    broken = tmp_path / "000004.png"
    broken.write_bytes(frames[4].read_bytes()[:500])
    with pytest.raises(InputError, match="000004.png: the image is truncated"):
        prediction.write_label_maps(model, [*frames[:4], broken, *frames[5:]], tmp_path / "out", batch_size=2)

    for path in (tmp_path / "out").glob("*.png"):
        assert cityscapes.read_label_map(path).shape == (320, 320)
    assert not (tmp_path / "out" / "000004.png").exists()


def test_two_images_of_one_name(model, frames, tmp_path):
    with pytest.raises(InputError, match="share a name"):
        prediction.write_label_maps(model, [frames[0], frames[0]], tmp_path)


def test_no_memory_for_the_batch(model, monkeypatch):
    labels = IMAGES[..., 0] // 8
    monkeypatch.setattr(memory, "on_gpu", lambda: None)
    monkeypatch.setattr(memory, "available", lambda: memory.needed(model, 3, training=False) - 1)
    with pytest.raises(InputError, match="batch_size=3: no memory for a batch of 3 images of 64x64"):
        prediction.predict(model, IMAGES, batch_size=3)
    with pytest.raises(InputError, match="batch_size=7: no memory"):
        quality.quality(model, IMAGES, labels, batch_size=7)
    with pytest.raises(InputError, match="batch_size=3: no memory"):  # which takes far more
        memory.require(model, 3, training=True)
    assert prediction.predict(model, IMAGES, batch_size=2).shape == (7, SIZE, SIZE)


def test_a_gpus_memory_counts_where_there_is_one(model, monkeypatch, tmp_path):
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\nprintf '8192\\n2\\n'\n")  # MiB, of two
    tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr("tensorflow.config.list_physical_devices", lambda kind: [])
    assert memory.on_gpu() is None
    monkeypatch.setattr("tensorflow.config.list_physical_devices", lambda kind: ["one", "other"])
    assert memory.on_gpu() == 2 * 2**20
    with pytest.raises(InputError, match="batch_size=64: no memory .* are on the GPU; lower"):
        memory.require(model, 64, training=True)


def test_memory_available_follows_the_limit_of_the_process():
    resource = pytest.importorskip("resource")
    if memory.available() is None:
        pytest.skip("this system does not tell how much memory is left")
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, before[1]))
    try:
        assert 2**27 < memory.available() <= 2**28
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_memory_needed_by_the_thesiss_batch():
    model = build_unet((320, 320, 1), 35)
    row = 16 * 320 * 320 * 4  # bytes of one channel at full size in a batch of 16

    # the widest layer at full size reads and gives 128 channels; 600 are kept for the way back at full size alone
    assert memory.needed(model, 16, training=False) == 256 * row
    assert 600 * row < memory.needed(model, 16, training=True) < 20e9


def test_confusion_matrix_and_cityscapes_scores():
    true = np.array([[7, 7, 7, 11], [11, 0, 23, 255]], np.uint8)
    predicted = np.array([[7, 7, 11, 11], [11, 7, 5, 7]], np.uint8)
    confusion = quality.confusion_matrix(true, predicted)
    mean_iou, accuracy, table = quality.cityscapes_scores(confusion)

    assert confusion.sum() == 7 and confusion[7, 11] == 1 and confusion[0, 7] == 1 and confusion[23, 5] == 1
    assert table["iou"].to_dict() == pytest.approx({"road": 2 / 3, "building": 2 / 3, "sky": 0})  # 0 is not evaluated
    assert mean_iou == pytest.approx(4 / 9)
    assert accuracy == pytest.approx(4 / 6)
    assert table.loc["building", ["pixels", "precision", "recall"]].tolist() == pytest.approx([2, 2 / 3, 1])


def test_quality_agrees_with_keras_and_with_a_plain_count(model):
    labels = np.random.default_rng(1).choice(np.array([7, 11, 23, 26], np.uint8), IMAGES.shape[:3])
    measured = quality.quality(model, IMAGES, labels, batch_size=3)
    batches = training.Batches([(IMAGES, labels)], 3)
    model.compile("adam", training.total_loss(), metrics=training.metrics())
    expected = model.evaluate(batches.dataset(), verbose=0, return_dict=True)
    predicted = most_probable(model, IMAGES)

    assert measured.iou_score == pytest.approx(expected["iou_score"], abs=1e-5)
    assert measured.f1_score == pytest.approx(expected["f1-score"], abs=1e-5)
    assert measured.accuracy == pytest.approx((predicted == labels).mean())
    road = ((predicted == 7) & (labels == 7)).sum() / ((predicted == 7) | (labels == 7)).sum()
    assert measured.classes.loc["road", "iou"] == pytest.approx(road)
    # the library counts the 31 classes that are not there, and mostly not predicted, as perfect
    assert measured.iou_score > measured.mean_iou + 0.3


def test_quality_of_nothing(model):
    with pytest.raises(InputError, match="empty set"):
        quality.quality(model, IMAGES[:0], IMAGES[:0, ..., 0])


def test_colour_input(tmp_path):
    model = untrained(3, channels=3)
    picture = np.random.default_rng(2).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    files.write_png(tmp_path / "street.png", picture[..., ::-1])
    prediction.write_label_maps(model, [tmp_path / "street.png"], tmp_path / "out")

    expected = prediction.predict(model, picture[None])[0]
    assert np.array_equal(cityscapes.read_label_map(tmp_path / "out" / "street.png")[::5, ::5], expected)
    assert not np.array_equal(expected, prediction.predict(model, picture[None, ..., ::-1])[0])


@pytest.mark.parametrize("name", ["resnet18", "vgg16", "mobilenetv2"])
def test_backbones_predict_like_any_model(name, tmp_path):
    keras.utils.set_random_seed(0)
    model = backbones.backbone_unet(name)((SIZE, SIZE, 1), 35)
    model.save(tmp_path / "model.keras")
    labels = prediction.predict(training.load_model(tmp_path / "model.keras"), IMAGES[:2])

    assert (labels == most_probable(model, IMAGES[:2])).mean() > 0.999


def test_a_backbone_trains():
    labels = np.where(IMAGES[..., 0] > 127, 7, 11).astype(np.uint8)
    model = backbones.backbone_unet("resnet18")((SIZE, SIZE, 1), 35)
    model.compile("adam", training.total_loss())
    before = model.get_weights()
    model.fit(training.Batches([(IMAGES, labels)], 4, seed=0).dataset(), verbose=0)

    assert any((one != other).any() for one, other in zip(before, model.get_weights()))
    assert prediction.predict(model, IMAGES[:1]).shape == (1, SIZE, SIZE)


def test_unknown_backbone_and_size():
    with pytest.raises(InputError, match="'resnet19': unknown"):
        backbones.backbone_unet("resnet19")
    with pytest.raises(InputError, match="48x48.*multiples of 32"):
        backbones.backbone_unet("resnet18")((48, 48, 1), 35)


def test_an_ensemble_predicts_from_the_mean_probability(model):
    members = [model, model, untrained(2), untrained(5)]
    mean = np.mean([member.predict(IMAGES.astype(np.float32), verbose=0) for member in members], axis=0)

    labels = prediction.predict(backbones.ensemble(members), IMAGES)
    assert (labels == mean.argmax(-1)).mean() > 0.9999
    assert not np.array_equal(labels, prediction.predict(members[0], IMAGES))
    with pytest.raises(InputError, match="2 models with 2 different shapes"):
        backbones.ensemble([model, untrained(1, size=32)])


def test_flicker_of_a_moving_picture_with_and_without_noise():
    texture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (160, 300), np.uint8), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    classes = np.kron(np.random.default_rng(1).choice([7, 11, 23], (4, 8)), np.ones((40, 40))).astype(np.uint8)
    frames = [texture[:, shift:shift + 240] for shift in (0, 3, 6)]
    true = [classes[:, shift:shift + 240] for shift in (0, 3, 6)]
    wrong = [label_map.copy() for label_map in true]
    wrong[1][np.random.default_rng(2).random(wrong[1].shape) < 0.2] = 26  # a fifth of one frame flips

    steady, noisy = flicker(true, frames), flicker(wrong, frames)
    assert steady["frame"].tolist() == [1, 2]
    assert (steady["compared"] > 0.9).all() and (steady["changed"] < 0.01).all()
    assert noisy["changed"].tolist() == pytest.approx([0.2, 0.2], abs=0.02)
    # without taking the motion out, the boundaries alone would change more
    assert (true[1] != true[0]).mean() > 3 * steady["changed"].max()
    with pytest.raises(InputError, match="at least two"):
        flicker(true[:1], frames[:1])
