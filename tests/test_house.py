"""Imports between folders, types of public functions, and no unsafe reading of files."""

import ast
import graphlib
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "thesis_repro"
# {folder or module: folders it must not import}; nothing may import `tools`, which is not installed
NOT_IMPORTED = {
    "odometry": {"segmentation", "world", "study", "report"},
    "masks": {"odometry", "segmentation", "world", "study", "report"},
    "segmentation": {"study", "report"},
    "world": {"study", "report"},
    "study": {"report"},
}
PATHS = sorted(PACKAGE.rglob("*.py"))
FOLDERS = {
    ".".join(path.parent.relative_to(PACKAGE).parts) for path in PACKAGE.rglob("*/__init__.py")
}
MODULES = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in PATHS}


@cache
def tree_of(path):
    return ast.parse(path.read_text())


def imported_names(tree):
    """Dotted names of all imports of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names))


def imports(tree, folder=None):
    """The package's modules that a module in a folder imports, as dotted names without
    `thesis_repro`.
    """
    inner = {
        name.removeprefix("thesis_repro.")
        for name in imported_names(tree)
        if name.startswith("thesis_repro.")
    }
    # outside a folder, its name means its __init__; inside, it is part of a neighbour's name
    return inner & MODULES.keys() | {
        f"{name}.__init__" for name in inner & FOLDERS if name != folder
    }


def test_folders_import_only_allowed_folders():
    wrong = [
        f"{name} imports {other}"
        for name, path in MODULES.items()
        for other in imports(tree_of(path))
        if other.split(".")[0] in NOT_IMPORTED.get(name.split(".")[0], ())
    ]
    wrong += [
        f"{name} imports tools"
        for name, path in MODULES.items()
        if any(other.split(".")[0] == "tools" for other in imported_names(tree_of(path)))
    ]
    assert wrong == []


def test_no_circular_imports():
    graphlib.TopologicalSorter(
        {
            name: imports(tree_of(path), name.split(".")[0]) - {name}
            for name, path in MODULES.items()
        }
    ).prepare()


def test_imports_are_found():
    tree = ast.parse(
        "from thesis_repro.study import runner\nimport numpy\n"
        "from thesis_repro.report.style import BLUE\n"
    )
    assert imports(tree) == {"study.__init__", "study.runner", "report.style"}
    assert imports(tree, "study") == {"study.runner", "report.style"}


def test_no_file_is_read_with_code_in_it():
    # ruff forbids unsafe functions (pyproject.toml), but not these arguments
    assert [
        path.name
        for path in PATHS
        if re.search("allow_pickle=True|safe_mode=False", path.read_text())
    ] == []
