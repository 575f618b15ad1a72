"""The model that ships: the thesis's U-Net trained on CamVid, KITTI and embedded streets, for users without Cityscapes.

`python -m thesis_repro.segmentation.shipped CAMVID KITTI_SEMANTIC BUILD` (make weights) repeats its training and writes
it with its model card.
"""

import argparse
import json
import os
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import cv2
import keras
import numpy as np
import pandas as pd
import tensorflow as tf

from thesis_repro import InputError, cityscapes, files, longrun, stages
from thesis_repro.segmentation import memory, prediction, quality
from thesis_repro.segmentation.card import CURVES, card, draw_curves
from thesis_repro.segmentation.unet import DEPTH, build_unet
from thesis_repro.world import dataset as world

SIZE = prediction.SIZE
FOLDER = prediction.SHIPPED.parent
HISTORY, STATE = "history.csv", "state.npz"
LEARNT = quality.EVALUATED  # the ids that can be learnt; pixels of all others count for nothing

# How a camera of some focal length (pixels) looks once its frame is stretched to 320x320: focal lengths across and
# down. KITTI's frames are 3.3 times as wide as high, CamVid's 1.3.
LOOKS = {"camvid": (289, 385), "kitti": (185, 611)}
FOCAL = {"camvid": 430, "kitti": 359, "world": 410}  # of the images as they are read


@dataclass(frozen=True)
class Phase:
    """A stretch of training; its learning rate goes from one value to the other along half a cosine."""

    size: int  # pixels, both ways, of what the network sees
    batch_size: int
    steps: int
    rates: tuple  # the learning rate at the start and at the end

    def rate(self, step):
        start, end = self.rates
        return end + (start - end) * 0.5 * (1 + np.cos(np.pi * step / self.steps))


@dataclass(frozen=True)
class Preset:
    """What the thesis leaves open, frozen. On one machine the same preset gives the same weights every time."""

    base_filters: int = 16
    # Crops at full scale cost a quarter of whole images; whole images are what the network is used on.
    phases: tuple = (Phase(160, 8, 100, (2e-3, 2e-2)), Phase(160, 8, 10400, (2e-2, 2e-2)))
    last: Phase = Phase(320, 4, 700, (2e-2, 0))  # run twice: without the pairs held out, and with them
    shares: tuple = (("camvid", 0.5), ("kitti", 0.4), ("world", 0.1))  # of a batch, on average
    kitti_look: tuple = (("camvid", 0.4), ("kitti", 0.85), ("world", 0.7))  # share seen as KITTI shows it, not CamVid
    world_images: int = 100
    held_out: tuple = (4, 3)  # so many of KITTI's pairs at the start and at the end, on which the quality is reported
    weight_power: float = 0.35  # a class counts by its share of the pixels to minus this power ...
    weight_limit: float = 4.0  # ... and no more than so often as the commonest
    adam_share: float = 0.15  # of the learning rate, for what Muon is not made for
    weight_decay: float = 0.004
    save_every: int = 100  # steps
    seed: int = 0


PRESET = Preset()


def half_precision():
    """bfloat16 where the processor multiplies it faster than float32, else float32."""
    try:
        fast = "amx_bf16" in Path("/proc/cpuinfo").read_text()
    except OSError:
        fast = False
    return tf.bfloat16 if fast else tf.float32


def read_sources(camvid, kitti_semantic, preset=PRESET):
    """The images and label maps of each source as they are, lists of pairs of uint8 arrays."""
    def read(root):
        return [_read(pair) for pair in files.progress(cityscapes.pairs(root, "train"), "reading images", unit="image")]

    return {"camvid": read(camvid), "kitti": read(kitti_semantic),
            "world": [world.render_image("train", index, 0.5)
                      for index in files.progress(range(preset.world_images), "embedded streets", unit="image")]}


def _read(pair):
    image, label = files.read_gray(pair.image), cityscapes.read_label_map(pair.label)
    if image.shape != label.shape:
        raise InputError(f"{pair.label}: {label.shape[1]}x{label.shape[0]}, and its image is {image.shape[1]}x"
                         f"{image.shape[0]}; an image and its label map must have one size")
    return image, label


def class_weights(sources, preset):
    """What a pixel of each learnt class counts in the loss: rare classes more than common ones."""
    shares = np.zeros(256)
    for name, weight in preset.shares:
        counts = sum((np.bincount(label.ravel(), minlength=256) for _, label in sources[name]), np.zeros(256))
        shares += weight * counts / max(1, counts.sum())
    shares = shares[list(LEARNT)]
    weights = np.maximum(shares, 1e-9) ** -preset.weight_power
    return np.minimum(weights / weights.min(), preset.weight_limit).astype(np.float32)


def view(image, label, source, look, size, random):
    """A piece of an image, size x size, as a camera with another look would show it: stretched, turned, mirrored."""
    height, width = label.shape
    across, down = np.array(LOOKS[look]) / FOCAL[source]
    zoom, aspect = np.exp(random.uniform(-0.25, 0.4)), np.exp(random.uniform(-0.1, 0.1))
    down *= zoom * aspect
    across *= zoom / aspect
    if down * height < size:  # what is missing below and above cannot be made up
        across, down = across * size / (down * height), size / height
    angle = np.radians(random.normal(0, 1))
    flip = -1 if random.random() < 0.5 else 1
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = turn @ np.diag([across * flip, down])
    # the middle of what is seen; where the image is narrower than the view, its mirror image goes on beside it
    room_x, room_y = max(0.0, width - size / across), max(0.0, height - size / down)
    centre = np.array([width / 2 + random.uniform(-0.5, 0.5) * room_x, height / 2 + random.uniform(-0.5, 0.5) * room_y])
    matrix = np.column_stack([matrix, size / 2 - matrix @ centre])
    image = cv2.warpAffine(image, matrix, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    label = cv2.warpAffine(label, matrix, (size, size), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT_101)
    return image, label


def relight(image, random):
    """The same picture in other light and by another camera: gamma, contrast, brightness, shadow, blur, noise."""
    levels = np.linspace(0, 1, 256) ** np.exp(random.normal(0, 0.25))
    levels = (levels - 0.5) * np.exp(random.normal(0, 0.15)) + 0.5 + random.normal(0, 0.05)
    image = cv2.LUT(image, np.clip(levels * 255, 0, 255).astype(np.uint8))
    size = len(image)
    if random.random() < 0.2:  # KITTI's streets lie half in the shadow of trees and houses
        shade = np.full((4, 4), 1, np.float32)
        shade[random.random((4, 4)) < 0.4] = random.uniform(0.35, 0.8)
        shade = cv2.resize(shade, (size, size), interpolation=random.choice([cv2.INTER_CUBIC, cv2.INTER_LINEAR]))
        image = cv2.multiply(image, shade, dtype=cv2.CV_8U)
    if random.random() < 0.2:
        image = cv2.GaussianBlur(image, (0, 0), random.uniform(0.4, 1.2))
    if random.random() < 0.2:
        noise = np.empty(image.shape, np.int16)
        cv2.setRNGSeed(int(random.integers(2**31)))
        cv2.randn(noise, 0, random.uniform(1, 8))
        image = cv2.add(image, noise, dtype=cv2.CV_8U)
    return image


_PLACES = np.full(256, len(LEARNT), np.uint8)
_PLACES[list(LEARNT)] = np.arange(len(LEARNT))


def batch(sources, size, batch_size, step, preset):
    """The images and the label maps (places in LEARNT, their number for none) of one step, which the seed decides."""
    random = np.random.default_rng((preset.seed, step))
    images, labels = np.empty((batch_size, size, size, 1), np.uint8), np.empty((batch_size, size, size), np.uint8)
    names, shares = zip(*preset.shares)
    # spread evenly, so that every batch is mixed
    edges = (np.arange(batch_size) + random.random()) / batch_size
    for index, name in enumerate(np.array(names)[np.searchsorted(np.cumsum(shares), edges * sum(shares) * (1 - 1e-9))]):
        image, label = sources[name][random.integers(len(sources[name]))]
        look = "kitti" if random.random() < dict(preset.kitti_look)[name] else "camvid"
        image, label = view(image, label, name, look, size, random)
        images[index, ..., 0] = relight(image, random)
        labels[index] = _PLACES[label]
    return images, labels


def _batches(sources, phase, first, steps, preset):
    """The batches of some steps, each made while the network works on the one before."""
    with ThreadPoolExecutor(1) as pool:
        waiting = [pool.submit(batch, sources, phase.size, phase.batch_size, step, preset)
                   for step in range(first, min(first + 2, first + steps))]
        for step in range(first, first + steps):
            current = waiting.pop(0).result()
            if step + 2 < first + steps:
                waiting.append(pool.submit(batch, sources, phase.size, phase.batch_size, step + 2, preset))
            yield current


def forward(model, images, kind):
    """The U-Net in training: scores of the learnt classes, and what batch normalisation saw.

    The same arithmetic as `model(images, training=True)` in half the time: normalisation in one operation, half
    precision where that is fast, and no scores for classes that nothing is learnt about.
    """
    seen = []

    def block(x, number):
        name = f"_{2 * number + 1}"
        norm = model.get_layer("batch_normalization" + name)
        x = tf.nn.conv2d(x, tf.cast(model.get_layer("conv2d" + name).kernel, kind), 1, "SAME")
        x, mean, variance, *_ = tf.compat.v1.nn.fused_batch_norm(x, norm.gamma, norm.beta, epsilon=norm.epsilon)
        seen.append((norm, mean, variance))
        return tf.nn.relu(x)

    x, skips = tf.cast(images, kind), []
    for level in range(DEPTH):
        x = block(x, level)
        skips.append(x)
        x = tf.nn.max_pool2d(x, 2, 2, "VALID")
    x = block(x, DEPTH)
    for level, skip in enumerate(reversed(skips)):
        up = model.get_layer("conv2d_transpose" + (f"_{level}" if level else ""))
        x = tf.nn.conv2d_transpose(x, tf.cast(up.kernel, kind), tf.shape(skip), 2, "SAME") + tf.cast(up.bias, kind)
        x = block(tf.concat([x, skip], -1), DEPTH + 1 + level)
    kernel, bias = (tf.gather(variable, LEARNT, axis=-1) for variable in model.layers[-1].weights)
    return tf.cast(tf.nn.conv2d(x, tf.cast(kernel, kind), 1, "SAME"), tf.float32) + bias, seen


def held_out_pairs(kitti_semantic, preset=PRESET):
    """KITTI's pairs, sorted by name, and for each whether it is held out; neighbours show one street, so blocks are."""
    pairs, (first, last) = cityscapes.pairs(kitti_semantic, "train"), preset.held_out
    if len(pairs) <= first + last:
        raise InputError(f"{kitti_semantic}: {len(pairs)} training pairs; more than the {first + last} that are held "
                         "out are needed")
    return pairs, [not first <= index < len(pairs) - last for index in range(len(pairs))]


class Muon(keras.optimizers.Muon):
    """Muon (Jordan et al. 2024) for convolutions: their kernels as matrices; Keras would leave them to Adam.

    On this network it comes further in 400 steps than Adam, which moves the deep layers slowly, in 1000. The first and
    the last convolution, normalisations and biases stay with Adam.
    """

    def _should_use_adamw(self, variable):
        return len(variable.shape) != 4 or 1 in variable.shape[:3]

    def zeropower_via_newtonschulz5(self, x, steps):
        matrix = tf.reshape(x, (-1, x.shape[-1]))
        wide = matrix.shape[0] < matrix.shape[1]
        matrix = tf.transpose(matrix) if wide else matrix
        matrix /= tf.norm(matrix) + 1e-7
        for _ in range(steps):
            gram = tf.matmul(matrix, matrix, transpose_a=True)
            matrix = self.muon_a * matrix + matrix @ (self.muon_b * gram + self.muon_c * gram @ gram)
        return tf.reshape(tf.transpose(matrix) if wide else matrix, x.shape)

    def lr_adjust(self, x):
        outputs = x.shape[-1]
        return x * (self.rms_rate * max(outputs, x.shape.num_elements() // outputs) ** 0.5)


def combined_loss(labels, scores, weights):
    """Weighted cross-entropy plus the Dice loss, the mean over the classes of the batch; `labels`: places in LEARNT.

    Cross-entropy learns fast, Dice makes areas overlap, which is what the IoU measures.
    """
    counts = tf.gather(weights, labels)
    surprise = tf.nn.sparse_softmax_cross_entropy_with_logits(tf.minimum(labels, len(LEARNT) - 1), scores)
    cross_entropy = tf.reduce_sum(counts * surprise) / tf.maximum(tf.reduce_sum(counts), 1)
    true = tf.one_hot(labels, len(LEARNT))  # pixels without a class have zeros
    known = tf.cast(labels < len(LEARNT), tf.float32)[..., None]
    predicted = tf.nn.softmax(scores) * known
    common, size = (tf.reduce_sum(value, (0, 1, 2)) for value in (true * predicted, true + predicted))
    present = tf.cast(tf.reduce_any(true > 0, (0, 1, 2)), tf.float32)
    dice = tf.reduce_sum(present * (1 - (2 * common + 1) / (size + 1))) / tf.maximum(tf.reduce_sum(present), 1)
    return cross_entropy + dice


def train_shipped(camvid, kitti_semantic, folder, preset=PRESET):
    """Train the shipped model from nothing; returns (twin, shipped), which share all but the last phase.

    The twin never sees the pairs of KITTI held out, so that its quality can be measured on them; the shipped model
    sees them in the last phase. In `folder`: for each of the three stretches the state from which a killed training
    goes on, and its history.
    """
    folder = Path(folder)
    _, out = held_out_pairs(kitti_semantic, preset)
    every = read_sources(camvid, kitti_semantic, preset)
    fewer = every | {"kitti": [pair for pair, is_out in zip(every["kitti"], out, strict=True) if not is_out]}
    keras.utils.set_random_seed(preset.seed)
    model = build_unet((None, None, 1), cityscapes.N_CLASSES, preset.base_filters)
    optimizer = Muon(adam_lr_ratio=preset.adam_share, exclude_embeddings=False,
                     weight_decay=preset.weight_decay, adam_weight_decay=preset.weight_decay)
    optimizer.build(model.trainable_variables)
    memory.keep_freed()
    run = Run(model, optimizer, preset, class_weights(every, preset), _checksum(every))
    done = sum(phase.steps for phase in preset.phases)
    total = done + 2 * preset.last.steps
    with files.progress(description="shipped model", total=total, unit="step") as bar:
        advance(run, fewer, preset.phases, 0, None, folder / "common", bar)
        advance(run, fewer, [preset.last], done, folder / "common", folder / "twin", bar)
        twin = _finished(model, preset)
        advance(run, every, [preset.last], done, folder / "common", folder / "shipped", bar)
    return twin, _finished(model, preset)


class Run:
    """A network in training with its optimizer, and the compiled step; its state is one file."""

    def __init__(self, model, optimizer, preset, weights, data):
        self.preset, self.optimizer = preset, optimizer
        self.variables = model.variables + optimizer.variables
        self.key = json.loads(json.dumps({"preset": asdict(preset), "data": data}))
        kind, weights = half_precision(), tf.constant(np.append(weights, 0), tf.float32)

        # one graph for all sizes, so that a run resumed in a later phase rounds as an undisturbed run does
        @tf.function(input_signature=[tf.TensorSpec((None, None, None, 1), tf.uint8),
                                      tf.TensorSpec((None, None, None), tf.uint8), tf.TensorSpec((), tf.float32)])
        def step(images, labels, rate):
            optimizer.learning_rate.assign(rate)
            with tf.GradientTape() as tape:
                scores, seen = forward(model, images, kind)
                loss = combined_loss(tf.cast(labels, tf.int32), scores, weights)
            slopes = tape.gradient(loss, model.trainable_variables)
            # the biases of convolutions before a normalisation change nothing and have no gradient
            slopes = [tf.zeros(variable.shape) if slope is None else tf.convert_to_tensor(slope)
                      for slope, variable in zip(slopes, model.trainable_variables, strict=True)]
            optimizer.apply_gradients(zip(slopes, model.trainable_variables, strict=True))
            for norm, mean, variance in seen:
                for average, value in ((norm.moving_mean, mean), (norm.moving_variance, variance)):
                    average.assign(norm.momentum * average + (1 - norm.momentum) * value)
            return loss

        self.step = step

    def load(self, where):
        """Take the state of a file; returns its steps and history."""
        job, arrays = stages.resume(where)
        if job["key"] != self.key:
            raise InputError(f"{where.parent.parent}: holds a training with another preset or other data; delete it or "
                             "name another folder")
        for variable, value in zip(self.variables, arrays.values(), strict=True):
            variable.assign(value)
        return job["steps"], job["history"]

    def save(self, where, steps, history):
        stages.store(where, {"key": self.key, "steps": steps, "history": history},
                     {str(index): variable.numpy() for index, variable in enumerate(self.variables)})


def advance(run, sources, phases, first, start, folder, bar):
    """Run phases whose first step has the number `first`, from the state in the folder `start` or from nothing."""
    state = folder / STATE
    steps, history = 0, []
    if state.is_file():
        steps, history = run.load(state)
    elif start:
        run.load(start / STATE)
    bar.update(steps)
    before, losses = 0, []
    for phase in phases:
        begun = max(0, steps - before)
        for number, some in zip(range(begun, phase.steps),
                                  _batches(sources, phase, first + before + begun, phase.steps - begun, run.preset)):
            losses.append(run.step(*some, phase.rate(number)))
            bar.update()
            steps = before + number + 1
            if steps % run.preset.save_every == 0 or number + 1 == phase.steps:
                history.append({"step": first + steps, "size": phase.size, "loss": float(np.mean(losses))})
                losses = []
                run.save(state, steps, history)
        before += phase.steps
    files.write_text(folder / HISTORY, pd.DataFrame(history).to_csv(index=False))


def _finished(model, preset):
    """A copy for images of 320x320 that never gives a class of which nothing was learnt."""
    fixed = build_unet((SIZE, SIZE, 1), cityscapes.N_CLASSES, preset.base_filters)
    fixed.set_weights(model.get_weights())
    kernel, bias = fixed.layers[-1].get_weights()
    unknown = np.setdiff1d(np.arange(cityscapes.N_CLASSES), LEARNT)
    kernel[..., unknown], bias[unknown] = 0, -30
    fixed.layers[-1].set_weights([kernel, bias])
    return fixed


def _checksum(sources):
    value = 0
    for pairs in sources.values():
        for array in (array for pair in pairs for array in pair):
            value = zlib.crc32(np.ascontiguousarray(array), value)
    return value


def write_shipped(camvid, kitti_semantic, build, folder=FOLDER, preset=PRESET):
    """Train the shipped model, measure it, and write it with its card into `folder`.

    Raises InputError for folders that do not hold what they should, before anything is trained.
    """
    for name, root, subfolders in (("CAMVID", camvid, "train, trainannot, val and valannot"),
                                   ("KITTI_SEMANTIC", kitti_semantic, "train and trainannot")):
        if not Path(root).is_dir():
            raise InputError(f"{root}: no such folder; {name} must name the folder that holds {subfolders}")
    validation, (kitti, out) = cityscapes.pairs(camvid, "val"), held_out_pairs(kitti_semantic, preset)
    held_out = [pair for pair, is_out in zip(kitti, out, strict=True) if is_out]
    twin, model = train_shipped(camvid, kitti_semantic, build, preset)
    folder = Path(folder)
    with files.atomic(folder / prediction.SHIPPED.name) as temporary:
        model.save(temporary)
    stretches = {name: pd.read_csv(Path(build) / name / HISTORY) for name in ("common", "twin", "shipped")}
    draw_curves(stretches, folder / CURVES)
    camvid_quality = quality.quality(model, *cityscapes.load(validation, SIZE))
    kitti_quality = quality.quality(twin, *cityscapes.load(held_out, SIZE))
    files.write_text(folder / "README.md", card(
        model, folder / prediction.SHIPPED.name, preset, len(LEARNT), half_precision().name,
        len(cityscapes.pairs(camvid, "train")), len(validation), len(kitti), held_out, camvid_quality, kitti_quality))


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m thesis_repro.segmentation.shipped",
                                     description=write_shipped.__doc__)
    parser.add_argument("camvid", type=Path, help="folder with train, trainannot, val and valannot")
    parser.add_argument("kitti_semantic", type=Path, help="folder with train and trainannot")
    parser.add_argument("build", type=Path, help="folder for the state of the training")
    parser.add_argument("--output", type=Path, default=FOLDER, help="folder for the model and its card")
    options = parser.parse_args(arguments)
    try:
        with longrun.claimed(options.build), longrun.logged(options.build, "the model that ships", ours=True) as run:
            longrun.sweep(options.build)
            write_shipped(options.camvid, options.kitti_semantic, options.build, options.output)
            run.end(f"{options.output}: the model that ships, and its card")
    except Exception as error:
        return longrun.report_error(error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
