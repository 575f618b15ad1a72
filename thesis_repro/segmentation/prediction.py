"""Label maps for images and whole sequences (A.7)."""

import hashlib
import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import cv2
import numpy as np
import tensorflow as tf

from thesis_repro import InputError, files, stages
from thesis_repro.cityscapes import read_image
from thesis_repro.segmentation import memory, training

SIZE = 320  # pixels, both ways, of written label maps
SHIPPED = Path(__file__).parent / "weights" / "streets.keras"
CALL = 4  # images in one call of the network on a CPU; the activations of more fall out of its cache


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
    The folder is a stage (see stages): label maps of another model or of other images in it are deleted.

    Raises InputError for an unreadable image, two images of one name, a batch that does not fit into memory, and a
    folder with files that this project did not make.
    """
    memory.require(model, _call_size(min(batch_size, len(paths))))
    paths, output_dir = [Path(path) for path in paths], Path(output_dir)
    targets = [output_dir / f"{path.stem}.png" for path in paths]
    if len(set(targets)) < len(targets):
        raise InputError(f"{paths[0].parent}: two images share a name, so their label maps would; rename one")
    # The batch size counts, because the network's arithmetic may round differently for another one.
    stages.stage(output_dir, model=_weights(model), images=stages.listing(paths), batch_size=batch_size,
                 code=stages.code("segmentation/prediction"))
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


def _weights(model):
    digest = hashlib.sha256()
    for variable in model.variables:
        digest.update(variable.numpy().tobytes())
    return digest.hexdigest()[:12]


def _call_size(batch_size):
    return batch_size if tf.config.list_physical_devices("GPU") else min(batch_size, CALL)


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
        step = _call_size(len(images))
        return np.concatenate([call(images[start:start + step]).numpy() for start in range(0, len(images), step)])

    return run
