"""Measure the keypoints on movable things: python tools/moving.py --kitti ROOT --labels DIR.

DynaSLAM leaves such keypoints out, because what moves by itself contradicts the camera's motion.
DIR holds label maps, a folder for each sequence of ROOT that is measured. Writes the share of the
keypoints on movable things, the distances of their tracks from the true epipolar lines, and the
odometry's errors without them, as figures/kitti_excerpts/moving.csv and .md.

A track that moves along its epipolar line has no distance from it: a car ahead that drives in the
camera's direction does not disturb the estimate of a motion between two frames.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from keypoint_study import compare, jobs, runner
from keypoint_study.report import style, texts
from keypoint_study.sources import Source
from thesis.settings import ROOT, cores
from thesis_repro import masks
from thesis_repro.data import kitti
from thesis_repro.data.cityscapes import ID, read_label_map
from thesis_repro.errors import InputError
from thesis_repro.odometry.loop import detect, track
from thesis_repro.running import program

sys.path.append(str(ROOT / "notebooks"))

# isort: split
from thesis import ablations

# ids of label maps
KINDS = {
    "static things": [index for index in ID.values() if index not in masks.MOVABLE],
    "movable things": masks.MOVABLE,
    "of these, people and bicycles": [ID[name] for name in ("person", "rider", "bicycle")],
}
FAR = 2  # pixels from the epipolar line; nearly all tracks of static things are nearer
REPETITIONS = 5
NOTE = (
    "odometry: real KITTI frames; label maps: {labels}; distances of tracked keypoints from the "
    "epipolar lines of the true motion; refined estimator, {repetitions} repetitions"
)


def tracks(sequence, labels):
    """Return one row for each keypoint of a sequence that is tracked into the next frame.

    A row has the id of its label and its distance, pixels, from the epipolar line of the true
    motion. labels: folder of the label maps. Poses may be those of a camera beside: six centimetres
    change the distances by 0.001 pixels.
    """
    rows = []
    for index, name in enumerate(sequence.label_names[:-1]):
        frame, following = sequence.frame(index), sequence.frame(index + 1)
        points = detect(frame)
        moved, tracked = track(frame, following, points)
        motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        distances = sequence.intrinsics[0, 0] * ablations.sampson_distances(
            points[tracked], moved[tracked], motion, sequence.intrinsics
        )
        label_map = cv2.resize(
            read_label_map(labels / name), sequence.size[::-1], interpolation=cv2.INTER_NEAREST
        )
        columns, lines = np.rint(points[tracked]).astype(int).T
        rows.append(pd.DataFrame({"id": label_map[lines, columns], "pixels": distances}))
    return pd.concat(rows, ignore_index=True)


def table(root, labels, build, repetitions=REPETITIONS, frames=None):
    """Return one row for each sequence of a KITTI root with label maps and each of KINDS.

    build: folder for the runs. Raises InputError if no sequence has label maps.
    """
    names = [name for name in kitti.sequences(root) if (labels / name).is_dir()]
    if not names:
        raise InputError(f"{labels}: holds no folder named like a sequence of {root}")
    planned = [
        jobs.Job(name, method, width, estimator="refined", repetition=repetition)
        for name in names
        for method, width in (("baseline", None), ("static", jobs.CONTROL_WIDTH))
        for repetition in range(repetitions)
    ]
    sequences = [kitti.Sequence(root, name).subset(frames) for name in names]
    outcome = runner.run_jobs(planned, sequences, [Source(labels)], build, processes=cores())
    runs = outcome.table
    by_method = [runs[runs["method"] == method] for method in ("static", "baseline")]
    ratios = {metric: compare.ratios(*by_method, metric) for metric in compare.JUDGING_METRICS}
    rows = []
    for sequence in sequences:
        name = sequence.name
        points = tracks(sequence, labels / name)
        for kind, ids in KINDS.items():
            pixels = points.loc[points["id"].isin(ids), "pixels"]
            row = {
                "sequence": name,
                "keypoints on": kind,
                "share (%)": round(100 * len(pixels) / len(points), 1),
                "median distance (px)": round(pixels.median(), 2),
                "upper tenth from (px)": round(pixels.quantile(0.9), 2),
                f"beyond {FAR} px (%)": round(100 * (pixels > FAR).mean(), 1),
            }
            without = {
                f"{compare.METRICS[metric]} without them, ratio": texts.number(by_sequence[name])
                for metric, by_sequence in ratios.items()
                if kind == "movable things"
            }
            rows.append(row | without)
    return pd.DataFrame(rows)


def main():
    """Write and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", type=Path, required=True, metavar="ROOT")
    parser.add_argument("--labels", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    measured = table(options.kitti, options.labels.absolute(), ROOT / "build" / "moving")
    note = NOTE.format(labels=options.labels.name, repetitions=REPETITIONS)
    style.save_table(measured, ROOT / "figures" / "kitti_excerpts", "moving", note)
    print(style.markdown(measured))


if __name__ == "__main__":
    program.run_main(main)
