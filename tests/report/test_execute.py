"""Executing notebooks: what is shown, what is kept out, and how it fails."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import nbformat
import psutil
import pytest

from thesis_repro.settings import ROOT

pytestmark = pytest.mark.slow

COMMAND = [str(Path(sys.executable).parent / "jupyter-nbconvert"), "--to", "notebook", "--execute",
           "--log-level=CRITICAL", "--NotebookExporter.default_preprocessors=thesis_repro.report.execute.Execution",
           "--Execution.log_file=out/done.log", "--output-dir", "out", "--output", "done", "one.ipynb"]


@pytest.fixture
def start(tmp_path):
    """Starts nbconvert as the Makefile does, on a notebook of the cells that are given."""

    def started(*cells):
        cells = [nbformat.v4.new_code_cell(cell) for cell in cells]
        nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "one.ipynb")
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        # (what runs in the background of a shell script is deaf to an interrupt)
        return subprocess.Popen(COMMAND, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True,
                                stderr=subprocess.PIPE, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))

    return started


def test_progress_is_shown_and_what_compiled_libraries_log_stays_out(start, tmp_path):
    process = start("import os\nopen(os.environ['THESIS_REPRO_PROGRESS'], 'a').write('half way\\n')\nprint('mine')\n"
                    "os.write(2, b'I0000 00:00:1.1 3010 port.cc:153] oneDNN custom operations are on.')")
    stdout, stderr = process.communicate()
    assert process.returncode == 0 and stderr == "half way\n"
    assert stdout.startswith("one\none: done in ")
    (cell,) = nbformat.read(tmp_path / "out" / "done.ipynb", 4).cells
    assert [output.get("text") for output in cell.outputs if output.output_type == "stream"] == ["mine\n"]
    assert "port.cc" in (tmp_path / "out" / "done.log").read_text()


def test_a_failure_is_one_line_a_report_and_no_notebook(start, tmp_path):
    process = start("from thesis_repro import InputError\nprint('so far')",
                    "raise InputError('00.txt: no such file; check KITTI\\nmore of it')")
    _, stderr = process.communicate()
    assert process.returncode == 1 and stderr.splitlines() == [
        "one failed: InputError: 00.txt: no such file; check KITTI\\nmore of it",
        "the whole report: out/done.log; the same command goes on from here"]
    log = (tmp_path / "out" / "done.log").read_text()
    assert "ERROR   one failed: InputError: 00.txt: no such file" in (tmp_path / "out" / "log.txt").read_text()
    assert "raise InputError" in log and "more of it" in log and "\x1b" not in log
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"done.log", "log.txt"}


def test_a_kernel_that_dies_is_said_to_have_died(start, tmp_path):
    process = start("import os, signal\nos.kill(os.getpid(), signal.SIGKILL)")
    _, stderr = process.communicate()
    assert process.returncode == 1 and stderr.startswith("one failed: the kernel died")
    assert "Traceback" not in stderr and "DeadKernelError" in (tmp_path / "out" / "done.log").read_text()


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_notebook_leaves_no_kernel_running(start, tmp_path, sent):
    process = start("import os, time\nfrom pathlib import Path\n"
                    "try:\n    Path('pid').write_text(str(os.getpid()))\n    time.sleep(100)\n"
                    "finally:\n    Path('tidied').touch()")
    while not (tmp_path / "pid").is_file():
        assert process.poll() is None
        time.sleep(0.1)
    time.sleep(0.5)
    process.send_signal(sent)
    _, stderr = process.communicate(timeout=120)
    assert process.returncode == 130
    assert stderr.splitlines() == ["one was interrupted; the same command goes on from here"]
    alive = {each.pid for each in psutil.process_iter(["status"]) if each.info["status"] != psutil.STATUS_ZOMBIE}
    assert (tmp_path / "tidied").is_file() and int((tmp_path / "pid").read_text()) not in alive
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"done.log", "log.txt"}
