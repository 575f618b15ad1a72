"""Label maps for images and whole sequences (A.7)."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tensorflow as tf
from keras.applications.imagenet_utils import preprocess_input

from thesis_repro import segmentation
from thesis_repro.data.cameras import Camera
from thesis_repro.data.cityscapes import read_image
from thesis_repro.data.frames import white_level
from thesis_repro.errors import InputError
from thesis_repro.running import files, program, provenance
from thesis_repro.segmentation import training

SIZE = 320  # height and width of written label maps, pixels
SHIPPED = Path(__file__).parent / "weights" / "streets.keras"
# images in one call of the network on a CPU; the activations of more images do not fit in its cache
CALL = 4


def load_shipped() -> Any:
    """Return the model in the package, for users without a trained model.

    weights/README.md describes it.
    """
    return training.load_model(SHIPPED)


def predict(
    model: Any,
    images: np.ndarray,
    batch_size: int = 16,
    scale: float = 1.0,
    preprocess: str | None = None,
) -> np.ndarray:
    """Return the label maps of images.

    images: (n, height, width, channels) uint8, of the model's input size. Label maps: (n, height,
    width) uint8. The class of a pixel is the most probable one.
    scale: factor of the gray values 0 to 255 before the network, 1/255 for one that wants 0 to 1.
    preprocess: instead, the mode of Keras' `preprocess_input`: "tf" (-1 to 1), "torch", "caffe".
    Raises InputError for images of another shape or type.
    """
    training.check_images(images, model.input_shape)
    run = _compiled(model, scale, preprocess)
    labels = np.empty(images.shape[:3], np.uint8)
    for start in files.progress(range(0, len(images), batch_size), "predicting", unit="batch"):
        labels[start : start + batch_size] = run(images[start : start + batch_size])
    return labels


def write_label_maps(
    model: Any,
    paths: list[Path],
    output_dir: str | Path,
    batch_size: int = 16,
    scale: float = 1.0,
    lens: Camera | None = None,
    preprocess: str | None = None,
) -> int:
    """Write the label map of each image as output_dir/NAME.png (A.7.2).

    Label maps are 320x320 pixels of 8 bits; they hold the ids of the model's classes, which are
    Cityscapes ids for the thesis's network. Images of any size are stretched to the model's input,
    as in the appendix. scale, preprocess: as in `predict`. lens: of the camera; they are made of
    frames without its distortion, as the odometry sees them.
    A killed run resumes: complete batches are skipped, and of an incomplete batch all images are
    predicted again, because the bits depend on the batch, but only missing files are written. The
    folder is a stage (see provenance): label maps of another model or of other images in it are
    moved aside.

    Returns the number of images predicted.
    Raises InputError for an unreadable image, two images of one name, and a folder that holds files
    of the user or is in use by another run.
    """
    paths = [Path(path).absolute() for path in paths]
    names = [f"{path.stem}.png" for path in paths]
    if len(set(names)) < len(names):
        raise InputError(
            f"{paths[0].parent}: two images share a name, so their label maps would; rename one"
        )
    with provenance.claimed(output_dir):
        folder = Path(output_dir).absolute()
        inputs = {
            "model": training.weights_digest(model),
            "frames": provenance.digest_of_files(paths),
            **provenance.first_frame(paths),
            "batch_size": batch_size,  # the arithmetic may round differently for another one
            **provenance.versions("tensorflow", "keras", "opencv"),
            "code": provenance.digest_of_code(*segmentation.CODE),
            "arithmetic": segmentation.arithmetic(),
        }
        if scale != 1:
            inputs["scale"] = scale
        if lens is not None and (made_for := lens.record()):
            inputs["camera"] = made_for
        if preprocess:
            inputs["preprocess"] = preprocess
        provenance.stage(folder, **inputs)
        pairs = [(path, folder / name) for path, name in zip(paths, names)]
        batches = [pairs[start : start + batch_size] for start in range(0, len(pairs), batch_size)]
        batches = [batch for batch in batches if not all(path.is_file() for _, path in batch)]
        missing = sum(map(len, batches))
        run = _compiled(model, scale, preprocess)
        height, width, channels = model.input_shape[1:]
        white = white_level(paths[0]) if batches else 0
        bar = files.progress(None, "label maps", len(paths), initial=len(paths) - missing)
        with bar, ThreadPoolExecutor() as pool:
            for batch in batches:
                images = pool.map(
                    lambda pair: read_image(pair[0], height, width, channels, white, lens), batch
                )
                label_maps = run(np.stack(list(images)))
                list(pool.map(_write, batch, label_maps))
                bar.update(len(batch))
    return missing


def _write(pair: tuple[Path, Path], label_map: np.ndarray) -> None:
    target = pair[1]
    if not target.is_file():  # an existing file may have been corrected by hand
        files.write_png(
            target, cv2.resize(label_map, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
        )


@lru_cache(maxsize=4)
def _compiled(
    model: Any, scale: float, preprocess: str | None
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from uint8 images to uint8 label maps.

    It gives the bits of `model.predict` and argmax. Raises InputError if `preprocess` wants colours
    and the network has none.
    For small networks `model.predict` takes two to four times as long, because every call has a
    set-up and returns 35 probabilities a pixel.
    """
    program.keep_freed_memory()
    if preprocess in ("torch", "caffe") and model.input_shape[3] == 1:
        raise InputError(
            f"preprocess {preprocess}: is for colours, but the network reads gray images; tf is for both"
        )
    signature = tf.TensorSpec((None, *model.input_shape[1:]), tf.uint8)

    @tf.function(input_signature=[signature])
    def call(images: tf.Tensor) -> tf.Tensor:
        values = tf.cast(images, tf.float32) * scale
        if preprocess:
            values = preprocess_input(values, "channels_last", preprocess)
        probabilities = model(values, training=False)
        return tf.cast(tf.argmax(probabilities, axis=-1, output_type=tf.int32), tf.uint8)

    def run(images: np.ndarray) -> np.ndarray:
        step = CALL
        if tf.config.list_physical_devices("GPU"):
            step = len(images)
        return np.concatenate(
            [call(images[start : start + step]) for start in range(0, len(images), step)]
        )

    return run
