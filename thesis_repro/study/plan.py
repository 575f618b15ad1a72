"""How long a series of runs would take on this machine: the real code is timed on a few frames, and multiplied.

Times are those of one core; a busy machine easily changes them by a third.
"""

import os
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from thesis_repro import InputError, cityscapes, kitti, odometry
from thesis_repro.files import progress
from thesis_repro.settings import Profile
from thesis_repro.study import ablations, jobs, runner
from thesis_repro.study.series import Study
from thesis_repro.study.sources import Source

SHORT, LONG = 3, 9  # frames that are timed: the difference leaves out what a run costs once
PLACES = 2  # sequences on which they are timed, at the most
IMAGES = 4  # on which a network is timed
LABEL_MAP_BYTES, ROW_BYTES = 6_000, 450  # of a label map, and of a frame of a run
RUNS_OF_07 = 2 * 12 + 3  # of notebook 07, over one sequence


@dataclass(frozen=True)
class Step:
    """What is done, how many times in words, and the seconds that it takes one core."""

    name: str
    number: str
    seconds: float


def duration(seconds: float) -> str:
    """Minutes below an hour, hours above."""
    return f"{seconds / 60:.1f} minutes" if seconds < 3600 else f"{seconds / 3600:.1f} hours"


def of_study(study: Study) -> str:
    """What a study with masks of one's own would take, for reading."""
    frames = {name: len(kitti.Sequence(study.kitti, name).subset(study.frames)) for name in study.sequences}
    first = study.first_jobs()
    # a limit of keypoints and a distance between them, for each source
    second = 2 * len(study.sources) * len(study.estimators) * study.repetitions if study.tested else 0
    runs = len(first) // len(frames) + second  # of a sequence
    places = _places(frames)
    with _pool() as pool, progress(places, "timing", unit="sequence") as timed:
        each = [pool.submit(_study_seconds, study, name).result() for name in timed]
    steps = [Step("odometry", f"{runs * len(frames):,} runs", sum(frames.values()) * runs * float(np.mean(each)))]
    return text(steps, frames, places, runs * sum(frames.values()) * ROW_BYTES)


def of_thesis(root: Path, sizes: Profile, complete: bool = False, training_images: int = 0) -> str:
    """What the notebooks would take on a KITTI folder, or on the complete benchmark, for reading.

    training_images: of the folder, before they are split and doubled; 0 where the model in the package is used.
    Raises InputError where the folder has no sequence that is long enough.
    """
    lengths = {name: len(kitti.Sequence(root, name)) for name in kitti.sequences(root)}
    places = _places(lengths)
    frames = {name: min(count, sizes.frames or count)
              for name, count in (kitti.FRAME_COUNTS if complete else lengths).items()}
    with _pool() as pool, progress(places, "timing", unit="sequence") as timed:
        costs = [pool.submit(_thesis_seconds, root, name, sizes).result() for name in timed]
        network, training = pool.submit(_network_seconds, sizes).result() if training_images else (0.0, 0.0)
    cost = {key: float(np.mean([each[key] for each in costs])) for key in costs[0]}
    total, repetitions = sum(frames.values()), sizes.repetitions
    counts = [len(_thesis_jobs(root, name, sizes)) + (1 + 2 * len(jobs.ESTIMATORS)) * repetitions for name in lengths]
    runs = round(float(np.mean(counts)))  # of a sequence; with the plainly reduced ones, "fewer" and "spread"
    timed_frames = sum(min(count, sizes.timed_frames) for count in frames.values())
    steps = []
    if training_images:
        images = 2 * min(training_images, sizes.training_images or training_images)  # once more, augmented
        steps.append(Step("04: training", f"{sizes.epochs} epochs of {round(0.8 * images):,} images",
                          images * sizes.epochs * (0.8 * training + 0.2 * network)))
    steps += [
        Step("05: label maps", f"{total:,} frames", total * (network or cost["label map"])),
        Step("07: odometry", f"{RUNS_OF_07} runs", next(iter(frames.values())) * RUNS_OF_07 * cost["ablation"]),
        Step("08: odometry", f"{runs * len(frames):,} runs", total * runs * cost["run"]),
        Step("08: timing of every width", f"{timed_frames:,} frames",
             timed_frames * (len(sizes.widths) + 1) * cost["single run"]),
        Step("09: ablations", f"{int(cost['ablations']) * len(frames):,} runs",
             total * cost["ablations"] * cost["ablation"])]
    return text(steps, frames, places, total * (LABEL_MAP_BYTES + runs * ROW_BYTES))


def text(steps: Iterable[Step], frames: dict[str, int], places: Iterable[str], disk: float) -> str:
    """The plan for reading; disk: bytes."""
    steps, cores = list(steps), os.cpu_count() or 1
    everything = sum(step.seconds for step in steps)
    rows = [(step.name, step.number, duration(step.seconds)) for step in steps]
    rows += [("in all, on one core", "", duration(everything)),
             (f"on the {cores} cores of this machine", "", f"about {duration(everything / cores)}")]
    wide = [max(len(row[column]) for row in rows) for column in (0, 1)]
    lines = [f"{name:{wide[0]}}  {number:>{wide[1]}}  {spent}" for name, number, spent in rows]
    return "\n".join([
        f"{len(frames)} sequence{'s' * (len(frames) > 1)}, {sum(frames.values()):,} frames; timed on {LONG} frames "
        f"of {', '.join(places)}", *lines, f"disk: about {disk / 1e9:.2f} GB; masks are made when needed and not kept",
        "A stopped run goes on where it was. A busy machine easily changes these times by a third."])


def _places(lengths: dict[str, int]) -> list[str]:
    long = [name for name, count in lengths.items() if count >= LONG]
    if not long:
        raise InputError(f"the sequences are too short to plan from; one of {LONG} frames or more is needed")
    return sorted({long[index] for index in np.linspace(0, len(long) - 1, PLACES).round().astype(int)})


def _pool() -> ProcessPoolExecutor:
    """A process of its own, since TensorFlow keeps its memory and the bars of single runs say nothing here."""
    return ProcessPoolExecutor(1, get_context("spawn"), _be_silent)


def _be_silent() -> None:
    sys.stdout = sys.stderr = open(os.devnull, "w")


def _study_seconds(study: Study, name: str) -> float:
    """CPU seconds a frame and run of the jobs of one sequence."""
    chosen = [job for job in study.first_jobs() if job.sequence == name]
    return _slope(lambda frames, folder: runner.run(chosen, study.kitti, study.sources, folder, frames=frames)
                  ) / len(chosen)


def _thesis_jobs(root: Path, name: str, sizes: Profile) -> list[jobs.Job]:
    return jobs.first_jobs(root, [name], {"thesis": sizes.widths, "refined": []}, tested=jobs.CONTROL_WIDTH,
                           repetitions=sizes.repetitions)


def _thesis_seconds(root: Path, name: str, sizes: Profile) -> dict[str, float]:
    """CPU seconds a frame on one sequence: of a label map, of a run of notebook 08, of one alone, of an ablation.

    "ablations" is their number.
    """
    from thesis_repro.segmentation import quietly

    with quietly():
        from thesis_repro.segmentation import prediction  # here and below: TensorFlow takes seconds to load

    model, sequence, chosen = prediction.load_shipped(), kitti.Sequence(root, name), _thesis_jobs(root, name, sizes)

    def predict(frames: int, folder: Path) -> None:
        prediction.write_label_maps(model, sequence.subset(frames).frame_paths, folder)

    with TemporaryDirectory() as temporary:
        labels = Path(temporary) / name
        predict(LONG, labels)
        made = ablations.runs_of(sequence.subset(LONG), labels, repetitions=ablations.REPETITIONS,
                                 baseline_repetitions=ablations.BASELINE_REPETITIONS)
        runs = {" ".join(map(str, key)): run for key, run in made.items()}
        return {
            "label map": _slope(predict),
            "run": _slope(lambda frames, folder: runner.run(chosen, root, [Source(Path(temporary))], folder,
                                                            frames=frames)) / len(chosen),
            "single run": _slope(lambda frames, _: odometry.run(sequence.subset(frames))),
            "ablation": _slope(lambda frames, _: odometry.run_many(sequence.subset(frames), runs)) / len(runs),
            "ablations": len(runs)}


def _slope(run: Callable[[int, Path], Any]) -> float:
    """CPU seconds a frame of run(frames, folder), without what a run costs once."""
    seconds = []
    for frames in (SHORT, SHORT, LONG):  # the first one loads compiled code
        with TemporaryDirectory() as folder:
            started = time.process_time()
            run(frames, Path(folder))
            seconds.append(time.process_time() - started)
    return max(seconds[2] - seconds[1], 0) / (LONG - SHORT)


def _network_seconds(sizes: Profile) -> tuple[float, float]:
    """(CPU seconds of a prediction, of a step of the training), for each image, of a network of one's own."""
    import keras

    from thesis_repro.segmentation import prediction, training
    from thesis_repro.segmentation.unet import build_unet

    shape = (IMAGES, sizes.image_size, sizes.image_size)
    model = build_unet((*shape[1:], 1), cityscapes.N_CLASSES, sizes.base_filters)
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (*shape, 1), np.uint8)
    masks = np.eye(cityscapes.N_CLASSES, dtype=np.float32)[random.integers(0, cityscapes.N_CLASSES, shape)]
    model.compile(keras.optimizers.Adam(), training.fused_loss(training.total_loss()), metrics=training.metrics())
    seconds = []
    for work in (lambda: prediction.predict(model, images),
                 lambda: model.train_on_batch(images.astype(np.float32), masks)):
        work()  # compiles
        started = time.process_time()
        work()
        seconds.append((time.process_time() - started) / IMAGES)
    return seconds[0], seconds[1]
