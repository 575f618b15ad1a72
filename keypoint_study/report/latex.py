"""Tables for a paper: LaTeX that fits one of two columns, in letters of 8 points."""

import re
from collections.abc import Iterable
from pathlib import Path
from textwrap import wrap

import matplotlib
import pandas as pd
from matplotlib.font_manager import get_font

from keypoint_study.report.style import Artefact

SIZE = 8  # points
COLUMN = 229  # points, of a column of article; IEEE's has 252
NAMES = 85  # points, of the first column at most; longer names are broken
GAP = 6  # points between columns
HEADING = 14  # letters of a line of a heading
NEEDS = f"""% in the preamble: \\usepackage{{booktabs}}
% for a column of {COLUMN} points or more (article in two columns has {COLUMN}, IEEE 252)
"""
SPLIT_BY = ("error", "estimator", "masks")  # columns whose values stand in the caption
FONT = Path(matplotlib.get_data_path(), "fonts", "ttf", "cmr10.ttf")  # Computer Modern
SPECIAL = {letter: f"\\{letter}" for letter in "&%$#_{}"}
SPECIAL |= {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "<": "$<$",
    ">": "$>$",
}


def latex_of(artefact: Artefact, table: pd.DataFrame) -> str:
    """Return a table as LaTeX, with the artefact's title and caption, and a label made of its name.

    The columns SPLIT_BY divide it into tables. Of the others, the first is in each table, and as
    many as fit follow it. A text between ** is bold.
    """
    parts: Iterable[tuple] = [((), table)]
    keys = [name for name in SPLIT_BY if name in table]
    if keys:
        parts = table.groupby(keys, sort=False)
    pieces = []
    for values, rows in parts:
        rows = rows.drop(columns=keys).astype(object).fillna("").astype(str)
        pieces += [(values, rows[columns]) for columns in _fitting(rows)]
    texts = []
    for number, (values, rows) in enumerate(pieces, 1):
        caption = ", ".join([artefact.title, *values])
        if number == 1:
            caption = f"{caption}. {artefact.caption}"
        texts.append(_float(rows, caption, f"tab:{artefact.name}-{number}"))
    return "\n".join([NEEDS, *texts])


def _fitting(rows: pd.DataFrame) -> list[list[str]]:
    """Divide the columns of a table into lists that fit; each begins with the first column."""
    first, *others = rows.columns
    fitting: list[list[str]] = []
    room = 0.0
    for name in others:
        width = GAP + max(map(width_of, [*wrap(name, HEADING), *rows[name]]))
        if width > room:
            fitting.append([first])
            room = COLUMN - NAMES
        fitting[-1].append(name)
        room -= width
    return fitting


def width_of(text: str) -> float:
    """Return the width of a text in Computer Modern, in points."""
    font = get_font(FONT)
    font.set_size(SIZE, 72)
    # other letters have about the width of this one
    font.set_text(re.sub(r"[^ -~]", "+", text.replace("*", "")))
    width, _ = font.get_width_height()
    return width / 64


def _float(rows: pd.DataFrame, caption: str, label: str) -> str:
    shown = rows.map(escaped)
    shown.columns = [_heading(name) for name in rows]
    text = shown.to_latex(
        index=False,
        escape=False,
        caption=escaped(caption),
        label=label,
        column_format=f"@{{}}p{{{NAMES}pt}}{'l' * (len(rows.columns) - 1)}@{{}}",
    )
    letters = (
        f"\\fontsize{{{SIZE}}}{{{SIZE + 2}}}\\selectfont\\setlength{{\\tabcolsep}}{{{GAP / 2}pt}}"
    )
    return text.replace("\\begin{tabular}", f"{letters}\n\\begin{{tabular}}", 1)


def _heading(name: str) -> str:
    lines = [escaped(line) for line in wrap(name, HEADING)]
    return "\\shortstack[l]{" + r" \\ ".join(lines) + "}"


def escaped(text: str) -> str:
    """Return a text for LaTeX; what stands between ** is bold."""
    letters = "".join(SPECIAL.get(letter, letter) for letter in text)
    return re.sub(r"\*\*(.*?)\*\*", r"\\textbf{\1}", letters)
