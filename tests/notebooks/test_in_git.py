"""Notebooks as they are in git: short cells, few names, cleared outputs, the appendix's calls."""

import ast
import json
import re
from collections import Counter

import nbformat
import pytest
from cells import NOTEBOOKS, code_of
from nbconvert import ScriptExporter

from thesis import run
from thesis.run_settings import ROOT

# functions, classes and notebook commands in the listings of each section of the appendix
CALLS = {
    "A.1": 2,
    "A.2.1": 8,
    "A.2.2": 10,
    "A.2.3": 10,
    "A.3": 33,
    "A.4": 7,
    "A.5": 6,
    "A.5.1": 5,  # which the copy of the thesis lacks
    "A.5.2": 4,
    "A.6": 9,
    "A.7.1": 13,
    "A.7.2": 17,
    "A.8": 15,
}
# what is called otherwise in a notebook: by the library, and a transform by its variable
RENAMED = {"RandomBrightness": "RandomBrightnessContrast", "transform": "compose"}


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


def code_below_headings(name):
    """{heading: code} of the cells below each heading of a notebook."""
    code, heading = {}, ""
    for cell in json.loads((ROOT / "notebooks" / name).read_text())["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            code[heading] = code.get(heading, "") + text + "\n\n"
        elif headings := re.findall("(?m)^#+ (.*)$", text):
            heading = headings[-1]
            assert heading not in code, heading
    return code


class Called(ast.NodeVisitor):
    """Notes the names of what code calls, without what an `if` may leave out."""

    def __init__(self, code):
        self.names = set()
        self.visit(ast.parse(re.sub("(?m)^%", "#", code)))

    def visit_Call(self, node):
        self.names.add(getattr(node.func, "attr", getattr(node.func, "id", "")))
        self.generic_visit(node)

    def visit_If(self, node):
        self.visit(node.test)

    visit_IfExp = visit_If


def test_every_call_of_the_appendix_is_live_below_the_heading_that_the_table_names():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\| (A[\d.]+) \| (`.*?`) \| (\d\d), (.*?) \|", table, re.MULTILINE)
    calls = [(section, call) for section, listed, *_ in rows for call in listed.split(", ")]
    assert len(set(calls)) == len(calls)
    assert Counter(section for section, _ in calls) == CALLS
    lessons = {name[:2]: code_below_headings(name) for name in NOTEBOOKS}
    for section, listed, number, heading in rows:
        code = lessons[number][heading]
        names = Called(code).names
        for call in re.findall("`(.*?)`", listed):
            name = call.rpartition(".")[2]
            found = call in code if call[0] == "%" else RENAMED.get(name, name) in names
            assert found, (section, call, number, heading)
