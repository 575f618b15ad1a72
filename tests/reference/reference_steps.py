"""Record real steps in numbers: python tests/reference/reference_steps.py KITTI MASKS.

Writes the files of this folder, from which every clone checks both estimators on real data. README
says what they hold, and how the masks are made. KITTI: folder of sequences. MASKS: a folder of
masks for each of 00, 01 and 07.
"""

import hashlib
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from thesis_repro.data.sequence import Sequence
from thesis_repro.masks.folders import MaskFolder
from thesis_repro.odometry import THESIS, Odometry, run_many
from thesis_repro.odometry.estimators import refined
from thesis_repro.odometry.loop import normalise

FOLDER = Path(__file__).parent
SETTINGS = {"thesis": THESIS, "refined": replace(THESIS, estimator=refined)}
# {run: (its sequence, its first and its last recorded step, its keypoints in place of 2000)};
# step n ends in frame n
STEPS = {
    "00": ("00", 1, 3),
    "00_masked": ("00", 1, 4),
    "01": ("01", 16, 19),  # the vote moves the camera backwards from step 17 on
    "01_masked": ("01", 22, 29),  # about 120 points, and several wrong motions
    "02": ("02", 80, 82),  # a turn
    "05": ("05", 130, 133),  # a sharper turn, with far points
    "06": ("06", 1, 3),
    "07": ("07", 1, 3),  # steps of 0.1 m: nearly all points are too far away to vote
    "07_masked": ("07", 1, 7),  # the vote turns the camera by 180 degrees in step 4
    "05_few": ("05", 129, 149, 500),  # the turn again; a shift to the side explains it as well
    "05_start": ("05", 1, 1, 300),  # a minimum that a second start leaves
}
FEW_POINTS = (5, 6, 7, 8)  # points
DECIMALS = 7  # of poses in a digest: different processors change them by up to 6e-14 m


def digest(poses):
    """SHA-256 of the bytes of poses (N, 4, 4), which are rounded first."""
    rounded = np.round(poses, DECIMALS) + 0.0  # zero has one sign
    return hashlib.sha256(rounded.tobytes()).hexdigest()


def matched_points(before, after, mask=None, count=2000):
    """Points of a frame and where they are in the next frame, (N, 2) float32 pixels each."""
    points = cv2.goodFeaturesToTrack(before, count, 0.01, 3, blockSize=5, mask=mask)
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, None, winSize=(21, 21), maxLevel=3, criteria=(3, 30, 0.01)
    )
    return points[status == 1], tracked[status == 1]


def estimated(previous, current, camera):
    """Return what OpenCV's calls make of matched points: one row of a file."""
    points = normalise(current, camera), normalise(previous, camera)
    matrix, inliers = cv2.findEssentialMat(
        *points, focal=1, pp=(0, 0), method=cv2.RANSAC, prob=0.999, threshold=0.0003
    )
    votes, rotation, translation = 0, np.full((3, 3), np.nan), np.full(3, np.nan)
    if len(matrix) == 3:
        votes, rotation, translation, _ = cv2.recoverPose(matrix, *points, focal=1, pp=(0, 0))
    return {
        "previous": previous,
        "current": current,
        "matches": len(current),
        "matrices": matrix,
        "solutions": len(matrix) // 3,
        "inliers": inliers.ravel() > 0,
        "votes": votes,
        "rotations": rotation,
        "translations": translation.ravel(),
    }


def steps(sequence, masks, first, last, count=2000):
    """Return one row for each step. The refined estimator knows nothing before the first one."""
    follower = Odometry(sequence.intrinsics, replace(SETTINGS["refined"], max_keypoints=count))
    follower.step(sequence.frame(first - 1), mask=masks[first - 1])
    rows = []
    for index in range(first, last + 1):
        frames = sequence.frame(index - 1), sequence.frame(index)
        points = matched_points(*frames, masks[index - 1], count)
        row = estimated(*points, sequence.intrinsics)
        step = follower.step(frames[1], sequence.scales[index], masks[index])
        np.testing.assert_array_equal(step.current, row["current"])
        motion = {
            "frames": index,
            "scales": step.scale,
            "true_motions": np.linalg.inv(sequence.poses[index - 1]) @ sequence.poses[index],
            "updated": step.updated,
            "refined_rotations": step.motion.rotation,
            "refined_translations": step.motion.translation,
            "flags": step.motion.flag,
        }
        rows.append(row | motion)
    return rows


def few_points(sequence):
    """Return steps of few points. Five of them have several essential matrices."""
    previous, current = matched_points(sequence.frame(0), sequence.frame(1))
    slices = [slice(start, start + count) for count in FEW_POINTS for start in range(0, 200, 50)]
    return [estimated(previous[few], current[few], sequence.intrinsics) for few in slices]


def no_parallax(sequence):
    """Return a step of a camera that stands, and one of a camera that only turns."""
    standing = matched_points(sequence.frame(0), sequence.frame(0))
    turn, _ = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))
    warp = sequence.intrinsics @ turn @ np.linalg.inv(sequence.intrinsics)
    turned = cv2.perspectiveTransform(standing[0][:, None].astype(float), warp)
    turning = standing[0], turned[:, 0].astype(np.float32)
    return [estimated(*points, sequence.intrinsics) for points in (standing, turning)]


def write(name, rows, camera):
    """Write rows as one file. What has a row for each point or matrix is joined."""
    columns = {"camera": camera}
    for column in rows[0]:
        is_joined = column in ("previous", "current", "matrices", "inliers")
        join = np.concatenate if is_joined else np.array
        columns[column] = join([row[column] for row in rows])
    np.savez_compressed(FOLDER / f"{name}.npz", **columns)


def main(kitti, masks):
    """Write all files."""
    paths = []
    for run, (name, *wanted) in STEPS.items():
        sequence = Sequence(kitti, name)
        folder = MaskFolder(masks, sequence) if "masked" in run else None
        rows = steps(sequence, folder or [None] * len(sequence), *wanted)
        write(run, rows, sequence.intrinsics)
        if len(wanted) > 2:
            continue
        settings = {estimator: (value, folder) for estimator, value in SETTINGS.items()}
        for estimator, result in run_many(sequence, settings).items():
            paths.append((run, estimator, len(sequence), digest(result.poses)))
    street = Sequence(kitti, "00")
    write("few_points", few_points(street), street.intrinsics)
    write("no_parallax", no_parallax(street), street.intrinsics)
    pd.DataFrame(paths, columns=["run", "estimator", "frames", "sha256"]).to_csv(
        FOLDER / "poses.csv", index=False, lineterminator="\n"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
