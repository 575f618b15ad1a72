"""The recorded trainings of the default run's network, which differ only in their seed.

`tools/trainings.py` writes the table. It has one row for each training and estimator.
"""

import pandas as pd

from keypoint_study import comparisons, jobs
from thesis.settings import ROOT, Settings
from thesis_repro.running import provenance
from thesis_repro.running.files import listed

TABLE = ROOT / "figures" / "trainings.csv"
COLUMN_TITLES = {  # columns of the table: their names in `table_of_trainings`
    "keypoints": "keypoints with masks",
    "mean_iou": "mean IoU of the label maps",
    "se3_ratio": f"ratio of the {comparisons.METRIC_TITLES['se3']}",
    "rotation_ratio": f"ratio of the {comparisons.METRIC_TITLES['rotation']}",
    "rmse_ratio": "ratio of the RMSE",
    "table_4_2_mean": "mean of Table 4.2 (%), best of 15 widths",
    "table_4_2_improved": "sequences improved in Table 4.2",
    "controls_beaten": "controls without segmentation that masks beat",
}


def read() -> pd.DataFrame:
    """Return the table; the first training is the one that `make figures` repeats."""
    return pd.read_csv(TABLE)


def table_of_trainings() -> pd.DataFrame:
    """Return the lowest, median and highest training of each number, and how often which verdict.

    One row for each estimator and number.
    """
    parts = {}
    for estimator, rows in read().groupby("estimator", sort=False):
        numbers = rows[[name for name in COLUMN_TITLES if rows[name].notna().all()]]
        table = numbers.agg(["min", "median", "max"]).T.round(2).astype(object)
        table = table.rename(COLUMN_TITLES)
        counts = rows["verdict"].value_counts().items()
        table.loc["verdict"] = [", ".join(f"{count} {name}" for name, count in counts), "", ""]
        parts[jobs.ESTIMATOR_TITLES[str(estimator)]] = table[["min", "median", "max"]]
    table = pd.concat(parts, names=["estimator", "number"]).reset_index()
    return table.rename(columns={"min": "lowest", "max": "highest"})


def network_note(settings: Settings) -> str:
    """Return one line that says whether a run's network is the recorded one, to the bit.

    It is empty for a run of other data or sizes. The digest of the network's weights is in the
    record of its label maps.
    """
    folders = listed(settings.build / "labels", "*")
    if not settings.figures_in_git or not folders:
        return ""
    network, recorded = provenance.record(folders[0])["model"], read()["network"].iloc[0]
    if network == recorded:
        return f"The network of this run is the recorded one, to the bit ({network})."
    return (
        f"The network of this run ({network}) is not the recorded one ({recorded}). Causes: a notebook "
        "was edited; TensorFlow or Keras have another version; a GPU was used; the processor is not "
        "x86, or has no AVX2; TF_ENABLE_ONEDNN_OPTS, ONEDNN_MAX_CPU_ISA, XLA_FLAGS or "
        "TF_NUM_INTRAOP_THREADS were set. If only sums were rounded otherwise, numbers differ as "
        f"between the trainings in {TABLE.relative_to(ROOT)}."
    )
