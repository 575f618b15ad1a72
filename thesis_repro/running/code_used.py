"""A digest of the code that made a result: the definitions that it used, and all that these use.

A definition is a statement of a module: a function, a class or a value. From those that made a
result, names are followed through the modules of PACKAGES. So an entry that nothing leads to
changes no digest, and neither does a comment, but a definition that was used does.
Other packages are told by their versions (`provenance.versions`).
"""

import ast
import hashlib
import linecache
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

PACKAGES = ("thesis_repro", "keypoint_study", "opencv_exact", "street_world", "thesis")
WHOLE = "*"  # in place of a name: all that a module defines and imports


class Place(NamedTuple):
    """A name in a module; without a name, what the module does when it is imported."""

    module: str
    name: str = ""


class Code(NamedTuple):
    """A module: the modules that it loads, and its names, imported or defined."""

    loads: list[Place]
    imports: dict[str, Place]
    definitions: dict[str, list[ast.AST]]

    def nodes(self) -> list[ast.AST]:
        """Return all its statements but imports."""
        return [node for nodes in self.definitions.values() for node in nodes]


def digest_of_code(*used: Any, without: Collection[str] = ()) -> str:
    """Return a digest of the code of what was used.

    used: functions, classes, modules, and objects with what they hold; a text is that of a script.
    without: definitions that are not followed, "module.name": tables whose entries are in `used`.
    """
    texts: set[str] = set()
    known: dict[Any, Any] = {}  # keeps what is known by its identity
    waiting = list(used)
    while waiting:
        each = waiting.pop()
        key = each if isinstance(each, Place) else id(each)
        if key in known or (isinstance(each, Place) and ".".join(each) in without):
            continue
        known[key] = each
        text, more = _of_place(each) if isinstance(each, Place) else _of_object(each)
        texts.add(text)
        waiting += more
    return hashlib.sha256("\0".join(sorted(texts)).encode()).hexdigest()[:12]


def _of_object(each: Any) -> tuple[str, list[Any]]:
    """Return the text of an object's code, if PACKAGES have it not, and what the object uses."""
    if isinstance(each, partial):
        return "", [each.func, *_held([*each.args, *each.keywords.values()])]
    if isinstance(each, ModuleType):
        return "", [Place(each.__name__, WHOLE)]
    if isinstance(each, str):
        script = _code(each)
        return each, [*script.loads, *_uses(Place(""), script.nodes(), script)]
    name = getattr(each, "__qualname__", "").split(".")[0]
    if not name:
        return "", [type(each), *_held(vars(each).values() if hasattr(each, "__dict__") else ())]
    cells = getattr(each, "__closure__", None) or ()
    held = [cell.cell_contents for cell in cells]
    held += [getattr(each, "__self__", None), *getattr(each, "__bases__", ())]
    module = str(getattr(each, "__module__", ""))
    if _path(module):
        return "", [Place(module, name), *_held(held)]
    return _text_around(each), _held(held)


def _held(parts: Iterable[Any]) -> list[Any]:
    """Return the parts of an object that can have code."""
    return [part for part in parts if callable(part) or _path(type(part).__module__)]


def _text_around(each: Any) -> str:
    """Return the text of the file, or of the notebook's cell, of a function or a class."""
    parts = [each, *getattr(each, "__dict__", {}).values()]
    for code in [part.__code__ for part in parts if hasattr(part, "__code__")]:
        linecache.checkcache(code.co_filename)
        return "".join(linecache.getlines(code.co_filename))
    return ""


@cache
def _of_place(place: Place) -> tuple[str, list[Place]]:
    """Return the text of a definition, and the places that it leads to."""
    module, name = place
    path = _path(module)
    if path is None:
        return "", []
    code = _code(path.read_text(encoding="utf-8"))
    if name in code.imports:
        return "", [Place(module), code.imports[name]]
    if name in code.definitions or name in ("", "__file__"):  # a path needs no definition
        nodes = code.definitions.get(name, [])
        more = [Place(module)] if name else [Place(module.rpartition(".")[0]), *code.loads]
    else:  # all of it, or a name that is made as the module runs
        nodes = code.nodes()
        more = [Place(module), *code.imports.values()]
    return "\n".join(map(ast.unparse, nodes)), [*more, *_uses(place, nodes, code)]


@cache
def _path(module: str) -> Path | None:
    """Return the file of a module of PACKAGES; None for what is none."""
    package, *parts = module.split(".")
    spec = find_spec(package) if package in PACKAGES else None
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).parent.joinpath(*parts)
    return next(filter(Path.is_file, (path / "__init__.py", path.with_suffix(".py"))), None)


@cache
def _code(text: str) -> Code:
    """Return the names of a module with a text."""
    body = ast.parse(text).body
    loads = [Place(place.module) for node in body for place in _imported(node).values()]
    code = Code(loads, {}, defaultdict(list))
    for node in _statements(body):
        code.imports.update(_imported(node))
        for name in _defined(node):
            code.definitions[name].append(node)
    return code


def _statements(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Yield statements, and those of conditions in place of these."""
    for node in nodes:
        if isinstance(node, ast.If | ast.Try | ast.ExceptHandler):
            yield from _statements(ast.iter_child_nodes(node))
        else:
            yield node


def _defined(node: ast.AST) -> list[str]:
    """Return the names that a statement defines; "" for one that does something else."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [node.name]
    is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    if is_docstring or isinstance(node, ast.Import | ast.ImportFrom):
        return []
    if not isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
        return [""]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    parts = [part for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
    return [part.id for part in parts if isinstance(part.ctx, ast.Store)] or [""]


def _imported(node: ast.AST) -> dict[str, Place]:
    """Return what an import gives names to: {name: place}."""
    if isinstance(node, ast.ImportFrom):
        module = node.module or ""
        return {each.asname or each.name: _place(module, each.name) for each in node.names}
    if isinstance(node, ast.Import):
        names = {each.asname or each.name.split(".")[0]: each for each in node.names}
        return {name: Place(each.name if each.asname else name) for name, each in names.items()}
    return {}


def _place(module: str, name: str) -> Place:
    """Return the place of a name in a module, which may be a module itself."""
    inner = f"{module}.{name}"
    return Place(inner) if _path(inner) else Place(module, name)


def _uses(place: Place, nodes: Iterable[ast.AST], code: Code) -> list[Place]:
    """Return the places that the names in statements of a module lead to."""
    parts = [part for node in nodes for part in ast.walk(node)]
    inner = [item for part in parts for item in _imported(part).items()]
    imports = code.imports | dict(inner)
    attributes = {id(part.value): part.attr for part in parts if isinstance(part, ast.Attribute)}
    places = [Place(imported.module) for _, imported in inner]
    for part in parts:
        if not isinstance(part, ast.Name):
            continue
        if part.id in code.definitions:
            places.append(Place(place.module, part.id))
        if part.id in imports:
            used = imports[part.id]
            if not used.name:  # a module, of which an attribute is used, or all
                used = _place(used.module, attributes.get(id(part), WHOLE))
            places.append(used if used.name else Place(used.module, WHOLE))
    return places
