"""Notebooks as they are in git: knobs, short cells, cleared outputs, the appendix's calls."""

import json
import re
import statistics

import pytest
from cells import NOTEBOOKS, assigned, cells

from thesis_repro.running.settings import ROOT, read_settings


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_last_cell_resets_all_knobs(name):
    (knobs,), last = (
        [code for code in cells(name, "code") if code.startswith("# EDIT HERE: knobs")],
        cells(name, "code")[-1],
    )
    assert assigned(last) == assigned(knobs) | {"PUT_BACK": "False"}


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_cells_are_short(name):
    assert statistics.median(len(code.splitlines()) for code in cells(name, "code")) <= 8


def test_the_makefile_lists_the_notebooks_that_each_one_needs():
    listed = dict(
        re.findall(r"^NEEDS_(\d\d) :=(.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    )
    earlier = {}
    for number, needs in sorted(listed.items()):
        earlier[number] = {*needs.split()}.union(*(earlier[need] for need in needs.split()))
    needed = {
        name[:2]: set(re.findall(r'"(\d\d)_\w+"', "\n".join(cells(name, "code")))) - {name[:2]}
        for name in NOTEBOOKS
    }
    assert listed.keys() == needed.keys() and sum(map(len, needed.values())) > 10
    assert [number for number, names in needed.items() if names - earlier[number]] == []


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_have_no_outputs_and_set_what_libraries_read(name):
    in_git = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in in_git)
    first = cells(name, "code")[0]
    assert (
        name > "08"
        or "%env SM_FRAMEWORK=tf.keras" in first
        and "from thesis_repro import segmentation" in first
    )


def test_every_call_of_the_appendix_is_in_the_notebook_that_the_table_names():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\|[^|]*\|(?: `[^|]*` \|)? (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    code = {name[:2]: "\n".join(cells(name, "code")) for name in NOTEBOOKS}
    assert len(rows) > 70
    # as a reader's search finds it
    assert [row for row in rows if row[1] not in code[row[0]]] == []


def test_the_readme_s_command_without_make_opens_the_lab():
    command = r"^(THESIS_REPRO_\w+)=(\S+) \.venv/bin/jupyter lab notebooks"
    (setting,) = re.findall(command, (ROOT / "README.md").read_text(), re.MULTILINE)
    assert read_settings(dict([setting])).profile == "lab"
