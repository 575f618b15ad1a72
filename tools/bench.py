"""Measure what odometry and masks cost on this machine, as ratios.

Usage: python tools/bench.py --kitti ROOT.

Machines differ and are busy, so only the ratio of two measurements taken in turn in one process
counts. Prints a table and writes it as JSON. A slow machine is no error.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path

from thesis_repro import segmentation  # noqa: F401  sets what TensorFlow reads at its import

# isort: split
import cv2
import numpy as np
import pandas as pd

from keypoint_study import methods
from keypoint_study.sources import Source
from thesis.settings import ROOT
from thesis_repro import masks, odometry
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import folders
from thesis_repro.odometry import THESIS, Odometry, loop, sharing
from thesis_repro.odometry.estimators import refined
from thesis_repro.running import program
from thesis_repro.running.files import write_text
from thesis_repro.segmentation import prediction

FRAMES = 40  # from the sequence's start; longer runs go back and forth over them
LENGTHS = (100, 1000)  # frames of a run with 2,000 keypoints
KEYPOINTS = (200, 2000, 5000)  # of a run of LENGTHS[0] frames
TOGETHER = (1, 16, 64)  # runs in one pass
REPEATS = 3
WIDTHS = range(1, 17)  # dilation widths in pixels; with all keypoints, 17 runs
FIRST_USE = "import thesis_repro.odometry.refined, thesis_repro.odometry.sharing"

FASTER = loop.Calls(
    track=sharing.track,
    find_essential_matrix=sharing.find_essential_matrix,
    recover_pose=sharing.recover_pose,
)  # those of a long run
ONE_RUN = """
import sys, time
import cv2
import thesis_repro as tr
from thesis_repro.odometry.sharing import SharedCalls
cv2.setNumThreads(1)
root, name, frames = sys.argv[1:]
drive = tr.Sequence(root, name)
tr.run(drive.subset(3), calls=SharedCalls().calls)
started = time.perf_counter()
tr.run(drive.subset(int(frames)), calls=SharedCalls().calls)
print(time.perf_counter() - started)
"""


def seconds(work, clock=time.perf_counter):
    """Return the seconds that a call takes."""
    started = clock()
    work()
    return clock() - started


def bare_calls(previous, frame, points, intrinsics):
    """Return the OpenCV calls of one step of the thesis's odometry, functions without arguments."""
    calls = loop.OPENCV
    tracked, followed = calls.track(previous, frame, points)
    old, new = (loop.normalise(corners[followed], intrinsics) for corners in (points, tracked))
    matrix, _ = calls.find_essential_matrix(new, old, THESIS.threshold)
    return [
        lambda: calls.track(previous, frame, points),
        lambda: calls.find_essential_matrix(new, old, THESIS.threshold),
        lambda: calls.recover_pose(matrix, new, old),
        lambda: calls.detect(frame),
    ]


def step_cost(sequence):
    """Return the milliseconds of a thesis step, a refined step and the bare OpenCV calls.

    They are medians of the best of 3.
    """
    followers = [
        Odometry(sequence.intrinsics, replace(THESIS, estimator=make)) for make in (None, refined)
    ]
    metres, costs = sequence.scales, []
    clock = time.thread_time  # does not count other processes
    previous = sequence.frame(0)
    for follower in followers:
        follower.step(previous)
    for index, frame in enumerate(list(sequence)[1:], 1):
        calls = bare_calls(previous, frame, followers[0].points, sequence.intrinsics)
        before, least = followers, np.full(3, np.inf)
        for _ in range(REPEATS):  # in turn, so that all three share the machine's load
            followers = [copy(follower) for follower in before]
            row = [
                seconds(partial(follower.step, frame, metres[index]), clock)
                for follower in followers
            ]
            least = np.minimum(least, [*row, sum(seconds(call, clock) for call in calls)])
        costs.append(1e3 * least)
        previous = frame
    return np.median(costs, axis=0)


def shared_cost(sequence):
    """Return CPU milliseconds a frame of runs in one pass and one by one.

    The last value is whether their poses are equal.
    """
    # edges of the frames stand in for label maps
    contours = [cv2.Canny(cv2.GaussianBlur(frame, (0, 0), 4), 20, 60) for frame in sequence]
    runs = {"": (THESIS, None)} | {
        f"{width}": (THESIS, [masks.dilate(edges, width) for edges in contours]) for width in WIDTHS
    }
    together, alone = {}, {}

    def one_by_one():
        alone.update({name: odometry.run(sequence, *run) for name, run in runs.items()})

    costs = [
        seconds(lambda: together.update(odometry.run_many(sequence, runs)), time.process_time),
        seconds(one_by_one, time.process_time),
    ]
    same = all(np.array_equal(together[name].poses, alone[name].poses) for name in runs)
    return *(1e3 * cost / len(sequence) for cost in costs), same


def bouncing(sequence, frames):
    """Return a sequence of so many frames in memory, which goes back and forth over another."""
    there = range(len(sequence) - 1)
    order = np.resize([*there, *(len(sequence) - 1 - k for k in there)], frames)
    pictures = list(sequence)
    for picture in pictures:
        picture.setflags(write=False)
    scales = np.ones(frames)
    chosen = [pictures[k] for k in order]
    return Sequence.from_arrays(chosen, sequence.intrinsics, scales=scales)


def plain_script(sequence, settings):
    """Call OpenCV's four functions on every frame, as a short script of one's own does."""
    points, previous = None, None
    for frame in sequence:
        if previous is not None:
            tracked, followed = loop.track(previous, frame, points, settings)
            old, new = (
                loop.normalise(side[followed], sequence.intrinsics) for side in (points, tracked)
            )
            matrix, _ = loop.find_essential_matrix(new, old, settings.threshold)
            loop.recover_pose(matrix[:3], new, old)
            points = tracked[followed]
        if points is None or len(points) < settings.redetect_below:
            points = loop.detect(frame, settings)
        previous = frame


def of_keypoints(number):
    """Return the thesis's settings with another number of keypoints."""
    quality = min(THESIS.quality, 20 / number)
    return replace(THESIS, max_keypoints=number, redetect_below=number, quality=quality)


def call_costs(sequence):
    """Yield (what, milliseconds, reference) of three calls against OpenCV's, the best of 5."""
    previous, frame = (sequence.frame(k) for k in range(2))
    for picture in (previous, frame):
        picture.setflags(write=False)
    for number in KEYPOINTS:
        points = loop.detect(previous, of_keypoints(number))
        tracked, followed = loop.track(previous, frame, points)
        old, new = (
            loop.normalise(side[followed], sequence.intrinsics) for side in (points, tracked)
        )
        matrix, _ = loop.find_essential_matrix(new, old, THESIS.threshold)
        arguments = {
            "track": (previous, frame, points),
            "find_essential_matrix": (new, old, THESIS.threshold),
            "recover_pose": (matrix, new, old),
        }
        for name, values in arguments.items():
            least = np.full(2, np.inf)
            for _ in range(5):
                for k, calls in enumerate((FASTER, loop.OPENCV)):
                    work = partial(getattr(calls, name), *values)
                    least[k] = min(least[k], seconds(work, time.thread_time))
            yield f"{name}, {len(points)} points", *(1e3 * least)


def run_costs(sequence):
    """Yield (what, milliseconds a frame, reference) of whole runs against the plain script."""
    cases = [(LENGTHS[0], number) for number in KEYPOINTS]
    cases += [(frames, THESIS.max_keypoints) for frames in LENGTHS[1:]]
    for frames, number in cases:
        drive, settings = bouncing(sequence, frames), of_keypoints(number)
        costs = [
            seconds(partial(odometry.run, drive, settings, calls=FASTER), time.process_time),
            seconds(partial(plain_script, drive, settings), time.process_time),
        ]
        yield f"a run, {frames} frames, {number} keypoints", *(1e3 * np.array(costs) / frames)
    one = None
    for count in TOGETHER:
        drive = bouncing(sequence, FRAMES)
        runs = {seed: (replace(THESIS, shuffle_seed=seed), None) for seed in range(count)}
        cost = seconds(partial(odometry.run_many, drive, runs), time.process_time)
        one = one or cost
        yield f"{count} runs in one pass, a run", *(1e3 * np.array([cost / count, one]) / FRAMES)
    one, both = (max(wall_of_processes(sequence, count)) for count in (1, 2))
    yield "a run in each of two processes", *(1e3 * np.array([both, one]) / len(sequence))


def wall_of_processes(sequence, count):
    """Return the seconds of a run in each of so many processes at once, without their starts."""
    folder, frames = sequence.folder, str(len(sequence))
    command = [sys.executable, "-c", ONE_RUN, folder.parents[1], folder.name, frames]
    begun = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(count)]
    return [float(process.communicate()[0]) for process in begun]


def mask_cost(sequence, labels):
    """Return CPU milliseconds a mask, for masks made together and one by one.

    The masks are those of all widths and methods.
    """
    source, costs = Source(labels), np.zeros(2)
    kinds = [source.masks(sequence, width) for width in WIDTHS]
    for name in set(methods.MASK_CONTROLS) - {"true-labels"}:
        _, control = methods.METHODS[name].choose(methods.Asked(sequence, source))
        kinds += [control] * (control is not None)  # a method may have settings alone
    for index in range(len(sequence)):
        for column, forget in enumerate((lambda: None, folders.forget_edges)):
            folders.forget_edges()
            for kind in kinds:
                forget()
                costs[column] += seconds(lambda: kind[index], time.process_time)  # noqa: B023
    return 1e3 * costs / len(sequence) / len(kinds)


def compile_cost():
    """Return the CPU seconds until the refined odometry is ready.

    The first value is with an empty Numba cache, the second with a full one.
    """

    def clock():
        return os.times().children_user + os.times().children_system

    with tempfile.TemporaryDirectory() as cache:
        work = partial(
            subprocess.run,
            [sys.executable, "-c", FIRST_USE],
            check=True,
            env={**os.environ, "NUMBA_CACHE_DIR": cache},
        )
        return [seconds(work, clock) for _ in range(2)]


def cost_ratios(sequence):
    """Return a table with a row for each measurement, its reference and their ratio."""
    # loads compiled code
    odometry.run_many(sequence.subset(2), {"": (replace(THESIS, estimator=refined), None)})
    cv2.setNumThreads(1)  # one thread makes times comparable
    step, refined_step, bare = step_cost(sequence)
    together, alone, same = shared_cost(sequence.subset(12))
    with tempfile.TemporaryDirectory() as labels:
        prediction.write_label_maps(prediction.load_shipped(), sequence.frame_paths, labels)
        shared_masks, single_masks = mask_cost(sequence, Path(labels))
        first, second = compile_cost()
    in_one_pass = f"{1 + len(WIDTHS)} runs in one pass, {'the' if same else 'NOT THE'} same bits"
    table = pd.DataFrame(
        [
            ("a step of the odometry", "ms", step, "its bare OpenCV calls", bare),
            ("a refined step", "ms", refined_step, "a step", step),
            (in_one_pass, "ms a frame", together, "one by one", alone),
            (
                "masks and controls made together",
                "ms a mask",
                shared_masks,
                "one by one",
                single_masks,
            ),
            ("first use, compiling", "s", first, "second use", second),
        ],
        columns=["what", "unit", "measured", "against", "reference"],
    )
    return table.assign(ratio=table["measured"] / table["reference"])


def scale(sequence):
    """Return a table of calls and runs against OpenCV's, and of more runs against one."""
    cv2.setNumThreads(1)
    odometry.run(sequence.subset(3), calls=FASTER)  # loads compiled code
    rows = [*call_costs(sequence), *run_costs(sequence)]
    table = pd.DataFrame(rows, columns=["what", "measured", "reference"])
    table.insert(1, "unit", ["ms" if "points" in what else "ms a frame" for what in table["what"]])
    against = [
        "OpenCV's" if "points" in what or "frames" in what else "one" for what in table["what"]
    ]
    table.insert(3, "against", against)
    return table.assign(ratio=table["measured"] / table["reference"])


def main():
    """Print the ratios, and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kitti", required=True, type=Path, help="KITTI odometry folder (sequences, poses)"
    )
    options = parser.parse_args()
    drive = Sequence(options.kitti, "00").subset(FRAMES)
    table = pd.concat([cost_ratios(drive), scale(drive)], ignore_index=True)
    write_text(ROOT / "build" / "bench.json", table.to_json(orient="records", indent=1) + "\n")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, OpenCV {cv2.__version__}")
    print(table.to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    program.run_main(main)
