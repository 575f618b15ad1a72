"""Predicted label maps, model files, and the quality of label maps."""

import json
import zipfile
from pathlib import Path

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


def untrained(seed, size=SIZE, channels=1):
    """Return a U-Net with random weights and batch statistics, as varied as after a training."""
    keras.utils.set_random_seed(seed)
    model = build_unet((size, size, channels), 35, 4)
    values = np.random.default_rng(seed)
    for layer in model.layers:
        if isinstance(layer, keras.layers.BatchNormalization):
            layer.set_weights(
                [values.uniform(0.5, 1.5, weights.shape) for weights in layer.get_weights()]
            )
    return model


@pytest.fixture(scope="module")
def model():
    return untrained(1)


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

    assert (
        labels.dtype == np.uint8 and labels.shape == (7, SIZE, SIZE) and len(np.unique(labels)) > 3
    )
    assert np.array_equal(labels, model.predict(IMAGES.astype(np.float32), verbose=0).argmax(-1))
    for wrong in (IMAGES[:, :32, :32], IMAGES / np.float32(255)):
        with pytest.raises(InputError, match="give uint8 images"):
            prediction.predict(model, wrong)


def test_a_scale_multiplies_the_gray_values(model, frames, tmp_path):
    scaled = prediction.predict(model, IMAGES, scale=1 / 255)
    expected = model.predict(IMAGES * np.float32(1 / 255), verbose=0).argmax(-1)
    assert np.array_equal(scaled, expected)
    prediction.write_label_maps(model, frames[:2], tmp_path)
    unscaled = contents(tmp_path)
    assert prediction.write_label_maps(model, frames[:2], tmp_path, scale=1 / 255) == 2
    assert contents(tmp_path) != unscaled


def test_values_are_preprocessed_as_keras_applications_do_it(frames, tmp_path):
    gray, colours = untrained(1), untrained(3, channels=3)
    expected = gray.predict(IMAGES / np.float32(127.5) - 1, verbose=0).argmax(-1)
    assert np.array_equal(prediction.predict(gray, IMAGES, preprocess="tf"), expected)
    pictures = np.random.default_rng(2).integers(0, 256, (2, SIZE, SIZE, 3), np.uint8)
    of_imagenet = {  # the means of ImageNet, and their order
        "torch": (pictures / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225],
        "caffe": pictures[..., ::-1] - [103.939, 116.779, 123.68],
    }
    for mode, wanted in of_imagenet.items():
        expected = colours.predict(wanted.astype(np.float32), verbose=0).argmax(-1)
        predicted = prediction.predict(colours, pictures, preprocess=mode)
        assert np.mean(predicted == expected) > 0.999
        with pytest.raises(InputError, match=mode):
            prediction.predict(gray, IMAGES, preprocess=mode)
    prediction.write_label_maps(gray, frames[:2], tmp_path)
    usual = contents(tmp_path)
    assert prediction.write_label_maps(gray, frames[:2], tmp_path, preprocess="tf") == 2
    assert contents(tmp_path) != usual


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


def test_colour_input(tmp_path):
    model = untrained(3, channels=3)
    picture = np.random.default_rng(2).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    files.write_png(tmp_path / "street.png", picture[..., ::-1])
    prediction.write_label_maps(model, [tmp_path / "street.png"], tmp_path / "out")

    expected = prediction.predict(model, picture[None])[0]
    assert np.array_equal(
        cityscapes.read_label_map(tmp_path / "out" / "street.png")[::5, ::5], expected
    )
    assert not np.array_equal(expected, prediction.predict(model, picture[None, ..., ::-1])[0])


@pytest.mark.parametrize("suffix", [".keras", ".hdf5"])
def test_model_files_that_cannot_be_used_are_named(suffix, model, tmp_path):
    whole, half, any_size = (tmp_path / f"{name}{suffix}" for name in ("whole", "half", "any"))
    model.save(whole)
    half.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    build_unet((None, None, 1), 35, 2).save(any_size)
    for path in (half, any_size, tmp_path / f"none{suffix}"):
        with pytest.raises(InputError, match=path.name):
            training.load_model(path)


def test_a_network_of_keras_2_gives_what_it_gave_there():
    """`keras_2.h5` is a file of tf_keras 2.21, and these are its probabilities and classes there.

    It has DepthwiseConv2D, SeparableConv2D, SpatialDropout2D, RandomFlip and Conv2DTranspose, a
    Sequential that is called twice, and a network of two outputs within the network.
    """
    network = training.load_model(Path(__file__).parent / "keras_2.h5")
    images = np.random.default_rng(0).integers(0, 256, (1, 16, 32, 3), np.uint8)
    probabilities = np.asarray(network(images.astype(np.float32), training=False))
    expected = [0.249994, 0.000351, 0.724935, 0.0014, 0.020734, 0.002587]
    assert probabilities[0, 3, 5] == pytest.approx(expected, abs=1e-5)
    counts = np.bincount(prediction.predict(network, images).ravel(), minlength=6)
    assert counts == pytest.approx([113, 1, 236, 9, 33, 120], abs=2)


def as_keras_2(layer):
    """A layer's description in the words of Keras 2."""
    for key in ("module", "registered_name", "build_config"):
        layer.pop(key, None)
    config = layer["config"]
    config.pop("quantization_config", None)
    for key, value in config.items():
        if isinstance(value, dict) and "module" in value:
            config[key] = {name: value[name] for name in ("class_name", "config")}
    if isinstance(config["dtype"], dict):
        config["dtype"] = "float32"
    if "batch_shape" in config:
        config["batch_input_shape"] = config.pop("batch_shape")


@pytest.fixture
def of_keras_2(tmp_path):
    """A function that writes a Sequential as Keras 2 did, after a change of its description."""

    def write(*layers, change=lambda description: None):
        convolution = keras.layers.Conv2D(3, 1, activation="softmax")
        network = keras.Sequential([keras.Input((8, 16, 1)), *layers, convolution])
        path = tmp_path / "model.h5"
        network.save(path)
        with h5py.File(path, "r+") as file:
            description = json.loads(file.attrs["model_config"])
            description["config"] = {
                "name": "sequential",
                "layers": description["config"]["layers"],
            }
            for layer in description["config"]["layers"]:
                as_keras_2(layer)
            change(description)
            file.attrs["model_config"] = json.dumps(description)
        return path, network

    return write


def without_input(description):  # before Keras 2.3, the first layer stated the size
    first = description["config"]["layers"].pop(0)
    shape = first["config"]["batch_input_shape"]
    description["config"]["layers"][0]["config"]["batch_input_shape"] = shape


def plain_list(description):  # before Keras 2.2.3
    without_input(description)
    description["config"] = description["config"]["layers"]


def mixed(description):
    policy = {"class_name": "Policy", "config": {"name": "float32"}}
    description["config"]["layers"][1]["config"]["dtype"] = policy


@pytest.mark.parametrize("change", [without_input, plain_list, mixed])
def test_older_descriptions_load(change, of_keras_2):
    path, network = of_keras_2(keras.layers.Conv2D(4, 3, padding="same"), change=change)
    images = np.random.default_rng(0).integers(0, 256, (1, 8, 16, 1), np.uint8)
    assert np.array_equal(training.load_model(path)(images), network(images))
    as_keras = path.rename(path.with_suffix(".keras"))  # Keras 2 wrote HDF5 under this name, too
    assert np.array_equal(training.load_model(as_keras)(images), network(images))


def another_class(name, **config):
    def change(description):
        layer = description["config"]["layers"][1]
        layer["class_name"] = name
        layer["config"] |= config

    return change


@pytest.mark.parametrize(
    "change, named",
    [
        (another_class("TFOpLambda", function="image.resize"), r"TFOpLambda \(image.resize\)"),
        (another_class("Lambda"), "holds code"),
        (another_class("Activation", activation="hard_sigmoid"), "hard_sigmoid"),
        (another_class("LayerNormalization", axis=[1, 2, 3]), "LayerNormalization over several"),
        (another_class("Activation", nonsense=1), "Activation.*nonsense"),
    ],
)
def test_what_keras_3_lacks_or_computes_otherwise_is_named(change, named, of_keras_2):
    path, _ = of_keras_2(keras.layers.Activation("relu"), change=change)
    with pytest.raises(InputError, match=f"model.h5: .*{named}") as error:
        training.load_model(path)
    assert "truncated" not in str(error.value)


def test_files_of_keras_2_without_a_network_or_in_its_own_form_are_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "model.keras", "w") as file:
        file.writestr("metadata.json", '{"keras_version": "2.15.0"}')
    with h5py.File(tmp_path / "weights.h5", "w") as file:
        file.create_group("model_weights")
    for name, said in (("model.keras", "Keras 2.15.0.*HDF5"), ("weights.h5", "weights alone")):
        with pytest.raises(InputError, match=f"{name}: .*{said}"):
            training.load_model(tmp_path / name)


def test_a_saved_model_folder_and_code_in_a_file_are_named(tmp_path):
    (tmp_path / "saved_model").mkdir()
    with pytest.raises(InputError, match="saved_model: is a folder"):
        training.load_model(tmp_path / "saved_model")
    inputs = keras.Input((SIZE, SIZE, 1))
    code = keras.layers.Lambda(lambda x: x + 1)(inputs)
    keras.Model(inputs, code).save(tmp_path / "code.keras")
    with pytest.raises(InputError, match="holds code"):
        training.load_model(tmp_path / "code.keras")


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


def test_quality_agrees_with_keras_and_with_a_plain_count():
    model = untrained(1)
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
