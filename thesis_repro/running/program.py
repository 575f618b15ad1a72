"""What a program says and how it ends: messages, the summary, errors in one line, Ctrl-C."""

import ctypes
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from multiprocessing import resource_tracker

from tqdm import tqdm

from thesis_repro.errors import InputError, missing_package, one_line

STARTED = time.monotonic()
# glibc's M_ARENA_MAX, M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD, as `keep_freed_memory` sets them
MALLOC_OPTIONS = {-8: 1, -4: 0, -1: 2**31 - 1, -2: 2**28}
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
    log.handlers = [_Printer()]
    log.setLevel(logging.INFO)
    log.propagate = False


def warn(lines: Iterable[str]) -> list[str]:
    """Print warnings, and return them."""
    warnings = list(lines)
    for line in warnings:
        log.warning(line)
    return warnings


def explain(error: BaseException) -> str | None:
    """Return one line for bad input and for an error of the system, such as a full disk.

    An error of the system is told in its own words. Returns None for any other error, which
    deserves its traceback.
    """
    if isinstance(error, (ImportError, AttributeError)):
        error = missing_package(error) or error
    if isinstance(error, (InputError, OSError, MemoryError)):
        return one_line(error) or "memory ran out"
    return None


def run(main: Callable[[], object]) -> int:
    """Call the function of a program, and return the exit status of the process.

    It is what the function returns (None: 0), 1 after an error that `explain` knows, and 130 after
    Ctrl-C, 143 after SIGTERM. Programs print messages.
    """
    print_messages()
    threads = os.environ.pop("OMP_NUM_THREADS", "").partition(",")[0].strip()
    if threads.isdigit():  # OpenMP allows a list, for nested levels; Numba reads one number
        os.environ["OMP_NUM_THREADS"] = threads
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup has set SIGHUP
            signal.signal(number, _stop)
    keep_freed_memory()
    try:
        with flushed():
            return int(bool(main()))
    except BrokenPipeError:
        return 128 + signal.SIGPIPE
    except KeyboardInterrupt as stop:
        print("stopped; run the same command again to resume", file=sys.stderr)
        return 128 + int(*stop.args or [signal.SIGINT])
    except Exception as error:
        line = explain(error)
        if line is None:
            raise
        print(f"error: {line}", file=sys.stderr)
        return 1


@contextmanager
def flushed() -> Iterator[None]:
    """Write at the end of the block what was printed in it, so that an error of that can be told.

    What can no longer be written, as to `| head`, which has ended, is dropped: otherwise Python
    tries it again, and prints a traceback.
    """
    try:
        yield
    finally:
        if sys.stdout:
            try:
                sys.stdout.flush()
            except OSError:
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
                raise


def run_main(main: Callable[[], object]) -> None:
    """Call the function of a program, and end the process with the status of `run`."""
    sys.exit(run(main))


def keep_freed_memory() -> None:
    """Make the C library keep freed memory for the next image or tensor of this process.

    By default glibc requests each large one from the system anew, which fills it with zeros. That
    takes an eighth of the time of an odometry run, and half of a training step's on a CPU. Without
    glibc, this function does nothing.
    """
    with suppress(AttributeError, OSError, TypeError):  # macOS, Windows
        for option, value in MALLOC_OPTIONS.items():
            ctypes.CDLL(None).mallopt(option, value)


def summary(text: str, reused: int = 0) -> None:
    """Print what a program made, and its time. reused: number of results from an earlier run."""
    print(text)
    time_taken = f"{timedelta(seconds=round(time.monotonic() - STARTED))} h"
    if reused:
        time_taken += f"; from an earlier run: {reused:,}"
    print(time_taken, flush=True)


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
