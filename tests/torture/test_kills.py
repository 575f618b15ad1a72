"""Commands killed at random moments resume and leave the bytes of an undisturbed run, and no
temporary files.
"""

import random
import shutil
import sys
import time

import nbformat
import pytest
from trials import contents, finish, kill, no_temporary_files, snapshot, start, succeed
from waiting import wait_for

from thesis_repro.settings import read_settings

pytestmark = pytest.mark.torture


def torture(command, where, results, kills, prepare=lambda: None, **environment):
    """Kill a command `kills` times while it writes, then let it end.

    `prepare` fills the folder `results` before the undisturbed run and before the killed one. Kills
    are spread over the time of the undisturbed run. A run may end before it is killed.
    """

    def clear():
        shutil.rmtree(where / results, ignore_errors=True)
        prepare()

    def begin():
        """Start the command and wait until a file has changed."""
        before, process = snapshot(where), start(command, where, **environment)
        wait_for(lambda: process.poll() is not None or snapshot(where) != before, 600)
        return process

    clear()
    process, started = begin(), time.monotonic()
    assert finish(process).returncode == 0
    seconds, expected = time.monotonic() - started, contents(where / results)
    draw = random.Random(1)
    clear()
    killed = 0
    for number in draw.sample(range(kills), kills):
        process = begin()
        # a resumed run is shorter
        time.sleep((number + draw.random()) / kills * seconds / (1 + killed))
        if process.poll() is None:
            kill(process)
            killed += 1
        else:
            assert finish(process).returncode == 0
            assert contents(where / results) == expected
            clear()
            killed = 0
    succeed(command, where, **environment)
    assert contents(where / results) == expected
    no_temporary_files(where)


@pytest.mark.parametrize(
    "name, kills", [("synthesize", 6), ("training", 4), ("predict", 4), ("study", 7)]
)
def test_a_command_that_writes(words, tmp_path, name, kills):
    torture(words(name), tmp_path, "out", kills)


def test_the_page(tmp_path):
    changes = {
        "THESIS_REPRO_BUILD": str(tmp_path / "build"),
        "THESIS_REPRO_FIGURES": str(tmp_path / "figures"),
    }
    settings = read_settings(changes)

    def prepare():
        executed = settings.build / "notebooks"
        executed.mkdir(parents=True)
        settings.figures.mkdir(exist_ok=True)
        output = nbformat.v4.new_output("stream", text="1\n" * 2000)
        cell = nbformat.v4.new_code_cell("1", id="one", outputs=[output])
        notebook = nbformat.v4.new_notebook(
            cells=[cell], metadata={"language_info": {"name": "python"}}
        )
        for number in range(12):
            nbformat.write(notebook, executed / f"{number:02d}_some.ipynb")

    torture(
        [sys.executable, "-m", "thesis_repro.report.page"], tmp_path, ".", 5, prepare, **changes
    )
