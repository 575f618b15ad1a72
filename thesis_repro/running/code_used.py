"""A digest of the code that made a result: the modules that it used, and all that these import.

Editing a module, even a comment, repeats what used it or imports it, directly or not. A module that
nobody imports repeats nothing. Nor does a new entry of a table: the modules of TABLES count for
nobody, and each entry stands for itself, by its own text, where it was used.
Other packages are told by their versions (`provenance.versions`).
"""

import ast
import hashlib
import inspect
import linecache
import textwrap
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

PACKAGES = ("thesis_repro", "keypoint_study", "opencv_exact", "street_world", "thesis")
# of detectors, estimators and layouts. A function or class there uses no other one of its module.
TABLES = (
    "thesis_repro.odometry.keypoints",
    "thesis_repro.odometry.estimators",
    "thesis_repro.data.layout",
)


def digest_of_code(*used: Any) -> str:
    """Return a digest of the code of what was used.

    used: modules, functions, classes, and objects with what they hold; a text is that of a script.
    """
    texts: set[str] = set()
    modules: set[str] = set()
    known: dict[int, Any] = {}  # keeps what is known by its identity
    waiting = list(used)
    while waiting:
        each = waiting.pop()
        if id(each) in known:
            continue
        known[id(each)] = each
        waiting += _held(each)
        module = each.__name__ if isinstance(each, ModuleType) else _definition(each).__module__
        if isinstance(each, str) or module in TABLES or not _path(module):
            text = each if isinstance(each, str) else _text_of(_definition(each))
            texts.add(text)
            modules.update(*map(_with_imports, _imported(text)))
        else:
            modules |= _with_imports(module)
    texts |= {_text(module) for module in modules}
    return hashlib.sha256("\0".join(sorted(texts)).encode()).hexdigest()[:12]


def _definition(each: Any) -> Any:
    """Return the function or class of an object."""
    return each if hasattr(each, "__qualname__") else type(each)


def _held(each: Any) -> list[Any]:
    """Return the functions and objects of PACKAGES that an object holds."""
    held = [cell.cell_contents for cell in getattr(each, "__closure__", None) or ()]
    if isinstance(each, partial):
        held = [each.func, *each.args, *each.keywords.values()]
    elif not hasattr(each, "__qualname__") and not isinstance(each, ModuleType):
        held = list(getattr(each, "__dict__", {}).values())
    held += [getattr(each, "__self__", None), *getattr(each, "__bases__", ())]
    return [part for part in held if callable(part) or _path(type(part).__module__)]


def _text_of(definition: Any) -> str:
    """Return the text of an entry of TABLES, or of the file or notebook's cell around code."""
    if definition.__module__ in TABLES:
        return textwrap.dedent(inspect.getsource(definition))
    parts = [definition, *getattr(definition, "__dict__", {}).values()]
    for code in [part.__code__ for part in parts if hasattr(part, "__code__")]:
        linecache.checkcache(code.co_filename)
        return "".join(linecache.getlines(code.co_filename))
    return ""


@cache
def _with_imports(module: str) -> frozenset[str]:
    """Return the names of a module of PACKAGES and of those that it imports, directly or not."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found and name not in TABLES and _path(name):
            found.add(name)
            waiting += _imported(_text(name))
    return frozenset(found)


@cache
def _imported(text: str) -> list[str]:
    """Return the names of the modules that a text imports, at its beginning or in a function."""
    names: list[str] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names += [each.name for each in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            for each in node.names:
                inner = f"{module}.{each.name}"
                names.append(inner if _path(inner) else module)
    return names


@cache
def _text(module: str) -> str:
    path = _path(module)
    return path.read_text(encoding="utf-8") if path else ""


@cache
def _path(module: str) -> Path | None:
    """Return the file of a module of PACKAGES; None for what is none."""
    package, *parts = module.split(".")
    spec = find_spec(package) if package in PACKAGES else None
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).parent.joinpath(*parts)
    return next(filter(Path.is_file, (path / "__init__.py", path.with_suffix(".py"))), None)
