"""SIGKILL at moments nobody chose, then the same command again: the bytes of an undisturbed run, and nothing stray."""

import random
import shutil
import sys
import time

import nbformat
import pytest
from trials import ROOT, contents, finish, kill, nothing_stray, same, snapshot, start, succeed

from thesis_repro.settings import read_settings

pytestmark = pytest.mark.torture


def torture(command, where, results, kills, prepare=lambda: None, **environment):
    """Kill a command `kills` times, each time a while after it has begun to write; then let it end.

    The folder `results` below `where` is made anew by `prepare` for the undisturbed run and for the killed one. The
    moments are spread over the time of the undisturbed run. A run that has ended before its moment is compared too.
    """
    def anew():
        shutil.rmtree(where / results, ignore_errors=True)
        prepare()

    def begin():
        """Start the command and wait until a file has changed."""
        before, process = snapshot(where), start(command, where, **environment)
        while process.poll() is None and snapshot(where) == before:
            time.sleep(0.005)
        return process

    anew()
    process, started = begin(), time.monotonic()
    result = finish(process)
    assert result.returncode == 0, result
    seconds, wanted = time.monotonic() - started, contents(where / results)
    draw = random.Random(1)
    anew()
    killed = 0
    for number in draw.sample(range(kills), kills):
        process = begin()
        time.sleep((number + draw.random()) / kills * seconds / (1 + killed))  # what goes on is shorter
        if process.poll() is None:
            kill(process)
            killed += 1
            continue
        result = finish(process)
        assert result.returncode == 0, f"does not go on: {result}"
        same(contents(where / results), wanted)
        anew()
        killed = 0
    succeed(command, where, **environment)
    same(contents(where / results), wanted)
    nothing_stray(where)


@pytest.mark.parametrize("name, kills", [("synthesize", 6), ("training", 4), ("predict", 4), ("study", 7)])
def test_a_command_that_writes(words, tmp_path, name, kills):
    torture(words(name), tmp_path, "out", kills)


def test_the_page(tmp_path):
    changes = {"THESIS_REPRO_BUILD": str(tmp_path / "build"), "THESIS_REPRO_FIGURES": str(tmp_path / "figures")}
    settings = read_settings(changes)

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

    torture([sys.executable, "-m", "thesis_repro.report.page"], tmp_path, ".", 5, prepare, **changes)
