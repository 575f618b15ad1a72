"""Numbers of tables, and tables in files."""

from pathlib import Path

import pandas as pd

IMPROVED = "sequences improved"  # a row of counts


def three_digits(value: float) -> float:
    """Round a number to three significant digits."""
    return float(f"{value:.3g}")


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
