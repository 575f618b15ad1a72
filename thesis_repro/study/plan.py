"""How long a series of runs would take: jobs, CPU and wall hours, memory and disk, from a short calibration.

The calibration runs the real code on a few frames from several places of the user's own KITTI: for the thesis's runs
network, training and all, for a study with masks of one's own on these.
"""

import heapq
import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from thesis_repro import InputError, cityscapes, kitti, odometry
from thesis_repro.files import progress, write_text
from thesis_repro.odometry import passes
from thesis_repro.settings import PROFILES, Profile
from thesis_repro.study import budget, controls, jobs, results, runner
from thesis_repro.study.series import Study
from thesis_repro.study.sources import Source

EXCERPTS, FRAMES, FIRST = 3, 6, 2  # at most; frames of each, of which the first ones stand for what each run costs once
ENOUGH = 30  # seconds after which no further excerpt is begun
MOST_REPETITIONS = 5  # that are calibrated; more cost in proportion
NETWORK_IMAGES, TRAINING_IMAGES = 8, 2  # on which a network is timed, and one step of its training
NAME = "00"  # of every excerpt
SHIPPED, OWN = "the model in the package", "a network of one's own"
FIRST_SERIES, SECOND_SERIES = "baseline, masks, controls that need no result", "reduced, fewer, spread"
CORES = (1, 4, 8, 16, 64)


@dataclass(frozen=True)
class Thesis:
    """The runs of notebook 08 with the sizes of a profile."""

    kitti: Path
    sequences: tuple[str, ...]
    sizes: Profile = PROFILES["thesis"]
    sources: tuple[Source, ...] = ()
    repetitions: int = PROFILES["thesis"].repetitions

    def first_jobs(self) -> list[jobs.Job]:
        """The runs that need no result of others."""
        widths = sorted({*self.sizes.widths, jobs.CONTROL_WIDTH})
        return (jobs.first_jobs(self.sequences, widths, self.repetitions)
                + jobs.mask_control_jobs(self.kitti, self.sequences, self.repetitions))

    def second_jobs(self, summary: pd.DataFrame | None) -> list[jobs.Job]:
        """The others; without a summary what they take from it is made up."""
        if summary is None:
            made_up = pd.DataFrame({"mean_keypoints": 1.0}, index=list(self.sequences))
            return jobs.reduced_jobs(made_up, self.repetitions) + [
                job for name in self.sequences for job in jobs.keypoint_controls(name, 1.0, 1.0, self.repetitions)]
        return (jobs.reduced_jobs(results.best_widths(summary), self.repetitions)
                + jobs.keypoint_control_jobs(results.keypoints_left(summary), self.kitti, repetitions=self.repetitions))


Work: TypeAlias = Thesis | Study


@dataclass(frozen=True)
class Excerpt:
    """What one excerpt cost: CPU seconds a frame, for all jobs of a sequence unless it says otherwise."""

    where: str
    jobs: dict[str, int]  # for a sequence, by series
    series: dict[str, float]  # CPU seconds a frame, by series
    shared: float  # of these, for what a pass does whatever the number of its jobs: reading, corners, tracking
    row_bytes: float  # of a result, a frame and job
    worker_bytes: int  # memory of a process that runs odometry


@dataclass(frozen=True)
class Calibration:
    """What follows the seconds is of the thesis's runs alone."""

    excerpts: list[Excerpt]
    seconds: float  # that the calibration took
    timing: float = 0.0  # CPU seconds a frame of timing every width
    networks: dict[str, float] = field(default_factory=dict)  # name: CPU seconds a frame
    network_bytes: int = 0  # memory of a process that predicts
    label_bytes: float = 0.0  # of a label map on disk
    training: float = 0.0  # CPU seconds an image of an epoch
    training_bytes: int = 0  # memory of a batch


def counts(root: Path, complete: bool, frames: int | None = None) -> dict[str, int]:
    """Frames by sequence: of the folder, or of the complete benchmark; `frames` of each at most.

    Raises InputError where there are none.
    """
    there = {name: len(kitti.Sequence(root, name)) for name in kitti.sequences(root)}
    return {name: min(count, frames or count) for name, count in (kitti.FRAME_COUNTS if complete else there).items()}


def calibrate(work: Work) -> Calibration:
    """Run everything on a few frames and measure it; about a minute."""
    started = time.perf_counter()
    done: list[Excerpt] = []
    sizes = work.sizes if isinstance(work, Thesis) else None
    with (tempfile.TemporaryDirectory() as temporary,
          progress(None, "calibration", EXCERPTS + 3 * (sizes is not None), unit="step") as bar,
          ProcessPoolExecutor(1, get_context("spawn")) as pool):
        places = _places(work)
        folder = Path(temporary)
        model = _shipped_model() if sizes else None
        for number, (sequence, start) in enumerate(places):
            if number and time.perf_counter() - started > ENOUGH:
                bar.total -= len(places) - number
                break
            where = folder / str(number)
            _copy(sequence, start, where / "kitti")
            label_bytes = _predict(model, where) if sizes else 0.0
            excerpt = _excerpt(work, sequence, start, where)
            done.append(pool.submit(_measure, where, f"{sequence.name} from frame {start}", excerpt).result())
            bar.update()
        if sizes is None:
            return Calibration(excerpts=done, seconds=time.perf_counter() - started)
        timing = pool.submit(_measure_timing, folder / "0", sizes).result()
        bar.update()
        own = _own_model(sizes)
        networks = {SHIPPED: _network_seconds(model), OWN: _network_seconds(own)}
        bar.update()
        network_bytes = peak_memory()
        training, training_bytes = _training(own, sizes)
        bar.update()
        return Calibration(done, time.perf_counter() - started, timing, networks, network_bytes, label_bytes, training,
                           training_bytes)


def _places(work: Work) -> list[tuple[kitti.Sequence, int]]:
    """Up to EXCERPTS sequences with frame numbers, evenly spread over all frames of the work's sequences."""
    root, frames = work.kitti, getattr(work, "frames", None)
    sequences = [kitti.Sequence(root, name).subset(frames) for name in work.sequences]
    ends, found = np.cumsum([len(sequence) for sequence in sequences]), {}
    for position in (np.arange(EXCERPTS) + 0.5) / EXCERPTS * ends[-1]:
        index = int(np.searchsorted(ends, position, side="right"))
        sequence = sequences[index]
        start = min(int(position) - int(ends[index]) + len(sequence), len(sequence) - FRAMES)
        if start >= 0:
            found[sequence.name, start] = sequence, start
    if not found:
        raise InputError(f"{root}: its sequences are too short to plan from; one of {FRAMES} frames or more is needed")
    return list(found.values())


def _copy(sequence: kitti.Sequence, start: int, root: Path) -> None:
    """An excerpt as a sequence of its own."""
    folder, indices = root / "sequences" / NAME, range(start, start + FRAMES)
    camera = sequence.frame_paths[0].parent.name
    frames = folder / (camera if camera in kitti.IMAGE_FOLDERS else "image_0")
    frames.mkdir(parents=True)
    labels = controls.true_labels(sequence.root, sequence.name)
    for index in indices:
        sequence.frame(index)  # says which file is unreadable, if it is
        path = sequence.frame_paths[index]
        shutil.copy(path, frames)
        label = labels / sequence.label_names[index]
        if label.is_file():
            controls.true_labels(root, NAME).mkdir(exist_ok=True)
            shutil.copy(label, controls.true_labels(root, NAME))
    shutil.copy(sequence.folder / "calib.txt", folder)
    write_text(folder / "times.txt", "".join(f"{sequence.times[index]}\n" for index in indices))
    kitti.write_kitti_poses(root / "poses" / f"{NAME}.txt", sequence.poses[start:start + FRAMES])


def _excerpt(work: Work, sequence: kitti.Sequence, start: int, where: Path) -> Work:
    """The work on an excerpt, with copies of its masks; those of the thesis's runs are predicted."""
    chosen = [path.name for path in sequence.frame_paths[start:start + FRAMES]]
    found = []
    for source in work.sources:
        (where / source.name / NAME).mkdir(parents=True)
        for name in chosen:
            shutil.copy(source.of(sequence.name) / name, where / source.name / NAME)
        found.append(replace(source, folder=where / source.name))
    changes: dict[str, Any] = {"kitti": where / "kitti", "sequences": (NAME,),
                               "sources": tuple(found) or (Source(where / "labels"),),
                               "repetitions": min(work.repetitions, MOST_REPETITIONS)}
    return replace(work, **changes, frames=None) if isinstance(work, Study) else replace(work, **changes)


def _shipped_model() -> Any:
    from thesis_repro.segmentation import quietly

    with quietly():
        from thesis_repro.segmentation import prediction  # here and below: TensorFlow takes seconds to load

    return prediction.load_shipped()


def _own_model(sizes: Profile) -> Any:
    from thesis_repro.segmentation.unet import build_unet

    return build_unet((sizes.image_size, sizes.image_size, 1), cityscapes.N_CLASSES, sizes.base_filters)


def _training(model: Any, sizes: Profile) -> tuple[float, int]:
    """(CPU seconds an image, bytes that a batch of the training takes)."""
    import keras

    from thesis_repro.segmentation import memory, training

    random, shape = np.random.default_rng(0), (TRAINING_IMAGES, *model.input_shape[1:3])
    images = random.integers(0, 256, (*shape, 1)).astype(np.float32)
    masks = np.eye(cityscapes.N_CLASSES, dtype=np.float32)[random.integers(0, cityscapes.N_CLASSES, shape)]
    loss = training.fused_loss(training.total_loss())
    model.compile(keras.optimizers.Adam(), loss, metrics=training.metrics())
    model.train_on_batch(images, masks)  # compiles
    seconds = _cpu(lambda: model.train_on_batch(images, masks))[0] / TRAINING_IMAGES
    return seconds, memory.needed(model, sizes.batch_size, training=True)


def _predict(model: Any, where: Path) -> float:
    """Write the label maps of an excerpt; returns their mean size in bytes."""
    from thesis_repro.segmentation import prediction

    labels = where / "labels" / NAME
    prediction.write_label_maps(model, kitti.Sequence(where / "kitti", NAME).frame_paths, labels)
    return float(np.mean([path.stat().st_size for path in labels.glob("*.png")]))


def _network_seconds(model: Any) -> float:
    from thesis_repro.segmentation import prediction

    images = np.random.default_rng(0).integers(0, 256, (NETWORK_IMAGES, *model.input_shape[1:]), np.uint8)
    prediction.predict(model, images[:1])  # compiles
    return _cpu(lambda: prediction.predict(model, images))[0] / NETWORK_IMAGES


def _measure(where: Path, name: str, work: Work) -> Excerpt:
    """One excerpt, in a process without the network."""
    _be_silent()
    root, whole, start, loaded = work.kitti, where / "whole", where / "start", where / "loaded"
    first = work.first_jobs()
    runner.run(first, root, work.sources, loaded, frames=FIRST)  # loads compiled code
    series = {FIRST_SERIES: _slope(first, work, start, whole)}
    summary = runner.run(first, root, work.sources, whole)
    second = work.second_jobs(summary)
    series[SECOND_SERIES] = _slope(second, work, start, whole) if second else 0.0
    files = list((whole / NAME).rglob("*-*.csv"))

    alone, result = _cpu(lambda: odometry.run_many(kitti.Sequence(root, NAME), {"": (odometry.THESIS, None)}))
    alone -= result[""].frames[["essential_seconds", "pose_seconds"]].sum().sum()
    row_bytes = sum(path.stat().st_size for path in files) / len(files) / FRAMES
    return Excerpt(where=name, jobs={FIRST_SERIES: len(first), SECOND_SERIES: len(second)}, series=series,
                   shared=max(alone, 0) / FRAMES, row_bytes=row_bytes, worker_bytes=peak_memory())


def _slope(some: list[jobs.Job], work: Work, start: Path, whole: Path) -> float:
    """CPU seconds a frame of some jobs, without what they cost once."""
    few, _ = _cpu(lambda: runner.run(some, work.kitti, work.sources, start, frames=FIRST))
    many, _ = _cpu(lambda: runner.run(some, work.kitti, work.sources, whole))
    return max(many - few, 0) / (FRAMES - FIRST)


def _measure_timing(where: Path, sizes: Profile) -> float:
    _be_silent()
    once = jobs.first_jobs([NAME], sizes.widths)
    return _cpu(lambda: budget.time_runs(once, where / "kitti", where / "labels", where / "whole",
                                         frames=FIRST + 1))[0] / FIRST  # on the first frame little happens


def _be_silent() -> None:
    sys.stdout = sys.stderr = open(os.devnull, "w")  # the bars of single runs say nothing about the whole


def _cpu(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of this process in all its threads, and what `work` returned."""
    started = time.process_time()
    result = work()
    return time.process_time() - started, result


def peak_memory() -> int:
    """Bytes: the most that this process has taken so far, without what the one that started it had."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    except OSError:  # not Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@dataclass(frozen=True)
class Plan:
    """What to expect; hours and bytes."""

    frames: dict[str, int]  # by sequence
    jobs: dict[str, int]  # by series
    odometry_hours: dict[str, float]  # CPU, by series, where every sequence is one pass
    timing_hours: float
    label_hours: dict[str, float]  # CPU, by network
    wall_hours: dict[int, float]  # by cores: odometry and timing
    worker_bytes: dict[int, float]  # by cores: memory of the largest worker
    memory_bytes: dict[int, float]  # by cores: of all workers
    label_bytes: float
    result_bytes: float
    low: float  # the cheapest and the dearest excerpt against the mean
    high: float
    training_hours: float = 0.0  # CPU, up to the last epoch
    training_images: int = 0  # of an epoch


def make(work: Work, frames: dict[str, int], calibration: Calibration, cores: Iterable[int],
         training_images: int = 0) -> Plan:
    """The Plan for sequences of so many frames each ({name: frames}), from what the calibration measured.

    training_images: of the folder, before they are split and doubled.
    """
    excerpts = calibration.excerpts
    shared, row_bytes, worker_bytes = (float(np.mean(values)) for values in zip(
        *((one.shared, one.row_bytes, one.worker_bytes) for one in excerpts)))
    work = replace(work, sequences=tuple(frames))
    series = {FIRST_SERIES: work.first_jobs(), SECOND_SERIES: work.second_jobs(None)}
    series = {name: some for name, some in series.items() if some}
    cost = {name: max(float(np.mean([one.series[name] for one in excerpts])) - shared, 0) / excerpts[0].jobs[name]
            for name in series}  # CPU seconds a frame and job
    sizes = work.sizes if isinstance(work, Thesis) else None

    def seconds(name: str, some: list[jobs.Job]) -> float:
        """Of one pass."""
        return frames[some[0].sequence] * (shared + cost[name] * len(some))

    def room(some: list[jobs.Job]) -> float:
        """Of one pass: its rows as numbers, and once more as a table."""
        return worker_bytes + 2 * 8 * len(passes.NUMBER_COLUMNS) * frames[some[0].sequence] * len(some)

    timing = [calibration.timing * min(count, sizes.timed_frames) for count in frames.values()] if sizes else [0.0]
    doubled = 2 * min(training_images, sizes.training_images or training_images) if sizes else 0
    wall, largest, memory = {}, {}, {}
    for number in sorted({1, *cores}):
        cut = {name: jobs.in_passes(some, frames, number) for name, some in series.items()}
        wall[number] = sum((_schedule([seconds(name, some) for some in of_series], number)
                            for name, of_series in cut.items()), _schedule(timing, number)) / 3600
        rooms = [sorted(map(room, of_series)) for of_series in cut.values()]
        largest[number] = max(some[-1] for some in rooms)
        memory[number] = max(sum(some[-number:]) for some in rooms)
    total, sums = sum(frames.values()), [sum(one.series.values()) for one in excerpts]
    return Plan(
        frames=frames, jobs={name: len(some) for name, some in series.items()},
        odometry_hours={name: sum(seconds(name, one) for one in jobs.in_passes(some, frames, 1)) / 3600
                        for name, some in series.items()},
        timing_hours=sum(timing) / 3600,
        label_hours={name: one * total / 3600 for name, one in calibration.networks.items()},
        wall_hours=wall, worker_bytes=largest, memory_bytes=memory, label_bytes=calibration.label_bytes * total,
        result_bytes=row_bytes * sum(frames[job.sequence] for some in series.values() for job in some),
        low=min(sums) / float(np.mean(sums)), high=max(sums) / float(np.mean(sums)),
        # a fifth of the images is for validation, which costs what prediction does
        training_hours=doubled * sizes.epochs * (0.8 * calibration.training + 0.2 * calibration.networks[OWN]) / 3600
        if sizes and doubled else 0.0, training_images=round(0.8 * doubled))


def _schedule(seconds: Iterable[float], workers: int) -> float:
    """When the last of several workers is done that take what comes next as soon as they are free."""
    free = [0.0] * workers
    for some in seconds:
        heapq.heapreplace(free, free[0] + some)
    return max(free)


def of_study(study: Study, cores: Iterable[int] = CORES) -> str:
    """What a study with masks of one's own would take, for reading."""
    calibration = calibrate(study)
    return text(study, make(study, study.lengths(), calibration, cores), calibration)


def text(work: Work, plan: Plan, calibration: Calibration, complete: bool = False) -> str:
    """The plan for reading."""
    total, everything = sum(plan.frames.values()), sum(kitti.FRAME_COUNTS.values())
    sizes = work.sizes if isinstance(work, Thesis) else None
    whose = "the complete benchmark" if complete else f"{work.kitti}"
    lines = [f"{whose}: {len(plan.frames)} sequence{'s' * (len(plan.frames) > 1)}, {total:,} frames"]
    if sizes and not complete and (passed_over := kitti.without_truth(work.kitti)):
        lines.append(f"(passed over, for they have no true poses: {', '.join(passed_over)})")
    if not complete and sizes and any(plan.frames.get(name, 0) < count for name, count in kitti.FRAME_COUNTS.items()):
        lines.append(f"(the complete benchmark has {len(kitti.FRAME_COUNTS)} sequences, {everything:,} frames; "
                     "--complete plans for it)")
    places = "; ".join(one.where for one in calibration.excerpts)
    lines += [f"calibrated in {calibration.seconds:.0f} s on {FRAMES} frames of sequence {places}",
              f"this machine: {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", ""]
    hours, numbers = dict(plan.odometry_hours), {name: f"{count:,} runs" for name, count in plan.jobs.items()}
    sums = {"in all": sum(hours.values())}
    if sizes:
        timing = f"timing of every width, {sizes.timed_frames} frames"
        hours[timing], numbers[timing] = plan.timing_hours, f"{len(plan.frames)} sequences"
        odometry_hours = sum(hours.values())
        for name, spent in plan.label_hours.items():
            hours[f"label maps, {name}"], numbers[f"label maps, {name}"] = spent, f"{total:,} label maps"
        sums = {f"in all, with {SHIPPED}": odometry_hours + plan.label_hours[SHIPPED]}
        if plan.training_images:
            training = f"its training, up to {sizes.epochs} epochs of {plan.training_images:,} images"
            hours[training], numbers[training] = plan.training_hours, f"{sizes.base_filters} base filters"
            sums[f"in all, with {OWN}"] = odometry_hours + plan.label_hours[OWN] + plan.training_hours
    wide = max(map(len, [*hours, *sums]))
    lines += [f"{'step':{wide}}  {'number':>18}  CPU hours"]
    lines += [f"{step:{wide}}  {numbers[step]:>18}  {spent:9.2f}" for step, spent in hours.items()]
    lines += [*(f"{name:{wide}}  {'':18}  {spent:9.2f}" for name, spent in sums.items()), ""]
    maps = f"  {'label maps, wall hours':>22}" if sizes else ""
    lines.append(f"{'cores':>5}  {'odometry, wall hours':>20}{maps}  {'memory a worker':>15}  {'memory in all':>13}")
    for cores, spent in plan.wall_hours.items():
        both = " or ".join(f"{one / cores:.2f}" for one in plan.label_hours.values())
        lines.append(f"{cores:5}  {spent:20.2f}{f'  {both:>22}' if sizes else ''}  "
                     f"{_size(plan.worker_bytes[cores]):>15}  {_size(plan.memory_bytes[cores]):>13}")
    spread = (f"excerpts cost {100 * plan.low - 100:+.0f} to {100 * plan.high - 100:+.0f} % of their mean"
              if len(calibration.excerpts) > 1 else "only one excerpt could be calibrated in the time")
    if sizes:
        lines += ["", f"disk: label maps {_size(plan.label_bytes)}, results {_size(plan.result_bytes)}; masks are not "
                  "kept", f"predicting takes {_size(calibration.network_bytes)} of memory once, whatever the number of "
                  f"cores; a training batch of {sizes.batch_size} at least {_size(calibration.training_bytes)}"]
    else:
        lines += ["", f"disk: results {_size(plan.result_bytes)}; masks are made as they are needed and not kept"]
    lines += [f"how sure: {spread};",
              "a busy machine, other processors and the clocks of many busy cores easily change times by a third.",
              "Wall hours take cores for as fast as this one alone, and the network for as divisible as its work."]
    if sizes and not plan.training_images:
        lines.append("Without Cityscapes nothing is trained; --cityscapes ROOT counts a training too.")
    lines.append(f"{work.repetitions} repetition{'s' * (work.repetitions > 1)}; finished runs are kept, and a stopped "
                 f"pass goes on from its last checkpoint, one every {passes.CHECKPOINT} frames")
    return "\n".join(lines)


def _size(amount: float) -> str:
    return f"{amount / 1e9:.1f} GB" if amount >= 1e9 else f"{amount / 1e6:.0f} MB"
