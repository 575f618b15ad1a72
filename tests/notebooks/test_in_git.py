"""Notebooks as they are in git: short cells, few names, cleared outputs, the appendix's calls."""

import ast
import json
import re
from collections import Counter

import nbformat
import pytest
from cells import NOTEBOOKS, code_of, named
from nbconvert import ScriptExporter

from thesis import run
from thesis.run_settings import ROOT

LOOP = "def path_by_hand("  # the one cell that may be longer
# functions, classes and notebook commands in the listings of each section of the appendix
CALLS = {
    "A.1": 2,
    "A.2.1": 8,
    "A.2.2": 10,
    "A.2.3": 10,
    "A.3": 32,
    "A.4": 7,
    "A.5": 6,
    "A.5.2": 4,
    "A.6": 9,
    "A.7.1": 13,
    "A.7.2": 17,
    "A.8": 15,
}
# the notebook of a section, and calls that are in another one
MIRRORS: dict = {
    "A.1": "01",
    "A.2": "01",
    "A.3": "02",
    "A.4": "03",
    "A.5": "04",
    "A.6": "04",
    "A.7": "05",
    "A.8": "06",
    ("A.5.2", "build_unet"): "03",
    # the label maps of A.8
    ("A.8", "len"): "05",
    ("A.8", "np.expand_dims"): "05",
    ("A.8", "model.predict"): "05",
    ("A.8", "np.argmax"): "05",
}
RENAMED = {"RandomBrightness": "RandomBrightnessContrast"}  # by the library


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_are_valid_and_python_and_have_no_outputs(name):
    path = ROOT / "notebooks" / name
    nbformat.validate(nbformat.read(path, 4))
    in_git = json.loads(path.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in in_git)
    assert ScriptExporter().from_filename(path)[1]["output_extension"] == ".py"


def test_a_notebook_reads_only_what_those_that_it_needs_have_written():
    needs = {}
    for name, direct in run.NEEDS.items():  # in order: what is needed is complete
        needs[name] = set(direct).union(*(needs[other] for other in direct))
    for name in NOTEBOOKS:
        read = re.findall(r'"(\d\d_\w+)"', code_of(name))
        assert set(read) <= needs[name.removesuffix(".ipynb")], name


def called_names(code):
    """The names of all functions, methods and classes that code calls."""
    tree = ast.parse(re.sub("(?m)^%", "#", code))
    called = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    return {getattr(function, "attr", getattr(function, "id", "")) for function in called}


def test_every_call_of_each_section_of_the_appendix_is_live_in_the_notebook_that_mirrors_it():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\| (A[\d.]+) \| `([^|]*)` \| (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    assert Counter(section for section, *_ in rows) == CALLS
    code = {name[:2]: code_of(name) for name in NOTEBOOKS}
    for section, call, number, where in rows:
        assert number == MIRRORS.get((section, call), MIRRORS[section[:3]]), (section, call)
        assert where in code[number], (section, where)  # as a reader's search finds it
        names = re.findall(r"(\w+)(?=,|\(|$)", call.replace("transform(image, mask)", "compose"))
        names = [] if call.startswith("%") else [RENAMED.get(name, name) for name in names]
        assert set(names) <= called_names(code[number]), (section, call)


def test_what_the_copy_of_the_thesis_lacks_is_in_the_notebook_that_the_table_names():
    table = (ROOT / "docs" / "appendix-calls.md").read_text().partition("\n## ")[2]
    rows = re.findall(r"^\|[^|]*\| (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    assert len(rows) == 7
    assert [row for row in rows if row[1] not in code_of(named(row[0]))] == []
