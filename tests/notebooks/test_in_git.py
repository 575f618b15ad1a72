"""Notebooks as they are in git: short cells, few names, cleared outputs, the appendix's calls."""

import ast
import json
import re
import statistics

import nbformat
import pytest
from cells import LESSONS, NOTEBOOKS, cells

from thesis_repro.running.settings import ROOT, read_settings

LOOP = "def path_by_hand("  # the one cell that may be longer


@pytest.mark.parametrize("name", LESSONS)
def test_cells_of_lessons_are_short(name):
    lengths = {text: len(text.splitlines()) for text in cells(name, "code").values()}
    assert statistics.median(lengths.values()) <= 5
    assert [text for text, lines in lengths.items() if lines > 15 and LOOP not in text] == []
    assert max(lengths.values()) <= 25


@pytest.mark.parametrize("name", LESSONS)
def test_lessons_import_at_most_six_names_of_the_package(name):
    code = "\n".join(cells(name, "code").values()).replace("%env", "#")
    names = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("thesis_repro"):
            names += [imported.name for imported in node.names]
        elif isinstance(node, ast.Import):
            names += [each.name for each in node.names if each.name.startswith("thesis_repro")]
    assert 1 < len(names) <= 6, names


@pytest.mark.parametrize("name", LESSONS)
def test_knobs_stand_one_a_line_in_one_cell(name):
    (knobs,) = (
        text for text in cells(name, "code").values() if text.startswith("# EDIT HERE: the knobs")
    )
    targets = [node.targets for node in ast.parse(knobs).body]
    assert all(len(names) == 1 and names[0].id.isupper() for names in targets)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_are_valid_and_have_no_outputs(name):
    path = ROOT / "notebooks" / name
    nbformat.validate(nbformat.read(path, 4))
    in_git = json.loads(path.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in in_git)
    # what decides how TensorFlow rounds is set before TensorFlow is loaded
    loads = [
        i for i, text in cells(name, "code").items() if re.search("import (keras|tensor)", text)
    ]
    sets = [i for i, text in cells(name, "code").items() if "import segmentation " in text]
    assert not loads or sets[0] < loads[0]


def test_the_makefile_lists_the_notebooks_that_each_one_needs():
    makefile = (ROOT / "Makefile").read_text()
    listed = dict(re.findall(r"^NEEDS_(\d\d) :=(.*)$", makefile, re.MULTILINE))
    earlier = {}
    for number, needs in sorted(listed.items()):
        earlier[number] = {*needs.split()}.union(*(earlier[need] for need in needs.split()))
    for name in LESSONS:
        named = re.findall(r'"(\d\d)_\w+"', "\n".join(cells(name, "code").values()))
        assert named and set(named) <= earlier[name[:2]]


def test_every_call_of_the_appendix_is_in_the_notebook_that_the_table_names():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\|[^|]*\|(?: `[^|]*` \|)? (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    code = {name[:2]: "\n".join(cells(name, "code").values()) for name in NOTEBOOKS}
    assert len(rows) > 70
    # as a reader's search finds it
    assert [row for row in rows if row[1] not in code[row[0]]] == []


def test_the_readme_s_command_without_make_opens_the_lab():
    command = r"^(THESIS_REPRO_\w+)=(\S+) \.venv/bin/jupyter lab notebooks"
    (setting,) = re.findall(command, (ROOT / "README.md").read_text(), re.MULTILINE)
    assert read_settings(dict([setting])).profile == "lab"
