"""Results on disk that know what they were made from, so that a rerun goes on and never reuses what is stale."""

import ast
import hashlib
import json
import shutil
from pathlib import Path

from thesis_repro.files import write_text

_PACKAGE = Path(__file__).parent
RECORD = "made-from.json"


def stage(folder, **inputs):
    """The folder of one stage, holding only results that were made from `inputs` (JSON values).

    What an earlier run with the same inputs finished is kept; results of other inputs are deleted.
    """
    folder = Path(folder)
    wanted = json.dumps(inputs, indent=1, sort_keys=True, default=str)
    record = folder / RECORD
    if not record.is_file() or record.read_text(encoding="utf-8") != wanted:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_text(record, wanted)
    return folder


def made_from(folder):
    """A digest of what the results in a stage's folder were made from."""
    return content(Path(folder) / RECORD)


def code(*modules):
    """A digest of what modules of this package do: their syntax trees, without comments and docstrings."""
    digest = hashlib.sha256()
    for module in modules:
        tree = ast.parse((_PACKAGE / f"{module}.py").read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node) is not None:
                node.body = node.body[1:]
        digest.update(ast.dump(tree).encode())
    return digest.hexdigest()[:12]


def listing(paths):
    """A digest of files by name and size: enough to notice other data without reading gigabytes."""
    digest = hashlib.sha256()
    for path in paths:
        path = Path(path)
        digest.update(f"{path.parent.name}/{path.name}:{path.stat().st_size}\n".encode())
    return digest.hexdigest()[:12]


def content(path):
    """A digest of one file's bytes."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:12]
