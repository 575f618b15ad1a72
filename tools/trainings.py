"""Measure how much another training of the same network changes what masks do (embedded world).

usage: make figures && python tools/trainings.py

Trains the network of the default run again with other seeds, which choose the initial weights and
the order of the images. Every network then predicts label maps for the same drives, and masks from
them are compared with all keypoints. Writes figures/trainings.csv: for each training a digest of
its weights, the quality of its label maps, the ratios of errors with their intervals, and the mean
of Table 4.2. A stopped run resumes.
"""

import sys

from thesis_repro import segmentation  # noqa: F401  sets what TensorFlow reads at its import

# isort: split
import keras
import numpy as np
import pandas as pd
import tensorflow as tf

from keypoint_study import comparisons, jobs, runner, verdicts
from keypoint_study.sources import Source
from thesis.settings import ROOT, read_settings
from thesis_repro.data import cityscapes, kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import WIDTHS
from thesis_repro.running import files, program, provenance, workers
from thesis_repro.segmentation import prediction, quality, training
from thesis_repro.segmentation.unet import build_unet

sys.path.append(str(ROOT / "notebooks"))

# isort: split
from thesis import domain_gap, section_4_2
from thesis.trainings import TABLE

SEEDS = range(10)  # the first one is the default run's
METRICS = (*comparisons.JUDGING_METRICS, "rmse")
DECIDING = "refined"  # estimator, as in comparisons.judging_estimator


def train(settings, seed):
    """Return the file of the network that notebooks 3 and 4 train if `seed` is their seed."""
    if seed == settings.seed:
        return files.needed(settings.build / "model" / training.MODEL, "04_training")
    data, sizes = settings.build / "data", settings.sizes
    arrays = {
        name: np.load(files.needed(data / f"doubled_{name}.npy", "02_augmentation"))
        for name in ("train_images", "train_labels", "validation_images", "validation_labels")
    }
    batches = training.Batches(
        [(arrays["train_images"], arrays["train_labels"])], sizes.batch_size, seed
    )
    validation = training.Batches(
        [(arrays["validation_images"], arrays["validation_labels"])], sizes.batch_size
    )
    keras.utils.set_random_seed(seed)
    model = build_unet(arrays["train_images"].shape[1:], cityscapes.N_CLASSES, sizes.base_filters)
    rate = sizes.learning_rate
    if sizes.rate_falls:
        rate = training.falling_rate(rate, sizes.epochs, batches)
    model.compile(keras.optimizers.Adam(rate), training.fused_loss(training.total_loss()))
    folder = provenance.stage(
        settings.build / f"trainings/model_{seed}",
        **training.made_from(model, batches, validation),
    )
    stop = keras.callbacks.EarlyStopping(monitor="val_loss", patience=sizes.patience)
    best = keras.callbacks.ModelCheckpoint(
        folder / training.MODEL, monitor="val_loss", save_best_only=True
    )
    resumable = training.ResumableTraining(folder, batches, [stop, best])
    model.fit(
        batches.dataset(),
        validation_data=validation.dataset(),
        epochs=sizes.epochs,
        shuffle=False,
        verbose=0,
        callbacks=[stop, best, resumable],
    )
    return folder / training.MODEL


def label_maps(settings, seed):
    """Train and predict; return the source of masks, and {network, mean_iou} of the training."""
    tf.config.threading.set_intra_op_parallelism_threads(settings.sizes.threads)
    model = training.load_model(train(settings, seed))
    folder = settings.build / f"trainings/labels_{seed}"
    sequences = opened(settings)
    for sequence in sequences:
        prediction.write_label_maps(model, sequence.frame_paths, folder / sequence.name)
    images, true = cityscapes.load(domain_gap.labelled_frames(sequences), *model.input_shape[2:])
    confusion = quality.confusion_matrix(true, prediction.predict(model, images))
    mean_iou, *_ = quality.cityscapes_scores(confusion)
    facts = {"network": training.weights_digest(model), "mean_iou": mean_iou}
    return Source(folder, name=f"seed {seed}"), facts


def opened(settings):
    """Return the drives of the embedded world, shortened as for notebook 8."""
    return [
        Sequence(settings.kitti, name).subset(settings.sizes.frames)
        for name in kitti.sequences(settings.kitti)
    ]


def run(settings, sources):
    """Return the table of the runs that Table 4.2, the comparison and its verdicts need."""
    sequences, repetitions = opened(settings), settings.sizes.repetitions
    folder = settings.build / "trainings/odometry"
    first = jobs.first_jobs(
        sequences,
        {"thesis": WIDTHS, DECIDING: []},
        tested=jobs.CONTROL_WIDTH,
        sources=sources,
        repetitions=repetitions,
    )
    runs = jobs.runs_of(filter(is_needed, first), sequences, sources)
    table = runner.run_all(runs, folder, processes=settings.jobs).table
    more = runner.keypoint_controls(
        table, sequences, sources, repetitions, jobs.CONTROL_WIDTH, [DECIDING]
    )
    runs |= jobs.runs_of(more, sequences, sources)
    return runner.run_all(runs, folder, processes=settings.jobs).table


def is_needed(job):
    """Say whether a column of TABLE is made from a run."""
    if job.method in comparisons.SEGMENTATION_FREE_CONTROLS:
        return job.estimator == DECIDING
    is_tested = job.dilation_width in (None, jobs.CONTROL_WIDTH)
    return job.method in ("baseline", "masked") and (is_tested or job.repetition == 0)


def rows(runs, comparison, source, facts):
    """Yield one row for each estimator, for one training."""
    own = comparisons.of_source(runs, source.name)
    is_masked = (comparison["source"] == source.name) & (comparison["method"] == "masked")
    table = comparison[is_masked & comparison["tested"]]
    for estimator in ("thesis", DECIDING):
        pairs = table[table["estimator"] == estimator]
        of_all = pairs[pairs["reference"] == "baseline"].set_index("metric")
        row = {
            "training": source.name,
            **facts,
            "estimator": estimator,
            "keypoints": of_all["keypoints"].iloc[0],
        }
        for metric in METRICS:
            for end in ("ratio", "low", "high"):
                row[f"{metric}_{end}"] = of_all.loc[metric, end]
        row["verdict"] = comparisons.verdict_of(of_all.loc[list(comparisons.JUDGING_METRICS)])
        if estimator == DECIDING:
            judging = pairs[
                pairs["decides"] & pairs["reference"].isin(comparisons.SEGMENTATION_FREE_CONTROLS)
            ]
            of_controls = judging.groupby("reference")[["low", "high", "n"]]
            beaten = of_controls.apply(comparisons.verdict_of) == verdicts.LOWER
            row["controls_beaten"] = beaten.sum()
        else:
            masked, baseline = (comparisons.of_method(own, name) for name in ("masked", "baseline"))
            best = section_4_2.of_chosen_width(masked)
            changes = section_4_2.changes(best, baseline, "rmse")
            row["table_4_2_mean"] = changes.mean()
            row["table_4_2_improved"] = (changes < 0).sum()
        yield row


def main():
    """Write TABLE; the settings are those of the default run."""
    settings = read_settings()
    calls = [(settings, seed) for seed in SEEDS]
    with workers.open_pool(settings.jobs) as pool:  # a training uses one core, so several run
        made = pool.run(label_maps, calls)
        trained = list(files.progress(made, "trainings", len(calls), "network"))
    runs = run(settings, [source for source, _ in trained])
    comparison = comparisons.comparisons_of(runs)
    table = pd.DataFrame(
        row for source, facts in trained for row in rows(runs, comparison, source, facts)
    )
    files.write_text(TABLE, table.round(4).to_csv(index=False))
    print(table.round(3).to_string(index=False))


if __name__ == "__main__":
    program.run_main(main)
