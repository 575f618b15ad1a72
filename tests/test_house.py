"""The house: which folder may import which, no import in a circle, types of the method, nothing unsafe."""

import ast
import graphlib
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "thesis_repro"
# what each folder, or module at the top, must not import; nothing may import `tools`, which is not installed
NOT_IMPORTED = {
    "odometry": {"segmentation", "world", "study", "report"},
    "masks": {"odometry", "segmentation", "world", "study", "report"},
    "segmentation": {"study", "report"},
    "world": {"study", "report"},
    "study": {"report"},
}
PATHS = sorted(PACKAGE.rglob("*.py"))
FOLDERS = {".".join(path.parent.relative_to(PACKAGE).parts) for path in PACKAGE.rglob("*/__init__.py")}
MODULES = {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in PATHS}


@cache
def tree_of(path):
    return ast.parse(path.read_text())


def imported_names(tree):
    """Dotted names of all that a module imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names))


def imports(tree, folder=None):
    """The package's modules that a module in a folder imports, as dotted names without the package's own."""
    inner = {name.removeprefix("thesis_repro.") for name in imported_names(tree) if name.startswith("thesis_repro.")}
    # from outside, a folder's name stands for what its __init__ gathers; inside, for the way to a neighbour
    return inner & MODULES.keys() | {f"{name}.__init__" for name in inner & FOLDERS if name != folder}


def test_no_folder_imports_what_it_must_not():
    wrong = [f"{name} imports {other}" for name, path in MODULES.items() for other in imports(tree_of(path))
             if other.split(".")[0] in NOT_IMPORTED.get(name.split(".")[0], ())]
    wrong += [f"{name} imports tools" for name, path in MODULES.items()
              if any(other.split(".")[0] == "tools" for other in imported_names(tree_of(path)))]
    assert wrong == []


def test_no_import_leads_in_a_circle():
    graphlib.TopologicalSorter({name: imports(tree_of(path), name.split(".")[0]) - {name}
                                for name, path in MODULES.items()}).prepare()


def test_the_check_of_the_imports_can_fail():
    tree = ast.parse("from thesis_repro.study import runner\nimport numpy\n"
                     "from thesis_repro.report.style import BLUE\n")
    assert imports(tree) == {"study.__init__", "study.runner", "report.style"}
    assert imports(tree, "study") == {"study.runner", "report.style"}


def test_public_signatures_of_the_method_have_types():
    bare = []
    for path in (path for path in PATHS if path.relative_to(PACKAGE).parts[0] in ("masks.py", "kitti.py", "odometry",
                                                                                  "study")):
        body = tree_of(path).body
        for node in [*body, *(inner for each in body if isinstance(each, ast.ClassDef) for inner in each.body)]:
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_") or any(
                    isinstance(name, ast.Name) and name.id in ("fast", "inner") for name in node.decorator_list):
                continue  # what is compiled gets its types from its arguments
            arguments = [*node.args.args, *node.args.kwonlyargs]
            if node.returns is None or not all(a.annotation for a in arguments if a.arg not in ("self", "cls")):
                bare.append(f"{path.relative_to(PACKAGE)}: {node.name}")
    assert bare == []


def test_nothing_that_a_file_carries_is_executed():
    # ruff refuses functions that could (pyproject.toml), and not these keywords of others
    assert [path.name for path in PATHS if re.search("allow_pickle=True|safe_mode=False", path.read_text())] == []
