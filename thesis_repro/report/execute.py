"""How `make figures` executes a notebook: with progress, one line on failure, and what libraries log in a file.

The Makefile calls `jupyter nbconvert --to notebook --execute` and names `Execution` as the preprocessor that does it.
"""

import logging
import os
import signal
import sys
import time
import traceback
from pathlib import Path

from nbclient.exceptions import CellExecutionError, DeadKernelError
from nbconvert.filters import strip_ansi
from nbconvert.preprocessors import ExecutePreprocessor
from traitlets import Unicode

from thesis_repro import longrun
from thesis_repro.settings import PREFIX


class Execution(ExecutePreprocessor):
    """Executes all cells of a notebook; ends the program with status 1 where one fails, 130 where it is interrupted."""

    kernel_name = Unicode("python3").tag(config=True)  # not what the last editor of the notebook called it
    log_file = Unicode("execution.log").tag(config=True)  # what is said outside of cells, and a failure's whole report

    def preprocess(self, nb, resources=None, km=None):
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the kernel ends with this program
        sys.excepthook = _say_why  # where nbconvert cannot write the result
        name, path, started = resources["metadata"]["name"], Path(self.log_file), time.monotonic()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            with longrun.locked(path), longrun.logged(path.parent, f"make figures, {name}", has_results=True), \
                    open(path, "w", encoding="utf-8") as self._log:
                longrun.say(name)
                try:
                    executed = super().preprocess(nb, resources, km)
                    longrun.say(f"{name}: done in {time.monotonic() - started:.0f} s")
                    return executed
                except Exception as error:
                    self._log.write(strip_ansi(traceback.format_exc()))
                    failure = f"{name} failed: {_reason(error)}"
                    longrun.note(failure)
        except KeyboardInterrupt:
            logging.getLogger("asyncio").disabled = True  # would report the cell that nobody waits for now
            print(f"{name} was interrupted; the same command goes on from here", file=sys.stderr)
            sys.exit(130)
        sys.exit(f"{failure}\nthe whole report: {os.path.relpath(path)}; the same command goes on from here")

    def setup_kernel(self, **options):
        # what compiled libraries log goes to the log file instead of into the cells' outputs
        self.extra_arguments = ["--IPKernelApp.capture_fd_output=False"]
        # bars of progress (`files.progress`) go to this program's own standard error
        environment = os.environ | {f"{PREFIX}PROGRESS": f"/proc/{os.getpid()}/fd/2"}
        return super().setup_kernel(env=environment, stdout=self._log, stderr=self._log, **options)


def _say_why(kind, error, _trace):
    print(longrun.explain(error) or f"{kind.__name__}: {error}", file=sys.stderr)


def _reason(error):
    """Why a notebook failed, in one line."""
    if isinstance(error, DeadKernelError):
        return "the kernel died, as it does where there is not enough memory"
    name, text = type(error).__name__, str(error)
    if isinstance(error, CellExecutionError):
        name, text = error.ename, error.evalue
    return f"{name}: {text}".splitlines()[0] + longrun.remedy(text)
