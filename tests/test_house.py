"""Imports between folders, types of public functions, and no unsafe reading of files."""

import ast
import graphlib
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BASE = {"errors", "running"}
METHOD = BASE | {"data", "masks", "mask_files", "odometry", "segmentation", "opencv_exact"}
# {room: the other rooms that it may import}; a room is a folder or a module of thesis_repro
ALLOWED = {
    "errors": set(),
    "running": {"errors"},
    "data": BASE,
    "masks": BASE | {"data"},
    "mask_files": BASE | {"data", "masks"},
    "opencv_exact": set(),
    "odometry": BASE | {"data", "opencv_exact"},
    "segmentation": BASE | {"data"},
    "checks": BASE | {"data", "masks", "mask_files"},
    "study": METHOD,
    "report": METHOD | {"study"},
    "command": METHOD | {"checks", "study", "report", "street_world"},
    "street_world": BASE | {"data"},
    "thesis": METHOD | {"study", "report"},
    "__init__": METHOD | {"_face"},  # at run time, a name is imported on its first use
    "_face": METHOD,
    "__main__": {"command"},
}
# {dotted name, without thesis_repro: path}
MODULES = {
    ".".join(path.relative_to(folder).with_suffix("").parts): path
    for folder, pattern in (
        (ROOT / "thesis_repro", "**/*.py"),
        (ROOT, "street_world/*.py"),
        (ROOT, "opencv_exact/*.py"),
        (ROOT / "notebooks", "thesis/*.py"),
    )
    for path in sorted(folder.glob(pattern))
}
FOLDERS = {name.removesuffix(".__init__") for name in MODULES if name.endswith(".__init__")}


@cache
def tree_of(path):
    return ast.parse(path.read_text())


def imported_names(tree):
    """Dotted names of all imports of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
            yield from [f"{node.module}.{alias.name}" for alias in node.names]


def imports(tree, module=""):
    """The modules that a module imports, named as in MODULES."""
    names = {name.removeprefix("thesis_repro.") for name in imported_names(tree)}
    modules = names & MODULES.keys()
    # outside a folder, its name means its __init__; inside, it is part of a neighbour's name
    folders = {name for name in names & FOLDERS if not module.startswith(f"{name}.")}
    return modules | {f"{name}.__init__" for name in folders}


def test_rooms_import_only_rooms_below_them():
    wrong = []
    for name, path in MODULES.items():
        room = name.split(".")[0]
        allowed = ALLOWED[room] | {room}
        above = [other for other in imports(tree_of(path)) if other.split(".")[0] not in allowed]
        wrong += [f"{name} imports {other}" for other in (*above, *tools(tree_of(path)))]
    assert wrong == []


def test_the_page_of_the_odometry_needs_no_other_room():
    page = MODULES["odometry.loop"]
    assert imports(tree_of(page), "odometry.loop") == {
        "errors",
        "odometry.settings",
        "odometry.step",
        "odometry.inputs",
    }
    lines = [node for node in ast.walk(tree_of(page)) if isinstance(node, ast.stmt)]
    docstrings = [line for line in lines if isinstance(line, ast.Expr) and is_text(line.value)]
    assert len(lines) - len(docstrings) <= 130


def is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def tools(tree):
    """What a module imports from the folder tools, which is not installed."""
    names = {path.stem for path in (ROOT / "tools").glob("*.py")} | {"tools"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom) and node.module in names:
            yield node.module


def imports_by_string(tree):
    """Lines that import what a string names, which the tests above cannot see."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func).split(".")[-1]
            if name in ("import_module", "__import__", "resolve_name", "load_object"):
                yield node.lineno
        elif is_text(node) and re.fullmatch(r"[a-z_]\w*(\.\w+)+:\w+", node.value):
            yield node.lineno


def test_nothing_is_imported_by_string():
    found = {name: list(imports_by_string(tree_of(path))) for name, path in MODULES.items()}
    assert {name: lines for name, lines in found.items() if lines} == {}
    bad = "importlib.import_module(name)\n__import__('os')\nHOME = 'thesis_repro.masks:dilate'\n"
    assert list(imports_by_string(ast.parse(bad))) == [1, 2, 3]


def test_newcomers_see_few_names():
    names = [path.name for path in (ROOT / "thesis_repro").iterdir()]
    assert len([name for name in names if not name.startswith("_")]) <= 12


def test_no_circular_imports():
    graph = {}
    for name, path in MODULES.items():
        graph[name] = imports(tree_of(path), name) - {name}
    graphlib.TopologicalSorter(graph).prepare()


def test_imports_are_found():
    tree = ast.parse(
        "from thesis_repro.study import runner\nimport numpy, street_world\n"
        "from thesis_repro.report.style import BLUE\n"
    )
    assert imports(tree) == {
        "study.__init__",
        "study.runner",
        "report.style",
        "street_world.__init__",
    }
    assert imports(tree, "study.runner") == {
        "study.runner",
        "report.style",
        "street_world.__init__",
    }
    assert list(tools(ast.parse("import evidence\nfrom bench import measure"))) == [
        "evidence",
        "bench",
    ]


def test_no_file_is_read_with_code_in_it():
    # ruff forbids unsafe functions (pyproject.toml), but not these arguments
    unsafe = re.compile("allow_pickle=True|safe_mode=False")
    assert [path.name for path in MODULES.values() if unsafe.search(path.read_text())] == []
