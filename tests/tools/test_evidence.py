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
    masked = comparisons.of_method(runs("runs"), "masked")
    if metric is None:
        return tables.table_4_1(masked, COMPLETE)
    baseline = comparisons.of_method(runs("runs"), "baseline")
    return tables.table_of_change(masked, baseline, runs("shuffled_runs"), metric, COMPLETE)


def all_pairs():
    rows = comparison.all_of(comparisons.comparisons_of(runs("runs")))
    return comparison.table_of_ratios(rows)


def few(name):
    return few_keypoints.table_of_few(few_keypoints.ratios_to_all(runs(name)))


TABLES = {
    "comparison": all_pairs,
    "widths": lambda: comparison.table_of_widths(runs("runs")).content,
    "table_4_1": of_the_thesis,
    "table_4_2": lambda: of_the_thesis("rmse"),
    "table_4_3": lambda: of_the_thesis("mae"),
    "refined_widths": lambda: evidence.table_of_widths(runs("refined_widths_runs")),
    "every_second": lambda: few("every_second_runs"),
    "few_keypoints": lambda: few("few_keypoints_runs"),
}


def words_and_numbers(path, columns):
    """Return a table's text with # for each number, and the numbers."""
    text = pd.read_csv(path, dtype=str)[columns].to_csv()
    return NUMBER.sub("#", text), [float(number) for number in NUMBER.findall(text)]


@pytest.mark.parametrize("name", TABLES)
def test_tables_in_git_are_those_of_the_runs_in_git(name, tmp_path):
    table = TABLES[name]()
    style.save_table(table, tmp_path, name, "")
    words, numbers = words_and_numbers(tmp_path / f"{name}.csv", list(table))
    in_git = evidence.FOLDER / f"{name}.csv"
    words_in_git, numbers_in_git = words_and_numbers(in_git, list(table))
    assert words.splitlines() == words_in_git.splitlines()
    assert numbers == pytest.approx(numbers_in_git, rel=1e-3, abs=0.011)  # runs have six digits
