"""Tables as LaTeX, typeset where pdflatex is installed."""

import numpy as np
import pandas as pd
import pytest
from typeset import PDFLATEX, assert_fits

from thesis_repro.report import latex

NAMES = [
    "my segmentation network",
    "RMSE MAE",
    "RESNETBACKBONE",
    "net_2%",
    "Masks*",
    "[best] {of} ~all^<3>",
    "a" * 60,
]
RATIO = "10.85 (0.71-1180.41), no clear difference"


def table(rows, columns):
    """A table of hard texts: long words, LaTeX's own characters, missing cells."""
    cells = {
        "sequence": [f"2011_09_26_drive_{row:04d}_sync" for row in range(rows)],
        "keypoints": [NAMES[row % len(NAMES)] for row in range(rows)],
    }
    for column in range(columns):
        texts = {
            f"keypoint_mask {column} of aligned ATE, RMSE (m)": [RATIO, None],
            f"RMSE {column} & 100 %": [123456.789, np.nan],
            f"n{column}": [3, 12],
        }
        name, values = list(texts.items())[column % 3]
        cells[name] = (values * rows)[:rows]
    return pd.DataFrame(cells)


TABLES = {
    "none": pd.DataFrame(),
    "no rows": table(0, 3),
    "one cell": table(1, 1),
    "wide": table(3, 40),
    "long": table(150, 4),
    "many sources": pd.DataFrame({"masks": ["ratio"], **{name: [RATIO] for name in NAMES}}),
}


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("columns", ["onecolumn", "twocolumn"])
@pytest.mark.skipif(not PDFLATEX, reason="needs pdflatex")
def test_any_table_fits_the_columns_of_an_article(name, columns, tmp_path):
    text = latex.latex(TABLES[name], ["masks", "sequence", "keypoints"])
    assert_fits({"table": text}, columns, tmp_path)


def test_every_cell_is_in_the_text_once_and_labels_are_repeated():
    rows = table(60, 9)
    text = latex.latex(rows, ["sequence", "keypoints"]).replace(r"\allowbreak{}", "")
    pieces = text.split(r"\begin{tabular}")[1:]
    assert len(pieces) > 3
    for name in rows.columns[2:]:
        assert sum(latex.escaped(name).replace(r"\allowbreak{}", "") in piece for piece in pieces)
    ratios = rows.iloc[:, 2::3].notna().to_numpy().sum()
    assert text.count(RATIO) == ratios
    assert text.count("0007") == text.count("0008") > 1
    assert latex.latex(rows.iloc[:0], ["sequence"]) == ""
