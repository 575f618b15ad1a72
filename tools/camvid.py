"""Train the thesis's network at its size on CamVid, and write its curves and scores.

`make camvid CAMVID=/path` takes the thesis's settings: 64 filters, 320x320, its loss, weights and
augmentation, Adam, batches of 16, at most 100 epochs, a patience of 5. It takes hours, and can be
stopped and resumed at any moment. EPOCHS=10 ends sooner; a later call with more goes on.
KITTI_SEMANTIC=/path: also the mean IoU on KITTI's street scenes. KITTI=/path: also its label maps,
and what masks from them do to the odometry.
JOB=folder only writes what tools/camvid_jax.py needs to train elsewhere, on a GPU; TRAINED=folder
takes what that program wrote, one training a seed, in place of a training here.
Cityscapes, which the thesis trained on, cannot be had here. CamVid has images to validate on, so
none are split off.
"""

import json
import sys
import time
from pathlib import Path

from thesis_repro import segmentation  # noqa: F401  sets what TensorFlow reads at its import

# isort: split
import cv2
import keras
import numpy as np
import pandas as pd
import tensorflow as tf

from keypoint_study import comparisons
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.plan import Study
from keypoint_study.report import comparison, style
from keypoint_study.sources import Source
from thesis import domain_gap, timing
from thesis.reported import REPORTED
from thesis.settings import PROFILES, ROOT, folder, read_settings
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.running import files, program, provenance
from thesis_repro.segmentation import augmentation, prediction, training
from thesis_repro.segmentation.unet import build_unet

BEST = "best.keras"
EXAMPLE = 0  # validation image whose label maps are drawn; the image itself is not ours to show
SCORES = {"loss": "loss", "f1-score": "F1 score", "iou_score": "IoU score"}
REPORTED_KEYS = {"loss": "loss", "f1-score": "f1", "iou_score": "iou"}


class Timed(keras.callbacks.Callback):
    """Adds the seconds of an epoch to its row of the history."""

    def on_epoch_begin(self, epoch, logs=None):
        """Start the clock."""
        self._began = time.monotonic()

    def on_epoch_end(self, epoch, logs=None):
        """Add the seconds, before the row is written."""
        logs["seconds"] = time.monotonic() - self._began


def doubled(images, labels, transforms, seed):
    """Return images and label maps, each with a transformed copy after all of them (A.3)."""
    copies = augmentation.augment_set(images, labels, transforms, seed)
    return tuple(np.concatenate(pair) for pair in zip((images, labels), copies, strict=True))


def batches_of(camvid, sizes, seed):
    """Return the batches of the training and of the validation, as notebooks 1 and 2 make them."""
    sets = []
    for split in ("train", "val"):
        pairs = cityscapes.pairs(camvid, split, limit=sizes.training_images)
        sets.append(cityscapes.load(pairs, sizes.image_size))
    full = augmentation.training_augmenter(sizes.image_size)
    train = doubled(*sets[0], full, seed)
    validation = doubled(*sets[1], augmentation.validation_augmenter(), seed + 1)
    return (
        training.Batches([train], sizes.batch_size, seed),
        training.Batches([validation], sizes.batch_size),
        sets[1],
    )


def train(train_batches, validation, sizes, root, seed):
    """Train, or go on training, and return the folder of the training and its history."""
    for set_threads in ("set_intra_op_parallelism_threads", "set_inter_op_parallelism_threads"):
        getattr(tf.config.threading, set_threads)(sizes.threads)  # decide how sums are rounded
    keras.utils.set_random_seed(seed)
    size = sizes.image_size
    model = build_unet((size, size, 1), cityscapes.N_CLASSES, sizes.base_filters)
    optimizer = keras.optimizers.Adam(sizes.learning_rate)
    optimizer.build(model.trainable_variables)
    loss = training.fused_loss(training.total_loss())
    model.compile(optimizer, loss, metrics=training.metrics())
    stage = provenance.stage(root, **training.made_from(model, train_batches, validation))
    early = keras.callbacks.EarlyStopping(monitor="val_loss", patience=sizes.patience)
    kept = keras.callbacks.ModelCheckpoint(stage / BEST, monitor="val_loss", save_best_only=True)
    resumable = training.ResumableTraining(stage, train_batches, [early, kept])
    model.fit(
        train_batches.dataset(),
        validation_data=validation.dataset(),
        epochs=sizes.epochs,
        shuffle=False,
        verbose=0,
        callbacks=[early, kept, Timed(), resumable],
    )
    return stage, resumable.history


def write_job(folder, train_batches, validation, sizes, seed):
    """Write what tools/camvid_jax.py reads: the network, its settings, the images, augmented."""
    size = sizes.image_size
    network = build_unet((size, size, 1), cityscapes.N_CLASSES, sizes.base_filters)
    for split, batches in (("train", train_batches), ("val", validation)):
        for kind, images in zip(("images", "labels"), batches.sets[0], strict=True):
            (folder / f"{split}_{kind}").mkdir(parents=True)
            for index, image in enumerate(files.progress(images, f"{split} {kind}", unit="image")):
                path = folder / f"{split}_{kind}" / f"{index:04}.webp"
                # the quality of no loss
                cv2.imwrite(f"{path}", image, [cv2.IMWRITE_WEBP_QUALITY, 101])
    job = {
        "network": json.loads(network.to_json()),
        "class_weights": np.asarray(cityscapes.CLASS_WEIGHTS).tolist(),
        "seed": seed,
    }
    numbers = ("batch_size", "learning_rate", "epochs", "patience")
    job |= {name: getattr(sizes, name) for name in numbers}
    files.write_text(folder / "job.json", json.dumps(job))


def read_trained(folder, sizes):
    """Return {seed: (network, history)} of what tools/camvid_jax.py wrote, and where it ran."""
    size = sizes.image_size
    trained = {}
    for path in sorted(folder.glob("seed_*.json")):
        network = build_unet((size, size, 1), cityscapes.N_CLASSES, sizes.base_filters)
        with np.load(path.with_suffix(".npz")) as weights:
            network.set_weights([weights[name].astype(np.float32) for name in weights.files])
        history = pd.DataFrame(json.loads(path.read_text(encoding="utf-8")))
        history.columns = history.columns.str.replace("f1_score", "f1-score")  # the library's name
        trained[int(path.stem.removeprefix("seed_"))] = network, history
    if not trained:
        raise InputError(f"{folder}: TRAINED has no seed_0.json; tools/camvid_jax.py writes it")
    return trained, (folder / "machine.txt").read_text(encoding="utf-8").strip()


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


def example(model, images, labels):
    """Draw the label map of an image by people, and the network's (Figure 4.3)."""
    predicted = prediction.predict(model, images[EXAMPLE : EXAMPLE + 1])[0]
    figure, panels = style.new_figure(1, 2, height=3.4)
    maps = {"label map by people": labels[EXAMPLE], "label map by the network": predicted}
    for panel, (title, label_map) in zip(panels, maps.items(), strict=True):
        style.show_image(panel, cityscapes.colorize(label_map), title)
    known = labels[EXAMPLE][labels[EXAMPLE] < cityscapes.N_CLASSES]
    style.class_legend(figure, known, predicted)
    return figure


def facts_of_training(history, patience):
    """Return {fact: text} of a training: its epochs, and the scores of its last and best epoch."""
    best, last = history.loc[history["val_loss"].idxmin()], history.iloc[-1]
    stopped = last["epoch"] - best["epoch"] >= patience
    facts = {
        "epochs": f"{len(history)}",
        "ended by early stopping": "yes" if stopped else "no: EPOCHS ended it",
        "epoch of the lowest validation loss": f"{best['epoch']:.0f}",
        "seconds an epoch, median": f"{history['seconds'].median():.1f}",
    }
    for prefix, part in (("", "training"), ("val_", "validation")):
        for name, title in SCORES.items():
            values = [f"{row[f'{prefix}{name}']:.3f}" for row in (last, best)]
            facts[f"{title}, {part}, last epoch (best epoch)"] = "{} ({})".format(*values)
    return facts


def table_of_training(histories, patience):
    """Return one row a fact, one column a training, and what the thesis reports of Cityscapes."""
    facts = {
        f"CamVid, seed {seed}": facts_of_training(history, patience)
        for seed, history in histories.items()
    }
    reported = REPORTED["segmentation_results"]
    thesis = {"epochs": "24", "ended by early stopping": "yes"} | {
        f"{title}, {part}, last epoch (best epoch)": str(reported[key][REPORTED_KEYS[name]])
        for part, key in (("training", "train"), ("validation", "validation"))
        for name, title in SCORES.items()
    }
    table = pd.DataFrame(facts | {"Cityscapes, thesis": thesis}).fillna("")
    return table.loc[list(next(iter(facts.values())))].rename_axis("training").reset_index()


def streets(settings, labels, out, note):
    """Compare masks from the label maps with all keypoints, and write the table."""
    names = tuple(kitti.sequences(settings.kitti))
    study = Study(
        settings.kitti,
        names,
        (Source(labels),),
        (CONTROL_WIDTH,),
        estimators=("refined", "thesis"),
        repetitions=settings.sizes.repetitions,
    )
    folder = settings.build.parent / "camvid" / "study"
    table = comparisons.comparisons_of(study.run(folder, settings.jobs).table)
    over_all = table[(table["reference"] == "baseline") & (table["method"] == "masked")]
    style.save_table(comparison.table_of_ratios(comparison.all_of(over_all)), out, "streets", note)


def main(camvid, job="", trained=""):
    """Train, or read trainings, and write what they give."""
    if not camvid:
        raise InputError("CAMVID: give the folder that holds train, trainannot, val and valannot")
    settings = read_settings()
    sizes = settings.sizes
    thesis_sizes = PROFILES["thesis"]
    named = [f"{sizes.image_size}", f"{sizes.base_filters}", f"{sizes.training_images or 'all'}"]
    root = settings.build.parent / "camvid" / "-".join(named)
    is_thesis = settings.profile == "thesis" and all(
        getattr(sizes, name) == getattr(thesis_sizes, name)
        for name in ("image_size", "base_filters", "batch_size", "training_images")
    )
    out = ROOT / "figures" / "camvid" if is_thesis else root / "figures"
    train_batches, validation, held_out = batches_of(folder(camvid), sizes, settings.seed)
    if job:
        write_job(Path(job), train_batches, validation, sizes, settings.seed)
        program.summary(f"{job}: written; tools/camvid_jax.py trains it")
        return
    if trained:
        networks, machine = read_trained(Path(trained), sizes)
    else:
        stage, history = train(train_batches, validation, sizes, root / "training", settings.seed)
        networks = {settings.seed: (training.load_model(stage / BEST), history)}
        machine = timing.processor()
    histories = {seed: history for seed, (_, history) in networks.items()}
    model, history = next(iter(networks.values()))
    size = f"{sizes.base_filters} filters, {sizes.image_size}x{sizes.image_size} pixels"
    note = f"the thesis's network, {size}, trained on CamVid; {machine}"
    style.save_figure(curves(history), out, "figure_4_01", note)
    rows = pd.concat([rows.assign(seed=seed) for seed, rows in histories.items()])
    provenance.write_table(out / "figure_4_01.csv", rows)
    style.save_figure(example(model, *held_out), out, "figure_4_03", f"{note}; CamVid, validation")
    absent = (
        f"{note}; F1 and IoU: means over {cityscapes.N_CLASSES} outputs, absent classes score 1"
    )
    style.save_table(table_of_training(histories, sizes.patience), out, "training", absent)
    domains = {"CamVid, validation": cityscapes.pairs(folder(camvid), "val")}
    if settings.kitti_semantic:
        domains["KITTI's street scenes"] = cityscapes.pairs(settings.kitti_semantic, "train")
    by_seed = {f"seed {seed}": model for seed, (model, _) in networks.items()}
    scores = domain_gap.scores_of_models(by_seed, domains)
    style.save_table(domain_gap.table_of_scores(scores), out, "scores", note)
    if not settings.kitti_is_embedded:
        name = next(iter(by_seed))  # label maps take minutes, so only the first network makes them
        labels = root / "labels" / f"CamVid, {name}"
        for street in kitti.sequences(settings.kitti):
            paths = Sequence(settings.kitti, street).frame_paths
            prediction.write_label_maps(model, paths, labels / street)
        streets(settings, labels, out, note)
    program.summary(f"curves, scores and an example: {out}")


if __name__ == "__main__":
    program.run_main(lambda: main(*sys.argv[1:]))
