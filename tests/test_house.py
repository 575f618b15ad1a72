"""What import-linter does not say (pyproject.toml has its contracts, `make lint` runs them)."""

import ast
import re
import sys

import pytest
from trials import PACKAGES, ROOT, succeed

MODULES = [
    path for folder in (*PACKAGES, "notebooks") for path in sorted((ROOT / folder).rglob("*.py"))
]


def is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def test_the_odometry_is_a_page():
    tree = ast.parse((ROOT / "thesis_repro" / "odometry" / "loop.py").read_text())
    lines = [node for node in ast.walk(tree) if isinstance(node, ast.stmt)]
    docstrings = [line for line in lines if isinstance(line, ast.Expr) and is_text(line.value)]
    assert len(lines) - len(docstrings) <= 130


# imports by string, which no contract sees, and files that are read with code in them; Ruff forbids
# the functions (pyproject.toml)
UNSAFE = r"allow_pickle=True|safe_mode=False|[\"'][a-z_]\w*(\.\w+)+:\w+[\"']"


def test_no_string_names_code():
    assert [path.name for path in MODULES if re.search(UNSAFE, path.read_text())] == []
    assert re.search(UNSAFE, "HOME = 'thesis_repro.masks:dilate'")


@pytest.mark.slow
def test_the_thesis_needs_no_comparison(tiny_kitti, tmp_path):
    """Without keypoint_study, the odometry runs; the command that compares is one line."""
    code = (
        "import sys; sys.modules['keypoint_study'] = None\n"
        "from thesis_repro.command.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    given = ["--kitti", tiny_kitti, "--sequence", "00", "--output", tmp_path / "path.txt"]
    succeed([sys.executable, "-c", code, "odometry", *given], tmp_path)
    assert (tmp_path / "path.txt").read_text().count("\n") == 4
