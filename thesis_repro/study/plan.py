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
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from thesis_repro import InputError, kitti, odometry, stages
from thesis_repro.files import progress, write_text
from thesis_repro.odometry import passes
from thesis_repro.settings import PROFILES
from thesis_repro.study import budget, controls, jobs, results, runner

CORES = (1, 4, 8, 16, 64)
EXCERPTS, FRAMES, FIRST = 3, 6, 2  # at most; frames of each, of which the first ones stand for what each run costs once
ENOUGH = 30  # seconds after which no further excerpt is begun
MOST_REPETITIONS = 5  # that are calibrated; more cost in proportion
NETWORK_IMAGES = 8  # on which a network is timed
PROFILE = PROFILES["thesis"]
NAME = "00"  # of every excerpt
MODELS = ("the model in the package", f"the thesis's network, {PROFILE.base_filters} filters")


@dataclass(frozen=True)
class Excerpt:
    """What one excerpt cost: CPU seconds a frame, for all jobs of a sequence unless it says otherwise."""

    where: str
    jobs: tuple  # of the first and of the second series of runs, for a sequence
    series: tuple  # CPU seconds a frame of each series
    shared: float  # of these, for what a pass does whatever the number of its jobs: reading, corners, tracking
    row_bytes: float  # of a result, a frame and job
    worker_bytes: int  # memory of a process that runs odometry


@dataclass(frozen=True)
class Calibration:
    excerpts: tuple
    timing: float  # CPU seconds a frame of timing every width
    networks: dict  # name: CPU seconds a frame
    network_bytes: int  # memory of a process that predicts
    label_bytes: float  # of a label map on disk
    seconds: float  # that the calibration took
    repetitions: int


def counts(root, complete=False):
    """Frames by sequence: of the folder, or of the complete benchmark. Raises InputError where there are none."""
    there = {name: len(kitti.Sequence(root, name)) for name in kitti.sequences(root)}
    return dict(kitti.FRAME_COUNTS) if complete else there


def calibrate(root, repetitions=5):
    """Run everything on a few frames of root and measure it; returns a Calibration. About a minute."""
    started, done = time.perf_counter(), []
    repetitions = min(repetitions, MOST_REPETITIONS)
    with (tempfile.TemporaryDirectory() as folder, progress(None, "calibration", EXCERPTS + 2, unit="step") as bar,
          ProcessPoolExecutor(1, get_context("spawn")) as pool):
        places = _places(root)
        folder = Path(folder)
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
        return Calibration(tuple(done), timing, networks, _peak_memory(), label_bytes, time.perf_counter() - started,
                           repetitions)


def _places(root):
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


def _copy(sequence, start, root):
    """An excerpt as a sequence of its own."""
    folder, indices = root / "sequences" / NAME, range(start, start + FRAMES)
    (folder / "image_0").mkdir(parents=True)
    labels = controls.true_labels(sequence.root, sequence.name)
    for index in indices:
        sequence.frame(index)  # says which file is unreadable, if it is
        path = sequence.frame_paths[index]
        shutil.copy(path, folder / "image_0")
        if (labels / path.name).is_file():
            controls.true_labels(root, NAME).mkdir(exist_ok=True)
            shutil.copy(labels / path.name, controls.true_labels(root, NAME))
    shutil.copy(sequence.folder / "calib.txt", folder)
    write_text(folder / "times.txt", "".join(f"{sequence.times[index]}\n" for index in indices))
    kitti.write_kitti_poses(root / "poses" / f"{NAME}.txt", sequence.poses[start:start + FRAMES])


def _shipped_model():
    from thesis_repro.segmentation import prediction  # here and below: TensorFlow takes seconds to load

    return prediction.load_shipped()


def _thesis_model():
    from thesis_repro.cityscapes import N_CLASSES
    from thesis_repro.segmentation.unet import build_unet

    return build_unet((PROFILE.image_size, PROFILE.image_size, 1), N_CLASSES, PROFILE.base_filters)


def _predict(model, where):
    from thesis_repro.segmentation import prediction

    labels = stages.stage(where / "labels" / NAME)
    prediction.write_label_maps(model, kitti.Sequence(where / "kitti", NAME).frame_paths, labels)
    return np.mean([path.stat().st_size for path in labels.glob("*.png")])


def _network_seconds(model):
    from thesis_repro.segmentation import prediction

    images = np.random.default_rng(0).integers(0, 256, (NETWORK_IMAGES, *model.input_shape[1:]), np.uint8)
    prediction.predict(model, images[:1])  # compiles
    return _cpu(lambda: prediction.predict(model, images))[0] / NETWORK_IMAGES


def _measure(where, name, repetitions):
    """One excerpt, in a process without the network."""
    _be_silent()
    root, labels = where / "kitti", where / "labels"
    whole, start, loaded = (where / part for part in ("whole", "start", "loaded"))
    first = (jobs.first_jobs([NAME], PROFILE.widths, repetitions)
             + jobs.mask_control_jobs(root, [NAME], repetitions))
    runner.run(first, root, labels, loaded, frames=FIRST)  # loads compiled code
    per_frame = [_slope(first, root, labels, start, whole)]
    summary = runner.run(first, root, labels, whole)
    second = (jobs.reduced_jobs(results.best_widths(summary), repetitions)
              + jobs.keypoint_control_jobs(results.keypoints_left(summary), root, repetitions=repetitions))
    per_frame.append(_slope(second, root, labels, start, whole))
    files = list((whole / NAME).glob("*-*.csv"))

    alone, result = _cpu(lambda: odometry.run_many(kitti.Sequence(root, NAME), {"": (odometry.THESIS, None)}))
    alone -= result[""].frames[["essential_seconds", "pose_seconds"]].sum().sum()
    row_bytes = sum(path.stat().st_size for path in files) / len(files) / FRAMES
    return Excerpt(name, (len(first), len(second)), tuple(per_frame), max(alone, 0) / FRAMES, row_bytes, _peak_memory())


def _slope(some, root, labels, start, whole):
    few, _ = _cpu(lambda: runner.run(some, root, labels, start, frames=FIRST))
    many, _ = _cpu(lambda: runner.run(some, root, labels, whole))
    return max(many - few, 0) / (FRAMES - FIRST)


def _measure_timing(where):
    _be_silent()
    once = jobs.first_jobs([NAME], PROFILE.widths)
    return _cpu(lambda: budget.time_runs(once, where / "kitti", where / "labels", where / "whole",
                                              frames=FIRST + 1))[0] / FIRST  # on the first frame little happens


def _be_silent():
    sys.stdout = sys.stderr = open(os.devnull, "w")  # the bars of single runs say nothing about the whole


def _cpu(work):
    """CPU seconds of this process in all its threads, and what `work` returned."""
    started = time.process_time()
    result = work()
    return time.process_time() - started, result


def _peak_memory():
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    except OSError:  # not Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@dataclass(frozen=True)
class Plan:
    """What to expect; hours and bytes."""

    frames: dict  # by sequence
    jobs: tuple  # number of the first and of the second series
    odometry_hours: tuple  # CPU, of each series where every sequence is one pass
    timing_hours: float
    label_hours: dict  # CPU, by network
    wall_hours: dict  # cores: odometry and timing
    worker_bytes: dict  # cores: memory of the largest worker
    memory_bytes: dict  # cores: of all workers
    label_bytes: float
    result_bytes: float
    low: float  # the cheapest and the dearest excerpt against the mean
    high: float


def make(root, frames, calibration, repetitions=5, cores=CORES):
    """The Plan for sequences of so many frames each ({name: frames}), from what the calibration measured."""
    excerpts, names = calibration.excerpts, list(frames)
    there = [name for name in names if (Path(root) / "sequences" / name).is_dir()]
    mean = {field: np.mean([getattr(one, field) for one in excerpts], axis=0)
            for field in ("series", "shared", "row_bytes", "worker_bytes")}
    series = (jobs.first_jobs(names, PROFILE.widths, repetitions)
              + jobs.mask_control_jobs(root, there, repetitions)
              + jobs.mask_control_jobs(root, [name for name in names if name not in there], repetitions),
              _second_jobs(names, repetitions))
    per_job = [max(cost - mean["shared"], 0) / number for cost, number in zip(mean["series"], excerpts[0].jobs)]
    row = 2 * 8 * len(passes.NUMBERS)  # as numbers, and once more as a table
    wall, largest, memory, cpu = {}, {}, {}, {}
    timing = [calibration.timing * min(count, PROFILE.timed_frames) for count in frames.values()]
    for number in sorted({1, *cores}):
        hours, rooms = _schedule(timing, number) / 3600, []
        for which, (some, cost) in enumerate(zip(series, per_job)):
            cut = jobs.in_passes(some, frames, number)
            seconds = [frames[one[0].sequence] * (mean["shared"] + cost * len(one)) for one in cut]
            hours += _schedule(seconds, number) / 3600
            rooms.append([mean["worker_bytes"] + row * frames[one[0].sequence] * len(one) for one in cut])
            if number == 1:
                cpu[which] = sum(seconds) / 3600
        wall[number], largest[number] = hours, max(map(max, rooms))
        memory[number] = max(sum(sorted(room)[-number:]) for room in rooms)
    total, numbers = sum(frames.values()), tuple(map(len, series))
    sums = [sum(one.series) for one in excerpts]
    return Plan(frames, numbers, tuple(cpu.values()), sum(timing) / 3600,
                {name: seconds * total / 3600 for name, seconds in calibration.networks.items()},
                wall, largest, memory, calibration.label_bytes * total,
                mean["row_bytes"] * sum(frames[job.sequence] for some in series for job in some),
                min(sums) / np.mean(sums), max(sums) / np.mean(sums))


def _second_jobs(names, repetitions):
    """The jobs that follow from results, without the numbers that are not known yet."""
    one = range(repetitions)
    return [jobs.Job(name, variant, pose=pose, repetition=repetition) for name in names
            for variant, poses in (("reduced", jobs.POSES[:1]), ("fewer", jobs.POSES),
                                   ("spread", jobs.POSES)) for pose in poses for repetition in one]


def _schedule(seconds, workers):
    """When the last of several workers is done that take what comes next as soon as they are free."""
    free = [0.0] * workers
    for some in seconds:
        heapq.heapreplace(free, free[0] + some)
    return max(free)


def text(root, plan, calibration, repetitions, complete):
    """The plan for reading."""
    total, everything = sum(plan.frames.values()), sum(kitti.FRAME_COUNTS.values())
    whose = "the complete benchmark" if complete else f"{root}"
    lines = [f"{whose}: {len(plan.frames)} sequences, {total:,} frames"]
    if not complete and any(plan.frames.get(name, 0) < count for name, count in kitti.FRAME_COUNTS.items()):
        lines.append(f"(the complete benchmark has {len(kitti.FRAME_COUNTS)} sequences, {everything:,} frames; "
                     "--complete plans for it)")
    places = "; ".join(one.where for one in calibration.excerpts)
    lines += [f"calibrated in {calibration.seconds:.0f} s on {FRAMES} frames of sequence {places}",
              f"this machine: {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", ""]
    first, second = plan.jobs
    steps = [("label maps, " + name, total, "label maps", hours) for name, hours in plan.label_hours.items()]
    steps += [("baseline, masks, controls that need no result", first, "runs", plan.odometry_hours[0]),
              ("reduced, fewer, spread", second, "runs", plan.odometry_hours[1]),
              (f"timing of every width, {PROFILE.timed_frames} frames", len(plan.frames), "sequences",
               plan.timing_hours)]
    wide = max(len(step[0]) for step in steps)
    lines += [f"{'step':{wide}}  {'number':>18}  CPU hours"]
    lines += [f"{name:{wide}}  {f'{number:,} {unit}':>18}  {hours:9.2f}" for name, number, unit, hours in steps]
    lines += [f"{'in all, with the model in the package':{wide}}  {'':18}  "
              f"{sum(step[3] for step in steps) - steps[1][3]:9.2f}", ""]
    few, many = plan.label_hours.values()
    lines.append(f"{'cores':>5}  {'odometry, wall hours':>20}  {'label maps, wall hours':>22}  "
                 f"{'memory a worker':>15}  {'memory in all':>13}")
    for cores, hours in plan.wall_hours.items():
        lines.append(f"{cores:5}  {hours:20.2f}  {f'{few / cores:.2f} or {many / cores:.2f}':>22}  "
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


def _size(amount):
    return f"{amount / 1e9:.1f} GB" if amount >= 1e9 else f"{amount / 1e6:.0f} MB"
