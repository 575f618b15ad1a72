"""What a run says and how it ends: the log, the summary, errors in one line, Ctrl-C."""

import ctypes
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from multiprocessing import resource_tracker
from pathlib import Path

from tqdm import tqdm

from thesis_repro.errors import InputError, one_line

LOG = "log.txt"  # in a folder of results, see `logged`
RECORD = "made-from.json"  # in a folder of results, see `results.stage`
log = logging.getLogger("thesis_repro")


class _Printer(logging.Handler):
    """Prints messages and warnings on standard error, where they do not mix with results."""

    def emit(self, record: logging.LogRecord) -> None:
        prefix = ""
        if record.levelno == logging.WARNING:
            prefix = "warning: "
        tqdm.write(prefix + one_line(record.getMessage()), file=sys.stderr)  # above a progress bar


def print_messages() -> None:
    """Print the messages of this package from now on: in programs and notebooks.

    Without it they go where a user of the package sends those of the logger "thesis_repro".
    """
    if not any(isinstance(handler, _Printer) for handler in log.handlers):
        log.addHandler(_Printer())
    log.setLevel(logging.INFO)
    log.propagate = False


def explain(error: BaseException) -> str | None:
    """Return one line for bad input and for an error of the system, such as a full disk.

    An error of the system is told in its own words. Returns None for any other error, which
    deserves its traceback.
    """
    if type(error).__name__ == "TerminatedWorkerError":  # of joblib, which has a page of text
        return "a process was killed, most likely because memory ran out; use fewer (--jobs, JOBS)"
    if isinstance(error, (InputError, OSError, MemoryError)):
        return one_line(error) or "memory ran out"
    return None


def run(main: Callable[[], object]) -> int:
    """Call the function of a program, and return the exit status of the process.

    It is what the function returns (None: 0), 1 after an error that `explain` knows, and 130 after
    Ctrl-C, 143 after SIGTERM. Programs print messages.
    """
    print_messages()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup has set SIGHUP
            signal.signal(number, _stop)
    try:
        return int(bool(main()))
    except KeyboardInterrupt as stop:
        print("stopped; run the same command again to resume", file=sys.stderr)
        return 128 + int(*stop.args or [signal.SIGINT])
    except Exception as error:
        line = explain(error)
        if line is None:
            raise
        print(f"error: {line}", file=sys.stderr)
        return 1


def run_main(main: Callable[[], object]) -> None:
    """Call the function of a program, and end the process with the status of `run`."""
    sys.exit(run(main))


# The log


class _Log(logging.Handler):
    """The log of a run. It is written once its folder holds results, so not by a refused run."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        self.lines: list[str] = []  # not yet written
        self.warnings = 0
        self.started = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        self.warnings += record.levelno == logging.WARNING
        self.write(record.levelname, record.getMessage())

    def write(self, level: str, text: str) -> None:
        """Append a line."""
        self.lines.append(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {level:7} {one_line(text)}\n")
        if any(map(holds_results, (self.folder, *self.folder.glob("*")))):
            with open(self.folder / LOG, "a", encoding="utf-8") as file:
                file.writelines(self.lines)
            self.lines.clear()

    def end(self, text: str, reused: int = 0) -> None:
        """Print a summary of the run, its time and its warnings.

        reused: the number of results from an earlier run.
        """
        numbers = [f"{timedelta(seconds=round(time.monotonic() - self.started))} h"]
        if reused:
            numbers.append(f"from an earlier run: {reused:,}")
        numbers += [f"warnings: {self.warnings}", f"log: {self.folder / LOG}"]
        for line in [*text.splitlines(), "; ".join(numbers)]:
            print(line, flush=True)
            self.write("INFO", line)


def holds_results(folder: Path) -> bool:
    """Return whether a folder is one of results: whether it has a record of their inputs."""
    return (folder / RECORD).exists()


@contextmanager
def logged(folder: str | Path, title: str) -> Iterator[_Log]:
    """Write what `log` prints, and the error that ends the block, into the log of a folder.

    title: the first line.
    """
    handler = _Log(Path(folder))
    log.addHandler(handler)
    try:
        handler.write("INFO", title)
        yield handler
    except BaseException as error:
        with suppress(OSError):  # such as a full disk, which is the error
            handler.write("ERROR", explain(error) or repr(error))
        raise
    finally:
        log.removeHandler(handler)


@contextmanager
def quiet() -> Iterator[None]:
    """Hide what libraries' own code prints on standard error within the block."""
    original = os.dup(2)
    with open(os.devnull, "w") as null:
        os.dup2(null.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(original, 2)
        os.close(original)


# Ctrl-C

_stops: list[int] = []  # numbers of the signals to stop that have arrived
_steps = 0  # number of steps of loops that are being made now (see `unstopped`)


def _stop(number: int, _: object) -> None:
    """Stop at once or, within a step of a loop, after it. A second signal ends the process."""
    if _stops:
        os._exit(128 + number)
    _stops.append(number)
    if not _steps:
        check_stop()


def check_stop() -> None:
    """Raise KeyboardInterrupt if a signal to stop has arrived."""
    if _stops:
        raise KeyboardInterrupt(_stops.pop())


@contextmanager
def unstopped() -> Iterator[None]:
    """Let a signal to stop wait for the end of the block, one step of a loop.

    An exception that is raised while compiled code makes Python objects gets lost, or ends the
    process in a crash.
    """
    global _steps
    _steps += 1
    try:
        yield
    finally:
        _steps -= 1
    check_stop()


@contextmanager
def starting_workers() -> Iterator[None]:
    """Start processes with Ctrl-C blocked, until they ignore it (`leave_ctrl_c_to_parent`).

    Half started, they would print a traceback each.
    """
    # joblib starts it with the first worker, and its start unblocks Ctrl-C
    resource_tracker.ensure_running()
    with unstopped():
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def leave_ctrl_c_to_parent() -> None:
    """Let this worker process ignore Ctrl-C, which reaches its parent too, and end with it.

    Otherwise the workers of a notebook that was stopped would compute on for minutes.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(AttributeError):  # Linux only
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
