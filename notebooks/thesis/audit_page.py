"""The audit's page in git: the words of each row once, and the numbers of two runs beside them."""

from pathlib import Path

import pandas as pd

from keypoint_study.report import style

WORDS = ["where", "the thesis or its code", "what would be right", "switch"]
NAMED = ["row", "quantity", "metric", "estimator", "unit"]  # what a number is
ARITHMETIC = "the thesis's numbers"  # in the column data: needs no run


def text(folder: Path, real: Path, note: str) -> str:
    """Return the page, made from audit.csv of the run in git and of the one on real frames.

    folder: of the page and of the run in git. real: in it. note: names the data of the run in git.
    """
    at = real.name
    data = {"embedded world": note, "real frames": f"[{at}]({at}/README.md)"}
    tables = dict(zip(data, map(_read, (folder, real))))
    notes = []
    for name, table in tables.items():
        times = [each for each in table["data"].unique() if each.startswith("timed on")]
        notes.append(f"Column {name}: {'; '.join([data[name], *times])}.")
    notes.append("In parentheses: 95 % intervals. Numbers of sequences and frames:")
    notes.append(f"[audit.csv](audit.csv), [{at}/audit.csv]({at}/audit.csv).")
    return f"{style.markdown(side_by_side(tables))}\n{' '.join(notes)}\n"


def side_by_side(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Return audits as one table: a column of values, with their 95 % intervals, for each of them.

    Another column has what is arithmetic with the thesis's numbers, the same in all. The first line
    of a row has the row's words, those of the first audit. tables: {name: its audit.csv, as texts}.
    """
    lines = pd.concat([table.assign(column=name) for name, table in tables.items()])
    lines["column"] = lines["column"].mask(lines["data"] == ARITHMETIC, ARITHMETIC)
    lines["number"] = [*map(_number, lines["value"], lines["low"], lines["high"])]
    numbers = {
        tuple(line[:-1]): line[-1] for line in lines[[*NAMED, "column", "number"]].to_numpy()
    }
    shown = lines[NAMED].drop_duplicates()
    has_numbers = set(shown.loc[shown["quantity"] != "", "row"])
    shown = shown[(shown["quantity"] != "") | ~shown["row"].isin(has_numbers)]
    shown = shown.sort_values("row", key=lambda row: row.astype(int), kind="stable")
    for column in (ARITHMETIC, *tables):
        shown[column] = [numbers.get((*line, column), "") for line in shown[NAMED].to_numpy()]
    words = lines.drop_duplicates("row").set_index("row")[WORDS].loc[shown["row"]]
    words[shown["row"].duplicated().to_numpy()] = ""
    return pd.concat(
        [words.reset_index(), shown.drop(columns="row").reset_index(drop=True)], axis=1
    )


def _read(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "audit.csv", dtype=str, keep_default_na=False)


def _number(value: str, low: str, high: str) -> str:
    """Return a value and its interval, if it has one: "0.766 (0.43 to 5.9)"."""
    if not value:
        return ""
    ends = f" ({float(low):g} to {float(high):g})" if low and high else ""
    return f"{float(value):g}{ends}"
