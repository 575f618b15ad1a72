"""How long the whole of KITTI would take: jobs, CPU and wall hours, memory and disk, from a short calibration.

The calibration runs the real code, network and all, on a few frames from several places of the user's own KITTI.
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
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from thesis_repro import InputError, kitti, odometry, stages
from thesis_repro.files import progress, write_text
from thesis_repro.odometry import passes
from thesis_repro.settings import PROFILES
from thesis_repro.study import budget, controls, jobs, results, runner

EXCERPTS, FRAMES, FIRST = 3, 6, 2  # at most; frames of each, of which the first ones stand for what each run costs once
ENOUGH = 30  # seconds after which no further excerpt is begun
MOST_REPETITIONS = 5  # that are calibrated; more cost in proportion
NETWORK_IMAGES = 8  # on which a network is timed
PROFILE = PROFILES["thesis"]
NAME = "00"  # of every excerpt
MODELS = ("the model in the package", f"the thesis's network, {PROFILE.base_filters} filters")
FIRST_SERIES, SECOND_SERIES = "baseline, masks, controls that need no result", "reduced, fewer, spread"


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
    excerpts: list[Excerpt]
    timing: float  # CPU seconds a frame of timing every width
    networks: dict[str, float]  # name: CPU seconds a frame
    network_bytes: int  # memory of a process that predicts
    label_bytes: float  # of a label map on disk
    seconds: float  # that the calibration took


def counts(root: Path, complete: bool) -> dict[str, int]:
    """Frames by sequence: of the folder, or of the complete benchmark. Raises InputError where there are none."""
    there = {name: len(kitti.Sequence(root, name)) for name in kitti.sequences(root)}
    return dict(kitti.FRAME_COUNTS) if complete else there


def calibrate(root: Path, repetitions: int) -> Calibration:
    """Run everything on a few frames of root and measure it; about a minute."""
    started = time.perf_counter()
    done: list[Excerpt] = []
    repetitions = min(repetitions, MOST_REPETITIONS)
    with (tempfile.TemporaryDirectory() as temporary, progress(None, "calibration", EXCERPTS + 2, unit="step") as bar,
          ProcessPoolExecutor(1, get_context("spawn")) as pool):
        places = _places(root)
        folder = Path(temporary)
        model = _shipped_model()
        for number, (sequence, start) in enumerate(places):
            if number and time.perf_counter() - started > ENOUGH:
                bar.total -= len(places) - number
                break
            where = folder / str(number)
            _copy(sequence, start, where / "kitti")
            label_bytes = _predict(model, where)
            done.append(pool.submit(_measure, where, f"{sequence.name} from frame {start}", repetitions).result())
            bar.update()
        timing = pool.submit(_measure_timing, folder / "0").result()
        bar.update()
        networks = dict(zip(MODELS, (_network_seconds(model), _network_seconds(_thesis_model()))))
        bar.update()
        return Calibration(excerpts=done, timing=timing, networks=networks, network_bytes=_peak_memory(),
                           label_bytes=label_bytes, seconds=time.perf_counter() - started)


def _places(root: Path) -> list[tuple[kitti.Sequence, int]]:
    """Up to EXCERPTS sequences with frame numbers, evenly spread over all frames of root."""
    sequences = [kitti.Sequence(root, name) for name in kitti.sequences(root)]
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


def _shipped_model() -> Any:
    from thesis_repro.segmentation import prediction  # here and below: TensorFlow takes seconds to load

    return prediction.load_shipped()


def _thesis_model() -> Any:
    from thesis_repro.cityscapes import N_CLASSES
    from thesis_repro.segmentation.unet import build_unet

    return build_unet((PROFILE.image_size, PROFILE.image_size, 1), N_CLASSES, PROFILE.base_filters)


def _predict(model: Any, where: Path) -> float:
    """Write the label maps of an excerpt; returns their mean size in bytes."""
    from thesis_repro.segmentation import prediction

    labels = stages.stage(where / "labels" / NAME)
    prediction.write_label_maps(model, kitti.Sequence(where / "kitti", NAME).frame_paths, labels)
    return float(np.mean([path.stat().st_size for path in labels.glob("*.png")]))


def _network_seconds(model: Any) -> float:
    from thesis_repro.segmentation import prediction

    images = np.random.default_rng(0).integers(0, 256, (NETWORK_IMAGES, *model.input_shape[1:]), np.uint8)
    prediction.predict(model, images[:1])  # compiles
    return _cpu(lambda: prediction.predict(model, images))[0] / NETWORK_IMAGES


def _measure(where: Path, name: str, repetitions: int) -> Excerpt:
    """One excerpt, in a process without the network."""
    _be_silent()
    root, labels = where / "kitti", where / "labels"
    whole, start, loaded = (where / part for part in ("whole", "start", "loaded"))
    first = (jobs.first_jobs([NAME], PROFILE.widths, repetitions)
             + jobs.mask_control_jobs(root, [NAME], repetitions))
    runner.run(first, root, labels, loaded, frames=FIRST)  # loads compiled code
    series = {FIRST_SERIES: _slope(first, root, labels, start, whole)}
    summary = runner.run(first, root, labels, whole)
    second = (jobs.reduced_jobs(results.best_widths(summary), repetitions)
              + jobs.keypoint_control_jobs(results.keypoints_left(summary), root, repetitions=repetitions))
    series[SECOND_SERIES] = _slope(second, root, labels, start, whole)
    files = list((whole / NAME).glob("*-*.csv"))

    alone, result = _cpu(lambda: odometry.run_many(kitti.Sequence(root, NAME), {"": (odometry.THESIS, None)}))
    alone -= result[""].frames[["essential_seconds", "pose_seconds"]].sum().sum()
    row_bytes = sum(path.stat().st_size for path in files) / len(files) / FRAMES
    return Excerpt(where=name, jobs={FIRST_SERIES: len(first), SECOND_SERIES: len(second)}, series=series,
                   shared=max(alone, 0) / FRAMES, row_bytes=row_bytes, worker_bytes=_peak_memory())


def _slope(some: list[jobs.Job], root: Path, labels: Path, start: Path, whole: Path) -> float:
    """CPU seconds a frame of some jobs, without what they cost once."""
    few, _ = _cpu(lambda: runner.run(some, root, labels, start, frames=FIRST))
    many, _ = _cpu(lambda: runner.run(some, root, labels, whole))
    return max(many - few, 0) / (FRAMES - FIRST)


def _measure_timing(where: Path) -> float:
    _be_silent()
    once = jobs.first_jobs([NAME], PROFILE.widths)
    return _cpu(lambda: budget.time_runs(once, where / "kitti", where / "labels", where / "whole",
                                         frames=FIRST + 1))[0] / FIRST  # on the first frame little happens


def _be_silent() -> None:
    sys.stdout = sys.stderr = open(os.devnull, "w")  # the bars of single runs say nothing about the whole


def _cpu(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of this process in all its threads, and what `work` returned."""
    started = time.process_time()
    result = work()
    return time.process_time() - started, result


def _peak_memory() -> int:
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


def make(root: Path, frames: dict[str, int], calibration: Calibration, repetitions: int, cores: Iterable[int]) -> Plan:
    """The Plan for sequences of so many frames each ({name: frames}), from what the calibration measured."""
    excerpts = calibration.excerpts
    shared, row_bytes, worker_bytes = (float(np.mean(values)) for values in zip(
        *((one.shared, one.row_bytes, one.worker_bytes) for one in excerpts)))
    series = _series(root, list(frames), repetitions)
    cost = {name: max(float(np.mean([one.series[name] for one in excerpts])) - shared, 0) / excerpts[0].jobs[name]
            for name in series}  # CPU seconds a frame and job

    def seconds(name: str, some: list[jobs.Job]) -> float:
        """Of one pass."""
        return frames[some[0].sequence] * (shared + cost[name] * len(some))

    def room(some: list[jobs.Job]) -> float:
        """Of one pass: its rows as numbers, and once more as a table."""
        return worker_bytes + 2 * 8 * len(passes.NUMBERS) * frames[some[0].sequence] * len(some)

    timing = [calibration.timing * min(count, PROFILE.timed_frames) for count in frames.values()]
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
        low=min(sums) / float(np.mean(sums)), high=max(sums) / float(np.mean(sums)))


def _series(root: Path, names: list[str], repetitions: int) -> dict[str, list[jobs.Job]]:
    """The jobs of both series; what those of the second take from results of the first is not known yet."""
    unknown = 1.0
    return {FIRST_SERIES: jobs.first_jobs(names, PROFILE.widths, repetitions)
            + jobs.mask_control_jobs(root, names, repetitions),
            SECOND_SERIES: jobs.reduced_jobs(pd.DataFrame({"mean_keypoints": unknown}, index=names), repetitions)
            + [job for name in names for job in jobs.keypoint_controls(name, unknown, unknown, repetitions)]}


def _schedule(seconds: Iterable[float], workers: int) -> float:
    """When the last of several workers is done that take what comes next as soon as they are free."""
    free = [0.0] * workers
    for some in seconds:
        heapq.heapreplace(free, free[0] + some)
    return max(free)


def text(root: Path, plan: Plan, calibration: Calibration, repetitions: int, complete: bool) -> str:
    """The plan for reading."""
    total, everything = sum(plan.frames.values()), sum(kitti.FRAME_COUNTS.values())
    whose = "the complete benchmark" if complete else f"{root}"
    lines = [f"{whose}: {len(plan.frames)} sequences, {total:,} frames"]
    if passed_over := kitti.without_truth(root):
        lines.append(f"(passed over, for they have no true poses: {', '.join(passed_over)})")
    if not complete and any(plan.frames.get(name, 0) < count for name, count in kitti.FRAME_COUNTS.items()):
        lines.append(f"(the complete benchmark has {len(kitti.FRAME_COUNTS)} sequences, {everything:,} frames; "
                     "--complete plans for it)")
    places = "; ".join(one.where for one in calibration.excerpts)
    lines += [f"calibrated in {calibration.seconds:.0f} s on {FRAMES} frames of sequence {places}",
              f"this machine: {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", ""]
    timing = f"timing of every width, {PROFILE.timed_frames} frames"
    hours = ({f"label maps, {name}": spent for name, spent in plan.label_hours.items()} | plan.odometry_hours
             | {timing: plan.timing_hours})
    numbers = (dict.fromkeys(hours, f"{total:,} label maps")
               | {name: f"{count:,} runs" for name, count in plan.jobs.items()}
               | {timing: f"{len(plan.frames)} sequences"})
    wide = max(map(len, hours))
    lines += [f"{'step':{wide}}  {'number':>18}  CPU hours"]
    lines += [f"{step:{wide}}  {numbers[step]:>18}  {spent:9.2f}" for step, spent in hours.items()]
    few, many = (plan.label_hours[name] for name in MODELS)
    lines += [f"{f'in all, with {MODELS[0]}':{wide}}  {'':18}  {sum(hours.values()) - many:9.2f}", ""]
    lines.append(f"{'cores':>5}  {'odometry, wall hours':>20}  {'label maps, wall hours':>22}  "
                 f"{'memory a worker':>15}  {'memory in all':>13}")
    for cores, spent in plan.wall_hours.items():
        lines.append(f"{cores:5}  {spent:20.2f}  {f'{few / cores:.2f} or {many / cores:.2f}':>22}  "
                     f"{_size(plan.worker_bytes[cores]):>15}  {_size(plan.memory_bytes[cores]):>13}")
    spread = (f"excerpts cost {100 * plan.low - 100:+.0f} to {100 * plan.high - 100:+.0f} % of their mean"
              if len(calibration.excerpts) > 1 else "only one excerpt could be calibrated in the time")
    lines += ["", f"disk: label maps {_size(plan.label_bytes)}, results {_size(plan.result_bytes)}; masks are not kept",
              f"predicting takes {_size(calibration.network_bytes)} of memory once, whatever the number of cores",
              f"how sure: {spread};",
              "a busy machine, other processors and the clocks of many busy cores easily change times by a third.",
              "Wall hours take cores for as fast as this one alone, and the network for as divisible as its work.",
              "The training of a network of one's own is not included.",
              f"{repetitions} repetition{'s' * (repetitions > 1)}; finished runs are kept, and a stopped pass "
              f"goes on from its last checkpoint, one every {passes.CHECKPOINT} frames"]
    return "\n".join(lines)


def _size(amount: float) -> str:
    return f"{amount / 1e9:.1f} GB" if amount >= 1e9 else f"{amount / 1e6:.0f} MB"
