"""Execution of notebooks by `make figures`: progress bars, one line on failure, a log file.

The Makefile calls `jupyter nbconvert --to notebook --execute` with `Execution` as its preprocessor.
"""

import logging
import os
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from nbclient.exceptions import CellExecutionError, DeadKernelError
from nbconvert.filters import strip_ansi
from nbconvert.preprocessors import ExecutePreprocessor
from traitlets import Unicode

from thesis_repro.running import console, results
from thesis_repro.running.settings import PREFIX


class Execution(ExecutePreprocessor):
    """Executes all cells of a notebook.

    Exits with status 1 if a cell fails and with 130 if it is interrupted.
    """

    # the notebook may name a kernel that is not installed here
    kernel_name = Unicode("python3").tag(config=True)
    # without it nbconvert shows the picture that stands for sliders
    store_widget_state = False
    # for the output of libraries and the traceback of a failure
    log_file = Unicode("execution.log").tag(config=True)

    def preprocess(
        self, nb: Any, resources: Any = None, km: Any = None
    ) -> tuple[Any, dict[str, Any]]:
        """Execute the notebook `nb`, as nbconvert asks for."""
        console.print_messages()
        # so that the kernel ends with this program, and this program with make: the parent of the
        # shell that runs it
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        console.interrupt_without(os.getppid())
        sys.excepthook = _print_error  # nbconvert may fail to write the executed notebook
        name = resources["metadata"]["name"]
        path = Path(self.log_file)
        started = time.monotonic()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            with (
                results.locked(path),
                console.logged(path.parent, f"make figures, {name}", has_results=True),
                open(path, "w", encoding="utf-8") as self._log,
            ):
                console.log.info(name)
                try:
                    executed = super().preprocess(nb, resources, km)
                    console.log.info(f"{name}: done in {time.monotonic() - started:.0f} s")
                    return executed
                except Exception as error:
                    self._log.write(strip_ansi(traceback.format_exc()))
                    failure = f"{name} failed: {_reason(error)}"
                    console.log.error(failure)
        except KeyboardInterrupt:
            logging.getLogger("asyncio").disabled = True  # would report the interrupted cell
            print(f"{name} was interrupted; the same command resumes it", file=sys.stderr)
            sys.exit(130)
        sys.exit(
            f"{failure}\nthe traceback is in {os.path.relpath(path)}; the same command resumes"
        )

    def setup_kernel(self, **options: Any) -> Any:
        """Start the kernel with an environment and outputs of its own, as nbclient asks for."""
        # compiled libraries log into the log file, not into the outputs of cells
        self.extra_arguments = ["--IPKernelApp.capture_fd_output=False"]
        # progress bars (`files.progress`) go to the standard error of this program
        environment = os.environ | {f"{PREFIX}PROGRESS": f"/proc/{os.getpid()}/fd/2"}
        return super().setup_kernel(
            env=environment,
            stdout=self._log,
            stderr=self._log,
            preexec_fn=console.end_with_parent,
            **options,
        )


def _print_error(kind: type[BaseException], error: BaseException, _traceback: Any) -> None:
    print(console.explain(error) or f"{kind.__name__}: {error}", file=sys.stderr)


def _reason(error: Exception) -> str:
    """Return in one line why a notebook failed."""
    if isinstance(error, DeadKernelError):
        return "the kernel died, probably for lack of memory"
    name, text = type(error).__name__, str(error)
    if isinstance(error, CellExecutionError):
        name, text = error.ename, error.evalue
    return f"{name}: {text}".splitlines()[0]
