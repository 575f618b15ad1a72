"""Train the model in the package and write it with its card: python tools/train_shipped.py --help.

The thesis's U-Net with 16 base filters learns from CamVid, KITTI's semantic benchmark, KITTI frames
labelled by a published network, and the embedded world. Some pairs of the benchmark are held out.
The last phase runs twice from the same state: without the held-out pairs, which gives a twin that
can be measured on them, and with all pairs, which gives the model. A stopped training resumes.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from thesis_repro import segmentation  # sets what TensorFlow reads at its import

# isort: split
import albumentations as A
import cv2
import jinja2
import keras
import numpy as np
import tensorflow as tf
from keras import ops

from street_world import dataset as world
from thesis_repro.data import cityscapes
from thesis_repro.running import files, program, provenance
from thesis_repro.segmentation import augmentation, prediction, quality, training
from thesis_repro.segmentation.unet import build_unet

BASE_FILTERS, WORLD_IMAGES, SEED = 16, 100, 0
EPOCH = 100  # steps
# ADAM_SHARE: Adam's share of the learning rate
LEARNING_RATE, ADAM_SHARE, WEIGHT_DECAY = 0.02, 0.15, 0.004
# indices of KITTI's pairs, in blocks because neighbours show one street
HELD_OUT = (*range(4), *range(-3, 0))
# ids that the network behind the pseudo labels predicts well; only these count in the common phase
TRUSTED_IDS = (7, 11, 17, 21, 23, 26)
# share shown like KITTI's camera; the rest like CamVid's
KITTI_LOOK = {"camvid": 0.4, "kitti": 0.85, "pseudo": 0.85, "world": 0.7}
# focal lengths of the images as they are read, pixels
FOCAL = {"camvid": 430, "kitti": 359, "pseudo": 370, "world": 410}
# focal lengths across and down of frames stretched to 320x320
LOOKS = {"camvid": (289, 385), "kitti": (185, 611)}
# a class's weight: its share of the pixels to this power, at most the limit
WEIGHT_POWER, WEIGHT_LIMIT = -0.35, 4.0
CAMVID_IDS = (7, 8, 11, 13, 17, 20, 21, 23, 24, 25, 26)


class Phase(NamedTuple):
    """A part of the training."""

    size: int  # height and width of the crops, pixels
    batch_size: int
    epochs: int
    shares: dict  # of a batch, by source


# small crops take a quarter of the time
COMMON = Phase(160, 8, 55, {"camvid": 0.4, "kitti": 0.25, "pseudo": 0.25, "world": 0.1})
LAST = Phase(320, 4, 10, {"camvid": 0.2, "kitti": 0.4, "pseudo": 0.3, "world": 0.1})

LIGHT = [
    A.RandomGamma((60, 165), p=1),
    A.RandomBrightnessContrast(0.1, 0.3, p=1),
    A.RandomShadow((0, 0, 1, 1), p=0.2),
    A.GaussianBlur(blur_limit=0, sigma_limit=(0.4, 1.2), p=0.2),
    A.GaussNoise(std_range=(1 / 255, 8 / 255), p=0.2),
]


class Muon(keras.optimizers.Muon):
    """Keras' Muon, which also takes kernels of convolutions, as matrices (inputs x outputs).

    Adam does the rest.
    """

    def _should_use_adamw(self, variable):
        return len(variable.shape) != 4 or 1 in variable.shape[:3]

    def zeropower_via_newtonschulz5(self, x, steps):
        """Return Muon's orthogonal matrix for a kernel, in the kernel's shape."""
        matrix = ops.reshape(x, (-1, x.shape[-1]))
        return ops.reshape(super().zeropower_via_newtonschulz5(matrix, steps), x.shape)

    def lr_adjust(self, x):
        """Return Muon's update of a kernel, scaled by the sides of its matrix."""
        matrix = ops.reshape(x, (-1, x.shape[-1]))
        return ops.reshape(super().lr_adjust(matrix), x.shape)


def view(image, label, source, look, size, random):
    """Return a random crop (size x size) of an image and its label map.

    It is as another camera would show it.
    """
    height, width = label.shape
    across, down = np.array(LOOKS[look]) / FOCAL[source]
    zoom, aspect = np.exp(random.uniform(-0.25, 0.4)), np.exp(random.uniform(-0.1, 0.1))
    across, down = across * zoom / aspect, down * zoom * aspect
    if down * height < size:  # the crop must not be higher than the image
        across, down = across * size / (down * height), size / height
    angle, flip = np.radians(random.normal(0, 1)), random.choice([-1, 1])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = turn @ np.diag([across * flip, down])
    # an image that is narrower than the crop is continued by its mirror image
    room = np.maximum(0.0, [width - size / across, height - size / down])
    centre = np.array([width, height]) / 2 + random.uniform(-0.5, 0.5, 2) * room
    matrix = np.column_stack([matrix, size / 2 - matrix @ centre])
    return tuple(
        cv2.warpAffine(array, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_REFLECT_101)
        for array, flags in ((image, cv2.INTER_LINEAR), (label, cv2.INTER_NEAREST))
    )


class Views(training.Batches):
    """Batches of views of the sources, which depend only on SEED and the epoch.

    sources: {name: [(image, label map)]}.
    """

    def __init__(self, sources, phase):
        self.sources, self.phase, self.epoch = sources, phase, 0
        # `dataset` reads the shape
        self.sets = [(np.empty((0, phase.size, phase.size, 1), np.uint8), None)]
        self.light = A.Compose(LIGHT)

    def __len__(self):
        return EPOCH

    def __iter__(self):
        random = np.random.default_rng((SEED, self.phase.size, self.epoch))
        size, batch_size, _, shares = self.phase
        names, ends = np.array(list(shares)), np.cumsum(list(shares.values()))
        for _ in range(EPOCH):
            # evenly spaced, to mix every batch
            places = (np.arange(batch_size) + random.random()) / batch_size
            pairs = []
            for name in names[np.searchsorted(ends[:-1], places)]:
                look = "kitti" if random.random() < KITTI_LOOK[name] else "camvid"
                image, label = self.sources[name][random.integers(len(self.sources[name]))]
                image, label = view(image, label, name, look, size, random)
                seed = random.integers(2**31)
                pairs.append(augmentation.augment(self.light, image[..., None], label, seed))
            images, labels = map(np.stack, zip(*pairs))
            yield images, np.where(np.isin(labels, quality.EVALUATED), labels, augmentation.NOTHING)


def class_weights(sources, shares_of_batch):
    """Return the weight of each of the 35 ids in the loss.

    It is larger for rare classes, and 0 for ids that are not evaluated.
    """
    shares = sum(
        shares_of_batch[name]
        * np.mean(
            [np.bincount(label.ravel(), minlength=256) / label.size for _, label in pairs], axis=0
        )
        for name, pairs in sources.items()
    )
    weights = np.zeros(cityscapes.N_CLASSES, np.float32)
    evaluated = list(quality.EVALUATED)
    weights[evaluated] = np.maximum(shares[evaluated], 1e-9) ** WEIGHT_POWER
    return np.minimum(weights / weights[evaluated].min(), WEIGHT_LIMIT)


def weighted_loss(weights):
    """Return weighted cross-entropy plus the Dice loss of the batch's classes.

    The first learns fast, the second is like IoU.
    """

    def cross_entropy_and_dice(true, predicted):
        counts = tf.reduce_sum(true * weights, -1)
        surprise = -tf.reduce_sum(true * tf.math.log(predicted + 1e-7), -1)
        cross_entropy = tf.reduce_sum(counts * surprise) / tf.maximum(tf.reduce_sum(counts), 1)
        predicted *= tf.reduce_sum(true, -1, keepdims=True)  # pixels without a class have zeros
        common, both, count = (
            tf.reduce_sum(value, (0, 1, 2)) for value in (true * predicted, true + predicted, true)
        )
        present = tf.cast(count > 0, tf.float32)
        dice = tf.reduce_sum(present * (1 - (2 * common + 1) / (both + 1))) / tf.maximum(
            tf.reduce_sum(present), 1
        )
        return cross_entropy + dice

    return cross_entropy_and_dice


def train(camvid, kitti_semantic, pseudo, folder):
    """Train in a folder; return (twin, model) and KITTI's held-out pairs.

    Twin and model share all but the last phase.
    """
    sets = {
        name: cityscapes.pairs(root, "train")
        for name, root in (("camvid", camvid), ("kitti", kitti_semantic), ("pseudo", pseudo))
    }
    pairs = sets["kitti"]
    held_out = [pairs[index] for index in HELD_OUT]
    world_images = [world.render_image("train", index, 0.5) for index in range(WORLD_IMAGES)]
    all_sources = {name: _read(pairs) for name, pairs in sets.items()} | {"world": world_images}
    training_sources = all_sources | {
        "kitti": _read([pair for pair in pairs if pair not in held_out])
    }
    trusted = [
        (image, np.where(np.isin(label, TRUSTED_IDS), label, augmentation.NOTHING))
        for image, label in all_sources["pseudo"]
    ]
    keras.utils.set_random_seed(SEED)
    model = build_unet((None, None, 1), cityscapes.N_CLASSES, BASE_FILTERS)
    optimizer = Muon(
        LEARNING_RATE,
        adam_lr_ratio=ADAM_SHARE,
        exclude_embeddings=False,
        weight_decay=WEIGHT_DECAY,
        adam_weight_decay=WEIGHT_DECAY,
    )
    optimizer.build(model.trainable_variables)
    made_from = {
        "code": provenance.digest_of_code(*segmentation.CODE),
        "tool": provenance.digest_of_file(Path(__file__)),
        **provenance.versions("tensorflow", "keras"),
        "phases": [COMMON, LAST],
        "steps": EPOCH,
        "images": provenance.digest_of_files(
            [file for pairs in sets.values() for pair in pairs for file in pair[1:]]
        ),
    }

    def fit(name, sources, phase, rate):
        batches = Views(sources, phase)
        loss = weighted_loss(class_weights(sources, phase.shares))
        model.compile(optimizer, training.fused_loss(loss))
        resumable = training.ResumableTraining(
            provenance.stage(folder / name, **made_from), batches
        )
        model.fit(
            batches.dataset(),
            epochs=phase.epochs,
            verbose=0,
            shuffle=False,
            callbacks=[keras.callbacks.LearningRateScheduler(rate), resumable],
        )

    def cosine(epoch):
        return LEARNING_RATE * 0.5 * (1 + np.cos(np.pi * (epoch + 0.5) / LAST.epochs))

    def warm_up(epoch):
        return LEARNING_RATE * (0.5 if epoch == 0 else 1)

    fit("common", training_sources | {"pseudo": trusted}, COMMON, warm_up)
    variables = model.variables + optimizer.variables
    state = [variable.numpy() for variable in variables]
    fit("twin", training_sources, LAST, cosine)
    twin = _finished(model)
    for variable, value in zip(variables, state, strict=True):
        variable.assign(value)
    fit("model", all_sources, LAST, cosine)
    return twin, _finished(model), held_out


def _read(pairs):
    return [(files.read_gray(pair.image), cityscapes.read_label_map(pair.label)) for pair in pairs]


def _finished(model):
    """Return a copy for images of 320x320 that only predicts evaluated ids."""
    fixed = build_unet((prediction.SIZE, prediction.SIZE, 1), cityscapes.N_CLASSES, BASE_FILTERS)
    fixed.set_weights(model.get_weights())
    kernel, bias = fixed.layers[-1].get_weights()
    unknown = np.setdiff1d(np.arange(cityscapes.N_CLASSES), quality.EVALUATED)
    kernel[..., unknown], bias[unknown] = 0, -30
    fixed.layers[-1].set_weights([kernel, bias])
    return fixed


def measured(model, pairs):
    """Return a model's scores on a set for the card: numbers, and a row for each class present."""
    scores = quality.quality(model, *cityscapes.load(pairs, prediction.SIZE))
    classes = scores.classes.assign(
        share=scores.classes["pixels"] / scores.classes["pixels"].sum()
    ).reset_index()
    camvid_classes = classes[classes["id"].isin(CAMVID_IDS)]
    return {
        "images": len(pairs),
        "accuracy": scores.accuracy,
        "mean_iou": camvid_classes["iou"].mean(),
        "count": len(camvid_classes),
        "mean_iou_all": scores.mean_iou,
        "classes": classes.to_dict("records"),
    }


def main(arguments=None):
    """Train the shipped model anew, and write it with its card."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("camvid", type=Path, help="folder with train, trainannot, val and valannot")
    parser.add_argument("kitti_semantic", type=Path, help="folder with train and trainannot")
    parser.add_argument("pseudo", type=Path, help="folder with train and trainannot")
    parser.add_argument(
        "output", type=Path, help="folder for the state of the training, the model and its card"
    )
    options = parser.parse_args(arguments)
    validation = cityscapes.pairs(options.camvid, "val")
    twin, model, held_out = train(
        options.camvid, options.kitti_semantic, options.pseudo, options.output
    )
    file = options.output / prediction.SHIPPED.name
    with files.atomic(file) as temporary:
        model.save(temporary)
    template = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True).from_string(
        Path(__file__).with_name("model_card.md.j2").read_text(encoding="utf-8")
    )
    files.write_text(
        options.output / "README.md",
        template.render(
            file=file.name,
            parameters=model.count_params(),
            steps=EPOCH,
            phases=(COMMON, LAST),
            held_out=[pair.name for pair in held_out],
            camvid=measured(model, validation),
            kitti=measured(twin, held_out),
        ),
    )
    print(f"written: {file}, and its card beside it")


if __name__ == "__main__":
    program.run_main(main)
