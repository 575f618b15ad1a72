"""The cells of the notebooks in git."""

import ast
import json

from thesis_repro.running.settings import ROOT

NOTEBOOKS = sorted(path.name for path in (ROOT / "notebooks").glob("*.ipynb"))


def cells(name, kind):
    read = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    return ["".join(cell["source"]) for cell in read if cell["cell_type"] == kind]


def assigned(code):
    """{name: value} of all assignments as text; assignments of tuples are split."""
    values = {}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            values |= dict(
                zip(
                    map(ast.unparse, node.targets[0].elts),
                    map(ast.unparse, node.value.elts),
                    strict=True,
                )
            )
        elif isinstance(node, ast.Assign):
            values[node.targets[0].id] = ast.unparse(node.value)
    return values
