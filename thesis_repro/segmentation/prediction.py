"""Label maps for images and whole sequences (A.7)."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tensorflow as tf

from thesis_repro import segmentation
from thesis_repro.data.cityscapes import read_image
from thesis_repro.errors import InputError
from thesis_repro.running import files, messages, results
from thesis_repro.segmentation import memory, training

SIZE = 320  # height and width of written label maps, pixels
SHIPPED = Path(__file__).parent / "weights" / "streets.keras"
# images in one call of the network on a CPU; the activations of more images do not fit in its cache
CALL = 4
# images in one task of a worker, in whole batches: minutes for the thesis's network on two cores
PART = 256


def load_shipped() -> Any:
    """Return the model in the package, for users without a trained model.

    weights/README.md describes it.
    """
    return training.load_model(SHIPPED)


def predict(model: Any, images: np.ndarray, batch_size: int = 16) -> np.ndarray:
    """Return the label maps of images.

    images: (n, size, size, channels) uint8, of the model's input size. Label maps: (n, size, size)
    uint8. The class of a pixel is the most probable one.
    Raises InputError for images of another shape.
    """
    if images.shape[1:] != model.input_shape[1:]:
        raise InputError(
            f"images of {images.shape[1:]}: the model takes {model.input_shape[1:]}; resize them first"
        )
    run = _compiled(model)
    labels = np.empty(images.shape[:3], np.uint8)
    for start in files.progress(range(0, len(images), batch_size), "predicting", unit="batch"):
        labels[start : start + batch_size] = run(images[start : start + batch_size])
    return labels


def write_label_maps(
    model: Any, paths: list[Path], output_dir: str | Path, batch_size: int = 16
) -> int:
    """Write the label map of each image as output_dir/NAME.png (A.7.2).

    Label maps are 320x320 pixels of 8 bits, Cityscapes ids.
    Images of any size are stretched to the model's input, as in the appendix. A killed run resumes:
    complete batches are skipped, and of an incomplete batch all images are predicted again, because
    the bits depend on the batch, but only missing files are written. The folder is a stage (see
    results): label maps of another model or of other images in it are moved aside.

    Returns the number of images predicted.
    Raises InputError for an unreadable image, two images of one name, and a folder that holds files
    of the user or is in use by another run.
    """
    with results.claimed(output_dir):
        batches = _open(training.weights_digest(model), paths, output_dir, batch_size)
        missing = sum(map(len, batches))
        with files.progress(None, "label maps", len(paths), initial=len(paths) - missing) as bar:
            _write_batches(model, batches, bar.update)
    return missing


def _open(
    weights: str, paths: list[Path], output_dir: str | Path, batch_size: int
) -> list[list[tuple[Path, Path]]]:
    """Make the folder of label maps a stage; return its incomplete batches.

    A batch is a list of (image, label map) paths.
    """
    paths = [Path(path).absolute() for path in paths]
    output_dir = Path(output_dir).absolute()
    targets = [output_dir / f"{path.stem}.png" for path in paths]
    if len(set(targets)) < len(targets):
        raise InputError(
            f"{paths[0].parent}: two images share a name, so their label maps would; rename one"
        )
    # The network's arithmetic may round differently for another batch size.
    results.stage(
        output_dir,
        model=weights,
        frames=results.digest_of_files(paths),
        batch_size=batch_size,
        **_arithmetic(),
    )
    pairs = list(zip(paths, targets))
    batches = [pairs[start : start + batch_size] for start in range(0, len(pairs), batch_size)]
    return [batch for batch in batches if not all(files.is_whole(target) for _, target in batch)]


def _arithmetic() -> dict[str, Any]:
    """Return the versions of the libraries and the code that the bits of label maps depend on."""
    return results.made_with("tensorflow", "keras", "opencv") | {
        "code": results.digest_of_code("thesis_repro.segmentation.prediction"),
        "arithmetic": segmentation.arithmetic(),
    }


def _write_batches(
    model: Any, batches: list[list[tuple[Path, Path]]], done: Callable[[int], Any]
) -> None:
    """Predict and write batches of (image, label map) paths.

    done: called with the length of each written batch.
    """
    run, shape = _compiled(model), model.input_shape[1:]
    with ThreadPoolExecutor() as pool:
        for batch in batches:
            images = pool.map(lambda pair: read_image(pair[0], *shape), batch)
            label_maps = run(np.stack(list(images)))
            list(pool.map(_write, batch, label_maps))
            done(len(batch))


def _write(pair: tuple[Path, Path], label_map: np.ndarray) -> None:
    target = pair[1]
    if not files.is_whole(target):  # an existing file may have been corrected by hand
        files.write_png(
            target, cv2.resize(label_map, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
        )


def spread_label_maps(
    run: Callable,
    model_file: str | Path,
    sequences: list[tuple[list[Path], Path]],
    batch_size: int = 16,
) -> int:
    """Write the label maps of many sequences on many workers.

    Processors of one kind give `write_label_maps`' bits.
    run: function of (function, list of argument tuples), like `run` of the pools in
    `study.workers`. It calls the function on the workers and yields (index, returned value or
    reason why the worker was lost).
    model_file: of the model. sequences: list of (image paths, folder).
    Workers need this package and must see all files under the same paths. A stopped run resumes.

    Returns the number of images predicted.
    Raises InputError in the cases of `write_label_maps`, after all other label maps have been
    written.
    """
    model_file = Path(model_file).absolute()
    weights = training.weights_digest(training.load_model(model_file))
    calls: list[tuple] = []
    failures: list[str] = []
    missing = 0
    total = sum(len(paths) for paths, _ in sequences)
    step = max(1, PART // batch_size)
    with ExitStack() as held:
        for paths, folder in sequences:
            held.enter_context(results.claimed(folder))
            batches = _open(weights, paths, folder, batch_size)
            missing += sum(map(len, batches))
            record, absolute = results.record(folder), Path(folder).absolute()
            for start in range(0, len(batches), step):
                part = batches[start : start + step]
                calls.append((model_file, absolute, record, part))
        bar = held.enter_context(files.progress(None, "label maps", total, initial=total - missing))
        for index, failed in run(_write_part, calls):
            if failed:
                failures.append(failed)
            else:
                bar.update(sum(map(len, calls[index][-1])))
    if failures:
        raise InputError(
            f"{len(failures)} of {len(calls)} parts of the label maps failed; the first: {failures[0]}"
        )
    return missing


@lru_cache(maxsize=1)  # a worker predicts many parts with one model
def _load_once(model_file: Path, weights: str) -> Any:
    """Load a model. weights: their digest, because the file may be written again."""
    return training.load_model(model_file)


def _write_part(
    model_file: Path, folder: Path, record: dict[str, Any], batches: list[list[tuple[Path, Path]]]
) -> str | None:
    """Write some batches of a sequence, here or on another machine.

    Returns the reason of a failure, or None.
    """
    try:
        results.check_worker(folder, record)
        model = _load_once(model_file, record["model"])
        results.check_worker(folder, record, model=training.weights_digest(model), **_arithmetic())
        _write_batches(model, batches, lambda count: None)
    except Exception as error:  # the other parts continue, and the caller reports the reason
        return messages.explain(error) or f"{type(error).__name__}: {error}"
    return None


@lru_cache(maxsize=4)
def _compiled(model: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from uint8 images to uint8 label maps.

    It gives the bits of `model.predict` and argmax.
    For small networks `model.predict` takes two to four times as long, because every call has a
    set-up and returns 35 probabilities a pixel.
    """
    memory.keep_freed()
    signature = tf.TensorSpec((None, *model.input_shape[1:]), tf.uint8)

    @tf.function(input_signature=[signature])
    def call(images: tf.Tensor) -> tf.Tensor:
        probabilities = model(tf.cast(images, tf.float32), training=False)
        return tf.cast(tf.argmax(probabilities, axis=-1, output_type=tf.int32), tf.uint8)

    def run(images: np.ndarray) -> np.ndarray:
        step = CALL
        if tf.config.list_physical_devices("GPU"):
            step = len(images)
        parts = []
        for start in range(0, len(images), step):
            part = call(images[start : start + step])
            parts.append(part.numpy())
        return np.concatenate(parts)

    return run
