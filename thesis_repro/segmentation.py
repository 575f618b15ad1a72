"""Label maps for images and whole sequences (A.7), and the quality of a model."""

import hashlib
import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import cv2  # noqa: E402
import keras  # noqa: E402 - TensorFlow reads its variables on import
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
import tensorflow as tf  # noqa: E402

from thesis_repro import InputError, files, memory, training  # noqa: E402
from thesis_repro.cityscapes import LABELS, N_CLASSES, read_image  # noqa: E402

SIZE = 320  # pixels, both ways, of written label maps
SHIPPED = Path(__file__).parent / "weights" / "camvid.keras"
CALL = 4  # images in one call of the network on a CPU; the activations of more fall out of its cache
MODEL_RECORD = ".model"  # beside written label maps: which model they are from

# The ids that the Cityscapes benchmark evaluates; pixels of all others are left out of its confusion matrix.
EVALUATED = (7, 8, 11, 12, 13, 17, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 31, 32, 33)


def load_shipped():
    """The model of the package, for users without a model of their own; see weights/README.md for what it is."""
    if not SHIPPED.is_file():
        raise InputError(f"{SHIPPED}: the shipped model is missing; reinstall the package or run `make weights`")
    return training.load_model(SHIPPED)


def predict(model, images, batch_size=16):
    """Label maps (n, size, size) uint8 for images (n, size, size, channels) uint8, the size being the model's input.

    The class of a pixel is the one with the highest probability. Raises InputError for images of another shape.
    """
    if images.shape[1:] != model.input_shape[1:]:
        raise InputError(f"images of {images.shape[1:]}: the model takes {model.input_shape[1:]}; resize them first")
    memory.require(model, _call_size(min(batch_size, len(images))))
    run = _compiled(model)
    labels = np.empty(images.shape[:3], np.uint8)
    for start in files.progress(range(0, len(images), batch_size), "predicting", unit="batch"):
        labels[start:start + batch_size] = run(images[start:start + batch_size])
    return labels


def write_label_maps(model, paths, output_dir, batch_size=16):
    """Write the label map of each image as output_dir/NAME.png: 320x320, 8 bit, Cityscapes ids (A.7.2).

    Images may have any size; they are stretched to the model's input as the appendix does. Decoding and writing go
    on while the network works. Files appear whole or not at all, and a killed run goes on where it was: batches whose
    files are all there are skipped, any other is predicted in full, so that every run gives the same bytes.
    Label maps of another model in the same folder are replaced.

    Raises InputError for an unreadable image, two images of one name, and a batch that does not fit into memory.
    """
    memory.require(model, _call_size(min(batch_size, len(paths))))
    paths, output_dir = [Path(path) for path in paths], Path(output_dir)
    targets = [output_dir / f"{path.stem}.png" for path in paths]
    if len(set(targets)) < len(targets):
        raise InputError(f"{paths[0].parent}: two images share a name, so their label maps would; rename one")
    output_dir.mkdir(parents=True, exist_ok=True)
    _claim(model, targets, output_dir, batch_size)
    chunks = [range(start, min(start + batch_size, len(paths))) for start in range(0, len(paths), batch_size)]
    chunks = [chunk for chunk in chunks if not all(targets[index].exists() for index in chunk)]
    finished = len(paths) - sum(map(len, chunks))
    run = _compiled(model)
    with ThreadPoolExecutor(2) as pool, files.progress(None, "label maps", len(paths), initial=finished) as bar:
        waiting = iter(chunks)
        decoded, written = deque(), deque()

        def decode_next():
            for chunk in waiting:
                decoded.append((chunk, pool.submit(_decode, [paths[index] for index in chunk], model.input_shape)))
                return

        decode_next()
        decode_next()
        while decoded:
            chunk, images = decoded.popleft()
            labels = run(images.result())
            decode_next()
            written.append((len(chunk), pool.submit(_write, labels, [targets[index] for index in chunk])))
            while written and (len(written) > 2 or not decoded):
                count, done = written.popleft()
                done.result()
                bar.update(count)


def read_input(path, input_shape):
    """One image file as a model's input: uint8, stretched to (height, width), gray or red, green, blue."""
    return read_image(path, *input_shape[-3:])


def _decode(paths, input_shape):
    return np.stack([read_input(path, input_shape) for path in paths])


def _write(labels, targets):
    for label_map, target in zip(labels, targets, strict=True):
        if label_map.shape != (SIZE, SIZE):
            label_map = cv2.resize(label_map, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
        files.write_png(target, label_map)


def _claim(model, targets, output_dir, batch_size):
    """Make sure that the label maps in a folder are this model's: delete those of another before the first is written.

    The batch size counts, because the network's arithmetic may round differently for another one.
    """
    digest = hashlib.sha256()
    for variable in model.variables:
        digest.update(variable.numpy().tobytes())
    record = f"{digest.hexdigest()} batch {batch_size}\n"
    where = output_dir / MODEL_RECORD
    if not where.is_file() or where.read_text(encoding="utf-8") != record:
        for target in targets:
            target.unlink(missing_ok=True)
        files.write_text(where, record)


def _call_size(batch_size):
    return batch_size if tf.config.list_physical_devices("GPU") else min(batch_size, CALL)


@lru_cache(maxsize=4)
def _compiled(model):
    """A function from uint8 images to uint8 label maps. `model.predict` costs two to five times as much: it sets up
    anew for each call, hands over 35 probabilities a pixel, and normalises where a convolution could."""
    memory.keep_freed()
    network = folded(model)
    signature = tf.TensorSpec((None, *model.input_shape[1:]), tf.uint8)

    @tf.function(input_signature=[signature])
    def call(images):
        scores = network(tf.cast(images, tf.float32), training=False)
        return tf.cast(tf.argmax(scores, axis=-1, output_type=tf.int32), tf.uint8)

    def run(images):
        step = _call_size(len(images))
        return np.concatenate([call(images[start:start + step]).numpy() for start in range(0, len(images), step)])

    return run


def folded(model, final=True):
    """The same network for prediction only: batch normalisation folded into the convolutions, no final softmax.

    Its scores order the classes of a pixel as the model's probabilities do. With `final` false, for a network inside
    another, the softmax stays.
    """
    model = keras.Model(model.input, model.output)  # without loss and metrics, which Keras would try to clone
    norms = {}  # a convolution's name: the batch normalisation that alone reads it
    for layer in model.layers:
        if type(layer) is keras.layers.BatchNormalization:
            source = layer._inbound_nodes[0].input_tensors[0]._keras_history.operation
            if (type(source) is keras.layers.Conv2D and len(source._outbound_nodes) == 1
                    and source.activation is keras.activations.linear):
                norms[source.name] = layer
    folded_away = {norm.name for norm in norms.values()}
    twins = {}

    def clone(layer):
        if isinstance(layer, keras.Model):
            return folded(layer, final=False)
        config = layer.get_config()
        if layer.name in norms:
            config["use_bias"] = True
        if final and layer is model.layers[-1] and config.get("activation") == "softmax":
            config["activation"] = "linear"
        twins[layer.name] = type(layer).from_config(config)
        return twins[layer.name]

    def call(layer, *args, **kwargs):
        return args[0] if layer.name in folded_away else layer(*args, **kwargs)

    network = keras.models.clone_model(model, clone_function=clone, call_function=call)
    for name, twin in twins.items():
        weights = model.get_layer(name).get_weights()
        if weights and name not in folded_away:
            twin.set_weights(_fold(weights, norms[name]) if name in norms else weights)
    return network


def _fold(weights, norm):
    kernel, bias = weights[0], weights[1] if len(weights) > 1 else 0.0
    factor = 1 / np.sqrt(norm.moving_variance.numpy() + norm.epsilon)
    if norm.scale:
        factor = factor * norm.gamma.numpy()
    shift = norm.beta.numpy() if norm.center else 0.0
    return [kernel * factor, (bias - norm.moving_mean.numpy()) * factor + shift]


@dataclass(frozen=True)
class Quality:
    """How good a model is on a set, by the library's measure and by that of the Cityscapes benchmark."""

    iou_score: float  # segmentation-models: mean over 35 classes, absent ones scoring 1, then over batches as in Keras
    f1_score: float
    mean_iou: float  # Cityscapes: one confusion matrix over the set, mean over the classes present
    accuracy: float  # share of evaluated pixels that are right
    classes: pd.DataFrame  # a row for each class present: id, pixels, iou, precision, recall
    confusion: np.ndarray  # (35, 35) pixels: true class, predicted class


def quality(model, images, labels, batch_size=16):
    """Measure a model on images (n, size, size, channels) and true label maps (n, size, size), both uint8.

    The library's scores depend on the batch size, the others do not (Sections 3.3 and 4.1).
    Raises InputError for an empty set or one of another shape than the model's.
    """
    if len(images) == 0:
        raise InputError("quality: an empty set; it needs at least one image with its label map")
    if images.shape[1:] != model.input_shape[1:] or images.shape[:3] != labels.shape:
        raise InputError(f"quality: images {images.shape} and label maps {labels.shape}; the model takes "
                         f"{model.input_shape[1:]} and one label map for each image")
    memory.require(model, min(batch_size, len(images)))
    scores = training.metrics()

    @tf.function(reduce_retracing=True)
    def run(some_images, some_labels):
        probabilities = model(tf.cast(some_images, tf.float32), training=False)
        true = tf.one_hot(some_labels, N_CLASSES)
        predicted = tf.argmax(probabilities, axis=-1, output_type=tf.int32)
        return [score(true, probabilities) for score in scores], predicted

    batch_scores, confusion = [], np.zeros((N_CLASSES, N_CLASSES), np.int64)
    for start in files.progress(range(0, len(images), batch_size), "measuring", unit="batch"):
        true = labels[start:start + batch_size]
        values, predicted = run(images[start:start + batch_size], true)
        batch_scores.append([float(value) for value in values])
        confusion += confusion_matrix(true, predicted.numpy())
    mean_iou, accuracy, classes = cityscapes_scores(confusion)
    return Quality(*np.mean(batch_scores, axis=0), mean_iou, accuracy, classes, confusion)


def confusion_matrix(true, predicted):
    """Pixels by true class (rows) and predicted class (columns); pixels without a true class are not counted."""
    known = true < N_CLASSES
    pairs = true[known].astype(np.int64) * N_CLASSES + predicted[known]
    return np.bincount(pairs, minlength=N_CLASSES**2).reshape(N_CLASSES, N_CLASSES)


def cityscapes_scores(confusion):
    """Mean IoU, pixel accuracy and per-class table as the Cityscapes benchmark defines them.

    Pixels whose true class it does not evaluate are left out. The mean is over the evaluated classes that are present
    in the true label maps; a prediction of any other class counts against the class it should have been.
    """
    evaluated = np.zeros_like(confusion)
    evaluated[EVALUATED, :] = confusion[EVALUATED, :]
    right, true, predicted = np.diag(evaluated), evaluated.sum(1), evaluated.sum(0)
    present = np.flatnonzero(true)
    if not len(present):
        raise InputError("quality: no pixel of a class that Cityscapes evaluates; are the label maps Cityscapes ids?")
    table = pd.DataFrame({
        "id": present, "pixels": true[present], "iou": right[present] / (true + predicted - right)[present],
        "precision": right[present] / np.maximum(predicted[present], 1), "recall": right[present] / true[present],
    }, index=pd.Index([LABELS[number].name for number in present], name="class"))
    return float(table["iou"].mean()), float(right.sum() / true.sum()), table
