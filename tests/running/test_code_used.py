"""Digests of code: what was used is in, what was not is out, in a small package of its own."""

import subprocess
import sys
from functools import partial

import pytest

FILES = {
    "thesis/__init__.py": "",
    "thesis/table.py": "from thesis import one, two\n\nTABLE = {'one': one.find, 'two': two.find}\n",
    "thesis/one.py": "from thesis.helpers import halved\n\nLIMIT = 3\nUNUSED = 1\n\n\n"
    "def find(frame):\n    from thesis import late\n    return halved(frame) + LIMIT + late.added()\n",
    "thesis/two.py": "def find(frame):\n    return 0\n",
    "thesis/helpers.py": "import numpy as np\n\nif np:\n    HALF = 2\n\n\n"
    "def halved(value):\n    return value // HALF\n\n\ndef other():\n    return 0\n",
    "thesis/late.py": "SUMS = {}\nSUMS['a'] = 1\n\n\ndef added():\n    return SUMS['a']\n",
}
PRINT = """
from thesis_repro.running.code_used import digest_of_code
from thesis import one, table
{}
print(digest_of_code({}, without=("thesis.table.TABLE",)))
"""


def digest(root, used="one.find", before=""):
    """The digest in a process of its own, because a process reads each module once."""
    for name, text in FILES.items():
        path = root / name
        path.parent.mkdir(exist_ok=True)
        if not path.exists():
            path.write_text(text)
    code = PRINT.format(before, used)
    run = partial(subprocess.run, check=True, capture_output=True, text=True)
    return run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(root)!r})\n{code}"]
    ).stdout


@pytest.mark.parametrize(
    "file, old, new, changes",
    [
        ("one", "+ LIMIT", "- LIMIT", True),
        ("one", "LIMIT = 3", "LIMIT = 4", True),  # a value that it uses
        ("helpers", "// HALF", "/ HALF", True),  # a function of another module
        ("helpers", "HALF = 2", "HALF = 4", True),  # within a condition
        ("late", "return SUMS", "return 1 + SUMS", True),  # imported where it is used
        ("late", "SUMS['a'] = 1", "SUMS['a'] = 2", True),  # changes what it uses
        ("one", "LIMIT = 3", "print('loaded')\nLIMIT = 3", True),  # done at the import
        ("one", "UNUSED = 1", "UNUSED = 2", False),
        ("helpers", "return 0", "return 1", False),
        ("two", "return 0", "return 1", False),
        ("one", "LIMIT = 3", "# a comment\nLIMIT = 3", False),
    ],
)
def test_what_was_used_changes_the_digest_and_nothing_else(tmp_path, file, old, new, changes):
    before = digest(tmp_path)
    path = tmp_path / f"thesis/{file}.py"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert (digest(tmp_path) != before) == changes


def test_an_object_is_used_with_what_it_holds(tmp_path):
    held = "from functools import partial\nfrom dataclasses import dataclass\n"
    kinds = [
        ("partial(one.find, 3)", held),
        ("made(one.find)", "def made(find):\n    return lambda frame: find(frame)\n"),
        ("Own(one.find)", f"{held}@dataclass\nclass Own:\n    find: object\n"),
        ("'from thesis.one import find\\nfind(3)'", ""),
        ("one", ""),
    ]
    before = [digest(tmp_path, *kind) for kind in kinds]
    path = tmp_path / "thesis/helpers.py"
    path.write_text(path.read_text().replace("// HALF", "/ HALF"))
    assert all(digest(tmp_path, *kind) != one for kind, one in zip(kinds, before, strict=True))


def test_entries_of_a_table_that_is_left_out_count_only_if_they_are_given(tmp_path):
    uses = "def use(name):\n    return table.TABLE[name]\n"
    script = repr(f"from thesis import table\n{uses}use('one')")
    first = [digest(tmp_path, used) for used in (script, f"{script}, one.find")]
    path = tmp_path / "thesis/two.py"
    path.write_text("def find(frame):\n    return 7\n")
    assert [digest(tmp_path, used) for used in (script, f"{script}, one.find")] == first
    path = tmp_path / "thesis/one.py"
    path.write_text(path.read_text().replace("LIMIT = 3", "LIMIT = 4"))
    again = [digest(tmp_path, used) for used in (script, f"{script}, one.find")]
    assert again[0] == first[0] and again[1] != first[1]
