"""SIGKILL at moments nobody chose, then the same command again: the bytes of an undisturbed run, and nothing stray."""

import random
import shlex
import shutil
import sys
import time

import nbformat
import pytest
from trials import ROOT, TIMEOUT, contents, finish, kill, nothing_stray, same, snapshot, start, succeed

from thesis_repro import longrun
from thesis_repro.settings import read_settings


def look(folder):
    """The files below a folder with their versions, the log left out."""
    return {path: about for path, about in snapshot(folder).items() if path.name != longrun.LOG}


def torture(command, where, results, kills, seed, prepare=lambda: None, **environment):
    """Kill a command `kills` times, each time a while after it has begun to write; then let it end.

    command: what is run in the folder `where`; results: the folder below it that is compared, made anew by `prepare`
    for the undisturbed run and for the killed one. The moments are spread over the time that the undisturbed run takes
    from its first file on; a run that ends before its moment is compared too, and the next one begins anew.
    """
    results = where / results

    def anew():
        shutil.rmtree(results, ignore_errors=True)
        prepare()

    def begun(process):
        """Wait until a file has changed; False where the process ended first."""
        before = look(where)
        while process.poll() is None:
            if look(where) != before:
                return True
            time.sleep(0.005)
        return False

    anew()
    process = start(command, where, **environment)
    assert begun(process), f"writes nothing: {process.communicate()}"
    started = time.monotonic()
    assert finish(process).returncode == 0
    seconds, wanted = time.monotonic() - started, contents(results)
    moments = [(number + random.Random(f"{seed} {number}").random()) / kills * seconds
               for number in range(kills)]
    random.Random(seed).shuffle(moments)
    anew()
    tries = 0
    while moments:
        tries += 1
        process = start(command, where, **environment)
        if begun(process):
            time.sleep(moments[0] if tries < 3 * kills else 0)
        if process.poll() is None:
            kill(process)
            moments.pop(0)
            continue
        result = finish(process)
        assert result.returncode == 0, f"does not go on: {result.stdout}\n{result.stderr}"
        same(contents(results), wanted)
        moments[0] /= 2  # a resumed run is shorter
        anew()
    succeed(command, where, timeout=2 * TIMEOUT, **environment)
    same(contents(results), wanted)
    nothing_stray(where)


WORLD = "from thesis_repro import world; world.write('out', sequences=['00'], frames=20, scale=0.2, " \
        "train_images=20, validation_images=10, jobs=1)"


@pytest.mark.parametrize("name, kills", [
    ("synthesize", 3), ("world", 7), ("training", 5), ("predict", 5), ("study", 9)])
def test_a_command_that_writes(words, tmp_path, name, kills):
    command = [sys.executable, "-c", WORLD] if name == "world" else words(name)
    torture(command, tmp_path, "out", kills, 1)


def test_the_drawing_of_a_study(words, tmp_path):
    succeed(words("study"), tmp_path)
    shutil.copytree(tmp_path / "out", tmp_path / "runs")

    def prepare():
        """All runs are there, no table and no figure."""
        shutil.copytree(tmp_path / "runs", tmp_path / "out")
        for path in (tmp_path / "out").iterdir():
            if path.is_file() and path.name != longrun.RECORD:
                path.unlink()

    torture(words("study"), tmp_path, "out", 6, 5, prepare)


DRAWING = """
import numpy as np
from thesis_repro.report import style
from thesis_repro.settings import read_settings
for number in range(12):
    figure, axes = style.new_figure()
    axes.plot(np.random.default_rng(number).random((400, 5)))
    style.save_figure(figure, read_settings().figures, f"figure_{number}", "made up")
"""
PAGE = [sys.executable, "-m", "thesis_repro.report.page"]


def own_folders(folder):
    """Environment and settings of a run that keeps everything in a folder."""
    changes = {"THESIS_REPRO_BUILD": str(folder / "build"), "THESIS_REPRO_FIGURES": str(folder / "figures")}
    return changes, read_settings(changes)


def test_the_figures_of_a_notebook(tmp_path):
    """As `make figures` executes one, and makes the page after the last."""
    changes, settings = own_folders(tmp_path)
    done = settings.build / "notebooks"

    def prepare():
        done.mkdir(parents=True)
        cell = nbformat.v4.new_code_cell(DRAWING, id="drawing")
        nbformat.write(nbformat.v4.new_notebook(cells=[cell]), tmp_path / "one.ipynb")

    execute = [sys.executable, "-m", "thesis_repro.report.execute", "one.ipynb", str(done / "one.ipynb")]
    command = ["bash", "-c", f"{shlex.join(execute)} && {shlex.join(PAGE)}"]
    torture(command, tmp_path, ".", 4, 6, prepare, **changes)


@pytest.mark.short
def test_the_page(tmp_path):
    changes, settings = own_folders(tmp_path)

    def prepare():
        executed = settings.build / "notebooks"
        executed.mkdir(parents=True)
        (tmp_path / "figures").mkdir(exist_ok=True)
        for number in range(12):
            output = nbformat.v4.new_output("stream", text=f"{number}\n" * 2000)
            cell = nbformat.v4.new_code_cell("1", id="one", outputs=[output])
            nbformat.write(nbformat.v4.new_notebook(cells=[cell], metadata={"language_info": {"name": "python"}}),
                           executed / f"{number:02d}_some.ipynb")
        for path in (ROOT / "figures").glob("*.csv"):
            shutil.copy(path, settings.figures)

    torture(PAGE, tmp_path, ".", 5, 7, prepare, **changes)
