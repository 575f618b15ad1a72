"""Predicted label maps, model files, and the quality of label maps."""

import json

import cv2
import h5py
import keras
import numpy as np
import pytest

from thesis_repro.command import cli
from thesis_repro.data import cityscapes
from thesis_repro.errors import InputError
from thesis_repro.running import files, values
from thesis_repro.segmentation import prediction, quality, training
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow


SIZE = 64
IMAGES = np.random.default_rng(0).integers(0, 256, (7, SIZE, SIZE, 1), np.uint8)
COLOURS = np.random.default_rng(2).integers(0, 256, (2, SIZE, SIZE, 3), np.uint8)


def untrained(seed, channels=1):
    """Return a U-Net with random weights and batch statistics, as varied as after a training."""
    keras.utils.set_random_seed(seed)
    model = build_unet((SIZE, SIZE, channels), 35, 4)
    random = np.random.default_rng(seed)
    for layer in model.layers:
        if isinstance(layer, keras.layers.BatchNormalization):
            weights = [random.uniform(0.5, 1.5, each.shape) for each in layer.get_weights()]
            layer.set_weights(weights)
    return model


@pytest.fixture(scope="module")
def model():
    return untrained(1)


@pytest.fixture(scope="module")
def of_colours():
    return untrained(3, channels=3)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Return paths of frames of KITTI's shape: smoothed noise of different contrast."""
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
    assert np.array_equal(labels, model.predict(IMAGES.astype(np.float32), verbose=0).argmax(-1))
    for wrong in (IMAGES[:, :32, :32], IMAGES / np.float32(255)):
        with pytest.raises(InputError, match="give uint8 images"):
            prediction.predict(model, wrong)


@pytest.mark.parametrize(
    "option, values",
    [
        ({"scale": 1 / 255}, IMAGES * np.float32(1 / 255)),
        ({"preprocess": "tf"}, IMAGES / np.float32(127.5) - 1),
    ],
)
def test_gray_values_are_changed_and_label_maps_then_replaced(
    model, frames, tmp_path, option, values
):
    expected = model.predict(values, verbose=0).argmax(-1)
    assert np.array_equal(prediction.predict(model, IMAGES, **option), expected)
    prediction.write_label_maps(model, frames[:2], tmp_path)
    usual = contents(tmp_path)
    assert prediction.write_label_maps(model, frames[:2], tmp_path, **option) == 2
    assert contents(tmp_path) != usual


@pytest.mark.parametrize(
    "mode, values",
    [  # the means of ImageNet, and their order
        ("torch", (COLOURS / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]),
        ("caffe", COLOURS[..., ::-1] - [103.939, 116.779, 123.68]),
    ],
)
def test_colours_are_preprocessed_as_keras_applications_do_it(model, of_colours, mode, values):
    expected = of_colours.predict(values.astype(np.float32), verbose=0).argmax(-1)
    predicted = prediction.predict(of_colours, COLOURS, preprocess=mode)
    assert np.mean(predicted == expected) > 0.999
    with pytest.raises(InputError, match=mode):
        prediction.predict(model, IMAGES, preprocess=mode)


@pytest.mark.parametrize("scale", ["0", "-1", "1/0", "1e400", "nan", "0/255", "1/", "/255", "x"])
def test_factors_that_are_none_are_refused(scale, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["predict", "--images", "frames", "--output", "out", f"--scale={scale}"])
    assert ended.value.code == 2 and "--scale" in capsys.readouterr().err.splitlines()[-1]


def test_factors_are_numbers_and_quotients(frames, tmp_path, capfd):
    assert list(map(values.positive_factor, ("1/255", "2/255", "1/127.5", "0.5"))) == [
        1 / 255,
        2 / 255,
        1 / 127.5,
        0.5,
    ]
    both = ["--scale", "1/255", "--preprocess", "tf"]
    where = ["--images", str(frames[0].parent), "--output", str(tmp_path / "out")]
    assert cli.main(["predict", *where, *both]) == 1
    assert "--preprocess" in capfd.readouterr().err and not (tmp_path / "out").exists()


def test_written_label_maps_are_the_predictions_and_replace_those_of_another_model(
    model, frames, tmp_path
):
    prediction.write_label_maps(untrained(2), frames[:3], tmp_path)
    prediction.write_label_maps(model, frames, tmp_path, batch_size=4)
    images = np.stack([cv2.resize(files.read_gray(path), (SIZE, SIZE)) for path in frames])
    expected = prediction.predict(model, images[..., None], batch_size=4)

    assert sorted(contents(tmp_path)) == [path.name for path in frames]
    for path, label_map in zip(frames, expected, strict=True):
        written = cityscapes.read_label_map(tmp_path / path.name)
        assert np.array_equal(written, np.kron(label_map, np.ones((5, 5), np.uint8)))  # 320x320
    (tmp_path / frames[3].name).unlink()
    # the batch is predicted again, but only the missing file is written
    before = (tmp_path / frames[2].name).stat().st_mtime_ns
    assert prediction.write_label_maps(model, frames, tmp_path, batch_size=4) == 4
    assert (tmp_path / frames[2].name).stat().st_mtime_ns == before
    assert sorted(contents(tmp_path)) == [path.name for path in frames]


def test_images_that_cannot_be_predicted_are_refused(model, frames, tmp_path):
    broken = tmp_path / "000004.png"
    broken.write_bytes(frames[4].read_bytes()[:500])
    with pytest.raises(InputError, match="000004.png"):
        prediction.write_label_maps(model, [*frames[:4], broken], tmp_path / "out", batch_size=2)
    assert sorted(contents(tmp_path / "out")) == [path.name for path in frames[:4]]
    with pytest.raises(InputError):  # two images with one name
        prediction.write_label_maps(model, [frames[0], frames[0]], tmp_path / "twice")


def test_colour_input(of_colours, tmp_path):
    picture = COLOURS[0]
    files.write_png(tmp_path / "street.png", picture[..., ::-1])
    prediction.write_label_maps(of_colours, [tmp_path / "street.png"], tmp_path / "out")
    expected, swapped = prediction.predict(of_colours, np.stack([picture, picture[..., ::-1]]))
    written = cityscapes.read_label_map(tmp_path / "out/street.png")
    assert np.array_equal(written[::5, ::5], expected)
    assert not np.array_equal(expected, swapped)


@pytest.mark.parametrize("suffix", [".keras", ".hdf5"])
def test_model_files_that_cannot_be_used_are_named(suffix, model, tmp_path):
    whole, half, any_size = (tmp_path / f"{name}{suffix}" for name in ("whole", "half", "any"))
    model.save(whole)
    half.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    build_unet((None, None, 1), 35, 2).save(any_size)
    for path in (half, any_size, tmp_path / f"none{suffix}"):
        with pytest.raises(InputError, match=path.name):
            training.load_model(path)


@pytest.fixture(scope="module")
def whole():
    """A network of 32 bits, for weights of others."""
    return untrained(6)


@pytest.mark.parametrize(
    "policy",
    ["mixed_float16", "float16", pytest.param("mixed_bfloat16", marks=pytest.mark.torture)],
)
def test_a_network_of_16_bits_computes_in_32(policy, whole, tmp_path):
    keras.config.set_dtype_policy(policy)
    try:
        half = untrained(6)
    finally:
        keras.config.set_dtype_policy("float32")
    half.save(tmp_path / "half.keras")
    whole.set_weights(half.get_weights())
    loaded = training.load_model(tmp_path / "half.keras")
    values = IMAGES.astype(np.float32)
    assert np.array_equal(loaded.predict(values, verbose=0), whole.predict(values, verbose=0))


def test_a_file_of_keras_2_is_refused_and_its_weights_load(tmp_path):
    """A file as Keras 2 wrote it: one setting more, which Keras 3 lacks."""
    old, new = tmp_path / "old.hdf5", tmp_path / "new.keras"
    written = untrained(4)
    written.save(old)
    with h5py.File(old, "r+") as file:
        description = json.loads(file.attrs["model_config"])
        for layer in description["config"]["layers"]:
            if layer["class_name"] == "Conv2DTranspose":
                layer["config"]["groups"] = 1
        file.attrs["model_config"] = json.dumps(description)
    way_out = r"load_weights\('old.hdf5'\), save\('new.keras'\)"
    with pytest.raises(InputError, match=f"layer Conv2DTranspose.*build_unet.*{way_out}"):
        training.load_model(old)
    network = untrained(5)
    network.load_weights(old)
    network.save(new)
    loaded = training.load_model(new)
    assert loaded.to_json() == written.to_json()
    assert all(map(np.array_equal, loaded.get_weights(), written.get_weights()))
    with h5py.File(old, "r+") as file:
        del file.attrs["model_config"]
    with pytest.raises(InputError, match=f"old.hdf5: .*weights alone.*{way_out}"):
        training.load_model(old)


def test_what_is_no_file_of_keras_is_named(tmp_path):
    (tmp_path / "saved_model").mkdir()
    (tmp_path / "unfetched.keras").write_text("version https://git-lfs.github.com/spec/v1\n")
    (tmp_path / "network.onnx").write_bytes(b"onnx")
    for name, says in (
        ("saved_model", "is a folder"),
        ("unfetched.keras", "git lfs pull"),
        ("network.onnx", "--labels"),
        ("missing.keras", "no such model"),
    ):
        with pytest.raises(InputError, match=f"{name}: .*{says}"):
            training.load_model(tmp_path / name)


def test_code_in_a_file_is_refused(tmp_path):
    inputs = keras.Input((SIZE, SIZE, 1))
    code = keras.layers.Lambda(lambda x: x + 1)(inputs)
    for name in ("code.keras", "code.h5"):
        keras.Model(inputs, code).save(tmp_path / name)
        with pytest.raises(InputError, match="holds code"):
            training.load_model(tmp_path / name)


def test_confusion_matrix_and_cityscapes_scores():
    true = np.array([[7, 7, 7, 11], [11, 0, 23, 255]], np.uint8)
    predicted = np.array([[7, 7, 11, 11], [11, 7, 5, 7]], np.uint8)
    confusion = quality.confusion_matrix(true, predicted)
    mean_iou, accuracy, table = quality.cityscapes_scores(confusion)

    assert (
        confusion.sum() == 7
        and confusion[7, 11] == 1
        and confusion[0, 7] == 1
        and confusion[23, 5] == 1
    )
    # 0 is not evaluated
    assert table["iou"].to_dict() == pytest.approx({"road": 2 / 3, "building": 2 / 3, "sky": 0})
    assert mean_iou == pytest.approx(4 / 9) and accuracy == pytest.approx(4 / 6)
    assert table.loc["building", ["pixels", "precision", "recall"]].tolist() == pytest.approx(
        [2, 2 / 3, 1]
    )


def test_quality_agrees_with_keras_and_with_a_plain_count(model):
    labels = np.random.default_rng(1).choice(np.array([7, 11, 23, 26], np.uint8), IMAGES.shape[:3])
    measured = quality.quality(model, IMAGES, labels, batch_size=3)
    model.compile("adam", training.total_loss(), metrics=training.metrics())
    expected = model.evaluate(
        training.Batches([(IMAGES, labels)], 3).dataset(), verbose=0, return_dict=True
    )
    predicted = prediction.predict(model, IMAGES)

    assert measured.iou_score == pytest.approx(expected["iou_score"], abs=1e-5)
    assert measured.f1_score == pytest.approx(expected["f1-score"], abs=1e-5)
    assert measured.accuracy == pytest.approx((predicted == labels).mean())
    # the library counts the 31 absent classes, which are hardly predicted, as perfect
    assert measured.iou_score > measured.mean_iou + 0.3
    with pytest.raises(InputError):
        quality.quality(model, IMAGES / 255, labels)


@pytest.mark.real
def test_the_shipped_model_is_as_good_on_a_tenth_of_camvid_as_recorded(camvid_real):
    pairs = cityscapes.pairs(camvid_real, "val")[::10]
    measured = quality.quality(prediction.load_shipped(), *cityscapes.load(pairs, 320))
    assert (measured.accuracy, measured.mean_iou) == pytest.approx((0.8905, 0.5982), abs=5e-4)


def test_the_command_writes_label_maps_and_two_lines(small_model, frames, tmp_path, capfd):
    words = ["--images", frames[0].parent, "--frames", 1, "--model", small_model]
    assert cli.main(["predict", *map(str, words), "--output", str(tmp_path / "labels")]) == 0
    out, err = capfd.readouterr()
    assert len(out.splitlines()) == 2 and err == ""  # what was written, and the time
    assert len(files.listed(tmp_path / "labels")) == 1
