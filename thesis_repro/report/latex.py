"""Tables as LaTeX that fits a column of any article, one or two a page; it needs only booktabs.

A table that is too wide becomes several, one below the other, which repeat what tells its rows
apart. A long one becomes several, too, so that a page can end between them: LaTeX's longtable
refuses two columns a page.
"""

import re
from collections.abc import Collection, Iterable

import pandas as pd

# The narrowest column that a table must fit is that of article with two columns: 229 points.
COLUMN = 229
LABEL = 78  # points, the widest label
CHARACTER = 4.1  # points, mean width in LaTeX's \scriptsize
GAP = 6  # points between two columns
LINES = 45  # of text in one table; a page of article has 65
LONGEST_WORD = 12  # characters; LaTeX may break a longer word anywhere after as many
ESCAPED = {character: f"\\{character}" for character in "&%$#_{}"}
ESCAPED |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
ESCAPED |= {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
# \hspace: LaTeX does not hyphenate the first word of a cell
HEAD = rf"""\providecommand{{\leftcell}}{{\raggedright\hspace{{0pt}}}}
\providecommand{{\rightcell}}{{\raggedleft\hspace{{0pt}}}}
\par{{\scriptsize\setlength{{\tabcolsep}}{{{GAP / 2:g}pt}}"""


def latex(table: pd.DataFrame, labels: Collection[str]) -> str:
    """Return a table as LaTeX. labels: names of the columns that tell rows apart, if it has them.

    A table without rows gives an empty text.
    """
    if table.empty:
        return ""
    names = [name for name in labels if name in table]
    label = table[names].map(_plain).agg(_joined, axis=1).rename(_joined(names))
    cells = table.drop(columns=names)
    numeric = {name for name in cells if pd.api.types.is_numeric_dtype(cells[name])}
    cells = cells.map(_plain)
    parts = []
    for names in _blocks(cells):
        block = pd.concat([label, cells[names]], axis=1)
        parts += [_tabular(rows, numeric) for rows in _chunks(block)]
    return "\n".join([HEAD, "\n\\par\\medskip\n".join(parts), "\\par}", ""])


def _plain(value: object) -> str:
    """Return a cell as text, numbers with six digits; "" if it is missing."""
    if pd.isna(value):
        return ""
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)


def _joined(texts: Iterable[str]) -> str:
    return ", ".join(text for text in texts if text)


def _blocks(cells: pd.DataFrame) -> list[list[str]]:
    """Return the names of the columns that fit beside a label, for one table after another."""
    blocks: list[list[str]] = []
    left = 0.0
    for name in cells:
        width = _width(cells[name])
        if width > left or not blocks:
            blocks.append([])
            left = COLUMN - LABEL
        blocks[-1].append(name)
        left -= width
    return blocks


def _width(column: pd.Series) -> float:
    """Return the width in points that a column needs: that of its longest word, and a gap."""
    words = " ".join([str(column.name), *column]).split()
    return max((_word_width(word[:LONGEST_WORD]) for word in words), default=0) + GAP


def _word_width(word: str) -> float:
    capitals = sum(character.isupper() for character in word)
    return CHARACTER * (len(word) + 0.6 * capitals)


def _chunks(block: pd.DataFrame) -> list[pd.DataFrame]:
    """Return the rows of a table in pieces of at most LINES lines of text."""
    widths = _widths(block)
    lines = pd.Series(1, block.index)
    for name, width in widths.items():
        # words that do not fill a line need more of them
        needed = 1 + 1.4 * CHARACTER * block[name].str.len() // width
        lines = lines.where(lines > needed, needed)
    piece = (lines.cumsum() - 1) // LINES
    return [rows for _, rows in block.groupby(piece.to_numpy())] or [block]


def _widths(block: pd.DataFrame) -> dict[str, float]:
    """Return the width in points of each column, the label first; together they fill COLUMN."""
    label, *names = block
    widths = {name: _width(block[name]) for name in names}
    return {label: COLUMN - sum(widths.values())} | widths


def _tabular(rows: pd.DataFrame, numeric: set[str]) -> str:
    columns, align = "", {}
    for name, width in _widths(rows).items():
        columns += rf"p{{\dimexpr{width / COLUMN:.4f}\linewidth-{GAP}pt\relax}}"
        align[name] = r"\rightcell " if name in numeric else r"\leftcell "
    lines = [rf"\noindent\begin{{tabular}}{{{columns}}}", r"\toprule"]
    lines += [_row(rows.columns, align), r"\midrule"]
    lines += [_row(texts, align) for texts in rows.itertuples(index=False)]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _row(texts: pd.Index | tuple[str, ...], align: dict[str, str]) -> str:
    cells = [start + escaped(text) for start, text in zip(align.values(), texts, strict=True)]
    return " & ".join(cells) + r" \tabularnewline"


def escaped(text: str) -> str:
    """Return a text for LaTeX, with places at which long words may be broken."""
    pieces = re.sub(rf"(\S{{{LONGEST_WORD}}})(?=\S)", "\\1\0", text)
    latex_text = "".join(ESCAPED.get(character, character) for character in pieces)
    return latex_text.replace("\0", r"\allowbreak{}")
