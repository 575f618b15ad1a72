"""The table of the errors of all sequences, and tables as files and as HTML."""

from pathlib import Path

import pandas as pd
from markupsafe import Markup

from thesis_repro.study import compare
from thesis_repro.study.jobs import ESTIMATORS
from thesis_repro.study.methods import ERRORS

IMPROVED = "sequences improved"  # a row of counts, and of a mean of counts


def three_digits(value: float) -> float:
    """Round a number to three significant digits."""
    return float(f"{value:.3g}")


def table_errors(runs: pd.DataFrame) -> pd.DataFrame:
    """Return keypoints and errors with all keypoints and with masks, by sequence.

    They are means over the repetitions.
    """
    rows = runs[runs["method"].isin(["baseline", "masked"])]
    metrics = [name for name in compare.METRICS if name in rows and rows[name].notna().any()]
    keys = ["sequence", "estimator", "method", "source", "dilation_width"]
    numbers = ["frames", "mean_keypoints", *metrics, "flagged"]
    means = rows.groupby(keys, dropna=False)[numbers].mean().reset_index()
    has_no_source = means["source"] == ""
    table = pd.DataFrame()
    table["sequence"] = means["sequence"]
    table["estimator"] = means["estimator"].map(ESTIMATORS)
    table["keypoints"] = means["source"].mask(has_no_source, means["method"].map(compare.METHODS))
    table["width (pixels)"] = means["dilation_width"].astype("Int64")
    table["frames"] = means["frames"].astype(int)
    table["number"] = means["mean_keypoints"].round().astype(int)
    for name in metrics:
        label = f"{compare.METRICS[name]} ({ERRORS[name].unit})"
        table[label] = means[name].map(three_digits)
    table["flagged frames"] = means["flagged"].round(1)
    groups = rows.groupby(keys, dropna=False)
    table["failed runs"] = [compare.count_failed(runs_of_row) for _, runs_of_row in groups]
    return table


def read(path: Path) -> pd.DataFrame:
    """Read a CSV file as a table with nullable integers.

    Returns an empty table if the file does not exist.
    """
    if not path.is_file():
        return pd.DataFrame()
    # a name may look like a number or a missing value
    texts = dict.fromkeys(("sequence", "masks", "source"), str)
    table = pd.read_csv(path, dtype=texts, keep_default_na=False, na_values=[""])
    return table.convert_dtypes()


def html(table: pd.DataFrame) -> Markup:
    """Return a table as HTML with escaped texts.

    The numbers of a column have the same number of digits. Where most numbers of a row are whole,
    and in the row IMPROVED, whole numbers are counts and stay whole.
    """
    floats = table.select_dtypes("Float64").astype(float)
    is_whole = floats.eq(floats.round())
    has_counts = is_whole.sum(axis=1) > floats.notna().sum(axis=1) / 2
    has_counts |= table.iloc[:, 0].astype(str).eq(IMPROVED)
    shown = {}
    numeric = 0
    for name, cells in table.items():
        numeric += pd.api.types.is_numeric_dtype(cells.dtype)
        if name in floats:
            shown[name] = _equal_digits(floats[name], has_counts & is_whole[name])
        else:
            shown[name] = cells.astype(object).where(cells.notna(), "")
    style = "words"
    if numeric > len(shown) / 2:
        style = "numbers"
    text = pd.DataFrame(shown).to_html(
        index=False, border=0, na_rep="", justify="unset", classes=style
    )
    return Markup(text)


def _equal_digits(numbers: pd.Series, is_count: pd.Series) -> pd.Series:
    """Return numbers as texts with as many digits after the point as most fractions have.

    Counts have none. A number that was written with more digits keeps them (at most six), so that
    0.9971 does not become 1.00. Missing numbers are empty.
    """
    decimals = numbers.map(lambda number: len(f"{number:.6f}".rstrip("0").partition(".")[2]))
    common = decimals[decimals > 0].mode().max()
    decimals = decimals.clip(lower=common).mask(is_count, 0)
    shown = [f"{number:.{places}f}" for number, places in zip(numbers, decimals, strict=True)]
    return pd.Series(shown, numbers.index).mask(numbers.isna(), "")
