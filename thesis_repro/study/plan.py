"""How long a series of runs would take on this machine: the real code is timed on a few frames, and multiplied.

Times are those of one core; a busy machine easily changes them by a third.
"""

import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from thesis_repro import InputError, cityscapes, kitti, odometry
from thesis_repro.settings import Profile
from thesis_repro.study import ablations, jobs, runner
from thesis_repro.study.series import Study
from thesis_repro.study.sources import Source

SHORT, LONG = 3, 9  # frames that are timed: the difference leaves out what a run costs once
IMAGES = 4  # on which a network is timed
LABEL_MAP_BYTES, ROW_BYTES = 6_000, 450  # of a label map, and of a frame of a run


def of_study(study: Study) -> dict[str, Any]:
    """What a study with masks of one's own would take, see `_plan`."""
    frames = {name: len(kitti.Sequence(study.kitti, name).subset(study.frames)) for name in study.sequences}
    name, total, first = _to_time(frames), sum(frames.values()), study.first_jobs()
    chosen = [job for job in first if job.sequence == name]
    # a limit of keypoints and a distance between them, for each source
    second = 2 * len(study.sources) * len(study.estimators) * study.repetitions if study.tested else 0
    runs = len(first) // len(frames) + second  # of a sequence
    cost = _seconds_a_frame(lambda count, folder: runner.run(chosen, study.kitti, study.sources, folder, frames=count)
                            ) / len(chosen)
    return _plan([("odometry", runs * len(frames), "runs", total * runs * cost)], frames, name,
                 total * runs * ROW_BYTES)


def of_thesis(root: Path, sizes: Profile, complete: bool = False, training_images: int = 0) -> dict[str, Any]:
    """What the notebooks would take on a KITTI folder, or on the complete benchmark, see `_plan`.

    training_images: of the folder, before they are split and doubled; 0 where the model in the package is used.
    Raises InputError where the folder has no sequence that is long enough.
    """
    lengths = {name: len(kitti.Sequence(root, name)) for name in kitti.sequences(root)}
    name = _to_time(lengths)
    frames = {name: min(count, sizes.frames or count)
              for name, count in (kitti.FRAME_COUNTS if complete else lengths).items()}
    total = sum(frames.values())
    timed_frames = sum(min(count, sizes.timed_frames) for count in frames.values())
    cost = _costs(root, name, sizes)
    network, training = _network_seconds(sizes) if training_images else (cost["label map"], 0.0)
    # of a sequence; with the plainly reduced ones, "fewer" and "spread"
    runs = int(cost["runs"]) + (1 + 2 * len(jobs.ESTIMATORS)) * sizes.repetitions
    steps = []
    if training_images:
        images = 2 * min(training_images, sizes.training_images or training_images)  # once more, augmented
        steps.append(("04: training", sizes.epochs, "epochs", images * sizes.epochs * (0.8 * training + 0.2 * network)))
    steps += [("05: label maps", total, "frames", total * network),
              ("08: odometry", runs * len(frames), "runs", total * runs * cost["run"]),
              ("08: timing of every width", timed_frames, "frames",
               timed_frames * (len(sizes.widths) + 1) * cost["single run"]),
              ("09: ablations", int(cost["ablations"]) * len(frames), "runs",
               total * cost["ablations"] * cost["ablation"])]
    return _plan(steps, frames, name, total * (LABEL_MAP_BYTES + runs * ROW_BYTES))


def _plan(steps: list[tuple[str, int, str, float]], frames: dict[str, int], timed: str, disk: float) -> dict[str, Any]:
    """steps: name, number, of what, and the seconds of one core. frames: by sequence. timed: which. disk: bytes."""
    return {"steps": steps, "seconds": sum(step[-1] for step in steps), "sequences": len(frames),
            "frames": sum(frames.values()), "timed": timed, "timed_frames": LONG, "disk": disk}


def _to_time(lengths: dict[str, int]) -> str:
    """The longest sequence, whose first frames are timed."""
    name = max(lengths, key=lambda name: lengths[name])
    if lengths[name] < LONG:
        raise InputError(f"the sequences are too short to plan from; one of {LONG} frames or more is needed")
    return name


def _costs(root: Path, name: str, sizes: Profile) -> dict[str, float]:
    """CPU seconds a frame on one sequence: of a label map, of a run of notebook 08, of one alone, of an ablation.

    "runs" and "ablations" are their numbers.
    """
    from thesis_repro.segmentation import quietly

    with quietly():
        from thesis_repro.segmentation import prediction  # here and below: TensorFlow takes seconds to load

    model, sequence = prediction.load_shipped(), kitti.Sequence(root, name)
    chosen = jobs.first_jobs(root, [name], {"thesis": sizes.widths, "refined": []}, tested=jobs.CONTROL_WIDTH,
                             repetitions=sizes.repetitions)

    def predict(frames: int, folder: Path) -> None:
        prediction.write_label_maps(model, sequence.subset(frames).frame_paths, folder)

    with TemporaryDirectory() as folder:
        predict(LONG, Path(folder) / name)
        ablated = {" ".join(map(str, key)): run for key, run in ablations.runs_of(
            sequence.subset(LONG), Path(folder) / name).items()}
        labels = [Source(Path(folder))]
        return {
            "label map": _seconds_a_frame(predict),
            "run": _seconds_a_frame(lambda frames, folder: runner.run(chosen, root, labels, folder, frames=frames)
                                    ) / len(chosen),
            "single run": _seconds_a_frame(lambda frames, _: odometry.run(sequence.subset(frames))),
            "ablation": _seconds_a_frame(lambda frames, _: odometry.run_many(sequence.subset(frames), ablated)
                                         ) / len(ablated),
            "runs": len(chosen), "ablations": len(ablated)}


def _seconds_a_frame(run: Callable[[int, Path], Any]) -> float:
    """CPU seconds a frame of run(frames, folder), without what a run costs once."""
    seconds = []
    for frames in (SHORT, SHORT, LONG):  # the first one loads compiled code
        with TemporaryDirectory() as folder:
            seconds.append(_timed(partial(run, frames, Path(folder))))
    return max(seconds[2] - seconds[1], 0) / (LONG - SHORT)


def _timed(work: Callable[[], Any]) -> float:
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # bars of single runs
        started = time.process_time()
        work()
        return time.process_time() - started


def _network_seconds(sizes: Profile) -> tuple[float, float]:
    """(CPU seconds of a prediction, of a step of the training), for each image, of a network of one's own."""
    import keras

    from thesis_repro.segmentation import prediction, training
    from thesis_repro.segmentation.unet import build_unet

    shape = (IMAGES, sizes.image_size, sizes.image_size)
    model = build_unet((*shape[1:], 1), cityscapes.N_CLASSES, sizes.base_filters)
    images = np.zeros((*shape, 1), np.uint8)
    masks = np.zeros((*shape, cityscapes.N_CLASSES), np.float32)
    model.compile(keras.optimizers.Adam(), training.fused_loss(training.total_loss()), metrics=training.metrics())
    predict, train = ([_timed(work) for _ in range(2)] for work in (  # the first time, they are compiled
        lambda: prediction.predict(model, images), lambda: model.train_on_batch(images.astype(np.float32), masks)))
    return predict[1] / IMAGES, train[1] / IMAGES
