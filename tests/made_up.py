"""Runs with made-up errors, as `runner.run` gives them."""

import numpy as np
import pandas as pd

from thesis_repro.study import compare
from thesis_repro.study.jobs import ESTIMATORS, Job


def runs(
    names, errors, widths, *, sources=("",), estimators=tuple(ESTIMATORS), repetitions=3, noise=0.0
):
    """Runs in which every metric is errors(sequence, method, width), and the MAE half of it.

    widths: {method: widths}; a method with widths [None] has no source. noise: relative spread of
    the repetitions.
    """
    random, rows = np.random.default_rng(0), []
    arms = [
        (method, width, source)
        for method, method_widths in widths.items()
        for width in method_widths
        for source in (sources if width else [""])
    ]
    for name in names:
        for method, width, source in arms:
            for estimator in estimators:
                for repetition in range(repetitions):
                    error = errors(name, method, width) * np.exp(noise * random.normal())
                    job = Job(
                        name,
                        method,
                        width,
                        estimator=estimator,
                        repetition=repetition,
                        source=source,
                    )
                    rows.append(
                        {
                            "run": job.name,
                            **vars(job),
                            "frames": 100,
                            "flagged": 0,
                            "mean_keypoints": 500 + width if width else 1900,
                            **dict.fromkeys(compare.METRICS, error),
                            "mae": error / 2,
                        }
                    )
    return pd.DataFrame(rows).astype({"dilation_width": float})
