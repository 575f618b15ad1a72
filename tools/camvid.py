"""Train the thesis's network at its size on CamVid, and write its curves, scores and tables.

64 filters, 320x320 pixels, the thesis's loss, weights and augmentation, Adam, batches of 16, at
most 100 epochs, a patience of 5: many hours on a CPU, minutes on a GPU. A stopped training goes on
after its last epoch. Any backend of Keras trains: --backend jax, where there is no TensorFlow.
Scores and tables need TensorFlow: there, the command without this option takes the folder of what
was trained elsewhere. Cityscapes, which the thesis trained on, cannot be had here. CamVid has
images to validate on, so none are split off.
"""

import argparse
import os
import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from keypoint_study import comparisons, ratios
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.plan import Study
from keypoint_study.report import comparison, style
from keypoint_study.sources import Source
from thesis import REPORTED, map_quality
from thesis.run_settings import PROFILES, ROOT
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.cityscapes import ID
from thesis_repro.data.sequence import Sequence
from thesis_repro.running import files, program, provenance
from thesis_repro.segmentation import augmentation

SIZES = PROFILES["thesis"]
SMOOTH = 1e-5  # of segmentation-models: an absent class scores 1
EPSILON = 1e-7  # of Keras, where the library clips probabilities
HISTORY, STATE, BEST = "history.csv", "state.npz", "best.npz"  # files of a training
EXAMPLE = 0  # validation image whose label maps are drawn; the image itself is not ours to show
SCORES = {"loss": "loss", "f1-score": "F1 score", "iou_score": "IoU score"}
REPORTED_KEYS = {"loss": "loss", "f1-score": "f1", "iou_score": "iou"}


# The training


def doubled(pairs, transforms, seed):
    """Return images and label maps, each with a transformed copy after all of them (A.3)."""
    images, labels = cityscapes.load(pairs, SIZES.image_size)
    copies = augmentation.augment_set(images, labels, transforms, seed)
    return np.concatenate([images, copies[0]]), np.concatenate([labels, copies[1]])


def batches_of(images, labels, seed=None, epoch=0):
    """Yield the batches of an epoch, in the order of `training.Batches`."""
    order = np.arange(len(images))
    if seed is not None:
        order = np.random.default_rng((seed, epoch)).permutation(order)
    for start in range(0, len(order), SIZES.batch_size):
        chosen = order[start : start + SIZES.batch_size]
        yield images[chosen].astype(np.float32), labels[chosen]


def loss_and_scores():
    """Return the loss, IoU and F1 score of label maps and probabilities, in Keras' operations.

    They are those of segmentation-models, which needs TensorFlow.
    """
    from keras import ops

    weights = np.asarray(cityscapes.CLASS_WEIGHTS, np.float32)

    def one_hot(labels):
        return ops.one_hot(ops.cast(labels, "int32"), cityscapes.N_CLASSES, dtype="float32")

    def dice(true, predicted):
        overlap = ops.sum(true * predicted, axis=(0, 1, 2))
        sizes = ops.sum(true + predicted, axis=(0, 1, 2))
        return (2 * overlap + SMOOTH) / (sizes + SMOOTH)

    def loss(labels, predicted):
        true = one_hot(labels)
        clipped = ops.clip(predicted, EPSILON, 1 - EPSILON)
        focal = -true * 0.25 * (1 - clipped) ** 2 * ops.log(clipped)
        return 1 - ops.mean(dice(true, predicted) * weights) + ops.mean(focal)

    def iou_score(labels, predicted):
        true, chosen = one_hot(labels), ops.cast(predicted > 0.5, "float32")
        overlap = ops.sum(true * chosen, axis=(0, 1, 2))
        union = ops.sum(true + chosen, axis=(0, 1, 2)) - overlap
        return ops.mean((overlap + SMOOTH) / (union + SMOOTH))

    def f1_score(labels, predicted):
        return ops.mean(dice(one_hot(labels), ops.cast(predicted > 0.5, "float32")))

    return loss, iou_score, f1_score


def build():
    """Return the thesis's network at its size, with fresh weights."""
    from thesis_repro.segmentation.unet import build_unet

    size = SIZES.image_size
    return build_unet((size, size, 1), cityscapes.N_CLASSES, SIZES.base_filters)


def write_arrays(path, arrays):
    """Write arrays as a NumPy archive, by their places."""
    with files.atomic(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, *arrays)


def read_arrays(path):
    """Return the arrays of a file of `write_arrays`."""
    with np.load(path) as archive:
        return [archive[name] for name in archive.files]


def is_done(rows, epochs):
    """Say whether a training has all epochs, or had none with a lower validation loss for long."""
    losses = [row["val_loss"] for row in rows]
    waited = len(rows) - int(np.argmin(losses)) - 1 if rows else 0
    return len(rows) >= epochs or waited >= SIZES.patience


def train(folder, train_set, validation_set, seed, epochs):
    """Train a network, or go on training, until it is done; its files lie in a folder."""
    rows = pd.read_csv(folder / HISTORY).to_dict("records") if (folder / HISTORY).exists() else []
    if is_done(rows, epochs):
        return
    with program.quiet():
        import keras

    keras.utils.set_random_seed(seed)
    model = build()
    loss, *scores = loss_and_scores()
    model.compile(keras.optimizers.Adam(SIZES.learning_rate), loss, metrics=scores)
    model.optimizer.build(model.trainable_variables)
    variables = model.variables + model.optimizer.variables
    if (folder / STATE).exists():
        for variable, value in zip(variables, read_arrays(folder / STATE), strict=True):
            variable.assign(value)
    steps = -(-len(train_set[0]) // SIZES.batch_size)
    rows = rows[: int(model.optimizer.iterations) // steps]  # it may have been stopped in between
    device = keras.distribution.list_devices()[0]
    made_on = f"Keras {keras.__version__} on {keras.backend.backend()}, {device}"
    files.write_text(folder / "machine.txt", made_on)
    while not is_done(rows, epochs):
        began, epoch = time.monotonic(), len(rows)
        batches = batches_of(*train_set, seed, epoch)
        for batch in files.progress(batches, f"epoch {epoch + 1}", steps, unit="batch"):
            trained = model.train_on_batch(*batch, return_dict=True)
        model.reset_metrics()
        for batch in batches_of(*validation_set):
            validated = model.test_on_batch(*batch, return_dict=True)
        model.reset_metrics()
        logs = trained | {f"val_{name}": value for name, value in validated.items()}
        logs = {name.replace("f1_score", "f1-score"): float(logs[name]) for name in sorted(logs)}
        rows.append({"epoch": epoch + 1, **logs, "seconds": time.monotonic() - began})
        if logs["val_loss"] == min(row["val_loss"] for row in rows):
            write_arrays(folder / BEST, model.get_weights())
        files.write_text(folder / HISTORY, pd.DataFrame(rows).to_csv(index=False))
        write_arrays(folder / STATE, [variable.numpy() for variable in variables])
        print(f"seed {seed}, epoch {epoch + 1}: validation loss {logs['val_loss']:.4f}", flush=True)


# Figures and tables


def curves(history):
    """Draw loss, F1 and IoU over the epochs (Figures 4.1 and 4.2)."""
    figure, panels = style.new_figure(1, 3, height=2.6)
    best = history["epoch"][history["val_loss"].idxmin()]
    for panel, (name, title) in zip(panels, SCORES.items(), strict=True):
        panel.plot(history["epoch"], history[name], label="training")
        panel.plot(history["epoch"], history[f"val_{name}"], "--", label="validation")
        panel.axvline(best, color=style.GRAY, linestyle=":", label="lowest validation loss")
        panel.set(xlabel="epoch", title=title)
    style.legend_below(figure, panels, 3)
    return figure


def example(model, pairs):
    """Draw the label map of an image by people, and the network's (Figure 4.3)."""
    from thesis_repro.segmentation import prediction

    images, labels = cityscapes.load(pairs[EXAMPLE : EXAMPLE + 1], SIZES.image_size)
    predicted = prediction.predict(model, images)[0]
    figure, panels = style.new_figure(1, 2, height=3.4)
    maps = {"label map by people": labels[0], "label map by the network": predicted}
    for panel, (title, label_map) in zip(panels, maps.items(), strict=True):
        style.show_image(panel, cityscapes.colorize(label_map), title)
    style.class_legend(figure, labels[0][labels[0] < cityscapes.N_CLASSES], predicted)
    return figure


def facts_of_training(history):
    """Return {fact: text} of a training: its epochs, and the scores of its last and best epoch."""
    best, last = history.loc[history["val_loss"].idxmin()], history.iloc[-1]
    stopped = last["epoch"] - best["epoch"] >= SIZES.patience
    facts = {
        "epochs": f"{len(history)}",
        "ended by early stopping": "yes" if stopped else "no: --epochs ended it",
        "epoch of the lowest validation loss": f"{best['epoch']:.0f}",
        "seconds an epoch, median": f"{history['seconds'].median():.1f}",
    }
    for prefix, part in (("", "training"), ("val_", "validation")):
        for name, title in SCORES.items():
            values = [f"{row[f'{prefix}{name}']:.3f}" for row in (last, best)]
            facts[f"{title}, {part}, last epoch (best epoch)"] = "{} ({})".format(*values)
    return facts


def table_of_training(histories):
    """Return one row a fact, one column a training, and what the thesis reports of Cityscapes."""
    facts = {f"CamVid, seed {seed}": facts_of_training(rows) for seed, rows in histories.items()}
    thesis = {"epochs": "24", "ended by early stopping": "yes"}
    for part, key in (("training", "train"), ("validation", "validation")):
        for name, title in SCORES.items():
            value = REPORTED["segmentation_results"][key][REPORTED_KEYS[name]]
            thesis[f"{title}, {part}, last epoch (best epoch)"] = str(value)
    table = pd.DataFrame(facts | {"Cityscapes, thesis": thesis}).fillna("")
    return table.loc[list(next(iter(facts.values())))].rename_axis("training").reset_index()


def table_of_areas(network, pairs, domain):
    """Return how right a network is in parts of images, and how many of its edges are invented.

    One row a measure: those of `map_quality.right_shares`, and the share (%) of Canny's edges of a
    predicted map that lie beside the true boundaries, by its thresholds. Means over the images.
    """
    from thesis_repro.segmentation import prediction

    images, _ = cityscapes.load(pairs, *network.input_shape[2:])
    rows = []
    for pair, predicted in zip(pairs, prediction.predict(network, images), strict=True):
        image = cv2.imread(str(pair.image), cv2.IMREAD_GRAYSCALE)
        exact = cityscapes.read_label_map(pair.label)
        row = map_quality.right_shares(predicted, exact, image)
        for low, high in map_quality.THRESHOLDS[:2]:
            row[f"invented {low}/{high}"] = map_quality.invented(predicted, exact, (low, high))
        rows.append(row)
    lines = []
    for measure, values in pd.DataFrame(rows).items():
        ends = ratios.mean_interval(values)
        lines.append([domain, measure, values.mean(), *ends, values.count()])
    return pd.DataFrame(lines, columns=["images", "measure", "mean (%)", "low", "high", "n"])


def table_of_pixels(domains):
    """Return the share (%) of pixels without a class, and those of persons over the road's."""
    lines = []
    for domain, pairs in domains.items():
        counts = np.zeros(256, int)
        for pair in pairs:
            counts += np.bincount(cityscapes.read_label_map(pair.label).ravel(), minlength=256)
        nothing = 100 * counts[0] / counts.sum()
        lines.append([domain, len(pairs), nothing, counts[ID["person"]] / counts[ID["road"]]])
    names = ["label maps", "number", "pixels without a class (%)", "persons over road"]
    return pd.DataFrame(lines, columns=names)


def write_areas(options, pairs):
    """Write what needs no training: the package's network by area, and counts of pixels."""
    from thesis_repro.segmentation import prediction

    held_out, domains = pairs["val"], {f"{options.camvid.name}'s training images": pairs["train"]}
    if options.kitti_semantic:
        domains["KITTI's street scenes"] = cityscapes.pairs(options.kitti_semantic, "train")
    areas = table_of_areas(
        prediction.load_shipped(), held_out, f"{options.camvid.name}, validation"
    )
    style.save_table(areas.round(2), options.figures, "areas", "the network in the package")
    pixels = table_of_pixels(domains).round(4)
    style.save_table(pixels, options.figures, "pixels", f"{options.camvid.name}")


def table_of_streets(model, root, folder):
    """Return the errors with masks from a network's label maps, over those with all keypoints."""
    from thesis_repro.segmentation import prediction

    names, labels = kitti.sequences(root), folder / "labels"
    for name in names:
        prediction.write_label_maps(model, Sequence(root, name).frame_paths, labels / name)
    study = Study(
        root,
        tuple(names),
        (Source(labels),),
        (CONTROL_WIDTH,),
        estimators=("refined", "thesis"),
        repetitions=SIZES.repetitions,
    )
    table = comparisons.comparisons_of(study.run(folder / "study").table)
    of_masks = table[(table["reference"] == "baseline") & (table["method"] == "masked")]
    return comparison.table_of_ratios(comparison.all_of(of_masks))


@style.applied()
def write(options, folders, held_out):
    """Write the figures and tables of all trainings. folders: of the trainings, by seed."""
    histories = {seed: pd.read_csv(folder / HISTORY) for seed, folder in folders.items()}
    networks = {seed: build() for seed in folders}
    for seed, network in networks.items():
        network.set_weights(read_arrays(folders[seed] / BEST))
    out, first = options.figures, options.seeds[0]
    size = f"{SIZES.base_filters} filters, {SIZES.image_size}x{SIZES.image_size} pixels"
    machine = (folders[first] / "machine.txt").read_text(encoding="utf-8")
    note = f"the thesis's network, {size}, trained on CamVid; {machine}"
    style.save_figure(curves(histories[first]), out, "figure_4_01", note)
    rows = pd.concat([rows.assign(seed=seed) for seed, rows in histories.items()])
    provenance.write_table(out / "figure_4_01.csv", rows)
    drawn = example(networks[first], held_out)
    style.save_figure(drawn, out, "figure_4_03", f"{note}; CamVid, validation")
    absent = f"F1 and IoU: means over {cityscapes.N_CLASSES} outputs, absent classes score 1"
    style.save_table(table_of_training(histories), out, "training", f"{note}; {absent}")
    domains = {"CamVid, validation": held_out}
    if options.kitti_semantic:
        domains["KITTI's street scenes"] = cityscapes.pairs(options.kitti_semantic, "train")
    by_seed = {f"seed {seed}": network for seed, network in networks.items()}
    scores = map_quality.scores_of_models(by_seed, domains)
    style.save_table(map_quality.table_of_scores(scores), out, "scores", note)
    if options.kitti:  # label maps take minutes, so only the first network makes them
        table = table_of_streets(networks[first], options.kitti, folders[first])
        style.save_table(table, out, "streets", note)


def main(arguments=None):
    """Train, and write what the trainings give."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("camvid", type=Path, help="folder with train, trainannot, val and valannot")
    parser.add_argument("--folder", type=Path, default=ROOT / "build/camvid", help="of trainings")
    parser.add_argument("--figures", type=Path, default=ROOT / "figures/camvid")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one training each")
    parser.add_argument("--epochs", type=int, default=SIZES.epochs)
    parser.add_argument("--backend", default="tensorflow", help="of Keras: jax, torch")
    parser.add_argument("--kitti", type=Path, help="also write what its masks do to the odometry")
    parser.add_argument("--kitti-semantic", type=Path, help="also score KITTI's street scenes")
    parser.add_argument("--areas", action="store_true", help="only measure the package's network")
    options = parser.parse_args(arguments)
    os.environ["KERAS_BACKEND"] = options.backend  # the package sets TensorFlow; Keras reads it
    pairs = {split: cityscapes.pairs(options.camvid, split) for split in ("train", "val")}
    if options.areas:
        write_areas(options, pairs)
        return
    made_from = provenance.digest_of_files(
        path for split in pairs.values() for pair in split for path in pair[1:]
    )
    transforms = augmentation.training_augmenter(SIZES.image_size)
    train_set = doubled(pairs["train"], transforms, 0)
    validation_set = doubled(pairs["val"], augmentation.validation_augmenter(), 1)
    folders = {}
    for seed in options.seeds:
        folders[seed] = provenance.stage(
            options.folder / f"seed_{seed}", images=made_from, sizes=SIZES, seed=seed
        )
        train(folders[seed], train_set, validation_set, seed, options.epochs)
    if options.backend != "tensorflow":
        program.summary(f"{options.folder}: trained; without --backend, tables are written")
        return
    write(options, folders, pairs["val"])
    program.summary(f"curves, scores and an example: {options.figures}")


if __name__ == "__main__":
    program.run_main(main)
