"""Ablations: the effect of each single setting of the odometry and of the masks (notebook 09).

Every run differs from a reference run in one setting. The tables have the columns that
`comparisons` needs.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from keypoint_study.jobs import Job, repeated, runs_of
from keypoint_study.methods import ABLATION, of_group
from keypoint_study.runner import run_all, run_poses
from keypoint_study.sources import Source
from thesis_repro import masks
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import MaskSettings
from thesis_repro.odometry import metrics

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
    methods = ["baseline", "masked", *of_group(ABLATION)]
    named = [Job(sequence.name, method) for sequence in sequences for method in methods]
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


# Boundaries one by one

EXACT = MaskSettings("exact")
THIN = MaskSettings("exact", classes=("pole", "traffic sign"))
NEAR = 2  # pixels: a boundary with an edge within this distance counts as found


def boundaries(label_map: np.ndarray, size: tuple[int, int]) -> dict[str, float]:
    """Return the share (%) of boundary pixels that Canny on enlarged ids loses (audit row 11).

    These have no edge within NEAR pixels. NaN without boundaries. size: (height, width) of the
    enlargement.
    """
    exact = masks.edges(label_map, size, EXACT) > 0
    missed = masks.dilate(masks.edges(label_map, size), 2 * NEAR + 1) == 0
    return {"lost": _percent(missed, exact)}


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
        name: _percent(masks.dilate(edges, 2 * NEAR + 1) > 0, thin)
        for name, edges in edges_by_name.items()
    }


def _percent(marked: np.ndarray, boundary: np.ndarray) -> float:
    """Return the percentage of a boundary's pixels that are marked; NaN without any."""
    return 100 * marked[boundary].mean() if boundary.any() else np.nan
