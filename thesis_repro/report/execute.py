"""How `make figures` executes a notebook: with progress, one line on failure and outputs without libraries' logs.

`python -m thesis_repro.report.execute NOTEBOOK EXECUTED` writes the executed notebook and, beside it, a log of what the
kernel says outside of cells and of a failure's whole report.
"""

import logging
import os
import re
import signal
import sys
import time
import traceback
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, DeadKernelError

from thesis_repro import longrun
from thesis_repro.files import atomic
from thesis_repro.settings import PREFIX

# Lines that segmentation-models, absl and TensorFlow print whatever TF_CPP_MIN_LOG_LEVEL says.
LOGGED = re.compile(r"^(?:Segmentation Models: using .* framework\.|WARNING: All log messages before absl::"
                    r"|[IWEF]\d{4} \d\d:\d\d:|To enable the following instructions: ).*\n?", re.MULTILINE)
COLORS = re.compile(r"\x1b\[[0-9;]*m")


def executed_notebook(path, log):
    """The notebook of a file with the outputs of all its cells, run in its folder; log: a file for the kernel's words.

    Raises nbclient's CellExecutionError and DeadKernelError. However it ends, its kernel does too.
    """
    notebook = nbformat.read(path, as_version=4)
    # python3: not what the last editor of the notebook called the kernel
    client = NotebookClient(notebook, kernel_name="python3", resources={"metadata": {"path": path.parent}})
    # bars of progress (`files.progress`) go to this program's own standard error
    environment = os.environ | {f"{PREFIX}PROGRESS": f"/proc/{os.getpid()}/fd/2"}
    with client.setup_kernel(env=environment, stdout=log, stderr=log):
        for index, cell in enumerate(notebook.cells):
            client.execute_cell(cell, index)
            for output in cell.get("outputs", []):
                if output.output_type == "stream":
                    output.text = LOGGED.sub("", output.text)
            if "outputs" in cell:
                cell.outputs = [output for output in cell.outputs if output.get("text") != ""]
    return notebook


def main(path, executed):
    """Execute a notebook; returns the exit status: 0, 1 where it failed, 130 where it was interrupted."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the kernel ends with this program
    path, executed = Path(path).absolute(), Path(executed)
    name, log_path, started = path.stem, executed.with_suffix(".log"), time.monotonic()
    try:
        log_path.parent.mkdir(parents=True, exist_ok=True)
        log_path.touch()
        with longrun.locked(log_path), longrun.logged(log_path.parent, f"make figures, {name}", ours=True), \
                open(log_path, "w", encoding="utf-8") as log:
            longrun.say(name)
            try:
                notebook = executed_notebook(path, log)
            except Exception as error:
                log.write(COLORS.sub("", traceback.format_exc()))
                reason = f"{name} failed: {_reason(error)}"
                longrun.note(reason)
                print(f"{reason}\nthe whole report: {os.path.relpath(log_path)}; the same command goes on from here",
                      file=sys.stderr)
                return 1
            with atomic(executed) as temporary:
                nbformat.write(notebook, temporary)
            longrun.say(f"{name}: done in {time.monotonic() - started:.0f} s")
    except KeyboardInterrupt:
        logging.getLogger("asyncio").disabled = True  # would report the cell that nobody waits for now
        print(f"{name} was interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    except Exception as error:
        return longrun.report_error(error)
    return 0


def _reason(error):
    """Why a notebook failed, in one line."""
    if isinstance(error, DeadKernelError):
        return "the kernel died, as it does where there is not enough memory"
    name, text = type(error).__name__, str(error)
    if isinstance(error, CellExecutionError):
        name, text = error.ename, error.evalue
    return f"{name}: {text}".splitlines()[0] + longrun.remedy(text)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
