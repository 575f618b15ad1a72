"""Train the model of the package from nothing and write it with its card: python tools/train_shipped.py --help.

The thesis's U-Net with 16 base filters learns from CamVid, KITTI's semantic benchmark and the embedded world. All but
the last phase leave out some pairs of KITTI. The last phase runs twice from the same state: without these pairs, which
gives a twin that can be measured on them, and with all pairs, which gives the model. A stopped training resumes.
"""

import argparse
import os
import sys
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import albumentations as A
import cv2
import jinja2
import keras
import numpy as np
import tensorflow as tf
from keras import ops

from thesis_repro import InputError, cityscapes, files, stages
from thesis_repro.segmentation import augmentation, memory, prediction, quality, training
from thesis_repro.segmentation.unet import build_unet
from thesis_repro.world import dataset as world

BASE_FILTERS, WORLD_IMAGES, SEED = 16, 100, 0
EPOCH = 100  # steps
LEARNING_RATE, ADAM_SHARE, WEIGHT_DECAY = 0.02, 0.15, 0.004  # ADAM_SHARE: of the learning rate, for what Muon leaves
HELD_OUT = (*range(4), *range(-3, 0))  # pairs of KITTI sorted by name; neighbours show one street, so blocks
SHARES = {"camvid": 0.5, "kitti": 0.4, "world": 0.1}  # of a batch
KITTI_LOOK = {"camvid": 0.4, "kitti": 0.85, "world": 0.7}  # share seen as KITTI's camera shows it, not as CamVid's
# Focal lengths in pixels: of the images as they are read, and across and down once a frame is stretched to 320x320.
FOCAL = {"camvid": 430, "kitti": 359, "world": 410}
LOOKS = {"camvid": (289, 385), "kitti": (185, 611)}  # frames 1.3 and 3.3 times as wide as high
WEIGHT_POWER, WEIGHT_LIMIT = -0.35, 4.0  # a class counts by its share of the pixels to this power, at most so much
CAMVID_IDS = (7, 8, 11, 13, 17, 20, 21, 23, 24, 25, 26)


class Phase(NamedTuple):
    size: int  # pixels, both ways, of what the network sees
    batch_size: int
    epochs: int


COMMON, LAST = Phase(160, 8, 105), Phase(320, 4, 7)  # crops at full scale cost a quarter of whole images

LIGHT = [A.RandomGamma((60, 165), p=1), A.RandomBrightnessContrast(0.1, 0.3, p=1), A.RandomShadow((0, 0, 1, 1), p=0.2),
         A.GaussianBlur(blur_limit=0, sigma_limit=(0.4, 1.2), p=0.2), A.GaussNoise(std_range=(1 / 255, 8 / 255), p=0.2)]


class Muon(keras.optimizers.Muon):
    """Keras' Muon, for the kernels of convolutions too: as matrices of inputs x outputs. The rest is left to Adam."""

    def _should_use_adamw(self, variable):
        return len(variable.shape) != 4 or 1 in variable.shape[:3]

    def zeropower_via_newtonschulz5(self, x, steps):
        return ops.reshape(super().zeropower_via_newtonschulz5(ops.reshape(x, (-1, x.shape[-1])), steps), x.shape)

    def lr_adjust(self, x):
        return ops.reshape(super().lr_adjust(ops.reshape(x, (-1, x.shape[-1]))), x.shape)


def view(image, label, source, look, size, random):
    """A piece of an image, size x size, as a camera with another look would show it: stretched, turned, mirrored."""
    height, width = label.shape
    across, down = np.array(LOOKS[look]) / FOCAL[source]
    zoom, aspect = np.exp(random.uniform(-0.25, 0.4)), np.exp(random.uniform(-0.1, 0.1))
    across, down = across * zoom / aspect, down * zoom * aspect
    if down * height < size:  # what is missing below and above cannot be made up
        across, down = across * size / (down * height), size / height
    angle, flip = np.radians(random.normal(0, 1)), random.choice([-1, 1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = turn @ np.diag([across * flip, down])
    # where the image is narrower than the view, its mirror image continues it
    room = np.maximum(0.0, [width - size / across, height - size / down])
    centre = np.array([width, height]) / 2 + random.uniform(-0.5, 0.5, 2) * room
    matrix = np.column_stack([matrix, size / 2 - matrix @ centre])
    return tuple(cv2.warpAffine(array, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_REFLECT_101)
                 for array, flags in ((image, cv2.INTER_LINEAR), (label, cv2.INTER_NEAREST)))


class Views(training.Batches):
    """Batches of views of the sources ({name: [(image, label map)]}), which follow from the seed and the epoch."""

    def __init__(self, sources, phase, steps):
        self.sources, self.phase, self.steps, self.epoch = sources, phase, steps, 0
        self.sets = [(np.empty((0, phase.size, phase.size, 1), np.uint8), None)]  # what `dataset` reads the shape from
        self.light = augmentation.Augmenter(LIGHT)

    def __len__(self):
        return self.steps

    def __iter__(self):
        random, (size, batch_size, _) = np.random.default_rng((SEED, self.phase.size, self.epoch)), self.phase
        for _ in range(self.steps):
            places = (np.arange(batch_size) + random.random()) / batch_size  # even, so that every batch is mixed
            pairs = []
            for name in np.array(list(SHARES))[np.searchsorted(np.cumsum(list(SHARES.values()))[:-1], places)]:
                look = "kitti" if random.random() < KITTI_LOOK[name] else "camvid"
                image, label = self.sources[name][random.integers(len(self.sources[name]))]
                image, label = view(image, label, name, look, size, random)
                pairs.append(self.light(image[..., None], label, random.integers(2**31)))
            images, labels = map(np.stack, zip(*pairs))
            yield images, np.where(np.isin(labels, quality.EVALUATED), labels, augmentation.NOTHING)


def class_weights(sources):
    """What a pixel of each of the 35 ids counts in the loss: rare classes more, what is not evaluated nothing."""
    shares = sum(SHARES[name] * np.mean([np.bincount(label.ravel(), minlength=256) / label.size for _, label in pairs],
                                        axis=0) for name, pairs in sources.items())
    weights = np.zeros(cityscapes.N_CLASSES, np.float32)
    evaluated = list(quality.EVALUATED)
    weights[evaluated] = np.maximum(shares[evaluated], 1e-9) ** WEIGHT_POWER
    return np.minimum(weights / weights[evaluated].min(), WEIGHT_LIMIT)


def weighted_loss(weights):
    """Weighted cross-entropy, which learns fast, plus the Dice loss of the classes in the batch, which is near IoU."""
    def cross_entropy_and_dice(true, predicted):
        counts = tf.reduce_sum(true * weights, -1)
        surprise = -tf.reduce_sum(true * tf.math.log(predicted + 1e-7), -1)
        cross_entropy = tf.reduce_sum(counts * surprise) / tf.maximum(tf.reduce_sum(counts), 1)
        predicted *= tf.reduce_sum(true, -1, keepdims=True)  # pixels without a class have zeros
        common, both, count = (tf.reduce_sum(value, (0, 1, 2)) for value in (true * predicted, true + predicted, true))
        present = tf.cast(count > 0, tf.float32)
        dice = tf.reduce_sum(present * (1 - (2 * common + 1) / (both + 1))) / tf.maximum(tf.reduce_sum(present), 1)
        return cross_entropy + dice

    return cross_entropy_and_dice


def train(camvid, kitti_semantic, folder, common=COMMON, last=LAST, steps=EPOCH):
    """Train in a folder; returns (twin, model), which share all but the last phase, and KITTI's pairs held out."""
    pairs = cityscapes.pairs(kitti_semantic, "train")
    if len(pairs) <= len(HELD_OUT):
        raise InputError(f"{kitti_semantic}: {len(pairs)} training pairs; more than the {len(HELD_OUT)} that are held "
                         "out are needed")
    held_out = [pairs[index] for index in HELD_OUT]
    world_images = [world.render_image("train", index, 0.5) for index in range(WORLD_IMAGES)]
    every = {"camvid": _read(cityscapes.pairs(camvid, "train")), "kitti": _read(pairs), "world": world_images}
    fewer = every | {"kitti": _read([pair for pair in pairs if pair not in held_out])}
    keras.utils.set_random_seed(SEED)
    memory.keep_freed()
    model = build_unet((None, None, 1), cityscapes.N_CLASSES, BASE_FILTERS)
    optimizer = Muon(LEARNING_RATE, adam_lr_ratio=ADAM_SHARE, exclude_embeddings=False, weight_decay=WEIGHT_DECAY,
                     adam_weight_decay=WEIGHT_DECAY)
    model.compile(optimizer, training.fused_loss(weighted_loss(class_weights(every))))
    optimizer.build(model.trainable_variables)
    made_from = {"code": stages.code("segmentation/unet"), "tool": stages.content(Path(__file__)),
                 "phases": [common, last], "steps": steps, "images": stages.listing([pair.image for pair in pairs])}

    def fit(name, sources, phase, rate):
        batches = Views(sources, phase, steps)
        resumable = training.ResumableTraining(stages.stage(folder / name, **made_from), model, batches)
        model.fit(batches.dataset(), epochs=phase.epochs, initial_epoch=resumable.first_epoch(phase.epochs), verbose=0,
                  shuffle=False, callbacks=[keras.callbacks.LearningRateScheduler(rate), resumable])

    def cosine(epoch):
        return LEARNING_RATE * 0.5 * (1 + np.cos(np.pi * (epoch + 0.5) / last.epochs))

    fit("common", fewer, common, lambda epoch: LEARNING_RATE * (0.5 if epoch == 0 else 1))
    variables = model.variables + optimizer.variables
    state = [variable.numpy() for variable in variables]
    fit("twin", fewer, last, cosine)
    twin = _finished(model)
    for variable, value in zip(variables, state, strict=True):
        variable.assign(value)
    fit("model", every, last, cosine)
    return twin, _finished(model), held_out


def _read(pairs):
    return [(files.read_gray(pair.image), cityscapes.read_label_map(pair.label)) for pair in pairs]


def _finished(model):
    """A copy for images of 320x320 that never gives an id which is not evaluated."""
    fixed = build_unet((prediction.SIZE, prediction.SIZE, 1), cityscapes.N_CLASSES, BASE_FILTERS)
    fixed.set_weights(model.get_weights())
    kernel, bias = fixed.layers[-1].get_weights()
    unknown = np.setdiff1d(np.arange(cityscapes.N_CLASSES), quality.EVALUATED)
    kernel[..., unknown], bias[unknown] = 0, -30
    fixed.layers[-1].set_weights([kernel, bias])
    return fixed


def measured(model, pairs):
    """What the card says of a model on a set: numbers, and a row for each class present."""
    scores = quality.quality(model, *cityscapes.load(pairs, prediction.SIZE))
    classes = scores.classes.assign(share=scores.classes["pixels"] / scores.classes["pixels"].sum()).reset_index()
    of_camvid = classes[classes["id"].isin(CAMVID_IDS)]
    return {"images": len(pairs), "accuracy": scores.accuracy, "mean_iou": of_camvid["iou"].mean(),
            "count": len(of_camvid), "mean_iou_all": scores.mean_iou, "classes": classes.to_dict("records")}


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("camvid", type=Path, help="folder with train, trainannot, val and valannot")
    parser.add_argument("kitti_semantic", type=Path, help="folder with train and trainannot")
    parser.add_argument("output", type=Path, help="folder for the state of the training, the model and its card")
    parser.add_argument("--epochs", type=int, default=COMMON.epochs, help=f"of the common phase ({COMMON.epochs})")
    parser.add_argument("--last-epochs", type=int, default=LAST.epochs, help=f"of the last phase ({LAST.epochs})")
    parser.add_argument("--steps", type=int, default=EPOCH, help=f"of an epoch ({EPOCH})")
    options = parser.parse_args(arguments)
    try:
        validation = cityscapes.pairs(options.camvid, "val")
        common, last = COMMON._replace(epochs=options.epochs), LAST._replace(epochs=options.last_epochs)
        twin, model, held_out = train(options.camvid, options.kitti_semantic, options.output, common, last,
                                      options.steps)
        file = options.output / prediction.SHIPPED.name
        with files.atomic(file) as temporary:
            model.save(temporary)
        template = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True).from_string(
            Path(__file__).with_name("model_card.md.j2").read_text(encoding="utf-8"))
        files.write_text(options.output / "README.md", template.render(
            file=file.name, parameters=model.count_params(), steps=options.steps, phases=(common, last),
            held_out=[pair.name for pair in held_out], camvid=measured(model, validation),
            kitti=measured(twin, held_out)))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"written: {file}, and its card beside it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
