"""What the odometry costs: python -m thesis_repro.bench --kitti ROOT prints it and writes one JSON file.

Machines differ and are busy, so what matters is a ratio of two things measured in turn in one process. Nothing fails
for being slow.
"""

import argparse
import json
import os
import platform
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numba
import numpy as np

from thesis_repro import InputError, odometry
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks, dilate
from thesis_repro.odometry import THESIS, Odometry, keypoints, pose
from thesis_repro.study.budget import opencv_threads

REPEATS = 3
BARE_CALLS = ("track", "essential", "pose", "detect")
KEYPOINTS = (500, 1000, 2000, 4000)
WIDTHS = tuple(range(1, 16))


def _clock(threads):
    # A single thread's own time does not see what else the machine is doing.
    return time.thread_time if threads == 1 else time.perf_counter


def bare_calls(previous, frame, points, intrinsics):
    """The four OpenCV calls of one step of the thesis's odometry, each as a function on what it is really given."""
    tracked, found = keypoints.track(previous, frame, points)
    old = pose.normalise(points[found], intrinsics)
    new = pose.normalise(tracked[found], intrinsics)
    matrix, _, problem = pose.essential_matrix(new, old, THESIS.threshold)
    if problem:
        return None
    corners = points.reshape(-1, 1, 2)
    options = {"focal": 1.0, "pp": (0.0, 0.0)}
    return {
        "track": lambda: cv2.calcOpticalFlowPyrLK(previous, frame, corners, None, **keypoints.TRACKER),
        "essential": lambda: cv2.findEssentialMat(new, old, method=cv2.RANSAC, prob=pose.PROBABILITY,
                                                  threshold=THESIS.threshold, **options),
        "pose": lambda: cv2.recoverPose(matrix, new, old, **options),
        "detect": lambda: cv2.goodFeaturesToTrack(frame, THESIS.max_keypoints, keypoints.QUALITY,
                                                  THESIS.min_distance, blockSize=keypoints.BLOCK_SIZE),
    }


def step_cost(sequence, threads):
    """A step against its bare OpenCV calls on the same inputs, in turn: medians over frames of the least of three.

    Milliseconds: step, bare, and bare by call. Ratio: the median over frames.
    """
    clock = _clock(threads)
    steps, bare = [], []
    with opencv_threads(threads):
        follower, metres = Odometry(sequence.intrinsics), odometry.scales(sequence)
        previous = sequence.frame(0)
        follower.step(previous)
        for index in range(1, len(sequence)):
            frame, state = sequence.frame(index), follower.state()
            calls = bare_calls(state["previous"], frame, state["points"], sequence.intrinsics)
            fastest_step, fastest = np.inf, dict.fromkeys(calls or (), np.inf)
            for _ in range(REPEATS):
                for name, call in (calls or {}).items():
                    started = clock()
                    call()
                    fastest[name] = min(fastest[name], clock() - started)
                follower.restore(state)
                started = clock()
                step = follower.step(frame, metres[index])
                fastest_step = min(fastest_step, clock() - started)
            if calls and step.detected is not None:
                steps.append(fastest_step * 1e3)
                bare.append([value * 1e3 for value in fastest.values()])
    if not steps:
        raise InputError(f"sequence {sequence.name}: no frame on which the odometry tracks and detects; "
                         "the bench needs some")
    bare = np.array(bare)
    return {"opencv_threads": threads, "frames": len(steps), "step_ms": float(np.median(steps)),
            "bare_ms": float(np.median(bare.sum(axis=1))),
            "bare_by_call_ms": dict(zip(BARE_CALLS, np.median(bare, axis=0).round(3).tolist(), strict=True)),
            "ratio": float(np.median(steps / bare.sum(axis=1)))}


class FrameMasks:
    """Masks of a sequence from the contours of its own frames, for where there are no label maps."""

    def __init__(self, sequence, width):
        self.sequence, self.width = sequence, width

    def __getitem__(self, index):
        smooth = cv2.GaussianBlur(self.sequence.frame(index), (0, 0), 4)
        return dilate(cv2.Canny(smooth, 20, 60), self.width)


def thesis_runs(sequence, labels=None):
    """The thesis's 17 runs over one sequence: {name: (settings, masks)}; masks are made beforehand, not timed."""
    runs = {"baseline": (THESIS, None)}
    for width in WIDTHS:
        masks = FrameMasks(sequence, width) if labels is None else LabelMasks(labels, sequence, width)
        runs[f"width {width}"] = (THESIS, [masks[index] for index in range(len(sequence))])
    runs["reduced"] = (replace(THESIS, max_keypoints=800), None)
    return runs


def shared_cost(sequence, runs, workers, threads=1, separate=None):
    """All runs in one pass against the same runs one by one: milliseconds a frame, CPU and wall, and their ratios.

    separate: the result of an earlier call, whose separate runs then count for this one too.
    """
    with opencv_threads(threads):
        together, results = _timed(sequence, lambda: odometry.run_many(sequence, runs, workers=workers))
        if separate is None:
            alone, expected = _timed(sequence, lambda: {name: odometry.run(sequence, *run)
                                                        for name, run in runs.items()})
            same = all(np.array_equal(results[name].poses, expected[name].poses) for name in runs)
        else:
            alone, same = separate["separate_ms"], separate["same_bits"]
    return {"runs": len(runs), "workers": workers, "opencv_threads": threads, "frames": len(sequence),
            "shared_ms": together, "separate_ms": alone, "same_bits": same,
            "cpu_ratio": together["cpu"] / alone["cpu"], "wall_ratio": together["wall"] / alone["wall"]}


def _timed(sequence, work):
    cpu, wall = time.process_time(), time.perf_counter()
    result = work()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {"cpu": cpu * 1e3 / len(sequence), "wall": wall * 1e3 / len(sequence)}, result


def keypoint_costs(sequence):
    """CPU milliseconds of a step, single-threaded, and their ratio to 2000 keypoints, by the detector's limit."""
    costs = {}
    with opencv_threads(1):
        for count in KEYPOINTS:
            settings = replace(THESIS, max_keypoints=count, redetect_below=count)
            follower, metres, times = Odometry(sequence.intrinsics, settings), odometry.scales(sequence), []
            for index in range(len(sequence)):
                frame = sequence.frame(index)
                started = time.thread_time()
                step = follower.step(frame, metres[index])
                if index:
                    times.append(((time.thread_time() - started) * 1e3, len(step.current)))
            costs[count] = dict(zip(("step_ms", "tracked"), np.median(times, axis=0).tolist(), strict=True))
    for cost in costs.values():
        cost["ratio_to_2000"] = cost["step_ms"] / costs[2000]["step_ms"]
    return costs


def variant_costs(sequence, runs):
    """CPU milliseconds a frame of one shared pass, by the number of runs in it, and the ratio to a single run."""
    costs, names = {}, list(runs)
    with opencv_threads(1):
        for count in (1, 2, 4, 8, len(names)):
            some = {name: runs[name] for name in names[:count]}
            cost, _ = _timed(sequence, lambda some=some: odometry.run_many(sequence, some))
            costs[count] = {"cpu_ms": cost["cpu"]}
    for cost in costs.values():
        cost["ratio_to_one"] = cost["cpu_ms"] / costs[1]["cpu_ms"]
    return costs


def machine():
    """Where the numbers come from."""
    try:
        processor = next(line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
                         if line.startswith("model name"))
    except (OSError, StopIteration):
        processor = platform.processor()
    return {"processor": processor, "cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1),
            "system": platform.platform(), "python": platform.python_version(), "opencv": cv2.__version__,
            "numpy": np.__version__, "numba": numba.__version__}


def measure(sequence, labels=None):
    """Everything above for one sequence, as one dictionary."""
    cores = os.cpu_count()
    few = sequence.subset(min(len(sequence), 20))
    runs = thesis_runs(sequence, labels)
    odometry.run_many(sequence.subset(2), runs)  # compiles and loads what the first use would
    result = {"machine": machine(), "sequence": sequence.name, "size": sequence.size}
    jobs = {
        "step, one thread": lambda: step_cost(sequence, 1),
        "step, all threads": lambda: step_cost(sequence, cores),
        "shared pass, one core": lambda: shared_cost(sequence, runs, 1),
        "shared pass, all cores": lambda: shared_cost(sequence, runs, cores, cores,
                                                      separate=result["shared pass, one core"]),
        "keypoints": lambda: keypoint_costs(few),
        "runs in one pass": lambda: variant_costs(few, runs),
    }
    for name, job in progress(jobs.items(), "bench", unit="measurement"):
        result[name] = job()
    return result


def table(result):
    """The ratios, one a line."""
    one, many = result["shared pass, one core"], result["shared pass, all cores"]
    lines = [f"{result['machine']['processor']}, {result['machine']['cores']} cores, load "
             f"{result['machine']['load']}; OpenCV {result['machine']['opencv']}"]
    for name in ("step, one thread", "step, all threads"):
        cost = result[name]
        lines.append(f"{name}: {cost['step_ms']:.1f} ms, bare OpenCV calls {cost['bare_ms']:.1f} ms: "
                     f"ratio {cost['ratio']:.3f}")
    lines.append(f"{one['runs']} runs in one pass, one core: {one['shared_ms']['cpu']:.0f} ms of CPU a frame, "
                 f"separately {one['separate_ms']['cpu']:.0f} ms: ratio {one['cpu_ratio']:.3f}, "
                 f"same bits: {'yes' if one['same_bits'] else 'NO'}")
    lines.append(f"the same with {many['workers']} workers: {many['shared_ms']['wall']:.0f} ms of wall-clock a frame: "
                 f"{one['shared_ms']['wall'] / many['shared_ms']['wall']:.2f} times as fast as on one core")
    lines += [f"{count} keypoints: {cost['step_ms']:.1f} ms, {cost['ratio_to_2000']:.2f} of 2000"
              for count, cost in result["keypoints"].items()]
    lines += [f"{count} runs in one pass: {cost['cpu_ms']:.0f} ms of CPU a frame, {cost['ratio_to_one']:.2f} of one"
              for count, cost in result["runs in one pass"].items()]
    return "\n".join(lines)


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m thesis_repro.bench", description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", required=True, type=Path, help="KITTI odometry folder (sequences, poses)")
    parser.add_argument("--sequence", default="00")
    parser.add_argument("--frames", default=40, type=int, help="taken from its start (40)")
    parser.add_argument("--labels", type=Path, help="folder of the sequence's label maps; "
                        "without it, masks come from the contours of the frames")
    parser.add_argument("--output", type=Path, default=Path("bench.json"))
    options = parser.parse_args(arguments)
    try:
        sequence = Sequence(options.kitti, options.sequence).subset(options.frames)
        if len(sequence) < 3:
            raise InputError(f"{len(sequence)} frames: the bench needs 3 or more")
        result = measure(sequence, options.labels)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    write_text(options.output, json.dumps(result, indent=1) + "\n")
    print(table(result))
    print(f"written: {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
