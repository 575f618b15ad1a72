"""Importing a module changes nothing in the process, and a script keeps its own settings."""

import ast
import json
import sys

import pytest
from trials import succeed

from thesis_repro.running.settings import ROOT

OURS = ("thesis_repro", "street_world")
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


def test_a_script_keeps_its_logging_and_its_style(tmp_path):
    (tmp_path / "script.py").write_text(
        "import io, logging, matplotlib\n"
        "matplotlib.rcParams['font.size'] = 33\n"
        "stream = io.StringIO()\n"
        "logging.basicConfig(stream=stream, level='INFO', format='%(name)s %(message)s')\n"
        "from thesis_repro.report import comparison, paths, style, video\n"
        "from thesis_repro.running import results\n"
        "with style.applied():\n"
        "    style.write_figure(style.new_figure()[0], 'figure.svg')\n"
        "for size in (1, 2):\n"
        "    (results.stage('out', size=size) / 'result').touch()\n"
        "print(matplotlib.rcParams['font.size'])\n"
        "print(stream.getvalue())\n"
    )
    done = succeed([sys.executable, "script.py"], tmp_path)
    assert done.stdout.startswith("33.0") and "\nthesis_repro out: " in done.stdout
    assert done.stderr == ""


def test_settings_of_the_user_do_not_change_figures(tmp_path):
    (tmp_path / "script.py").write_text(
        "import pathlib\n"
        "from thesis_repro.report import style\n"
        "def draw(name):\n"
        "    figure, axes = style.new_figure()\n"
        "    axes.plot([1, 3, 2])\n"
        "    style.save_figure(figure, pathlib.Path(), name, 'note')\n"
        "draw('by_default')\n"
        "style.use()\n"
        "draw('in_style')\n"
    )
    written = {"by_default": [], "in_style": []}
    for settings in ("", "font.size: 20\naxes.facecolor: red\n"):
        (tmp_path / "matplotlibrc").write_text(settings)  # read from the working folder
        succeed([sys.executable, "script.py"], tmp_path, MPLBACKEND="agg")
        for name, files in written.items():
            files.append((tmp_path / f"{name}.svg").read_bytes())
    plain, own = written["in_style"]
    assert plain == own
    plain, own = written["by_default"]
    assert plain != own
