"""Count the failures of the refined estimator, in runs of every method with the matched points
shuffled.

python tools/reliability.py --kitti ROOT --labels DIR --output FOLDER prints a row for each
sequence, method and number of keypoints. A run fails if its RMSE is more than SPREAD times the
median over its shuffles. A step of more than MOVING metres fails if its rotation is wrong by more
than WRONG degrees without a flag. Each sequence and method has a file, so a stopped series resumes.
The results on real frames are in reliability.md beside this file.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from thesis_repro import InputError, console, odometry, results
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks, MaskSettings
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.refined.motion_prior import AMBIGUOUS, NOT_DETERMINED
from thesis_repro.study import controls
from thesis_repro.study.sources import Source
from thesis_repro.study.timing import opencv_threads

SPREAD, MOVING, WRONG = 1.5, 0.25, 2.0  # ratio, metres, degrees
KEYPOINTS, SHUFFLES = (300, 500, 1000, 2000, 4000), 20
WIDTHS = (5, 10)
SPREAD_OUT = 12  # least distance between keypoints, pixels
CONTROLS = ("corrected", "other-frame", "mirrored", "random-lines", "image-edges")


def methods(sequence, labels=None):
    """Return {name: (settings, masks)}: all keypoints, spread-out keypoints, and with label
    maps masks and controls.
    """
    spread = replace(THESIS, min_distance=SPREAD_OUT)
    by_name = {"all": (THESIS, None), "spread": (spread, None)}
    if labels is not None:
        for width in WIDTHS:
            by_name[f"masked-{width}"] = THESIS, LabelMasks(labels, sequence, width)
            by_name[f"exact-{width}"] = (
                THESIS,
                LabelMasks(labels, sequence, width, MaskSettings("exact")),
            )
        for name in CONTROLS:
            by_name[name] = THESIS, controls.masks(name, Source(labels), sequence, WIDTHS[-1])
    return by_name


def trial(sequence, settings, masks, keypoints=KEYPOINTS, shuffles=SHUFFLES):
    """Run one method; return a DataFrame with a row for each run: RMSE (m) and the counts of
    `count_steps`.
    """
    runs = {
        (count, shuffle): (
            replace(
                settings, estimator="refined", max_keypoints=count, shuffle_seed=shuffle or None
            ),
            masks,
        )
        for count in keypoints
        for shuffle in range(shuffles)
    }
    run_results = odometry.run_many(sequence, runs)
    moving = odometry.scales(sequence) > MOVING
    return pd.DataFrame(
        [
            {
                "keypoints": count,
                "shuffle": shuffle,
                "rmse": metrics.rmse(result.poses, sequence.poses),
                **count_steps(result, sequence, moving),
            }
            for (count, shuffle), result in run_results.items()
        ]
    )


def count_steps(result, sequence, moving):
    """Return the largest error of a rotation (degrees), and how many moving steps have which
    kind of failure.
    """
    true, turns = (
        np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (sequence.poses, result.poses)
    )
    wrong = np.where(
        moving, np.concatenate([[0.0], metrics.angles(np.linalg.inv(true) @ turns)]), 0
    )
    flags = result.frames["flag"]
    return {
        "steps": int(moving.sum()),
        "largest": wrong.max(),
        "wrong": int((wrong > WRONG).sum()),
        "unflagged": int(((wrong > WRONG) & (flags == "")).sum()),
        "ambiguous": int(flags.str.contains(AMBIGUOUS).sum()),
        "not_determined": int(flags.str.contains(NOT_DETERMINED).sum()),
    }


def failures(trials):
    """Return the list of failures: a row for each sequence, method and number of keypoints."""
    cell = ["sequence", "method", "keypoints"]
    times = trials["rmse"] / trials.groupby(cell, sort=False)["rmse"].transform("median")
    cells = trials.assign(times=times, over=times > SPREAD).groupby(cell, sort=False)
    summed = ["over", "steps", "wrong", "unflagged", "ambiguous", "not_determined"]
    return cells.agg(
        runs=("rmse", "size"),
        rmse=("rmse", "median"),
        times=("times", "max"),
        largest=("largest", "max"),
        **{name: (name, "sum") for name in summed},
    ).reset_index()


def measure(options):
    """Return all trials as one DataFrame; trials whose file is already in the output folder are
    not run again.
    """
    folder = results.stage(
        options.output,
        code=results.code("odometry"),
        tool=results.content(Path(__file__)),
        kitti=str(options.kitti),
        labels=str(options.labels),
        keypoints=options.keypoints,
        shuffles=options.shuffles,
        frames=options.frames,
    )
    sequences = [Sequence(options.kitti, name).subset(options.frames) for name in options.sequences]
    jobs = [
        (sequence, name, method)
        for sequence in sequences
        for name, method in methods(
            sequence, options.labels and options.labels / sequence.name
        ).items()
        if options.methods is None or name in options.methods
    ]
    if not jobs:
        raise InputError(
            f"--methods {' '.join(options.methods)}: unknown; masks and controls need --labels"
        )
    tables = []
    for sequence, name, method in progress(jobs, "reliability", unit="method"):
        path = folder / f"{sequence.name}-{name}.csv"
        if not path.is_file():
            with opencv_threads(1):
                table = trial(sequence, *method, options.keypoints, options.shuffles)
            write_text(path, table.assign(sequence=sequence.name, method=name).to_csv(index=False))
        tables.append(pd.read_csv(path, dtype={"sequence": str}))
    return pd.concat(tables, ignore_index=True)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kitti", required=True, type=Path, metavar="ROOT", help="folder of sequences and poses"
    )
    parser.add_argument("--sequences", nargs="+", default=["00"], metavar="NN")
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="DIR",
        help="folder with a folder of label maps for each sequence; needed for masks and controls",
    )
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="names of methods (all)")
    parser.add_argument("--keypoints", nargs="+", type=int, default=list(KEYPOINTS), metavar="N")
    parser.add_argument(
        "--shuffles",
        type=int,
        default=SHUFFLES,
        metavar="N",
        help=f"shuffles a method ({SHUFFLES})",
    )
    parser.add_argument(
        "--frames", type=int, metavar="N", help="frames from each sequence's start (all)"
    )
    parser.add_argument("--output", type=Path, default=Path("reliability"), metavar="DIR")
    options = parser.parse_args(arguments)
    try:
        table = failures(measure(options))
    except InputError as error:
        return console.report_error(error)
    write_text(options.output / "failures.csv", table.to_csv(index=False))
    print(table.round(2).to_string(index=False))
    print(table[["runs", "steps", "over", "wrong", "unflagged"]].sum().to_string())
    return 0


if __name__ == "__main__":
    sys.exit(main())
