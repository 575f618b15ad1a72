"""Section 5.2.1's proposals for the network, tried: colour, a backbone and an ensemble, each trained for the same time.

`python -m thesis_repro.bench.proposals --cityscapes ROOT` prints a Markdown page (`--output FILE` writes it). Without
ROOT the images are drives of the embedded world, rendered in made-up colours; the world itself is gray.
"""

import argparse
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import cv2
import keras
import numpy as np
import pandas as pd

from thesis_repro import InputError, cityscapes, files
from thesis_repro.report.style import markdown
from thesis_repro.segmentation import augmentation, backbones, memory, prediction, quality, training
from thesis_repro.segmentation.unet import build_unet
from thesis_repro.settings import PROFILES
from thesis_repro.world import dataset as world
from thesis_repro.world import render, textures
from thesis_repro.world.raster import GAIN, TEXTURE

SIZES = PROFILES["demo"]
IMAGES = 64  # for training, and a quarter of them for validation, at most
BACKBONE = "resnet18"
MEMBERS = 2  # of the ensemble; each has its part of the time
SEEDS = (0, 1)
SECONDS = 60  # of processor time for the training of each network, all cores together
# For trainings of minutes: the steps are few, and batch normalisation's averages must keep up with them.
LEARNING_RATE, MOMENTUM = 0.003, 0.9


@dataclass(frozen=True)
class Data:
    """Images (n, size, size, 3) red, green, blue and label maps (n, size, size), uint8, and what they are, in words."""

    images: np.ndarray
    labels: np.ndarray
    validation_images: np.ndarray
    validation_labels: np.ndarray
    name: str

    @property
    def has_colour(self):
        return bool((self.images[..., :1] != self.images).any())


# What colour a material has in red, green, blue, by how its texture's name begins: made up, and the only colour that
# there is here. Those with several have one for each number at the end of the name.
LEAVES, NEUTRAL = ((0.8, 1.1, 0.5),), ((1.0, 1.0, 1.0),)
COATS = ((1.6, 0.75, 0.7), (0.6, 0.9, 1.7), (1.0, 1.0, 1.0), (0.97, 1.0, 1.05), (0.9, 1.0, 1.1), (0.8, 1.1, 0.8))
WALLS = ((1.35, 0.9, 0.7), (1.1, 1.0, 0.75), (1.0, 1.0, 0.95), (1.05, 0.98, 0.95), (1.2, 0.95, 0.8), (0.95, 1.0, 1.05),
         (1.15, 1.0, 0.7), (1.0, 1.0, 1.0))
SIGNS = ((0.5, 0.9, 2.0), (1.9, 0.65, 0.6), (1.3, 1.05, 0.3))
COLOURS = {
    **dict.fromkeys(("leaves", "hedge", "tree", "bush", "grass"), LEAVES), "wood": ((1.2, 0.95, 0.7),),
    "picket": ((1.2, 0.95, 0.7),), "roof": ((1.45, 0.85, 0.65),), "gravel": ((1.1, 1.0, 0.85),),
    "stone": ((1.05, 1.0, 0.9),), "facade": WALLS, "shop": WALLS, "sign": SIGNS, "person": COATS, "rider": COATS,
    **dict.fromkeys(("paint", "front", "rear", "sedan", "hatch", "estate", "van", "truck", "bus"), COATS)}
SKY = (0.8, 0.98, 1.35)
LUMINANCE = np.array([0.299, 0.587, 0.114])


def _tints(names):
    """What each texture's brightness is multiplied by in red, green and blue, (n, 3); its luminance stays."""
    tints = np.ones((len(names), 3))
    for name, index in names.items():
        kind = name.rstrip("0123456789")
        colours = COLOURS.get(kind, NEUTRAL)
        tints[index] = colours[int(name[len(kind):] or 0) % len(colours)]
    return tints / (tints @ LUMINANCE)[:, None]


def render_colour(name, index, frames=60, scale=0.45, seed=0):
    """A frame of the embedded world in colour: image (height, width, 3) red, green, blue and label map, uint8."""
    scene = world.drive(name, frames, scale, seed)
    street, light, tints = scene.street, scene.street.environment, _tints(textures.build(seed).names)
    faces = np.concatenate([street.faces, *(mover.at(index, scene.driven[index]) for mover in street.movers)])
    sky = np.array(SKY) / (SKY @ LUMINANCE)
    channels = []
    for channel in range(3):
        tinted = faces.copy()
        tinted[:, GAIN] *= tints[faces[:, TEXTURE].astype(int), channel]
        image, labels = render.render(
            tinted, street.textures, scene.poses[index], scene.intrinsics, scene.size,
            light._replace(zenith=light.zenith * sky[channel], horizon=light.horizon * (1 + sky[channel]) / 2))
        channels.append(image)
    picture = np.dstack(channels)
    picture *= (105 / picture.mean()) ** 0.8  # exposure
    picture += np.random.default_rng((seed, int(name), index)).normal(0, 2, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8), labels


def embedded_drives(size, count=IMAGES):
    """Frames of the embedded world's drives in colour: 00 to 07 for training, 08 to 10 for validation."""
    sets = []
    for names, number in ((world.SEQUENCES[:8], count), (world.SEQUENCES[8:], count // 4)):
        each = -(-number // len(names))
        pictures = [render_colour(name, index * 60 // each) for name in files.progress(names, "rendering", unit="drive")
                    for index in range(each)]
        sets += [np.stack([cv2.resize(image, (size, size)) for image, _ in pictures]),
                 np.stack([cv2.resize(labels, (size, size), interpolation=cv2.INTER_NEAREST)
                           for _, labels in pictures])]
    return Data(*sets, f"embedded world (rendered): {len(sets[0])} frames of the drives 00 to 07 for training, "
                       f"{len(sets[2])} of 08 to 10 for validation, in made-up colours")


def read_data(root, size, count=IMAGES):
    """Images of a folder in one of Cityscapes' layouts, spread evenly over its splits."""
    sets = [array for split, number in (("train", count), ("val", count // 4))
            for array in cityscapes.load(cityscapes.pairs(root, split, limit=number), size, 3)]
    return Data(*sets, f"folder “{Path(root).name}”: {len(sets[0])} images of its training split, {len(sets[2])} of "
                       "its validation split")


def train(build, images, labels, seconds, seed):
    """A network trained with the thesis's loss and augmentation for so many processor seconds: (model, images seen).

    build: function of input shape and number of classes. images: (n, size, size, channels) uint8.
    """
    keras.utils.set_random_seed(seed)
    memory.keep_freed()
    model = build(images.shape[1:], cityscapes.N_CLASSES)
    augmented = augmentation.augment_set(images, labels, augmentation.training_augmenter(images.shape[1]), seed)
    batches = training.Batches([(images, labels), augmented], SIZES.batch_size, seed=seed)
    for layer in model._flatten_layers():
        if isinstance(layer, keras.layers.BatchNormalization):
            layer.momentum = MOMENTUM
    model.compile(keras.optimizers.Adam(LEARNING_RATE), training.total_loss())
    since, steps = None, 0
    while since is None or time.process_time() - since < seconds:
        for some_images, some_labels in batches:
            model.train_on_batch(some_images.astype(np.float32),
                                 augmentation.one_hot(some_labels, cityscapes.N_CLASSES))
            steps += 1
            since = since or time.process_time()  # the first step compiles and does not count
            if time.process_time() - since >= seconds:
                break
        batches.epoch += 1
    return model, steps * SIZES.batch_size


def milliseconds(model, repeats=25):
    """Processor time of one image alone on all cores, from uint8 to label map: the median; others' load spares it."""
    image = np.random.default_rng(0).integers(0, 256, (1, *model.input_shape[1:]), np.uint8)
    prediction.predict(model, image)  # compiles
    times = []
    for _ in range(repeats):
        started = time.process_time()
        prediction.predict(model, image)
        times.append(time.process_time() - started)
    return 1000 * float(np.median(times))


def unet(input_shape, n_classes):
    return build_unet(input_shape, n_classes, SIZES.base_filters)


def methods(data, seconds, seed):
    """Yield (name, trained model, its validation images, images seen in training) for the thesis's way and each other.

    Colour is left out where the images have none.
    """
    def gray(images):
        return np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None] for image in images])

    images, shown = gray(data.images), gray(data.validation_images)
    yield "the thesis's network", *_with(train(unet, images, data.labels, seconds, seed), shown)
    if data.has_colour:
        yield "in colour", *_with(train(unet, data.images, data.labels, seconds, seed), data.validation_images)
    build = backbones.backbone_unet(BACKBONE)
    yield f"backbone {BACKBONE}", *_with(train(build, images, data.labels, seconds, seed), shown)
    members = [train(unet, images, data.labels, seconds / MEMBERS, seed + 100 * (1 + number))
               for number in range(MEMBERS)]
    yield (f"ensemble of {MEMBERS}", backbones.ensemble([model for model, _ in members]), shown,
           sum(seen for _, seen in members))


def _with(trained, shown):
    return trained[0], shown, trained[1]


def compare(data, seconds=SECONDS, seeds=SEEDS):
    """A table with a row for each network and seed: mean IoU and pixel accuracy (Cityscapes), milliseconds a frame."""
    rows = []
    for seed in seeds:
        for name, model, images, seen in methods(data, seconds, seed):
            predicted = prediction.predict(model, images)
            mean_iou, accuracy, _ = quality.cityscapes_scores(
                quality.confusion_matrix(data.validation_labels, predicted))
            rows.append({"network": name, "seed": seed, "mean_iou": mean_iou, "accuracy": accuracy,
                         "milliseconds": milliseconds(model), "parameters": model.count_params(), "seen": seen})
            print(", ".join(f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                            for key, value in rows[-1].items()), file=sys.stderr, flush=True)
            keras.backend.clear_session()
    return pd.DataFrame(rows)


def page(data, table, seconds):
    """The Markdown of one comparison: what was run, and mean and range over the seeds of each network."""
    rows = []
    for name, some in table.groupby("network", sort=False):
        rows.append({
            "network": name, "mean IoU": _spread(some["mean_iou"]), "pixel accuracy": _spread(some["accuracy"]),
            "processor ms a frame": f"{some['milliseconds'].median():.0f}",
            "parameters": f"{some['parameters'].iloc[0]:,}", "images seen": f"{some['seen'].mean():.0f}"})
    colour = "" if data.has_colour else " These images are gray, so colour is left out."
    return (f"**{data.name[0].upper()}{data.name[1:]}.**{colour} {SIZES.image_size}x{SIZES.image_size}, "
            f"{seconds:g} seconds of processor time for each network, seeds "
            f"{', '.join(map(str, table['seed'].unique()))}: mean (lowest to highest).\n\n"
            f"{markdown(pd.DataFrame(rows))}")


def _spread(values):
    return f"{values.mean():.3f} ({values.min():.3f} to {values.max():.3f})"


HEAD = f"""# Section 5.2.1, tried

Colour, a backbone ({BACKBONE}, from random weights: the published ones would need a download) and an ensemble
of {MEMBERS} against the thesis's network as the demo profile has it ({{filters}} filters), all with the thesis's loss
and augmentation. Each has the same processor time for its training, the members of the ensemble their part of it.
Quality is that of the Cityscapes benchmark on the validation images; milliseconds are the processor time, of all cores
together, of one image from its bytes to its label map. What comes out says how far a network gets in minutes; a
backbone with weights from elsewhere, or with hours, may go farther.

Written by `python -m thesis_repro.bench.proposals`, with `--cityscapes ROOT` for each folder of images.
"""


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m thesis_repro.bench.proposals", description=__doc__.split("\n")[0])
    parser.add_argument("--cityscapes", type=Path, nargs="*", metavar="ROOT", default=[],
                        help="folders of images and label maps; without one the embedded world in made-up colours")
    parser.add_argument("--seconds", type=float, default=SECONDS, help=f"of processor time a network ({SECONDS})")
    parser.add_argument("--output", type=Path, metavar="FILE", help="write the page there")
    options = parser.parse_args(arguments)
    try:
        parts = [HEAD.format(filters=SIZES.base_filters)]
        for root in options.cityscapes or [None]:
            data = read_data(root, SIZES.image_size) if root else embedded_drives(SIZES.image_size)
            parts.append(page(data, compare(data, options.seconds), options.seconds))
    except InputError as error:
        sys.exit(str(error))
    text = "\n".join(parts)
    print(text)
    if options.output:
        files.write_text(options.output, text)


if __name__ == "__main__":
    main()
