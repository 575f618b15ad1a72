"""What odometry and segmentation cost on this machine, as ratios: python tools/bench.py --kitti ROOT (make bench).

Machines differ and are busy, so what counts is the ratio of two things measured in turn in one process. Prints a table
and writes it as JSON. Nothing fails for being slow.
"""

import argparse
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from copy import copy
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import cv2
import numpy as np
import pandas as pd

from thesis_repro import InputError, odometry
from thesis_repro.cityscapes import N_CLASSES, read_image
from thesis_repro.files import write_png, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import dilate
from thesis_repro.odometry import THESIS, Odometry, keypoints, pose
from thesis_repro.study.timing import opencv_threads

REPEATS = 3
WIDTHS = (1, 5, 10, 15)
KEYPOINTS = (500, 1000, 2000, 4000)


def seconds(work, clock=time.perf_counter):
    started = clock()
    work()
    return clock() - started


def bare_calls(previous, frame, points, intrinsics):
    """The OpenCV calls of one step of the thesis's odometry, each as a function on what the step gives it."""
    tracked, followed = keypoints.track(previous, frame, points)
    old, new = (pose.normalise(corners[followed], intrinsics) for corners in (points, tracked))
    camera = {"focal": 1.0, "pp": (0.0, 0.0)}
    search = {"method": cv2.RANSAC, "prob": pose.PROBABILITY, "threshold": THESIS.threshold}
    matrix, _ = cv2.findEssentialMat(new, old, **search, **camera)
    corners = points.reshape(-1, 1, 2)
    return [lambda: cv2.calcOpticalFlowPyrLK(previous, frame, corners, None, **keypoints.TRACKER),
            lambda: cv2.findEssentialMat(new, old, **search, **camera),
            lambda: cv2.recoverPose(matrix, new, old, **camera),
            lambda: cv2.goodFeaturesToTrack(frame, THESIS.max_keypoints, keypoints.QUALITY, THESIS.min_distance,
                                            blockSize=keypoints.BLOCK_SIZE)]


def step_cost(sequence):
    """Milliseconds of a step that detects anew, and of its bare OpenCV calls: medians over frames of the least of 3."""
    follower, metres, costs = Odometry(sequence.intrinsics), odometry.scales(sequence), []
    clock = time.thread_time  # of a single thread, which does not see what else the machine is doing
    previous = sequence.frame(0)
    follower.step(previous)
    for index, frame in enumerate(list(sequence.frames())[1:], 1):
        state, steps = follower.state(), []
        calls = bare_calls(previous, frame, state["points"], sequence.intrinsics)
        bare = sum(min(seconds(call, clock) for _ in range(REPEATS)) for call in calls)
        for _ in range(REPEATS):
            follower.restore(state)
            steps.append(seconds(lambda: follower.step(frame, metres[index]), clock))  # noqa: B023
        costs.append((1e3 * min(steps), 1e3 * bare))
        previous = frame
    return np.median(costs, axis=0)


def shared_cost(sequence):
    """CPU milliseconds a frame of runs in one pass and of the same runs one by one; whether their poses are equal."""
    def masks(width):  # boundaries of the frames' own contours, for where there are no label maps
        smooth = [cv2.GaussianBlur(frame, (0, 0), 4) for frame in sequence.frames()]
        return [dilate(cv2.Canny(frame, 20, 60), width) for frame in smooth]

    runs = {"": (THESIS, None)} | {f"{width}": (THESIS, masks(width)) for width in WIDTHS}
    together, alone = {}, {}
    costs = [seconds(lambda: together.update(odometry.run_many(sequence, runs)), time.process_time),
             seconds(lambda: alone.update({name: odometry.run(sequence, *run) for name, run in runs.items()}),
                     time.process_time)]
    same = all(np.array_equal(together[name].poses, alone[name].poses) for name in runs)
    return *(1e3 * cost / len(sequence) for cost in costs), same


def keypoint_cost(sequence, count):
    """CPU milliseconds a frame with at most so many keypoints."""
    settings = replace(THESIS, max_keypoints=count, redetect_below=count)
    return 1e3 * seconds(lambda: odometry.run(sequence, settings), time.process_time) / len(sequence)


def pass_memory(sequence, frames, runs):
    """Megabytes that a pass of so many runs over so many frames adds to a process, and what it takes at the start.

    The frames of the sequence are gone through to and fro until there are as many.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_pass, sequence, frames, runs).result()


def peak_memory():
    """Bytes: the most that this process has taken so far, without what the one that started it had (Linux)."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))


def _pass(sequence, frames, runs):
    order = np.resize([*range(len(sequence)), *range(len(sequence) - 2, 0, -1)], frames)
    longer = copy(sequence)
    longer.frame_paths, longer._poses = [sequence.frame_paths[index] for index in order], sequence.poses[order]
    longer.times = 0.1 * np.arange(frames)
    settings = {f"{seed}": (replace(THESIS, shuffle_seed=seed or None), None) for seed in range(runs)}
    odometry.run_many(sequence, settings)  # loads and compiles everything
    start = peak_memory()
    odometry.run_many(longer, settings)
    return (peak_memory() - start) / 2**20, start / 2**20


def prediction_cost(model, paths):
    """Milliseconds a frame, from file to file: of `write_label_maps`, and of `model.predict` for each, as in A.7."""
    from thesis_repro.segmentation import prediction

    def one_by_one(folder):
        for path in paths:
            image = read_image(path, *model.input_shape[1:])[None].astype(np.float32)
            write_png(folder / f"{path.stem}.png", model.predict(image, verbose=0).argmax(-1)[0].astype(np.uint8))

    with tempfile.TemporaryDirectory() as temporary:
        folder, costs = Path(temporary), []
        for name, work in (("maps", lambda to: prediction.write_label_maps(model, paths, to)), ("single", one_by_one)):
            work(folder / f"{name}-warm")  # compiles
            costs.append(1e3 * seconds(lambda: work(folder / name)) / len(paths))  # noqa: B023
    return costs


def measure(sequence, frames=200, runs=4, models=None):
    """A table: what is measured, its unit, the measure, what it is set against, and their ratio."""
    from thesis_repro.segmentation import prediction
    from thesis_repro.segmentation.unet import build_unet

    rows = []

    def add(what, unit, pair, against):
        measured, reference = map(float, pair)
        rows.append({"what": what, "unit": unit, "measured": measured, "against": against, "reference": reference,
                     "ratio": measured / reference})

    odometry.run_many(sequence.subset(2), {"": (THESIS, None)})  # compiles and loads what the first use would
    with opencv_threads(1):
        add("a step of the odometry", "ms", step_cost(sequence), "its bare OpenCV calls")
        *pair, same = shared_cost(sequence)
        add(f"{1 + len(WIDTHS)} runs in one pass, {'the' if same else 'NOT THE'} same bits", "ms a frame", pair,
            "one by one")
        costs = {count: keypoint_cost(sequence, count) for count in KEYPOINTS}
    for count, cost in costs.items():
        add(f"{count} keypoints", "ms a frame", (cost, costs[2000]), "2000 keypoints")
    add(f"memory that {runs} runs over {frames} frames add", "MB", pass_memory(sequence, frames, runs), "at the start")
    models = models or {"model in the package": prediction.load_shipped(),
                        "the thesis's network": build_unet((320, 320, 1), N_CLASSES)}
    for name, model in models.items():
        add(f"label maps, {name}", "ms a frame", prediction_cost(model, sequence.frame_paths[:16]),
            "model.predict one by one")
    return pd.DataFrame(rows)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", required=True, type=Path, help="KITTI odometry folder (sequences, poses)")
    parser.add_argument("--sequence", default="00")
    parser.add_argument("--frames", default=40, type=int, help="taken from its start (40)")
    parser.add_argument("--output", type=Path, default=Path("bench.json"))
    options = parser.parse_args(arguments)
    try:
        table = measure(Sequence(options.kitti, options.sequence).subset(options.frames))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    write_text(options.output, table.to_json(orient="records", indent=1) + "\n")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, OpenCV {cv2.__version__}")
    print(table.to_string(index=False, float_format="{:.3g}".format))
    return 0


if __name__ == "__main__":
    sys.exit(main())
