"""The house: which folder may import which, and that no import leads in a circle."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "thesis_repro"
# what each folder, or module at the top, must not know of
NOT_KNOWN = {
    "odometry": {"segmentation", "world", "study", "report", "bench"},
    "masks": {"odometry", "segmentation", "world", "study", "report", "bench"},
    "segmentation": {"study", "report", "bench"},
    "world": {"study", "report", "bench"},
    "study": {"report", "bench"},
    "report": {"bench"},
}


FOLDERS = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
MODULES = {".".join(path.relative_to(PACKAGE).with_suffix("").parts) for path in PACKAGE.rglob("*.py")}


def imports(path, folder=None):
    """The package's modules that a module in a folder imports, as dotted names without the package's own."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    inner = {name.removeprefix("thesis_repro.") for name in found if name.startswith("thesis_repro.")}
    # from outside, a folder's name stands for what its __init__ gathers; inside, for the way to a neighbour
    return inner & MODULES | {f"{name}.__init__" for name in inner & FOLDERS if name != folder}


def test_the_top_is_small():
    assert len(list(PACKAGE.glob("*.py"))) <= 12


def test_no_folder_knows_what_it_must_not():
    wrong = []
    for path in PACKAGE.rglob("*.py"):
        here = path.relative_to(PACKAGE).with_suffix("").parts[0]
        wrong += [f"{path.relative_to(PACKAGE)} imports {name}" for name in imports(path, here)
                  if name.split(".")[0] in NOT_KNOWN.get(here, ())]
    assert wrong == []


def test_no_import_leads_in_a_circle():
    graph = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        graph[".".join(parts)] = imports(path, parts[0] if len(parts) > 1 else None)
    done, under_way = set(), []

    def visit(name):
        assert name not in under_way, " -> ".join([*under_way, name])
        if name in done:
            return
        under_way.append(name)
        for other in sorted(graph[name]):
            visit(other)
        done.add(under_way.pop())

    for name in sorted(graph):
        visit(name)


def test_the_check_of_the_imports_can_fail(tmp_path):
    module = tmp_path / "module.py"
    module.write_text("from thesis_repro.study import runner\nimport numpy\n"
                      "from thesis_repro.report.style import BLUE\n")
    assert imports(module) == {"study.__init__", "study.runner", "report.style"}
    assert imports(module, "study") == {"study.runner", "report.style"}


def test_public_signatures_of_the_method_have_types():
    bare = []
    for path in [PACKAGE / "masks.py", PACKAGE / "kitti.py",
                 *(path for folder in ("odometry", "study") for path in (PACKAGE / folder).glob("*.py"))]:
        tree = ast.parse(path.read_text())
        for node in [*tree.body, *(inner for one in tree.body if isinstance(one, ast.ClassDef) for inner in one.body)]:
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_") or any(
                    isinstance(name, ast.Name) and name.id == "fast" for name in node.decorator_list):
                continue  # what is compiled gets its types from its arguments
            arguments = [*node.args.args, *node.args.kwonlyargs]
            typed = all(one.annotation for one in arguments if one.arg not in ("self", "cls"))
            if node.returns is None or not typed:
                bare.append(f"{path.relative_to(PACKAGE)}: {node.name}")
    assert bare == []


# what would execute what a file carries, or listen where nobody said so; of a call with a keyword, what it must be
UNSAFE = {"eval", "exec", "compile_command", "pickle", "cPickle", "cloudpickle", "dill", "shelve", "marshal",
          "read_pickle", "to_pickle", "yaml", "joblib.load", "joblib.dump", "os.system", "os.popen",
          "enable_unsafe_deserialization", "LocalCluster", "urllib", "requests", "httpx", "urlopen"}
MUST_SAY = {"np.load": ("allow_pickle", False), "numpy.load": ("allow_pickle", False),
            "keras.models.load_model": ("safe_mode", True)}


def unsafe(tree):
    """What a module imports, names or calls that could execute what is in a file, or reach out."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = {alias.name for alias in node.names} | {getattr(node, "module", None) or ""}
            found |= {name for name in names if name.split(".")[0] in UNSAFE}
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            given = {word.arg: getattr(word.value, "value", None) for word in node.keywords}
            if name in MUST_SAY and given.get(MUST_SAY[name][0]) is not MUST_SAY[name][1]:
                found.add(name)
            if given.get("shell") or given.get("allow_pickle") or name in UNSAFE or name.split(".")[-1] in UNSAFE:
                found.add(name)
    return found


def test_nothing_that_a_file_carries_is_executed():
    wrong = {str(path.relative_to(PACKAGE)): names for path in PACKAGE.rglob("*.py")
             if (names := unsafe(ast.parse(path.read_text())))}
    assert wrong == {}


def test_the_check_of_what_is_executed_can_fail():
    for line in ("import pickle", "from pickle import loads", "eval(text)", "np.load(path)", "np.load(path, "
                 "allow_pickle=True)", "keras.models.load_model(path)", "pd.read_pickle(path)", "joblib.load(path)",
                 "subprocess.run(text, shell=True)", "from dask.distributed import LocalCluster", "os.system(text)"):
        assert unsafe(ast.parse(line)), line
    assert not unsafe(ast.parse("with np.load(path, allow_pickle=False) as kept: model.evaluate(kept)"))
