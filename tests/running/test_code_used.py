"""Digests of code: what was used is in, what was not is out, in a small package of its own."""

import ast
import inspect
import subprocess
import sys
import textwrap
from functools import partial

import pytest

from thesis_repro.odometry import estimators, keypoints
from thesis_repro.running import code_used

FILES = {
    "thesis/__init__.py": "",
    "thesis/one.py": "from thesis import helpers\n\n\ndef find(frame):\n"
    "    from thesis.late import added\n    return helpers.halved(frame) + added()\n",
    "thesis/two.py": "def find(frame):\n    return 0\n",
    "thesis/helpers.py": "import numpy as np\n\n\ndef halved(value):\n    return value // 2\n",
    "thesis/late.py": "SUM = 1\n\n\ndef added():\n    return SUM\n",
}
PRINT = """
from thesis_repro.running.code_used import digest_of_code
from thesis import one
{}
print(digest_of_code({}))
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
        ("one", "halved(frame) +", "halved(frame) -", True),
        ("helpers", "// 2", "/ 2", True),  # a module that it imports
        ("late", "SUM = 1", "SUM = 2", True),  # imported where it is used
        ("two", "return 0", "return 1", False),
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
    path.write_text(path.read_text().replace("// 2", "/ 2"))
    assert all(digest(tmp_path, *kind) != one for kind, one in zip(kinds, before, strict=True))


def test_entries_of_tables_stand_for_themselves():
    """They use no other name of their module, so their own text tells all of it."""
    for module, entries in (
        (keypoints, keypoints.DETECTORS.values()),
        (estimators, [entry.make for entry in estimators.ESTIMATORS.values() if entry.make]),
    ):
        assert module.__name__ in code_used.TABLES
        here = {name for name, each in vars(module).items() if is_of(each, module.__name__)}
        for entry in entries:
            tree = ast.parse(textwrap.dedent(inspect.getsource(entry)))
            used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
            assert not used & here - {entry.__name__}, entry


def is_of(each, module):
    """Whether a value was made in a module: not one that it imports."""
    return getattr(each, "__module__", module) == module and not inspect.ismodule(each)
