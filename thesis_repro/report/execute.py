"""Execution of notebooks by `make figures`: progress bars, one line on failure, a log file.

Usage: python -m thesis_repro.report.execute NOTEBOOK EXECUTED. The log file stands beside EXECUTED.
The user's settings of Jupyter and IPython are not read. One of them lets failing cells pass.
"""

import argparse
import logging
import os
import signal
import sys
import time
import traceback
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

if __name__ == "__main__":
    # jsonschema, which nbformat imports, would build a grammar of internationalised addresses. That
    # takes more than a second at each start, and nothing in a notebook is checked by it.
    sys.modules["rfc3987_syntax"] = None  # type: ignore[assignment]

# isort: split
import nbformat
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient.exceptions import CellExecutionError, DeadKernelError
from nbconvert.filters import strip_ansi
from nbconvert.preprocessors import ExecutePreprocessor

from thesis_repro.running import messages, results
from thesis_repro.running.files import write_text
from thesis_repro.running.settings import PREFIX


class Execution(ExecutePreprocessor):
    """Executes all cells of a notebook.

    Exits with status 1 if a cell fails and with 130 if it is interrupted.
    """

    # without it nbconvert shows the picture that stands for sliders
    store_widget_state = False

    def __init__(self, log_file: Path, ipython_folder: str) -> None:
        """Prepare an execution.

        log_file: for the output of libraries and the traceback of a failure. ipython_folder: an
        empty folder.
        """
        super().__init__()
        self.log_file = log_file
        self.ipython_folder = ipython_folder

    def preprocess(
        self, nb: Any, resources: Any = None, km: Any = None
    ) -> tuple[Any, dict[str, Any]]:
        """Execute the notebook `nb`, as nbconvert asks for."""
        messages.print_messages()
        # so that the kernel ends with this program, and this program with make: the parent of the
        # shell that runs it
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        messages.interrupt_without(os.getppid())
        name = resources["metadata"]["name"]
        path = self.log_file
        started = time.monotonic()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            with (
                results.locked(path),
                messages.logged(path.parent, f"make figures, {name}", has_results=True),
                open(path, "w", encoding="utf-8") as self._log,
            ):
                messages.log.info(name)
                try:
                    executed = super().preprocess(nb, resources, km)
                    messages.log.info(f"{name}: done in {time.monotonic() - started:.0f} s")
                    return executed
                except Exception as error:
                    self._log.write(strip_ansi(traceback.format_exc()))
                    failure = f"{name} failed: {_reason(error)}"
                    messages.log.error(failure)
        except KeyboardInterrupt:
            logging.getLogger("asyncio").disabled = True  # would report the interrupted cell
            print(f"{name} was interrupted; the same command resumes it", file=sys.stderr)
            sys.exit(130)
        sys.exit(
            f"{failure}\nthe traceback is in {os.path.relpath(path)}; the same command resumes"
        )

    def create_kernel_manager(self) -> AsyncKernelManager:
        """Choose the kernel of this Python, as nbclient asks for.

        The notebook, or a folder of the user's, may name another one.
        """
        specifications = KernelSpecManager(kernel_dirs=[])
        self.km = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=specifications)
        return self.km

    def setup_kernel(self, **options: Any) -> Any:
        """Start the kernel with an environment and outputs of its own, as nbclient asks for."""
        # compiled libraries log into the log file, not into the outputs of cells
        self.extra_arguments = ["--IPKernelApp.capture_fd_output=False"]
        environment = os.environ | {
            # progress bars (`files.progress`) go to the standard error of this program
            f"{PREFIX}PROGRESS": f"/proc/{os.getpid()}/fd/2",
            # without files that every kernel of the user executes at its start
            "IPYTHONDIR": self.ipython_folder,
            "PYTHONSTARTUP": "",
            "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        }
        return super().setup_kernel(
            env=environment,
            stdout=self._log,
            stderr=self._log,
            preexec_fn=messages.end_with_parent,
            **options,
        )


def _reason(error: Exception) -> str:
    """Return in one line why a notebook failed."""
    if isinstance(error, DeadKernelError):
        return "the kernel died, probably for lack of memory"
    name, text = type(error).__name__, str(error)
    if isinstance(error, CellExecutionError):
        name, text = error.ename, error.evalue
    return f"{name}: {text}".splitlines()[0]


def main() -> None:
    """Execute a notebook, and write it with its outputs."""
    parser = argparse.ArgumentParser(
        "python -m thesis_repro.report.execute", description=main.__doc__
    )
    parser.add_argument("notebook", type=Path)
    parser.add_argument("executed", type=Path, help="where the notebook with its outputs goes")
    options = parser.parse_args()
    source, output = options.notebook, options.executed
    resources = {"metadata": {"name": source.stem, "path": str(source.parent)}}
    with TemporaryDirectory() as ipython_folder:
        execution = Execution(output.with_suffix(".log"), ipython_folder)
        executed, _ = execution.preprocess(nbformat.read(source, 4), resources)
    write_text(output, nbformat.writes(executed) + "\n")


if __name__ == "__main__":
    messages.run_main(main)
