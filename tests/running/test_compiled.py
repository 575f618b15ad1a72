"""Machine code is cached, and compiled anew after an edit of a file that it was made from."""

import os
import shutil
import subprocess
import sys

import nbformat
import pytest
from nbclient import NotebookClient

from thesis_repro import errors
from thesis_repro.running import compiled, folders, messages

CALL = "from thesis_repro.odometry.outer import f; print(f(1.0))"
OUTER = (
    "from thesis_repro.odometry.below.adding import add\n"
    "from thesis_repro.running.compiled import fast\n"
    "@fast\ndef f(x):\n    return add(x)\n"
)
ADDING = "from thesis_repro.running.compiled import inner\n@inner\ndef add(x):\n    return x + {}\n"


def test_caches_of_compiled_code_are_deleted_when_a_file_has_changed(tmp_path):
    cache, module = tmp_path / "cache" / "old.nbi", tmp_path / "room" / "inner" / "neighbour.py"
    cache.parent.mkdir()
    module.parent.mkdir(parents=True)
    deleted = []
    # dates older than the cache's; neither an equal nor a new date says anything about the bytes
    for text, date in (("1", 1), ("1", 2), ("2", 2), ("2", 2)):
        module.write_text(text)
        os.utime(module, (date, date))
        cache.touch()
        compiled.forget_stale(cache.parent, tmp_path / "room")
        deleted.append(not cache.exists())
    assert deleted == [True, False, True, False]
    compiled.forget_stale(tmp_path / "nothing", tmp_path / "room")


def test_a_file_edited_while_it_is_in_use_leaves_no_cache_to_the_next_process(tmp_path):
    cache, module = tmp_path / "cache" / "old.nbi", tmp_path / "module.py"
    cache.parent.mkdir()
    module.write_text("1")  # later than the import of `compiled`
    for date in (None, (1, 1)):  # in this process, and as the next one sees it
        if date is not None:
            os.utime(module, date)
        cache.touch()
        compiled.forget_stale(cache.parent, tmp_path)
        assert not cache.exists()


@pytest.fixture
def project(tmp_path):
    """A made-up package in which one compiled function calls another file's; others beside it."""
    running = tmp_path / "thesis_repro" / "running"
    below = tmp_path / "thesis_repro" / "odometry" / "below"
    for folder in (running, below):
        folder.mkdir(parents=True)
    for folder in (running.parent, running, below.parent, below):
        (folder / "__init__.py").touch()
    for module in (compiled, messages, folders):
        shutil.copy(module.__file__, running)
    shutil.copy(errors.__file__, running.parent)
    (below.parent / "outer.py").write_text(OUTER)
    for name in ("street_world", "neighbour"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.py").write_text("not of this project")
    return tmp_path


def run_as_program(folder):
    environment = {"PYTHONPATH": str(folder), "PATH": os.environ["PATH"]}
    command = [sys.executable, "-c", CALL]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    ).stdout


def run_as_notebook(folder):
    cell = nbformat.v4.new_code_cell(f"import sys\nsys.path.insert(0, {str(folder)!r})\n{CALL}")
    notebook = nbformat.v4.new_notebook(cells=[cell])
    NotebookClient(notebook, kernel_name="python3").execute()
    return "".join(output.text for output in notebook.cells[0].outputs)


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_as_program, run_as_notebook])
def test_an_edit_takes_effect_in_functions_that_are_called_from_other_files(project, run):
    adding = project / "thesis_repro" / "odometry" / "below" / "adding.py"
    printed = []
    for number in (1, 2):
        adding.write_text(ADDING.format(number))
        # not the same date, which would keep Python's own cache
        os.utime(adding, (number, number))
        printed.append(run(project).strip())
    assert printed == ["2.0", "3.0"]
    assert list(project.rglob("outer.f-*.nbi"))
    left = {path.name for path in project.glob("*/*") if "thesis_repro" not in path.parts}
    assert left == {"mine.py"}  # nothing was written beside files of others


@pytest.mark.slow
def test_machine_code_is_loaded_by_the_next_process(project):
    adding = project / "thesis_repro" / "odometry" / "below" / "adding.py"
    adding.write_text(ADDING.format(1))
    os.utime(adding, (10**9, 10**9))
    dates = []
    for _ in range(2):
        run_as_program(project)
        dates.append({path: path.stat().st_mtime_ns for path in project.rglob("*.nb?")})
    assert dates[0] == dates[1] != {}
