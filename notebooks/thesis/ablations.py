"""Ablations: the effect of each single setting of the odometry and of the masks (notebook 09).

Every run differs from a reference run in one setting. The tables have the columns that
`comparisons` needs.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from keypoint_study.jobs import Job, repeated, runs_of
from keypoint_study.methods import ABLATIONS, compared_in
from keypoint_study.runner import run_all, run_poses
from keypoint_study.sources import Source
from thesis_repro import masks
from thesis_repro.data.cityscapes import ID, resize_bilinear
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.loop import detect, normalise, track

COMPARED = ("thesis", "inliers", "refined")  # a new one is compared when it is named here


def run_ablations(
    sequences: list[Sequence], labels: Path, folder: Path, repetitions: int = 1, processes: int = 1
) -> pd.DataFrame:
    """Run the ablations of `methods.METHODS` on every sequence with COMPARED.

    labels: a folder with one folder of label maps a sequence. folder: for the results. The
    estimator "inliers" is run for all keypoints and masks alone.
    Columns: sequence, method, estimator, repetition, those of `runner.run_all`, and sim3 (RMSE in
    metres after an alignment with scale).
    """
    named = [Job(sequence.name, name) for sequence in sequences for name in compared_in(ABLATIONS)]
    jobs = [
        job
        for job in repeated(named, COMPARED, repetitions)
        if job.estimator != "inliers" or job.method in ("baseline", "masked")
    ]
    table = run_all(runs_of(jobs, sequences, [Source(labels)]), folder, processes=processes).table
    poses = run_poses(table, folder)
    true = {sequence.name: sequence.poses for sequence in sequences}
    pairs = zip(table["sequence"], table["run"])
    table["sim3"] = [metrics.ate(poses[name, run], true[name], "sim3") for name, run in pairs]
    return table


# Keypoints and boundaries one by one

FIELDS = (16, 5)  # of a frame, across and down
EXACT = MaskSettings("exact")
THIN = MaskSettings("exact", classes=("pole", "traffic sign"))
NEAR = 2  # pixels: a boundary with an edge within this distance counts as found
PAIRS = (("road", "sidewalk"), ("vegetation", "sky"), ("building", "fence"))


def tracks(sequence: Sequence, masks_by_name: dict[str, Any], pairs: int) -> pd.DataFrame:
    """Measure how well keypoints can be tracked and how they are spread.

    masks_by_name: a mask a frame, None for all keypoints. pairs: number of evenly spread frames
    that are tracked to the next frame. Returns one row for each mask and pair of frames. Columns:
    sequence, frame, method (the name), keypoints; residual, the median distance (pixels) of tracked
    points from the epipolar lines of the true motion; outliers, the percentage of points beyond
    PySLAM's threshold; fields, the percentage of the frame's 16 x 5 fields with a keypoint.
    """
    rows = []
    height, width = sequence.size
    field_size = np.array([width / FIELDS[0], height / FIELDS[1]])
    indices = np.linspace(0, len(sequence) - 2, pairs).round().astype(int)
    for index in np.unique(indices).tolist():
        before, after = sequence.frame(index), sequence.frame(index + 1)
        motion = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        if np.linalg.norm(motion[:3, 3]) < metrics.MIN_DIRECTED_STEP:
            continue
        for name, frame_masks in masks_by_name.items():
            points = detect(before, THESIS, frame_masks[index])
            if len(points) < 10:
                continue
            moved, tracked = track(before, after, points)
            matches = points[tracked], moved[tracked]
            distances = sampson_distances(*matches, motion, sequence.intrinsics)
            fields = np.unique((points // field_size).astype(int), axis=0)
            row = {
                "sequence": sequence.name,
                "frame": index,
                "method": name,
                "keypoints": len(points),
                "residual": sequence.intrinsics[0, 0] * float(np.median(distances)),
                "outliers": 100 * (distances > THESIS.threshold).mean(),
                "fields": 100 * len(fields) / (FIELDS[0] * FIELDS[1]),
            }
            rows.append(row)
    return pd.DataFrame(rows)


def sampson_distances(
    previous: np.ndarray, current: np.ndarray, motion: np.ndarray, intrinsics: np.ndarray
) -> np.ndarray:
    """Return the Sampson distances (n,) of matched pixels (n, 2) under a 4x4 motion.

    They are in units of the focal length. intrinsics: the 3x3 camera matrix.
    """
    essential = np.cross(np.eye(3), motion[:3, 3]) @ motion[:3, :3]
    ones = np.ones(len(previous))
    previous_rays = np.column_stack([normalise(previous, intrinsics), ones])
    current_rays = np.column_stack([normalise(current, intrinsics), ones])
    squares = [
        cv2.sampsonDistance(current_ray, previous_ray, essential)
        for current_ray, previous_ray in zip(current_rays, previous_rays, strict=True)
    ]
    return np.sqrt(squares)


def boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """Measure what Canny on enlarged ids does to the boundaries of a label map, in percent.

    (Audit rows 10, 11, 71 and 72.) size: (height, width) of the enlargement.
    lost: boundary pixels of the map, enlarged by nearest neighbour, without an edge within NEAR
    pixels. The same for each of PAIRS of classes ("road/sidewalk"), NaN for fewer than 20 boundary
    pixels. invented: pixels of the bilinear enlargement whose id no pixel within NEAR pixels has.
    L2, Gaussian: edge pixels, of either kind, that change with the root of squares (Equation 3.11)
    and after a Gaussian.
    """
    nearest = cv2.resize(label_map, size[::-1], interpolation=cv2.INTER_NEAREST)
    bilinear = resize_bilinear(label_map, size)
    exact = masks.edges(label_map, size, EXACT) > 0
    edges = masks.edges(label_map, size)
    missed = masks.dilate(edges, 2 * NEAR + 1) == 0
    shares = {
        "lost": _percent(missed, exact, least=1),
        "invented": _percent_invented(bilinear, nearest),
    }
    # across a boundary: the pixel to the right or, if that has the same id, the one below
    right, below = np.roll(nearest, -1, axis=1), np.roll(nearest, -1, axis=0)
    neighbour = np.where(nearest != right, right, below)
    for pair in PAIRS:
        ids = [ID[name] for name in pair]
        pair_boundary = exact & np.isin(nearest, ids) & np.isin(neighbour, ids)
        shares["/".join(pair)] = _percent(missed, pair_boundary, least=20)
    for name, other in (
        ("L2", cv2.Canny(bilinear, *masks.CANNY, L2gradient=True)),
        ("Gaussian", cv2.Canny(cv2.GaussianBlur(bilinear, (5, 5), 0), *masks.CANNY)),
    ):
        shares[name] = 100 * (edges != other).sum() / max(np.count_nonzero(edges | other), 1)
    return shares


def thin_boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """Return the shares (%) of the boundaries of thin objects that are near an edge.

    (Audit row 87.) By the thresholds of Canny ("thin 5/15"). NaN without thin objects.
    """
    edges_by_name = {}
    for low, high in ((5, 15), (20, 60), (40, 120)):
        canny = MaskSettings(canny=(low, high))
        edges_by_name[f"thin {low}/{high}"] = masks.edges(label_map, size, canny)
    thin = masks.edges(label_map, size, THIN) > 0
    return {
        name: _percent(masks.dilate(edges, 2 * NEAR + 1) > 0, thin, least=1)
        for name, edges in edges_by_name.items()
    }


def _percent(marked: np.ndarray, boundary: np.ndarray, least: int) -> float:
    """Return the percentage of a boundary's pixels that are marked; NaN for fewer than `least`."""
    if boundary.sum() < least:
        return np.nan
    return 100 * marked[boundary].mean()


def _percent_invented(bilinear: np.ndarray, nearest: np.ndarray) -> float:
    """Return the percentage of pixels with an invented id, see `boundaries`."""
    around = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    is_real = np.zeros(nearest.shape, bool)
    for number in np.unique(bilinear):
        is_near = cv2.dilate((nearest == number).astype(np.uint8), around) > 0
        is_real |= (bilinear == number) & is_near
    return 100 * float((~is_real).mean())
