"""The tables on real frames that are in git are those of the runs that are in git."""

import re

import pandas as pd
import pytest

import evidence
import write_texts
from keypoint_study import comparisons
from keypoint_study.report import comparison, style
from thesis import few_keypoints, tables

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
COMPLETE = "thesis, complete KITTI sequences"


def runs(name):
    return write_texts.read_table(f"{write_texts.REAL}{name}")


def of_the_thesis(metric=None):
    masked, baseline = (
        comparisons.of_method(runs("runs"), name) for name in ("masked", "baseline")
    )
    if metric is None:
        return tables.table_4_1(masked, COMPLETE)
    shuffled = runs("shuffled_runs")
    return tables.table_of_change(masked, baseline, shuffled, metric, COMPLETE)


def all_pairs():
    rows = comparison.all_of(comparisons.comparisons_of(runs("runs")))
    return comparison.table_of_ratios(rows)


TABLES = {
    "comparison": all_pairs,
    "widths": lambda: comparison.table_of_widths(runs("runs")).content,
    "table_4_1": of_the_thesis,
    "table_4_2": lambda: of_the_thesis("rmse"),
    "table_4_3": lambda: of_the_thesis("mae"),
    "refined_widths": lambda: evidence.table_of_widths(runs("refined_widths_runs")),
    "every_second": lambda: few_keypoints.table_of_few(
        few_keypoints.ratios_to_all(runs("every_second_runs"))
    ),
    "few_keypoints": lambda: few_keypoints.table_of_few(
        few_keypoints.ratios_to_all(runs("few_keypoints_runs"))
    ),
}


def words_and_numbers(path, columns):
    """Return a table's text with # for each number, and the numbers."""
    text = pd.read_csv(path, dtype=str)[columns].to_csv()
    return NUMBER.sub("#", text), [float(number) for number in NUMBER.findall(text)]


@pytest.mark.parametrize("name", TABLES)
def test_tables_in_git_are_those_of_the_runs_in_git(name, tmp_path):
    table = TABLES[name]()
    style.save_table(table, tmp_path, name, "")
    (words, numbers), (words_in_git, numbers_in_git) = (
        words_and_numbers(folder / f"{name}.csv", list(table))
        for folder in (tmp_path, evidence.FOLDER)
    )
    assert words.splitlines() == words_in_git.splitlines()
    assert numbers == pytest.approx(numbers_in_git, rel=1e-3, abs=0.011)  # runs have six digits
