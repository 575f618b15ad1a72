"""How reliable the refined pose is: every method's runs over a sequence in many orders, and what failed in them.

python -m thesis_repro.bench.reliability --kitti ROOT --labels DIR --output FOLDER prints a table, one line a sequence
and method. A run fails where its RMSE is more than SPREAD times the median over its own orders; a step of more than
MOVING metres fails where it turns wrong by more than WRONG degrees without a flag. Each sequence and method is one
file, so that a series that was stopped goes on where it was.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from thesis_repro import InputError, odometry, stages
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.refined.motion_prior import AMBIGUOUS, NOT_DETERMINED
from thesis_repro.study import controls
from thesis_repro.study.budget import opencv_threads
from thesis_repro.study.sources import Source

SPREAD, MOVING, WRONG = 1.5, 0.25, 2.0
KEYPOINTS = (300, 500, 1000, 2000, 4000)
WIDTHS = (5, 10)
ORDERS = 20
SPREAD_OUT = 12  # pixels between keypoints
CONTROLS = ("corrected", "other-frame", "mirrored", "random-lines", "image-edges")


def methods(sequence, labels=None):
    """{name: (settings, masks)}: all keypoints, all of them spread out, and with label maps the masks and controls."""
    found = {"all": (THESIS, None), "spread": (replace(THESIS, min_distance=SPREAD_OUT), None)}
    if labels is not None:
        for width in WIDTHS:
            found[f"masked-{width}"] = THESIS, LabelMasks(labels, sequence, width)
            found[f"exact-{width}"] = THESIS, LabelMasks(labels, sequence, width, "exact")
        for name in CONTROLS:
            found[name] = THESIS, controls.masks(name, Source(labels), sequence, WIDTHS[-1])
    return found


def trial(sequence, settings, masks, keypoints=KEYPOINTS, orders=ORDERS):
    """One method's runs, a DataFrame with a row each: RMSE (m), the largest wrong turn (degrees), steps by kind."""
    runs = {(count, order): (replace(settings, estimator="refined", max_keypoints=count, shuffle_seed=order or None), masks)
            for count in keypoints for order in range(orders)}
    results = odometry.run_many(sequence, runs)
    moving = odometry.scales(sequence) > MOVING
    return pd.DataFrame([{"keypoints": count, "order": order, "rmse": metrics.rmse(result.poses, sequence.poses),
                          **_steps(result, sequence, moving)} for (count, order), result in results.items()])


def _steps(result, sequence, moving):
    true, turns = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (sequence.poses, result.poses))
    wrong = np.where(moving, np.concatenate([[0.0], metrics.angles(np.linalg.inv(true) @ turns)]), 0)
    flags = result.frames["flag"]
    return {"steps": int(moving.sum()), "largest": wrong.max(),
            "wrong": int((wrong > WRONG).sum()), "unflagged": int(((wrong > WRONG) & (flags == "")).sum()),
            "ambiguous": int(flags.str.contains(AMBIGUOUS).sum()),
            "not_determined": int(flags.str.contains(NOT_DETERMINED).sum())}


def failures(trials):
    """The failure list, a DataFrame with a row for each sequence, method and number of keypoints, from all trials."""
    cells = trials.groupby(["sequence", "method", "keypoints"], sort=False)
    median = cells["rmse"].transform("median")
    trials = trials.assign(over=trials["rmse"] > SPREAD * median, times=trials["rmse"] / median)
    cells = trials.groupby(["sequence", "method", "keypoints"], sort=False)
    table = cells.agg(runs=("rmse", "size"), rmse=("rmse", "median"), times=("times", "max"), over=("over", "sum"),
                      steps=("steps", "sum"), largest=("largest", "max"), wrong=("wrong", "sum"),
                      unflagged=("unflagged", "sum"), ambiguous=("ambiguous", "sum"),
                      not_determined=("not_determined", "sum"))
    return table.reset_index()


def measure(kitti, names, labels, output, chosen=None, keypoints=KEYPOINTS, orders=ORDERS, frames=None):
    """All trials as one DataFrame; those that `output` holds already are not made again."""
    folder = stages.stage(output, code=stages.code("odometry", "bench/reliability"), kitti=str(kitti),
                          labels=str(labels), keypoints=keypoints, orders=orders, frames=frames)
    jobs = [(sequence, name, method) for sequence in (Sequence(kitti, name).subset(frames) for name in names)
            for name, method in methods(sequence, labels and labels / sequence.name).items()
            if chosen is None or name in chosen]
    if not jobs:
        raise InputError(f"methods {' '.join(chosen)}: none is known here; the masks and controls need --labels")
    for sequence, name, method in progress(jobs, "reliability", unit="method"):
        path = folder / f"{sequence.name}-{name}.csv"
        if not path.is_file():
            with opencv_threads(1):
                found = trial(sequence, *method, keypoints, orders)
            found.insert(0, "method", name)
            found.insert(0, "sequence", sequence.name)
            write_text(path, found.to_csv(index=False))
    return pd.concat([pd.read_csv(folder / f"{sequence.name}-{name}.csv", dtype={"sequence": str})
                      for sequence, name, _ in jobs], ignore_index=True)


def main(arguments=None):
    parser = argparse.ArgumentParser(prog="python -m thesis_repro.bench.reliability",
                                     description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", required=True, type=Path, metavar="ROOT", help="folder of sequences and poses")
    parser.add_argument("--sequences", nargs="+", default=["00"], metavar="NN")
    parser.add_argument("--labels", type=Path, metavar="DIR",
                        help="folder with one folder of label maps a sequence; without it, no masks and controls")
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="some of the methods (all)")
    parser.add_argument("--keypoints", nargs="+", type=int, default=list(KEYPOINTS), metavar="N")
    parser.add_argument("--orders", type=int, default=ORDERS, metavar="N", help=f"of the correspondences ({ORDERS})")
    parser.add_argument("--frames", type=int, metavar="N", help="taken from each sequence's start (all)")
    parser.add_argument("--output", type=Path, default=Path("reliability"), metavar="DIR")
    options = parser.parse_args(arguments)
    try:
        table = failures(measure(options.kitti, options.sequences, options.labels, options.output, options.methods,
                                 options.keypoints, options.orders, options.frames))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    write_text(options.output / "failures.csv", table.to_csv(index=False))
    print(table.round(2).to_string(index=False))
    print(f"{table.runs.sum()} runs, {table.steps.sum()} steps: {table.over.sum()} runs over {SPREAD} times their "
          f"median, {table.unflagged.sum()} steps wrong by over {WRONG} degrees without a flag "
          f"({table.wrong.sum()} with those that have one)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
