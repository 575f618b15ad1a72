"""The recorded trainings of the default run's network, which differ only in their seed.

`tools/trainings.py` writes the table. It has one row for each training and estimator.
"""

from typing import Any

import pandas as pd

from thesis_repro.running import results
from thesis_repro.running.files import listed
from thesis_repro.running.settings import ROOT, Settings

TABLE = ROOT / "figures" / "trainings.csv"


def read() -> pd.DataFrame:
    """Return the table; the first training is the one that `make figures` repeats."""
    return pd.read_csv(TABLE)


def summary() -> list[dict[str, Any]]:
    """Return what the trainings give, one dict for each estimator.

    count: of trainings. verdicts: {verdict: number of trainings that give it}, the commonest first.
    ranges: {column: (lowest, median, highest)} over the trainings, for columns that the estimator
    has.
    """
    trainings = []
    for estimator, rows in read().groupby("estimator", sort=False):
        numbers = rows.select_dtypes("number").dropna(axis="columns")
        low, middle, high = numbers.min(), numbers.median(), numbers.max()
        ranges = {name: (low[name], middle[name], high[name]) for name in numbers}
        verdicts = rows["verdict"].value_counts().to_dict()
        trainings.append(
            {"estimator": estimator, "count": len(rows), "verdicts": verdicts, "ranges": ranges}
        )
    return trainings


def network_note(settings: Settings) -> str:
    """Return one line that says whether a run's network is the recorded one, to the bit.

    It is empty for a run of other data or sizes. The digest of the network's weights is in the
    record of its label maps.
    """
    folders = listed(settings.build / "labels", "*")
    if not settings.figures_in_git or not folders:
        return ""
    network, recorded = results.record(folders[0])["model"], read()["network"].iloc[0]
    if network == recorded:
        return f"The network of this run is the recorded one, to the bit ({network})."
    return (
        f"The network of this run ({network}) is not the recorded one ({recorded}). Causes: a notebook "
        "was edited; TensorFlow or Keras have another version; a GPU was used; the processor is not "
        "x86, or has no AVX2; TF_ENABLE_ONEDNN_OPTS, ONEDNN_MAX_CPU_ISA, XLA_FLAGS or "
        "TF_NUM_INTRAOP_THREADS were set. If only sums were rounded otherwise, numbers differ as "
        f"between the trainings in {TABLE.relative_to(ROOT)}."
    )
