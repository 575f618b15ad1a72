"""Commands killed at random moments resume and leave the bytes of an undisturbed run, and no
temporary files.
"""

import random
import shutil
import time

import pytest
from trials import contents, finish, kill, no_temporary_files, snapshot, start, succeed
from waiting import wait_for

pytestmark = pytest.mark.torture


@pytest.mark.parametrize(
    "name, kills", [("synthesize", 6), ("training", 4), ("predict", 4), ("study", 7)]
)
def test_a_command_that_writes(words, tmp_path, name, kills):
    """Kill a command `kills` times while it writes, then let it end.

    Kills are spread over the time of the undisturbed run. A run may end before it is killed.
    """
    out = tmp_path / "out"

    def begin():
        """Start the command and wait until a file has changed."""
        before, process = snapshot(tmp_path), start(words(name), tmp_path)
        wait_for(lambda: process.poll() is not None or snapshot(tmp_path) != before, 600)
        return process

    process, started = begin(), time.monotonic()
    assert finish(process).returncode == 0
    seconds, expected = time.monotonic() - started, contents(out)
    draw = random.Random(1)
    shutil.rmtree(out)
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
            assert contents(out) == expected
            shutil.rmtree(out)
            killed = 0
    succeed(words(name), tmp_path)
    assert contents(out) == expected
    no_temporary_files(tmp_path)
