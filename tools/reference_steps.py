"""Record real steps in numbers: python tools/reference_steps.py --kitti ROOT --masks DIR.

Writes tests/reference, from which every clone checks both estimators on real data. The files hold
matched points and what OpenCV's own calls, with PySLAM's arguments, make of them, but no frame.

DIR holds a folder of masks for each sequence of ROOT that is recorded with masks. --pyslam DIR:
runs of PySLAM itself, as CSV; its motions must have the same bits.
"""

import argparse
import hashlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import MaskFolder
from thesis_repro.odometry import THESIS, Odometry, run_many, scales

FOLDER = Path(__file__).parent.parent / "tests" / "reference"
ESTIMATORS = {"thesis": THESIS, "refined": replace(THESIS, estimator="refined")}
# {file: (sequence, its first and its last recorded step)}; a step has the number of its later frame
STEPS = {
    "00": ("00", 1, 3),
    "00_masked": ("00", 1, 4),
    "01": ("01", 16, 19),  # the vote moves the camera backwards from 17 on
    "01_masked": ("01", 22, 29),  # about 120 points; several wrong motions
    "02": ("02", 80, 82),
    "05": ("05", 130, 133),  # a turn with far points
    "06": ("06", 1, 3),
    "07": ("07", 1, 3),  # steps of 0.1 m: points are too far away to vote
    "07_masked": ("07", 1, 7),  # the vote turns the camera by 180 degrees in step 4
}
FEW = (5, 6, 7, 8)  # points; five give several essential matrices
DECIMALS = 9  # of the poses in a digest


def digest(poses):
    """SHA-256 of poses (N, 4, 4), rounded to a nanometre. Processors differ in later digits."""
    rounded = np.round(poses, DECIMALS) + 0.0  # zero has one sign
    return hashlib.sha256(rounded.tobytes()).hexdigest()


def matched_points(before, after, mask):
    """Points of one frame and where they are in the next frame, (N, 2) float32 pixels each."""
    points = cv2.goodFeaturesToTrack(before, 2000, 0.01, 3, blockSize=5, mask=mask)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, None, winSize=(21, 21), maxLevel=3, criteria=(3, 30, 0.01)
    )
    return points[status == 1], tracked[status == 1]


def estimated(previous, current, camera):
    """Return what OpenCV makes of matched points, as one row of a file."""
    inverse = np.linalg.inv(camera)
    inverse[:2, 2] = -camera[:2, 2] / np.diag(camera)[:2]
    old, new = (
        (inverse @ np.c_[side.astype(float), np.ones(len(side))].T).T[:, :2]
        for side in (previous, current)
    )
    matrix, inliers = cv2.findEssentialMat(
        new, old, focal=1, pp=(0, 0), method=cv2.RANSAC, prob=0.999, threshold=0.0003
    )
    votes, rotation, translation = 0, np.full((3, 3), np.nan), np.full(3, np.nan)
    if len(matrix) == 3:
        votes, rotation, translation, _ = cv2.recoverPose(matrix, new, old, focal=1, pp=(0, 0))
    return {
        "previous": previous,
        "current": current,
        "matches": len(current),
        "matrices": matrix,
        "inliers": inliers.ravel() > 0,
        "votes": votes,
        "rotations": rotation,
        "translations": translation.ravel(),
    }


def steps(sequence, masks, first, last):
    """Return one row for each step; the refined estimator starts with the first one."""
    follower, metres, rows = Odometry(sequence.intrinsics, ESTIMATORS["refined"]), scales(sequence), []
    follower.step(sequence.frame(first - 1), mask=masks[first - 1])
    for index in range(first, last + 1):
        frames = sequence.frame(index - 1), sequence.frame(index)
        row = estimated(*matched_points(*frames, masks[index - 1]), sequence.intrinsics)
        step = follower.step(frames[1], metres[index], masks[index])
        np.testing.assert_array_equal(step.current, row["current"])
        row |= {"frames": index, "scales": metres[index], "updated": step.updated}
        row |= {"refined_rotations": step.motion.rotation, "flags": "; ".join(step.flags)}
        rows.append(row | {"refined_translations": step.motion.translation})
    return rows


def hard_cases(sequence):
    """Return {file: rows} of a few points, and of points that are seen without parallax."""
    camera, frame = sequence.intrinsics, sequence.frame(0)
    previous, current = matched_points(frame, sequence.frame(1), None)
    few = [
        estimated(previous[start : start + count], current[start : start + count], camera)
        for count in FEW
        for start in range(0, 200, 50)
    ]
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))
    warp = camera @ turn @ np.linalg.inv(camera)
    turned = cv2.perspectiveTransform(previous[:, None].astype(float), warp)[:, 0]
    no_parallax = [
        estimated(*matched_points(frame, frame, None), camera),  # a standing camera
        estimated(previous, turned.astype(np.float32), camera),  # one that only turns
    ]
    return {"few_points": few, "no_parallax": no_parallax}


def check(rows, recorded):
    """Compare the steps with PySLAM's own run, a table: the same bits and numbers of points."""
    motions = [column for column in recorded if column.startswith("rel_")]
    for row in rows:
        expected = recorded.loc[row["frames"]]
        motion = [*row["rotations"].ravel(), *row["translations"]]
        np.testing.assert_array_equal(expected[motions], motion)
        counts = [row["matches"], row["inliers"].sum(), row["votes"]]
        names = ["n_tracked", "n_inliers_E", "n_inliers_recoverPose"]
        np.testing.assert_array_equal(expected[names], counts)


def write(path, rows, camera):
    """Write rows as one file: what has a row for each point joined, anything else stacked."""
    tallest = max(len(row["matrices"]) for row in rows)
    columns = {"camera": camera}
    for name in rows[0]:
        values = [row[name] for row in rows]
        if name in ("previous", "current", "inliers"):
            columns[name] = np.concatenate(values)
        elif name == "matrices":
            columns[name] = np.full((len(rows), tallest, 3), np.nan)
            for place, matrix in zip(columns[name], values, strict=True):
                place[: len(matrix)] = matrix
        else:
            columns[name] = np.array(values)
    np.savez_compressed(path, **columns)


def main():
    """Read the arguments and write the files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kitti", required=True)
    parser.add_argument("--masks", required=True)
    parser.add_argument("--pyslam", type=Path)
    given = parser.parse_args()
    paths = []
    for run, (name, first, last) in STEPS.items():
        sequence = Sequence(given.kitti, name)
        masks = MaskFolder(given.masks, sequence) if "masked" in run else None
        rows = steps(sequence, masks or [None] * len(sequence), first, last)
        if given.pyslam and (given.pyslam / f"{run}.csv").exists():
            check(rows, pd.read_csv(given.pyslam / f"{run}.csv", index_col="frame"))
        write(FOLDER / f"{run}.npz", rows, sequence.intrinsics)
        settings = {key: (value, masks) for key, value in ESTIMATORS.items()}
        for estimator, result in run_many(sequence, settings).items():
            paths.append((run, estimator, len(sequence), digest(result.poses)))
        if run == "00":
            for kind, cases in hard_cases(sequence).items():
                write(FOLDER / f"{kind}.npz", cases, sequence.intrinsics)
    table = pd.DataFrame(paths, columns=["run", "estimator", "frames", "sha256"])
    table.to_csv(FOLDER / "poses.csv", index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
