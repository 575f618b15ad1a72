"""Made-up paths, and runs with made-up errors, as `runner.run_all` gives them."""

from itertools import product

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from keypoint_study import comparisons
from keypoint_study.jobs import Job


def runs(
    names,
    errors,
    widths,
    *,
    sources=("",),
    estimators=("thesis", "refined"),
    repetitions=3,
    noise=0.0,
):
    """Runs in which every metric is errors(sequence, method, width), and the MAE half of it.

    widths: {method: widths}; a method with widths [None] has no source. noise: relative spread of
    the repetitions.
    """
    arms = []
    for method, method_widths in widths.items():
        for width in method_widths:
            sources_of_width = sources if width else [""]
            arms += [(method, width, source) for source in sources_of_width]
    random = np.random.default_rng(0)
    rows = []
    for name, arm, estimator, repetition in product(names, arms, estimators, range(repetitions)):
        method, width, source = arm
        error = errors(name, method, width) * np.exp(noise * random.normal())
        job = Job(name, method, width, estimator=estimator, repetition=repetition, source=source)
        row = {"run": job.name, **vars(job), "frames": 100, "flagged": 0}
        row |= {"failed": 0.0, "lost": 0, "mean_keypoints": 1900}
        if width:
            row["mean_keypoints"] = 500 + width
        row |= dict.fromkeys(comparisons.METRIC_TITLES, error)
        row["mae"] = error / 2
        rows.append(row)
    return pd.DataFrame(rows).astype({"dilation_width": float})


def winding(count=160, seed=None):
    """Poses of a path with rotations about all axes and steps of one metre.

    With a seed, steps have noise.
    """
    random = np.random.RandomState(seed)
    noise = seed is not None
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        turn = np.array([0.01 * np.sin(index), 0.03, 0.02 * np.cos(index)])
        turn += noise * random.normal(0, 0.01, 3)
        rotation = Rotation.from_rotvec(turn).as_matrix()
        poses[index] = poses[index - 1]
        poses[index, :3, :3] = poses[index - 1, :3, :3] @ rotation
        poses[index, :3, 3] += poses[index, :3, 2] + noise * random.normal(0, 0.05, 3)
    return poses
