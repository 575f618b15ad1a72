"""Importing a module changes nothing in the process."""

import ast
import json
import sys

import pytest
from trials import succeed

from thesis_repro.running.settings import ROOT

OURS = ("thesis_repro", "street_world", "opencv_exact")
PATHS = [
    path.relative_to(ROOT)
    for folder in OURS
    for path in sorted((ROOT / folder).rglob("*.py"))
    if path.name != "__main__.py"
]
# thesis_repro.segmentation has to set what TensorFlow reads at its import
LEFT_OUT = [path for path in PATHS if "segmentation" in path.parts]
# imports modules one by one, and prints what each of them changes
COMPARE = """
import importlib, json, logging, os, pathlib, signal, sys, threading, warnings
first, then = json.load(open("modules.json"))
for name in first:
    importlib.import_module(name)
import matplotlib

def state():
    loggers = logging.getLogger(), *map(logging.getLogger, ("thesis_repro", "py.warnings"))
    files = [path for folder in (".", sys.argv[1]) for path in pathlib.Path(folder).rglob("*")]
    return {
        "environment": dict(os.environ),
        "files": {str(path): path.stat().st_mtime_ns for path in files if path.is_file()},
        "folder": os.getcwd(),
        "hooks": (sys.excepthook, sys.displayhook),
        "logging": [(one.handlers[:], one.level, one.propagate, one.disabled) for one in loggers],
        "matplotlib": dict(matplotlib.rcParams),
        "path": sys.path[:],
        "signals": [signal.getsignal(number) for number in signal.valid_signals()],
        "threads": threading.enumerate(),
        "warnings": warnings.filters[:],
    }

before = state()
for name in then:
    importlib.import_module(name)
    after = state()
    for kind, value in after.items():
        if value != before[kind]:
            print(f"changed by {name}: {kind}")
    before = after
"""


def dotted(path):
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def imported(path):
    """Names of the modules that a file imports, not within functions."""
    for statement in ast.parse((ROOT / path).read_text()).body:
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            yield statement.module


@pytest.mark.slow
def test_no_module_changes_anything_by_its_import(tmp_path):
    names = {name for path in PATHS for name in imported(path)}
    # what other packages do at their import is not ours
    others = sorted(name for name in names if not name.startswith(OURS))
    first = [*map(dotted, LEFT_OUT), *others]
    then = [dotted(path) for path in PATHS if path not in LEFT_OUT]
    (tmp_path / "modules.json").write_text(json.dumps([first, then]))
    done = succeed(
        [sys.executable, "-c", COMPARE, ROOT / "thesis_repro"],
        tmp_path,
        MPLBACKEND="agg",
        PYTHONDONTWRITEBYTECODE=1,
        HOME=tmp_path,
    )
    assert [line for line in done.stdout.splitlines() if line.startswith("changed by")] == []
