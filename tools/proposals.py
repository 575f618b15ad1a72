"""Train the networks of Section 5.2.1 for equal times: python tools/proposals.py --cityscapes ROOT
[ROOT ...].

They are the thesis's network in gray and in colour, a U-Net with a published backbone (random
weights, because the published ones need a download) and an ensemble. ROOT is a folder in one of
Cityscapes' layouts. Prints a Markdown table for each folder: means over the seeds, and the mean IoU
of each seed. Milliseconds are processor time on all cores.
"""

import argparse
import sys
import time
from pathlib import Path

from thesis_repro import segmentation  # noqa: F401  sets what TensorFlow reads at its import

# isort: split
import cv2
import keras
import numpy as np
import pandas as pd
import segmentation_models as sm

from thesis_repro import InputError, cityscapes, console
from thesis_repro.report.style import markdown
from thesis_repro.segmentation import augmentation, memory, prediction, quality, training
from thesis_repro.segmentation.unet import build_unet
from thesis_repro.settings import PROFILES

SIZES = PROFILES["demo"]
IMAGES, SEEDS = 64, (0, 1)  # most images for training; a quarter as many for validation
BACKBONE, MEMBERS = "resnet18", 2  # the members of the ensemble share the time
# A training of minutes has few steps, so the averages of batch normalisation must adapt fast.
LEARNING_RATE, MOMENTUM = 0.003, 0.9


def unet(input_shape):
    return build_unet(input_shape, cityscapes.N_CLASSES, SIZES.base_filters)


def backbone_unet(input_shape):
    """Return the U-Net of segmentation-models with BACKBONE, which expects grey levels from 0
    to 1.
    """
    network = sm.Unet(
        BACKBONE,
        input_shape=input_shape,
        classes=cityscapes.N_CLASSES,
        activation="softmax",
        encoder_weights=None,
    )
    inputs = keras.Input(input_shape)
    return keras.Model(inputs, network(keras.layers.Rescaling(1 / 255)(inputs)))


class TimeLimit(keras.callbacks.Callback):
    """Ends a training after some seconds of processor time; the first batch, which compiles,
    does not count.
    """

    def __init__(self, seconds):
        super().__init__()
        self.seconds, self.start, self.batches = seconds, None, 0

    def on_train_batch_end(self, batch, logs=None):
        self.batches += 1
        self.start = self.start or time.process_time()
        self.model.stop_training = time.process_time() - self.start >= self.seconds


def train(build, images, labels, seconds, seed):
    """Train a network with the thesis's loss and augmentation; return it and the number of
    batches.
    """
    keras.utils.set_random_seed(seed)
    model = build(images.shape[1:])
    augmented = augmentation.augment_set(
        images, labels, augmentation.training_augmenter(images.shape[1]), seed
    )
    batches = training.Batches([(images, labels), augmented], SIZES.batch_size, seed=seed)
    for layer in model._flatten_layers():
        if isinstance(layer, keras.layers.BatchNormalization):
            layer.momentum = MOMENTUM
    model.compile(keras.optimizers.Adam(LEARNING_RATE), training.total_loss())
    limit = TimeLimit(seconds)
    while not model.stop_training:
        model.fit(batches.dataset(), shuffle=False, verbose=0, callbacks=[limit])
        batches.epoch += 1
    return model, limit.batches


def milliseconds(model, repeats=25):
    """Return the median processor time of predicting one image, on all cores together."""
    image, times = np.zeros((1, *model.input_shape[1:]), np.uint8), []
    for _ in range(repeats + 1):  # the first repeat compiles
        started = time.process_time()
        prediction.predict(model, image)
        times.append(time.process_time() - started)
    return 1000 * float(np.median(times[1:]))


def compare(root, seconds, seeds=SEEDS, images=IMAGES):
    """Return a table with a row for each network, trained on a folder of colour or gray images
    with label maps.
    """
    sets = [
        cityscapes.load(cityscapes.pairs(root, split, limit=limit), SIZES.image_size, 3)
        for split, limit in (("train", images), ("val", images // 4))
    ]
    (train_images, train_labels), (shown, shown_labels) = sets

    def gray(colour):
        return np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None] for image in colour])

    networks = {
        "the thesis's network": (unet, gray, 1),
        f"backbone {BACKBONE}": (backbone_unet, gray, 1),
        f"ensemble of {MEMBERS}": (unet, gray, MEMBERS),
    }
    if (train_images[..., :1] != train_images).any():
        networks["in colour"] = unet, np.asarray, 1
    rows = []
    for name, (build, convert, count) in networks.items():
        scores = []
        for seed in seeds:
            members, batches = zip(
                *(
                    train(
                        build,
                        convert(train_images),
                        train_labels,
                        seconds / count,
                        seed + 100 * number,
                    )
                    for number in range(count)
                )
            )
            model = members[0] if count == 1 else prediction.ensemble(members)
            confusion = quality.confusion_matrix(
                shown_labels, prediction.predict(model, convert(shown))
            )
            mean_iou, accuracy, classes = quality.cityscapes_scores(confusion)
            scores.append(
                (mean_iou, accuracy, milliseconds(model), sum(batches) * SIZES.batch_size)
            )
        mean_iou, accuracy, cost, seen = np.mean(scores, axis=0)
        rows.append(
            {
                "network": name,
                "mean IoU": round(mean_iou, 3),
                "classes": len(classes),
                "images": len(shown),
                "by seed": ", ".join(f"{score[0]:.3f}" for score in scores),
                "pixel accuracy": round(accuracy, 3),
                "ms an image": round(cost),
                "parameters": model.count_params(),
                "images seen": round(seen),
            }
        )
        keras.backend.clear_session()
    return pd.DataFrame(rows)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--cityscapes",
        type=Path,
        nargs="+",
        metavar="ROOT",
        required=True,
        help="folders of images and label maps",
    )
    parser.add_argument(
        "--seconds", type=float, default=60, help="processor time for each network (60)"
    )
    options = parser.parse_args(arguments)
    memory.keep_freed()
    try:
        for root in options.cityscapes:
            print(
                f"{root.name}, {options.seconds:g} s a network\n\n{markdown(compare(root, options.seconds))}"
            )
    except InputError as error:
        return console.report_error(error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
