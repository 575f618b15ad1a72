"""Executing notebooks: progress, logs, failures and interrupts."""

import os
import shlex
import signal
import subprocess
import sys
import time

import nbformat
import psutil
import pytest
from trials import wait_for

from thesis_repro.running.settings import ROOT

pytestmark = pytest.mark.slow

COMMAND = [sys.executable, "-m", "thesis_repro.report.execute", "one.ipynb", "out/done.ipynb"]


@pytest.fixture
def start(tmp_path):
    """Return a function that executes a notebook of its cells, as the Makefile does.

    command: another command that does so. variables: of the environment.
    """

    def started(*cells, command=COMMAND, **variables):
        cells = [nbformat.v4.new_code_cell(cell) for cell in cells]
        nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "one.ipynb")
        environment = os.environ | {"PYTHONPATH": str(ROOT)} | variables
        # processes in the background of a shell script ignore SIGINT
        return subprocess.Popen(
            command,
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            stderr=subprocess.PIPE,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    return started


def test_progress_is_shown_and_logs_of_compiled_libraries_are_not(start, tmp_path):
    process = start(
        "import os\nopen(os.environ['THESIS_REPRO_PROGRESS'], 'a').write('half way\\n')\nprint('mine')\n"
        "os.write(2, b'I0000 00:00:1.1 3010 port.cc:153] oneDNN custom operations are on.')"
    )
    stdout, stderr = process.communicate()
    assert process.returncode == 0 and stdout == ""
    assert stderr.startswith("one\nhalf way\none: done in ")
    (cell,) = nbformat.read(tmp_path / "out" / "done.ipynb", 4).cells
    assert [output.get("text") for output in cell.outputs if output.output_type == "stream"] == [
        "mine\n"
    ]
    assert "port.cc" in (tmp_path / "out" / "done.log").read_text()


def test_a_failure_leaves_one_line_and_a_log_and_no_notebook(start, tmp_path):
    process = start(
        "from thesis_repro import InputError\nprint('so far')",
        "raise InputError('00.txt: no such file; check KITTI\\nmore of it')",
    )
    _, stderr = process.communicate()
    _, error, log_file = stderr.splitlines()
    assert process.returncode == 1 and "out/done.log" in log_file
    assert error == "one failed: InputError: 00.txt: no such file; check KITTI\\nmore of it"
    log = (tmp_path / "out" / "done.log").read_text()
    assert (
        "ERROR   one failed: InputError: 00.txt: no such file"
        in (tmp_path / "out" / "log.txt").read_text()
    )
    assert "raise InputError" in log and "more of it" in log and "\x1b" not in log
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"done.log", "log.txt"}


def test_settings_of_the_user_let_no_failure_pass(start, tmp_path):
    allow = (
        "c = get_config()\nc.Execution.allow_errors = c.ExecutePreprocessor.allow_errors = True\n"
    )
    home = tmp_path / "home"
    kernel = home / "kernels/python3/kernel.json"
    startup = home / "profile_default/startup/x.py"
    for path, text in (
        (tmp_path / "jupyter_nbconvert_config.py", allow),
        (home / "jupyter_nbconvert_config.py", allow),
        (home / "jupyter_config.py", allow),
        (startup, "surprise = 1"),
        (home / "startup.py", "surprise = 1"),
        (
            home / "profile_default/ipython_kernel_config.py",
            "get_config().IPKernelApp.exec_lines = ['surprise = 1']",
        ),
        (kernel, '{"argv": ["false"], "display_name": "x", "language": "python"}'),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    process = start(
        "assert 'surprise' not in globals()\nprint('as it should')\n1 / 0",
        JUPYTER_CONFIG_DIR=str(home),
        JUPYTER_PATH=str(home),
        IPYTHONDIR=str(home),
        PYTHONSTARTUP=str(home / "startup.py"),
        MPLBACKEND="bogus",
    )
    _, stderr = process.communicate()
    assert process.returncode == 1 and "one failed: ZeroDivisionError" in stderr, stderr
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"done.log", "log.txt"}


def test_a_dead_kernel_is_reported(start, tmp_path):
    process = start("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)")
    _, stderr = process.communicate()
    assert process.returncode == 1 and stderr.startswith("one\none failed: the kernel died")
    assert (
        "Traceback" not in stderr
        and "DeadKernelError" in (tmp_path / "out" / "done.log").read_text()
    )


WAITING = (
    "import os, time\nfrom pathlib import Path\n"
    "try:\n    Path('pid').write_text(str(os.getpid()))\n    time.sleep(100)\n"
    "finally:\n    Path('tidied').touch()"
)


def test_a_notebook_ends_when_make_is_killed(start, tmp_path):
    # a shell in the place of make, and the one of its recipe
    recipe = f"bash -c '{shlex.join(COMMAND)} 2>/dev/null; :' & wait; :"
    process = start(WAITING, command=["bash", "-c", recipe])
    wait_for((tmp_path / "pid").is_file)
    time.sleep(0.5)
    kernel = psutil.Process(int((tmp_path / "pid").read_text()))
    converter = kernel.parent()
    process.kill()
    process.wait()
    assert psutil.wait_procs([kernel, converter], timeout=20)[1] == []


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_notebook_leaves_no_kernel_running(start, tmp_path, sent):
    process = start(WAITING)
    wait_for((tmp_path / "pid").is_file)
    time.sleep(0.5)
    process.send_signal(sent)
    _, stderr = process.communicate(timeout=120)
    assert (
        process.returncode == 130
        and stderr.startswith("one\none was interrupted")
        and stderr.count("\n") == 2
    )
    alive = {
        kernel.pid
        for kernel in psutil.process_iter(["status"])
        if kernel.info["status"] != psutil.STATUS_ZOMBIE
    }
    assert (tmp_path / "tidied").is_file() and int((tmp_path / "pid").read_text()) not in alive
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"done.log", "log.txt"}
