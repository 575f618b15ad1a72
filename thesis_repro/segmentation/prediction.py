"""Label maps for images and whole sequences (A.7)."""

import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import lru_cache, partial
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("TF_FORCE_GPU_ALLOW_GROWTH", "true")  # take of a GPU's memory what is needed, not all of it

import cv2
import keras
import numpy as np
import tensorflow as tf

from thesis_repro import InputError, files, longrun, stages
from thesis_repro.cityscapes import read_image
from thesis_repro.segmentation import memory, training

SIZE = 320  # pixels, both ways, of written label maps
SHIPPED = Path(__file__).parent / "weights" / "streets.keras"
CALL = 4  # images in one call of the network on a CPU; the activations of more fall out of its cache


def load_shipped():
    """The model of the package, for users without a model of their own; see weights/README.md for what it is."""
    return training.load_model(SHIPPED)


def predict(model, images, batch_size=16):
    """Label maps (n, size, size) uint8 for images (n, size, size, channels) uint8, the size being the model's input.

    The class of a pixel is the one with the highest probability. Raises InputError for images of another shape.
    """
    if images.shape[1:] != model.input_shape[1:]:
        raise InputError(f"images of {images.shape[1:]}: the model takes {model.input_shape[1:]}; resize them first")
    run = _compiled(model)
    labels = np.empty(images.shape[:3], np.uint8)
    for start in files.progress(range(0, len(images), batch_size), "predicting", unit="batch"):
        labels[start:start + batch_size] = run(images[start:start + batch_size])
    return labels


def write_label_maps(model, paths, output_dir, batch_size=16):
    """Write the label map of each image as output_dir/NAME.png: 320x320, 8 bit, Cityscapes ids (A.7.2).

    Images may have any size; they are stretched to the model's input as the appendix does. Decoding and writing go
    on while the network works. Files appear whole or not at all, and a killed run goes on where it was: batches whose
    files are all there are skipped, any other is predicted in full, so that every run gives the same bytes
    (and what is missing of it is written).
    The folder is a stage (see stages): label maps of another model or of other images in it are deleted.

    Returns how many images were predicted.
    Raises InputError for an unreadable image, two images of one name, and a folder with files that this
    project did not make, or that another run is at work in.
    """
    with longrun.claimed(output_dir):
        batches = _open(training.weights_digest(model), paths, output_dir, batch_size)
        missing = sum(map(len, batches))
        with files.progress(None, "label maps", len(paths), initial=len(paths) - missing) as bar:
            _write_batches(model, batches, bar.update)
    return missing


def _open(weights, paths, output_dir, batch_size):
    """Make the folder of label maps a stage; returns what is missing in it, batches of (image, label map) paths."""
    paths, output_dir = [Path(path).absolute() for path in paths], Path(output_dir).absolute()
    targets = [output_dir / f"{path.stem}.png" for path in paths]
    if len(set(targets)) < len(targets):
        raise InputError(f"{paths[0].parent}: two images share a name, so their label maps would; rename one")
    # The batch size counts, because the network's arithmetic may round differently for another one.
    stages.stage(output_dir, model=weights, frames=stages.listing(paths), batch_size=batch_size, **_arithmetic())
    pairs = list(zip(paths, targets))
    batches = [pairs[start:start + batch_size] for start in range(0, len(pairs), batch_size)]
    return [batch for batch in batches if not all(files.is_whole(target) for _, target in batch)]


def _arithmetic():
    """What the bits of label maps depend on beside the model and the images."""
    return stages.made_with("tensorflow", "keras", "opencv-python-headless") | {
        "code": stages.code("segmentation/prediction")}


def _write_batches(model, batches, done):
    """Predict and write batches of (image, label map) paths; done: called with the length of each that is written."""
    run, paths = _compiled(model), [[path for path, _ in batch] for batch in batches]
    with ThreadPoolExecutor(2) as pool:
        predicted = map(run, _ahead(pool, partial(_decode, model.input_shape), paths))
        for count in _ahead(pool, _write, zip(batches, predicted)):
            done(count)


def _ahead(pool, function, items):
    """The function of each item in their order, from threads that are two items ahead of whoever asks."""
    waiting = deque()
    for item in items:
        waiting.append(pool.submit(function, item))
        if len(waiting) > 2:
            yield waiting.popleft().result()
    yield from (future.result() for future in waiting)


def _decode(input_shape, paths):
    return np.stack([read_image(path, *input_shape[1:]) for path in paths])


def _write(batch):
    pairs, labels = batch
    for (_, target), label_map in zip(pairs, labels, strict=True):
        if not files.is_whole(target):  # one that is there may have been corrected by hand
            files.write_png(target, cv2.resize(label_map, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST))
    return len(pairs)


PART = 256  # images that a worker is given at once, in whole batches: minutes of the thesis's network on two cores


def spread_label_maps(run, model_files, sequences, batch_size=16):
    """Write the label maps of many sequences on many workers: on processors of one kind `write_label_maps`' bits.

    run: function of (function, argument tuples) that calls it with each on some worker and yields (index, what it
    returned, or for a lost worker the reason), like the pools of `study.cluster`. model_files: of one model, or of
    several for the mean of their probabilities (`ensemble`). sequences: (image paths, folder) for each.
    Workers need this package and see all files under the same paths; each reads the model once. Finished batches are
    not predicted again after a stop.

    Returns how many images were predicted.
    Raises InputError for what `write_label_maps` does, after whatever could be written has been.
    """
    model_files = tuple(str(Path(path).absolute()) for path in model_files)
    weights, calls, missing, failures = training.weights_digest(load(model_files)), [], 0, []
    total, step = sum(len(paths) for paths, _ in sequences), max(1, PART // batch_size)
    with ExitStack() as held:
        for paths, folder in sequences:
            held.enter_context(longrun.claimed(folder))
            batches = _open(weights, paths, folder, batch_size)
            missing += sum(map(len, batches))
            calls += [(model_files, Path(folder).absolute(), stages.record(folder), batches[start:start + step])
                      for start in range(0, len(batches), step)]
        bar = held.enter_context(files.progress(None, "label maps", total, initial=total - missing))
        for index, failed in run(_write_part, calls):
            if failed:
                failures.append(failed)
            else:
                bar.update(sum(map(len, calls[index][-1])))
    if failures:
        raise InputError(f"{len(failures)} of {len(calls)} parts of the label maps failed; the first: {failures[0]}")
    return missing


@lru_cache(maxsize=1)
def load(model_files):
    """The model of one file, or the ensemble of several (a tuple of paths); cached for the next call in this process.

    Raises InputError for models of different input shapes.
    """
    models = [training.load_model(path) for path in model_files]
    for path, model in zip(model_files, models):
        if model.input_shape != models[0].input_shape:
            raise InputError(f"{path}: takes images of {model.input_shape[1:]}, {model_files[0]} of "
                             f"{models[0].input_shape[1:]}; the models of an ensemble need one size")
    return models[0] if len(models) == 1 else ensemble(models)


def ensemble(models):
    """One model whose probabilities are the mean of those of several models of one input and output shape."""
    inputs = keras.Input(models[0].input_shape[1:])
    outputs = []
    for number, model in enumerate(models):
        # a copy, for the same model twice or two of one name must not collide; without the loss, which has no copy
        member = keras.models.clone_model(keras.Model(model.input, model.output))
        member.set_weights(model.get_weights())
        member.name = f"member_{number}"
        outputs.append(member(inputs))
    return keras.Model(inputs, keras.layers.Average()(outputs), name="ensemble")


def _write_part(model_files, folder, record, batches):
    """Write some batches of a sequence, here or on another machine; returns why that failed, None where it did not."""
    try:
        stages.check_worker(folder, record)
        model = load(model_files)
        stages.check_worker(folder, record, model=training.weights_digest(model), **_arithmetic())
        _write_batches(model, batches, lambda count: None)
    except Exception as error:  # whatever it is, the other parts go on and the reason is reported
        return longrun.explain(error) or f"{type(error).__name__}: {error}"
    return None


@lru_cache(maxsize=4)
def _compiled(model):
    """A function from uint8 images to uint8 label maps, with the bits of `model.predict` and argmax.

    `model.predict` costs two to four times as much for small networks: it sets up anew for each call and hands over
    35 probabilities a pixel.
    """
    memory.keep_freed()
    signature = tf.TensorSpec((None, *model.input_shape[1:]), tf.uint8)

    @tf.function(input_signature=[signature])
    def call(images):
        probabilities = model(tf.cast(images, tf.float32), training=False)
        return tf.cast(tf.argmax(probabilities, axis=-1, output_type=tf.int32), tf.uint8)

    def run(images):
        step = len(images) if tf.config.list_physical_devices("GPU") else CALL
        return np.concatenate([call(images[start:start + step]).numpy() for start in range(0, len(images), step)])

    return run
