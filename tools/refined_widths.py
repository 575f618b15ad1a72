"""The refined estimator's errors with masks of every width: one run a width and street.

Shuffled points hardly change the refined estimator, so one run is enough.
"""

import pandas as pd

import choices
from keypoint_study import compare, runner
from keypoint_study.jobs import Job


def measure(sequences, labels, widths, folder, processes=1) -> pd.DataFrame:
    """Return the runs with all keypoints and with masks of each width (pixels).

    labels: folder of the label maps. What is in the folder of the results is not repeated.
    """
    kinds = [("baseline", None), *(("masked", width) for width in widths)]
    jobs = [
        Job(sequence.name, method, width, estimator="refined")
        for sequence in sequences
        for method, width in kinds
    ]
    return runner.run_jobs(jobs, sequences, labels, folder, processes=processes).table


def table(runs) -> pd.DataFrame:
    """Return one row a width: errors divided by those with all keypoints, and failed runs."""
    everything = compare.of_method(runs, "baseline", "refined")
    masked = compare.of_method(runs, "masked", "refined")
    rows = []
    for width, of_width in masked.groupby("dilation_width"):
        ratios = {
            title: choices.ratio_text(compare.ratios(of_width, everything, error))
            for error, title in compare.JUDGING_METRICS.items()
        }
        row = {"dilation width (pixels)": int(width)}
        row["keypoints"] = f"{of_width['mean_keypoints'].mean():.0f}"
        rows.append(row | ratios | {"failed runs": compare.count_failed(of_width)})
    return pd.DataFrame(rows)
