"""Measure what the odometry costs on this machine, as ratios: python tools/bench.py KITTI.

The first rows are those of opencv_exact's README: its three functions beside OpenCV's. The others
show how the cost of runs grows. Machines differ and are busy, so only the ratio of two measurements
taken in turn in one process counts. Prints a table, and writes it to build/bench.json.
"""

import argparse
import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from thesis.run_settings import ROOT
from thesis_repro import odometry
from thesis_repro.data.sequence import Sequence
from thesis_repro.odometry import THESIS, loop, sharing
from thesis_repro.running import program
from thesis_repro.running.files import write_text

FRAMES = 40  # from the sequence's start; longer runs go back and forth over them
KEYPOINTS = (200, 2000, 5000)
LENGTHS = (100, 1000)  # frames of a run; of the longer one, with 2,000 keypoints alone
TOGETHER = (1, 16, 64)  # runs in one pass
REPEATS = 5  # of a call; the least counts

FASTER = loop.Calls(
    track=sharing.track,
    find_essential_matrix=sharing.find_essential_matrix,
    recover_pose=sharing.recover_pose,
)  # those of a long run


def seconds(work, clock):
    """Return the seconds that a call takes by a clock."""
    started = clock()
    work()
    return clock() - started


def row(what, unit, measured, against, reference):
    """Return a row of the table; the times are seconds."""
    numbers = {"measured": 1e3 * measured, "against": against, "reference": 1e3 * reference}
    return {"what": what, "unit": unit, **numbers, "ratio": measured / reference}


def of_keypoints(number):
    """Return the thesis's settings with another number of keypoints."""
    quality = min(THESIS.quality, 20 / number)
    return replace(THESIS, max_keypoints=number, redetect_below=number, quality=quality)


def normalised(points, tracked, followed, sequence):
    """Return the points that were followed, and their places before, in normalised coordinates."""
    new, old = tracked[followed], points[followed]
    return loop.normalise(new, sequence.intrinsics), loop.normalise(old, sequence.intrinsics)


def call_costs(sequence):
    """Return rows of three calls beside OpenCV's."""
    previous, frame = sequence.frame(0), sequence.frame(1)
    for picture in (previous, frame):
        picture.setflags(write=False)
    rows = []
    for number in KEYPOINTS:
        points = loop.detect(previous, of_keypoints(number))
        new, old = normalised(points, *loop.track(previous, frame, points), sequence)
        matrix, _ = loop.find_essential_matrix(new, old, THESIS.threshold)
        arguments = {
            "track": (previous, frame, points),
            "find_essential_matrix": (new, old, THESIS.threshold),
            "recover_pose": (matrix, new, old),
        }
        for name, values in arguments.items():
            least = {FASTER: np.inf, loop.OPENCV: np.inf}
            for _ in range(REPEATS):  # in turn, so that both share the machine's load
                for calls in least:
                    work = partial(getattr(calls, name), *values)
                    least[calls] = min(least[calls], seconds(work, time.thread_time))
            what = f"{name}, {len(points)} points"
            rows.append(row(what, "ms", least[FASTER], "OpenCV's", least[loop.OPENCV]))
    return rows


def bouncing(sequence, frames):
    """Return a sequence of so many frames in memory, which goes back and forth over another."""
    there = range(len(sequence) - 1)
    order = np.resize([*there, *(len(sequence) - 1 - k for k in there)], frames)
    pictures = list(sequence)
    for picture in pictures:
        picture.setflags(write=False)
    chosen = [pictures[k] for k in order]
    return Sequence.from_arrays(chosen, sequence.intrinsics, scales=np.ones(frames))


def plain_script(sequence, settings):
    """Call OpenCV's four functions on every frame, as a short script of one's own does."""
    points, previous = None, None
    for frame in sequence:
        if previous is not None:
            tracked, followed = loop.track(previous, frame, points, settings)
            new, old = normalised(points, tracked, followed, sequence)
            matrix, _ = loop.find_essential_matrix(new, old, settings.threshold)
            loop.recover_pose(matrix[:3], new, old)
            points = tracked[followed]
        if points is None or len(points) < settings.redetect_below:
            points = loop.detect(frame, settings)
        previous = frame


def run_costs(sequence):
    """Return rows of whole runs beside the plain script, and of a run among others beside one."""
    rows = []
    cases = [(LENGTHS[0], number) for number in KEYPOINTS]
    for frames, number in [*cases, (LENGTHS[1], THESIS.max_keypoints)]:
        drive, settings = bouncing(sequence, frames), of_keypoints(number)
        run = partial(odometry.run, drive, settings, calls=FASTER)
        ours = seconds(run, time.process_time) / frames
        plain = seconds(partial(plain_script, drive, settings), time.process_time) / frames
        what = f"a run, {frames} frames, {number} keypoints"
        rows.append(row(what, "ms a frame", ours, "OpenCV's", plain))
    costs = {}
    for count in TOGETHER:
        drive = bouncing(sequence, FRAMES)
        runs = {seed: (replace(THESIS, shuffle_seed=seed), None) for seed in range(count)}
        whole = seconds(partial(odometry.run_many, drive, runs), time.process_time)
        costs[count] = whole / count / FRAMES
        what = f"{count} runs in one pass, a run"
        rows.append(row(what, "ms a frame", costs[count], "one", costs[1]))
    return rows


def bench(sequence):
    """Return the table of a sequence."""
    cv2.setNumThreads(1)  # one thread makes times comparable
    odometry.run(sequence.subset(3), calls=FASTER)  # loads compiled code
    return pd.DataFrame([*call_costs(sequence), *run_costs(sequence)])


def main():
    """Print the ratios, and write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kitti", type=Path, help="KITTI odometry folder (sequences, poses)")
    table = bench(Sequence(parser.parse_args().kitti, "00").subset(FRAMES))
    write_text(ROOT / "build" / "bench.json", table.to_json(orient="records", indent=1) + "\n")
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, OpenCV {cv2.__version__}")
    print(table.to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    program.run_main(main)
