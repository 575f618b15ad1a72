"""How long a series of runs would take on this machine: the real code is timed on a few frames, and multiplied.

Times are those of one core; a busy machine easily changes them by a third.
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
from thesis_repro.study.sources import Source

SHORT, LONG = 3, 9  # frames that are timed: the difference leaves out what a run costs once
LABEL_MAP_BYTES, ROW_BYTES = 6_000, 450  # of a label map, and of a frame of a run
NOTEBOOK_SECONDS = 16  # that a notebook takes however few frames there are: imports, figures, small examples
RUNS_IN_07 = 7  # what notebook 7 costs a frame of its one sequence, in runs with all keypoints


def of_study(study: Study) -> dict[str, Any]:
    """What a study with masks of one's own would take, see `_plan`."""
    frames = {name: len(kitti.Sequence(study.kitti, name).subset(study.frames)) for name in study.sequences}
    name, total, first = _to_time(frames), sum(frames.values()), study.first_jobs()
    chosen = [job for job in first if job.sequence == name]
    # a limit of keypoints and a distance between them, for each source
    second = 2 * len(study.sources) * len(study.estimators) * study.repetitions if study.tested else 0
    runs = len(first) // len(frames) + second  # of a sequence
    cost = _seconds_a_frame(lambda count, folder: runner.run(chosen, study.kitti, study.sources, folder, frames=count))
    return _plan([("odometry", runs * len(frames), "runs", total * runs * cost / len(chosen))], frames, name,
                 total * runs * ROW_BYTES)


def of_thesis(root: Path, sizes: Profile, training_images: int = 0) -> dict[str, Any]:
    """What the notebooks would take on a KITTI folder, see `_plan`.

    training_images: of the folder, before they are split and doubled; 0 where the model in the package is used.
    Raises InputError where the folder has no sequence that is long enough.
    """
    from thesis_repro.segmentation import quietly

    with quietly():
        from thesis_repro.segmentation import prediction  # here and below: TensorFlow takes seconds to load

    frames = {name: len(kitti.Sequence(root, name).subset(sizes.frames)) for name in kitti.sequences(root)}
    name, total, steps = _to_time(frames), sum(frames.values()), []
    timed_frames = sum(min(count, sizes.timed_frames) for count in frames.values())
    model, sequence = prediction.load_shipped(), kitti.Sequence(root, name)
    chosen = jobs.first_jobs(root, [name], {"thesis": sizes.widths, "refined": []}, tested=jobs.CONTROL_WIDTH,
                             repetitions=sizes.repetitions)
    # of a sequence; with the plainly reduced ones, "fewer" and "spread"
    runs = len(chosen) + (1 + 2 * len(jobs.ESTIMATORS)) * sizes.repetitions

    def predict(count: int, folder: Path) -> None:
        prediction.write_label_maps(model, sequence.subset(count).frame_paths, folder / name)

    with TemporaryDirectory() as folder:
        labels = Path(folder)
        predict(LONG, labels)
        label_map = _seconds_a_frame(predict)
        of_chosen = _seconds_a_frame(lambda count, folder: runner.run(chosen, root, [Source(labels)], folder,
                                                                      frames=count))
        alone = _seconds_a_frame(lambda count, _: odometry.run(sequence.subset(count)))
        of_ablated = _seconds_a_frame(lambda count, folder: ablations.measure(root, [name], labels, folder,
                                                                              frames=count))
    if training_images:
        label_map, training = _network_seconds(sizes)
        images = 2 * min(training_images, sizes.training_images or training_images)  # once more, augmented
        seconds = images * sizes.epochs * (0.8 * training + 0.2 * label_map)
        steps.append(("04: training", sizes.epochs, "epochs", seconds))
    notebooks, in_07 = 9 if training_images else 6, frames[min(frames)]
    steps += [("05: label maps", total, "frames", total * label_map),
              ("07: one sequence", in_07, "frames", in_07 * RUNS_IN_07 * alone),
              ("08: odometry", runs * len(frames), "runs", total * runs * of_chosen / len(chosen)),
              ("08: timing of every width", timed_frames, "frames", timed_frames * (len(sizes.widths) + 1) * alone),
              ("09: ablations", total, "frames", total * of_ablated)]
    return _plan(steps, frames, name, total * (LABEL_MAP_BYTES + runs * ROW_BYTES), notebooks * NOTEBOOK_SECONDS)


def _plan(steps: list[tuple[str, int, str, float]], frames: dict[str, int], timed: str, disk: float, once: float = 0
          ) -> dict[str, Any]:
    """steps: name, number, of what, and the seconds of one core. frames: by sequence. timed: which. disk: bytes. once:
    seconds that more cores do not shorten."""
    seconds = sum(step[-1] for step in steps)
    return {"steps": steps, "once": once, "seconds": once + seconds, "cores": cores(),
            "on_all_cores": once + seconds / cores(), "sequences": len(frames), "frames": sum(frames.values()),
            "timed": timed, "timed_frames": LONG, "disk": disk, "fewest": compare.MIN_SEQUENCES}


def _to_time(lengths: dict[str, int]) -> str:
    """The longest sequence, whose first frames are timed."""
    name = max(lengths, key=lambda name: lengths[name])
    if lengths[name] < LONG:
        raise InputError(f"the sequences are too short to plan from; one of {LONG} frames or more is needed")
    return name


def _seconds_a_frame(run: Callable[[int, Path], Any]) -> float:
    """CPU seconds a frame of run(frames, folder), without what a run costs once."""
    seconds = []
    for count in (SHORT, SHORT, LONG):  # the first one loads compiled code
        with TemporaryDirectory() as folder, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            started = time.process_time()
            run(count, Path(folder))
            seconds.append(time.process_time() - started)
    return max(seconds[2] - seconds[1], 0) / (LONG - SHORT)


def _network_seconds(sizes: Profile) -> tuple[float, float]:
    """CPU seconds of a prediction and of a step of the training, for each image, of a network of one's own."""
    import keras

    from thesis_repro.segmentation import prediction, training
    from thesis_repro.segmentation.unet import build_unet

    model = build_unet((sizes.image_size, sizes.image_size, 1), cityscapes.N_CLASSES, sizes.base_filters)
    model.compile(keras.optimizers.Adam(), training.fused_loss(training.total_loss()), metrics=training.metrics())
    images = np.zeros((LONG, *model.input_shape[1:]), np.uint8)
    one_hot = np.zeros((LONG, *model.output_shape[1:]), np.float32)
    return (_seconds_a_frame(lambda count, _: prediction.predict(model, images[:count])),
            _seconds_a_frame(lambda count, _: model.fit(images[:count].astype(np.float32), one_hot[:count], SHORT)))
