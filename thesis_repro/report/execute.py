"""How `make figures` executes a notebook: as nbconvert does, with progress, one line on failure and clean outputs.

The Makefile calls `jupyter nbconvert --to notebook --execute` and names `Execution` as the preprocessor that does it.
"""

import logging
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from contextlib import contextmanager
from pathlib import Path

from nbclient.exceptions import CellExecutionError, DeadKernelError
from nbclient.util import run_sync
from nbconvert.preprocessors import ExecutePreprocessor
from traitlets import Unicode

from thesis_repro import longrun
from thesis_repro.settings import PREFIX

# Whole lines that libraries log: segmentation-models on import, absl and TensorFlow with the place in their sources.
LOGGED = re.compile(r"""^(?:
    Segmentation\ Models:\ using\ .*\ framework\.
  | (?:WARNING:\ )?All\ log\ messages\ before\ absl::InitializeLog\(\)\ .*
  | (?:[IWEF]\d{4}|\d{4}-\d\d-\d\d)\ \d\d:\d\d:[\d.]+(?:\ +\d+|:\ [IWEF])\ \S+:\d+\]\ .*
  | To\ enable\ the\ following\ instructions:\ .*,\ rebuild\ TensorFlow\ with\ the\ appropriate\ compiler\ flags\.
)$\n?""", re.MULTILINE | re.VERBOSE)
COLORS = re.compile(r"\x1b\[[0-9;]*m")


class Execution(ExecutePreprocessor):
    """Executes all cells of a notebook; where one fails, ends the program with one line that says why."""

    kernel_name = Unicode("python3").tag(config=True)  # not what the last editor of the notebook called it
    log_file = Unicode("execution.log", help="what the kernel says outside of cells, and a failure's whole report"
                       ).tag(config=True)

    def preprocess(self, nb, resources=None, km=None):
        name, log = resources["metadata"]["name"], Path(self.log_file)
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the kernel ends with this program
        sys.excepthook = self._say_why  # where its result cannot be written
        log.parent.mkdir(parents=True, exist_ok=True)
        log.touch()
        with longrun.locked(log), longrun.logged(log.parent, f"make figures, {name}", ours=True), \
                open(log, "w", encoding="utf-8") as self._log:
            longrun.say(name)
            started = time.monotonic()
            try:
                executed = super().preprocess(nb, resources, km)
            except KeyboardInterrupt:
                print(f"{name} was interrupted; the same command goes on from here", file=sys.stderr)
                sys.exit(130)
            except Exception as error:
                self._log.write(COLORS.sub("", traceback.format_exc()))
                reason = f"{name} failed: {_reason(error)}"
                longrun.note(reason)
                print(f"{reason}\nthe whole report: {os.path.relpath(log)}; the same command goes on from here",
                      file=sys.stderr)
                sys.exit(1)
            longrun.say(f"{name}: done in {time.monotonic() - started:.0f} s")
        return executed

    def _say_why(self, kind, error, trace):
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(Path(self.log_file).parent)
        print(longrun.explain(error) or "".join(traceback.format_exception(error)), file=sys.stderr)

    @contextmanager
    def setup_kernel(self, **options):
        with _progress_path() as path, super().setup_kernel(env=os.environ | {f"{PREFIX}PROGRESS": path},
                                                            stdout=self._log, stderr=self._log, **options):
            try:
                yield
            except KeyboardInterrupt:
                logging.getLogger("asyncio").disabled = True  # would report the cell that nobody waits for now
                run_sync(self.km.interrupt_kernel)()  # so that the cell tidies up before its kernel ends,
                time.sleep(1)  # for which it needs a moment
                raise

    def preprocess_cell(self, cell, resources, index):
        cell, resources = super().preprocess_cell(cell, resources, index)
        for output in cell.get("outputs", []):
            if output.output_type == "stream":
                output.text = LOGGED.sub("", output.text)
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if output.get("text") != ""]
        return cell, resources


@contextmanager
def _progress_path():
    """The path that a kernel writes its progress to (`files.progress`), to be seen on this standard error.

    A terminal has a path of its own. Anything else, such as a file, is reached through a named pipe.
    """
    if os.isatty(2):
        yield os.ttyname(2)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "progress")
        os.mkfifo(path)
        with subprocess.Popen(["cat", path], stdout=2, start_new_session=True), open(path, "r+b", buffering=0):
            yield path  # held open, since the last writer that closes it would end the copying


def _reason(error):
    """Why a notebook failed, in one line."""
    if isinstance(error, DeadKernelError):
        return "the kernel died, as it does where there is not enough memory"
    name, text = type(error).__name__, str(error)
    if isinstance(error, CellExecutionError):
        name, text = error.ename, error.evalue
    lines = COLORS.sub("", f"{name}: {text}").strip().splitlines()
    return lines[0] + longrun.remedy(text)
