"""Notebooks as they are in git: short cells, few names, cleared outputs, the appendix's calls."""

import ast
import json
import re
import statistics

import nbformat
import pytest
from cells import NOTEBOOKS, cells

from thesis_repro.running.settings import ROOT

LOOP = "def path_by_hand("  # the one cell that may be longer


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_cells_of_lessons_are_short(name):
    lengths = {text: len(text.splitlines()) for text in cells(name, "code").values()}
    assert statistics.median_low(lengths.values()) <= 5
    assert [text for text, lines in lengths.items() if lines > 15 and LOOP not in text] == []
    assert max(lengths.values()) <= 25


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_lessons_import_few_names_of_the_package(name):
    code = re.sub("(?m)^%", "#", "\n".join(cells(name, "code").values()))
    imports = [node for node in ast.walk(ast.parse(code)) if hasattr(node, "names")]
    names = [
        each.name
        for node in imports
        for each in node.names
        if getattr(node, "module", each.name).startswith("thesis_repro")
    ]
    most = {"08": 10, "09": 8}.get(name[:2], 6)
    assert 1 < len(names) <= most, names


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_knobs_stand_one_a_line_in_one_cell(name):
    (knobs,) = (
        text for text in cells(name, "code").values() if text.startswith("# EDIT HERE: knobs")
    )
    targets = [node.targets for node in ast.parse(knobs).body]
    assert all(len(names) == 1 and names[0].id.isupper() for names in targets)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_are_valid_and_have_no_outputs(name):
    path = ROOT / "notebooks" / name
    nbformat.validate(nbformat.read(path, 4))
    in_git = json.loads(path.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in in_git)


def test_the_makefile_lists_the_notebooks_that_each_one_needs():
    makefile = (ROOT / "Makefile").read_text()
    rule = r"^\$\(call executed,([\d ]+)\): \$\(call executed,([\d ]+)\)"
    needs = {name[:2]: set() for name in NOTEBOOKS}
    for numbers, needed in re.findall(rule, makefile, re.MULTILINE):
        for number in numbers.split():
            needs[number] |= set(needed.split())
    for number in sorted(needs):  # a notebook needs only earlier ones, whose needs are complete
        needs[number] = needs[number].union(*(needs[other] for other in needs[number]))
    for name in NOTEBOOKS:
        named = re.findall(r'"(\d\d)_\w+"', "\n".join(cells(name, "code").values()))
        assert set(named) <= needs[name[:2]], name


def test_every_call_of_the_appendix_is_in_the_notebook_that_the_table_names():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\|[^|]*\|(?: `[^|]*` \|)? (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    code = {name[:2]: "\n".join(cells(name, "code").values()) for name in NOTEBOOKS}
    assert len(rows) > 70
    # as a reader's search finds it
    assert [row for row in rows if row[1] not in code[row[0]]] == []
