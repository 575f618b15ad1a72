"""Write README.md, docs and the gallery from templates, with numbers from the tables in git.

After a change of a template, an option or a caption; `make evidence` runs it at its end. A template
asks the functions below for the row of a table, and writes its numbers. Its only conditions are the
outcomes of verdicts.
"""

import re
from functools import cache
from typing import Any

import pandas as pd

from keypoint_study import comparisons, ratios, verdicts
from keypoint_study.report import texts
from thesis import audit, claim_rule, claims, equal_number, few_keypoints, gallery, tables
from thesis.run_settings import ROOT, read_settings
from thesis_repro.command import cli
from thesis_repro.command.options import build_parser
from thesis_repro.running import program
from thesis_repro.running.files import write_text

TEMPLATES = ROOT / "docs" / "templates"
WRITTEN = {"README.md.j2": ROOT / "README.md"}
WRITTEN |= {
    f"{name}.md.j2": ROOT / f"docs/{name}.md" for name in ("answer", "reading-results", "options")
}
REAL = "kitti_excerpts/"  # tables on real frames
# how the texts say a verdict on errors
VERDICT_PHRASES = {
    verdicts.LOWER: "lower than",
    verdicts.HIGHER: "higher than",
    verdicts.NO_CLEAR_DIFFERENCE: "not clearly different from",
    verdicts.TOO_FEW: "of too few streets to be compared with",
}
NAMES = ("sequence", "row", "source", "metric", "estimator")  # columns of texts, if empty, too


@cache
def read_table(name: str) -> pd.DataFrame:
    """Return the table figures/NAME.csv, names of sequences as texts."""
    rows = pd.read_csv(ROOT / "figures" / f"{name}.csv", dtype=dict.fromkeys(NAMES, str))
    texts_in = rows.select_dtypes(exclude="number").columns
    return rows.fillna(dict.fromkeys(texts_in, ""))


def cell(name: str, column: str, row: dict[str, Any]) -> Any:
    """Return what stands in a column of the one row of a table that has the given values."""
    rows = read_table(name)
    (value,) = rows.loc[(rows[list(row)] == pd.Series(row)).all(axis=1), column]
    return value


@cache
def compared(where: str) -> pd.DataFrame:
    """Return the comparisons of the runs on real frames, or of some of them."""
    runs = read_table(f"{REAL}runs")
    return comparisons.comparisons_of(runs.query(where) if where else runs)


def error(
    metric: str,
    method: str = "masked",
    over: str = "baseline",
    estimator: str = "refined",
    where: str = "",
) -> dict[str, Any]:
    """Return the row of `comparisons.comparisons_of` of one error, width 10. where: which runs."""
    rows = compared(where)
    named = {"metric": metric, "method": method, "reference": over, "estimator": estimator}
    is_row = (rows[list(named)] == pd.Series(named)).all(axis=1) & rows["tested"]
    (row,) = rows[is_row].to_dict("records")
    return row


def by_chance(estimator: str = "thesis") -> pd.Series:
    """Return the highest RMSE over the lowest of shuffled runs with all keypoints, by street."""
    rows = ratios.range_of_shuffles(read_table(f"{REAL}runs"))
    return rows.loc[rows["estimator"] == estimator, "factor"]


def streets(of: str) -> str:
    """Return "1" for "1 of 11"."""
    return of.split()[0]


def of_masks() -> pd.DataFrame:
    """Return the deciding errors with masks, over those of all keypoints (refined), by street."""
    pair = equal_number.MASKS, equal_number.EVERY
    tables = read_table(f"{REAL}few_keypoints_runs"), read_table(f"{REAL}runs")
    return equal_number.over(*equal_number.of_pair(*tables, pair, "refined"))


def of_few(choice: str, number: int, column: str, name: str = f"{REAL}few_keypoints") -> Any:
    """Return what stands in a column of the table of few keypoints. number: 0 for no limit."""
    row = {"how chosen": few_keypoints.LABELS[choice]}
    return cell(name, column, row | ({"keypoints": number} if number else {}))


def data_note() -> str:
    """Return what stands below tables of real frames."""
    streets = read_table(f"{REAL}streets")[["sequence", "frames"]].itertuples(index=False)
    lengths = ", ".join(f"{name} ({frames} frames)" for name, frames in streets)
    return f"odometry: real KITTI frames, {lengths}; label maps by the model in the package"


@cache
def at_hand() -> claims.Tables:
    """Return the tables that the claims are tested on."""
    return claims.Tables(read_table, claims.EVIDENCE)


@cache
def all_claims() -> list[claims.Claim]:
    """Return what became of each claim of the thesis."""
    return claims.claims_of(at_hand())


def words() -> str:
    """Return how many claims have each word: "3 reproduced, 2 not reproduced"."""
    found = [each.word for each in all_claims()]
    return ", ".join(f"{found.count(word)} {word}" for word in claim_rule.WORDS)


def by_procedure(metric: str) -> dict[str, float]:
    """Return the mean changes (%) that the thesis's procedure finds, and if masks do nothing."""
    found, studies = claims.procedure(at_hand(), metric)
    means, by_chance = found.mean(), studies.mean(axis=1)
    low, high = tables.middle(by_chance)
    ends = {"least": means.max(), "most": means.min(), "low": low, "high": high}
    return ends | {"by_chance": by_chance.mean()}


def seen(metric: str, side: int) -> float:
    """Return the change of an error with masks that as many sequences would have shown."""
    return claim_rule.seen(at_hand().over("runs", "masked", "baseline", metric), side)


def needed(metric: str) -> str:
    """Return how many sequences would show a change of an error by the thesis's mean."""
    ratio = 1 + audit.CHANGES[metric.upper()].mean() / 100
    return claim_rule.needed(at_hand().over("runs", "masked", "baseline", metric), ratio)


def claim(name: str) -> claims.Claim:
    """Return what became of one claim."""
    (found,) = [each for each in all_claims() if each.name == name]
    return found


def equal(chosen: str, other: str, estimator: str = "refined") -> dict[str, Any]:
    """Return two choices at an equal number: {se3, rotation (typical ratios), verdict, ...}.

    chosen, other: of `equal_number.PAIRS`. hangs: of `equal_number.hangs_on`. failing: of both, the
    streets on which half of the runs fail.
    """
    few_runs, runs = read_table(f"{REAL}few_keypoints_runs"), read_table(f"{REAL}runs")
    sides = equal_number.of_pair(few_runs, runs, (chosen, other), estimator)
    of_streets = equal_number.over(*sides)
    typical = {name: ratios.typical_ratio(of_streets[name]) for name in of_streets}
    told = {"verdict": equal_number.word(of_streets), "hangs": equal_number.hangs_on(of_streets)}
    failed = [streets(equal_number.failing(side)) for side in sides]
    return {**typical, **told, "failing": failed}


def commands() -> dict[str, Any]:
    """Return the parser of options of each command."""
    parser = build_parser(cli.COMMANDS)
    (action,) = [each for each in parser._actions if each.dest == "command"]
    return dict(action.choices or {})


def rows_of_options() -> dict[str, list[str]]:
    """Return a row of a table for each option, with the names of the commands that have it."""
    rows: dict[str, list[str]] = {}
    for name, command in commands().items():
        for option in command._actions[1:]:
            shown = " ".join(option.option_strings)
            if option.nargs != 0:
                value = option.metavar or "|".join(option.choices)
                shown = f"{shown} {value}".strip().replace("|", "\\|")
            row = f"| `{shown}` | {option.help.replace('%%', '%')} |"
            rows.setdefault(row, []).append(name)
    return rows


def whole(number: float) -> str:
    """Return a number without decimals."""
    return f"{number:.0f}"


def two(number: float) -> str:
    """Return a number with two decimals."""
    return f"{number:.2f}"


def with_interval(row: dict[str, Any]) -> str:
    """Return "1.09 (0.98-1.32)" for a ratio, or a value, and its interval."""
    ratio = row["ratio"] if "ratio" in row else row["value"]
    return f"{two(ratio)} ({two(row['low'])}-{two(row['high'])})"


def render(template: str) -> str:
    """Return the text that a template in docs/templates gives."""
    named = {function.__name__: function for function in FUNCTIONS}
    return texts.render(template, **named, errors=VERDICT_PHRASES)


def book() -> str:
    """Return where README finds the book: its address in docs/conf.py, or else the gallery."""
    (address,) = re.findall(r'(?m)^BOOK = "(.*?)"', (ROOT / "docs/conf.py").read_text())
    return address or "figures/README.md"


# that templates call
FUNCTIONS = (
    read_table,
    commands,
    rows_of_options,
    error,
    by_chance,
    by_procedure,
    seen,
    needed,
    of_few,
    claim,
    all_claims,
    words,
    book,
    equal,
    of_masks,
    equal_number.share_of_days,
    whole,
    two,
    with_interval,
)


def write_tables() -> None:
    """Write the tables that are made from other tables in git, and their figure."""
    folder = ROOT / "figures" / REAL
    equal_number.write(lambda name: read_table(f"{REAL}{name}"), folder, data_note())
    write_text(folder / "claims.md", claims.text_of_claims(all_claims(), data_note()))


def main() -> None:
    """Write the tables, then the texts."""
    write_tables()
    for template, path in WRITTEN.items():
        write_text(path, render(template))
    gallery.write(read_settings({}))


texts.LOADER.searchpath.append(str(TEMPLATES))

if __name__ == "__main__":
    program.run_main(main)
