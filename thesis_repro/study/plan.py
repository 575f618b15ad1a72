"""Estimate how long runs take on this machine: the code is timed on a few frames and the times are
multiplied.

Times are for one core. On a busy machine they can be wrong by a third.
"""

import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from thesis_repro import InputError, cityscapes, kitti, odometry
from thesis_repro.settings import Profile, cores
from thesis_repro.study import ablations, compare, jobs, runner
from thesis_repro.study.series import Study

# frames of two timed runs: their difference leaves out the cost of starting a run
SHORT, LONG = 3, 9
LABEL_MAP_BYTES, ROW_BYTES = 6_000, 450  # of a label map, and of a frame of a run
# of a notebook, whatever the number of frames: imports, figures, small examples
NOTEBOOK_SECONDS = 16
RUNS_IN_07 = 7  # cost of notebook 7, in runs with all keypoints over its sequence


def of_study(study: Study) -> dict[str, Any]:
    """Return the plan of a study with your own masks, see `_plan`."""
    frames = {sequence.name: len(sequence) for sequence in study.opened()}
    name, total, first_jobs = _longest(frames), sum(frames.values()), study.first_jobs()
    timed_jobs = [job for job in first_jobs if job.sequence == name]
    # the keypoint controls of each source cannot be timed before the masked runs are done
    later_runs = (
        study.repetitions * len(study.estimators) * len(study.sources) * len(jobs.KEYPOINT_CONTROLS)
    )
    runs = len(first_jobs) // len(frames) + (later_runs if study.tested else 0)  # of a sequence
    cost = _seconds_a_frame(
        lambda count, folder: runner.run(
            timed_jobs, study.kitti, study.sources, folder, frames=count
        )
    )
    return _plan(
        [("odometry", runs * len(frames), "runs", total * runs * cost / len(timed_jobs))],
        frames,
        name,
        total * runs * ROW_BYTES,
    )


def of_thesis(root: Path, sizes: Profile, training_images: int = 0) -> dict[str, Any]:
    """Return the plan of the notebooks on a KITTI folder, see `_plan`.

    training_images: number of them before the split and the augmentation; 0 if the model in the
    package is used.
    Raises InputError if no sequence is long enough to be timed.
    """
    from thesis_repro.segmentation import quietly

    with quietly():
        # imported here because TensorFlow takes seconds to load
        from thesis_repro.segmentation import prediction

    frames = {
        name: len(kitti.Sequence(root, name).subset(sizes.frames)) for name in kitti.sequences(root)
    }
    name, total, steps = _longest(frames), sum(frames.values()), []
    timed_frames = sum(min(count, sizes.timed_frames) for count in frames.values())
    model, sequence = prediction.load_shipped(), kitti.Sequence(root, name)
    timed_jobs = jobs.first_jobs(
        root,
        [name],
        {"thesis": sizes.widths, "refined": []},
        tested=jobs.CONTROL_WIDTH,
        repetitions=sizes.repetitions,
    )
    # runs of a sequence; the reduced run and the keypoint controls cannot be timed yet
    runs = (
        len(timed_jobs)
        + (1 + len(jobs.KEYPOINT_CONTROLS) * len(jobs.ESTIMATORS)) * sizes.repetitions
    )

    def predict(count: int, folder: Path) -> None:
        prediction.write_label_maps(model, sequence.subset(count).frame_paths, folder / name)

    with TemporaryDirectory() as folder:
        labels = Path(folder)
        predict(LONG, labels)
        label_map = _seconds_a_frame(predict)
        all_jobs = _seconds_a_frame(
            lambda count, folder: runner.run(timed_jobs, root, labels, folder, frames=count)
        )
        one_run = _seconds_a_frame(lambda count, _: odometry.run(sequence.subset(count)))
        all_ablations = _seconds_a_frame(
            lambda count, folder: ablations.measure(root, [name], labels, folder, frames=count)
        )
    if training_images:
        label_map, training = _network_seconds(sizes)
        # original and augmented ones
        images = 2 * min(training_images, sizes.training_images or training_images)
        seconds = images * sizes.epochs * (0.8 * training + 0.2 * label_map)
        steps.append(("04: training", sizes.epochs, "epochs", seconds))
    notebooks, in_07 = 9 if training_images else 6, frames[min(frames)]
    steps += [
        ("05: label maps", total, "frames", total * label_map),
        ("07: one sequence", in_07, "frames", in_07 * RUNS_IN_07 * one_run),
        ("08: odometry", runs * len(frames), "runs", total * runs * all_jobs / len(timed_jobs)),
        (
            "08: timing of every width",
            timed_frames,
            "frames",
            timed_frames * (len(sizes.widths) + 1) * one_run,
        ),
        ("09: ablations", total, "frames", total * all_ablations),
    ]
    return _plan(
        steps,
        frames,
        name,
        total * (LABEL_MAP_BYTES + runs * ROW_BYTES),
        notebooks * NOTEBOOK_SECONDS,
    )


def _plan(
    steps: list[tuple[str, int, str, float]],
    frames: dict[str, int],
    timed: str,
    disk: float,
    once: float = 0,
) -> dict[str, Any]:
    """Return a plan as a record for the template plan.txt.j2.

    steps: (name, number, unit, seconds on one core). frames: by sequence. timed: name of the timed
    sequence.
    disk: bytes. once: seconds that more cores do not shorten.
    """
    seconds = sum(step[-1] for step in steps)
    return {
        "steps": steps,
        "once": once,
        "seconds": once + seconds,
        "cores": cores(),
        "on_all_cores": once + seconds / cores(),
        "sequences": len(frames),
        "frames": sum(frames.values()),
        "timed": timed,
        "timed_frames": LONG,
        "disk": disk,
        "fewest": compare.MIN_SEQUENCES,
    }


def _longest(frames: dict[str, int]) -> str:
    """Return the longest sequence, whose first frames are timed."""
    name = max(frames, key=lambda name: frames[name])
    if frames[name] < LONG:
        raise InputError(
            f"the sequences are too short to plan from; one of {LONG} frames or more is needed"
        )
    return name


def _seconds_a_frame(run: Callable[[int, Path], Any]) -> float:
    """Return the CPU seconds of run(frames, folder) for each frame, without the cost of
    starting a run.
    """
    seconds = []
    for count in (SHORT, SHORT, LONG):  # the first run loads compiled code
        with (
            TemporaryDirectory() as folder,
            redirect_stdout(StringIO()),
            redirect_stderr(StringIO()),
        ):
            started = time.process_time()
            run(count, Path(folder))
            seconds.append(time.process_time() - started)
    return max(seconds[2] - seconds[1], 0) / (LONG - SHORT)


def _network_seconds(sizes: Profile) -> tuple[float, float]:
    """Return the CPU seconds, for each image, of a prediction and of a training step of a new
    network.
    """
    import keras

    from thesis_repro.segmentation import prediction, training
    from thesis_repro.segmentation.unet import build_unet

    model = build_unet(
        (sizes.image_size, sizes.image_size, 1), cityscapes.N_CLASSES, sizes.base_filters
    )
    model.compile(
        keras.optimizers.Adam(),
        training.fused_loss(training.total_loss()),
        metrics=training.metrics(),
    )
    images = np.zeros((LONG, *model.input_shape[1:]), np.uint8)
    one_hot = np.zeros((LONG, *model.output_shape[1:]), np.float32)
    return (
        _seconds_a_frame(lambda count, _: prediction.predict(model, images[:count])),
        _seconds_a_frame(
            lambda count, _: model.fit(images[:count].astype(np.float32), one_hot[:count], SHORT)
        ),
    )
