"""How `make figures` executes a notebook: as nbconvert does, with progress, one line on failure and clean outputs.

The Makefile calls `jupyter nbconvert --to notebook --execute` and names `Execution` as the preprocessor that does it.
"""

import logging
import os
import re
import signal
import sys
import tempfile
import time
import traceback
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Thread

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
  | [IWEF]\d{4}\ \d\d:\d\d:[\d.]+\ +\d+\ \S+:\d+\]\ .*
  | \d{4}-\d\d-\d\d\ \d\d:\d\d:[\d.]+:\ [IWEF]\ \S+:\d+\]\ .*
  | To\ enable\ the\ following\ instructions:\ .*,\ rebuild\ TensorFlow\ with\ the\ appropriate\ compiler\ flags\.
)$\n?""", re.MULTILINE | re.VERBOSE)
COLORS = re.compile(r"\x1b\[[0-9;]*m")


class Execution(ExecutePreprocessor):
    """Executes all cells of a notebook; where one fails, ends the program with one line that says why."""

    kernel_name = Unicode("python3").tag(config=True)  # not what the last editor of the notebook called it
    log_file = Unicode("execution.log", help="what the kernel says outside of cells, and a failure's whole report"
                       ).tag(config=True)

    def preprocess(self, nb, resources=None, km=None):
        name, started = resources["metadata"]["name"], time.monotonic()
        log = Path(self.log_file)
        folder = log.parent  # of all executed notebooks of a run, of which two may be at work at once
        sys.excepthook = partial(_in_one_line, folder)  # where the executed notebook itself cannot be written
        folder.mkdir(parents=True, exist_ok=True)
        log.touch()
        with longrun.locked(log), longrun.logged(folder, f"make figures, {name}", ours=True):
            longrun.say(name)
            done = self._executed(name, nb, resources, km)
            longrun.say(f"{name}: done in {time.monotonic() - started:.0f} s")
        return done

    def _executed(self, name, nb, resources, km):
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the kernel ends with this program
        with open(self.log_file, "w", encoding="utf-8") as self._log:
            try:
                return super().preprocess(nb, resources, km)
            except KeyboardInterrupt:
                print(f"{name} was interrupted; the same command goes on from here", file=sys.stderr)
                sys.exit(130)
            except Exception as error:
                why, report = _explained(error)
                self._log.write(report)
                longrun.note(f"{name} failed: {why}")
                print(f"{name} failed: {why}\nthe whole report: {_short(self.log_file)}; the same command goes on from "
                      "here", file=sys.stderr)
                sys.exit(1)
            finally:
                signal.signal(signal.SIGTERM, before)

    @contextmanager
    def setup_kernel(self, **options):
        with shown_progress() as path:
            environment = os.environ | {f"{PREFIX}PROGRESS": path}
            with super().setup_kernel(env=environment, stdout=self._log, stderr=self._log, **options):
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
def shown_progress():
    """Yield the path that a kernel writes its progress to (`files.progress`), to be seen on this standard error.

    A terminal has a path of its own. Anything else, such as a pipe or a file, is reached through a named pipe.
    """
    if (terminal := _terminal()) is not None:
        yield terminal
        return
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "progress")
        os.mkfifo(path)
        reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # does not wait for a writer
        writer = os.open(path, os.O_WRONLY)  # held, as the last one to close would end the reading
        os.set_blocking(reader, True)
        thread = Thread(target=_copy, args=(reader,), daemon=True)
        thread.start()
        try:
            yield path
        finally:
            os.close(writer)
            thread.join(timeout=1)


def _copy(reader):
    with open(reader, encoding="utf-8", errors="replace") as lines:
        for line in lines:
            print(line, end="", file=sys.stderr, flush=True)


def _terminal():
    try:
        path = os.ttyname(sys.stderr.fileno())
    except OSError:  # none, or not one that has a name here
        return None
    return path if os.access(path, os.W_OK) else None


def _explained(error):
    """(why a notebook failed in one line, the whole report)."""
    if isinstance(error, CellExecutionError):
        why, report = f"{error.ename}: {error.evalue}".strip(), str(error)
        why = why.partition("\n")[0] + longrun.remedy(why)
    elif isinstance(error, DeadKernelError):
        why = "the kernel died, as it does where there is not enough memory"
        report = traceback.format_exc()
    else:
        why, report = f"{type(error).__name__}: {error}", traceback.format_exc()
    return COLORS.sub("", why).strip().partition("\n")[0], COLORS.sub("", report)


def _in_one_line(folder, kind, error, trace):
    if isinstance(error, OSError) and error.filename is None:
        error.filename = str(folder)
    if longrun.explain(error) is None:
        sys.__excepthook__(kind, error, trace)
    else:
        longrun.report_error(error)


def _short(path):
    path = Path(path).absolute()
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
