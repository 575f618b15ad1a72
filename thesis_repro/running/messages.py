"""What a run says and how it ends: the log, the summary, signals, and one-line errors.

The errors are those of bad input and of a lack of space or memory. This module imports only the
standard library, so it still works if there is too little memory for
other packages.
"""

import ctypes
import errno
import logging
import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import Any

from thesis_repro.errors import InputError, one_line
from thesis_repro.running.folders import LOG, holds_results

# what a user can do about a system error, by its number
ROOM, ACCESS = (
    "make room on its disk, or name a folder on another",
    "name a folder that you may write to",
)
PERMISSION = "get the permission (chmod, chown), or name another file or folder"
REMEDIES = {
    errno.ENOSPC: ROOM,
    errno.EDQUOT: ROOM,
    errno.EFBIG: "allow larger files (ulimit -f)",
    errno.EROFS: ACCESS,
    errno.EACCES: PERMISSION,
    errno.EPERM: PERMISSION,
    errno.EMFILE: "allow more open files (ulimit -n)",
    errno.EIO: "check its disk, or the connection to it",
}
NO_MEMORY = "memory ran out; free some, or use fewer processes (--jobs, JOBS), and start again"
WORKER_KILLED = (
    "a process was killed, most likely because memory ran out; start again with fewer processes (--jobs, "
    "JOBS) to resume"
)
# variables that libraries read, their type and their least value; others end in a long traceback
NUMBERS: dict[str, tuple[type, int]] = {
    "LOKY_MAX_CPU_COUNT": (int, 1),
    "NUMBA_NUM_THREADS": (int, 1),
    "OMP_NUM_THREADS": (int, 1),
    "OPENCV_FOR_THREADS_NUM": (int, 0),
    "SOURCE_DATE_EPOCH": (int, 0),
    "TQDM_MININTERVAL": (float, 0),
}
# texts of libraries' own errors
NO_MEMORY_TEXTS = (
    "MemoryError",
    "nsufficient memory",
    "annot allocate memory",
    "nable to allocate",
    "bad_alloc",
    "ut of memory",
    "ResourceExhausted",
    "failed to map segment",
    "can't start new thread",
)


log = logging.getLogger("thesis_repro")


class _Printer(logging.Handler):
    """Prints messages and warnings on standard error, where they do not mix with results."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno < logging.ERROR and not hasattr(record, "printed"):
            prefix = "warning: " if record.levelno == logging.WARNING else ""
            print(prefix + one_line(record.getMessage()), file=sys.stderr, flush=True)


def print_messages() -> None:
    """Print the messages of this package from now on: in programs and notebooks.

    Without it they go where a user of the package sends those of the logger "thesis_repro".
    """
    if not prints_messages():
        log.addHandler(_Printer())
    if hasattr(sys.stdout, "reconfigure"):  # names of files may hold what the terminal has not
        sys.stdout.reconfigure(errors="backslashreplace")
    log.setLevel(logging.INFO)
    log.propagate = False


def prints_messages() -> bool:
    """Return whether `print_messages` was called in this process."""
    return any(isinstance(handler, _Printer) for handler in log.handlers)


def explain(error: BaseException | None) -> str | None:
    """Return one line for an InputError or for a lack of space, permission or memory.

    Returns None for any other error. The line names the file, if it is known, and says what to do.
    The causes of the error are searched too.
    """
    if isinstance(error, InputError):
        return str(error)
    while error is not None:
        line = _explain_one(error)
        if line is not None:
            return line
        error = error.__cause__ or error.__context__
    return None


def _explain_one(error: BaseException) -> str | None:
    """Do what `explain` does, without the causes of the error."""
    number, path = number_of(error), getattr(error, "filename", None)
    text = f"{type(error).__name__}: {error}"
    # a text with a number of the system may hold the name of a file
    tells_of_memory = number is None and any(words in text for words in NO_MEMORY_TEXTS)
    if number == errno.ENOMEM or tells_of_memory:
        return NO_MEMORY
    if text.startswith("TerminatedWorkerError"):  # of joblib
        return WORKER_KILLED
    if number is None:
        return None
    if number in REMEDIES:
        return f"{path or 'a file'}: {os.strerror(number)}; {REMEDIES[number]}"
    if isinstance(error, OSError) and path is not None:
        return f"{path or 'a file'}: {os.strerror(number)}; check the path"
    return None


def number_of(error: BaseException) -> int | None:
    """Return the system's number of an error, or None.

    HDF5 and other libraries give the system's text only.
    """
    number = getattr(error, "errno", None)
    if number:
        return number
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        if os.strerror(number) in str(error):
            return number
    return None


def need_addresses(gigabytes: int) -> None:
    """Raise InputError if `ulimit -v` is too low.

    Some libraries would then end the process without a message.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < gigabytes * 2**30:
        raise InputError(
            f"ulimit -v {limit // 1024}: too little memory; allow {gigabytes * 2**20} or more"
        )


def report_error(error: Exception) -> int:
    """Print the error that ends a command, and return the exit status.

    Raises an error that `explain` does not know.
    """
    line = explain(error)
    if line is None:
        raise error
    print(f"error: {one_line(line)}", file=sys.stderr)
    return 1


def check_environment() -> None:
    """Raise InputError for a variable that a library would fail with.

    Programs draw only into files, so another backend of matplotlib is not used.
    """
    os.environ["MPLBACKEND"] = "agg"
    for name, (kind, least) in NUMBERS.items():
        text = os.environ.get(name)
        if not text:
            continue
        try:
            is_good = kind(text) >= least
        except ValueError:
            is_good = False
        if not is_good:
            words = "a whole number" if kind is int else "a number"
            raise InputError(
                f"{name}={text[:60]}: must be {words} from {least}; change or unset it"
            )


def run_main(main: Callable[[], object]) -> None:
    """Call the function of a program, and end the process with `report_error` if it fails."""
    print_messages()
    try:
        check_environment()
        main()
    except Exception as error:
        sys.exit(report_error(error))


# The log


class _LogFile(MemoryHandler):
    """The log of a run.

    It is written once the folder holds results, so a refused run leaves no files.
    """

    target: Any  # the FileHandler; of a MemoryHandler it may be None

    def __init__(self, folder: Path, has_results: bool) -> None:
        super().__init__(
            1,
            target=logging.FileHandler(
                folder / LOG, delay=True, encoding="utf-8", errors="backslashreplace"
            ),
            flushOnClose=False,
        )
        self.target.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
        # a full disk is reported when results are written
        self.target.handleError = lambda record: None
        self.folder = folder
        self.has_results = has_results
        self.warnings = 0
        self.started = time.monotonic()

    def shouldFlush(self, record: logging.LogRecord) -> bool:
        self.warnings += record.levelno == logging.WARNING
        if not self.has_results:
            self.has_results = any(map(holds_results, (self.folder, *self.folder.glob("*"))))
        return self.has_results

    def end(self, text: str, reused: int = 0) -> None:
        """Print a summary of the run, its time and its warnings.

        reused: the number of results from an earlier run.
        """
        seconds = timedelta(seconds=round(time.monotonic() - self.started))
        text += f"\n{seconds} h; "
        if reused:
            text += f"from an earlier run: {reused:,}; "
        text += f"warnings: {self.warnings}; log: {self.folder / LOG}"
        print(text, flush=True)
        for line in text.splitlines():
            log.info(line, extra={"printed": True})


@contextmanager
def logged(folder: str | Path, title: str, has_results: bool = False) -> Iterator[_LogFile]:
    """Log into a folder what `log` prints, Python's warnings, and the error that ends the block.

    title: the first line. has_results: write the log at once, not only when results appear.
    """
    handler = _LogFile(Path(folder), has_results)
    loggers = log, logging.getLogger("py.warnings")
    for logger in loggers:
        logger.addHandler(handler)
    level = log.level
    log.setLevel(logging.INFO)
    logging.captureWarnings(True)
    log.info(title, extra={"printed": True})
    try:
        yield handler
    except Exception as error:
        reason = explain(error)
        log.error(reason or type(error).__name__, exc_info=reason is None)
        raise
    except BaseException as error:
        log.error("stopped: %r", error)
        raise
    finally:
        logging.captureWarnings(False)
        log.setLevel(level)
        for logger in loggers:
            logger.removeHandler(handler)
        with suppress(OSError):
            handler.target.close()


@contextmanager
def quiet() -> Iterator[None]:
    """Hide what libraries' own code prints on standard output and error within the block."""
    sys.stdout.flush()
    sys.stderr.flush()
    originals = os.dup(1), os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(null, stream)
        yield
    finally:
        sys.stdout.flush()
        for stream, original in enumerate(originals, 1):
            os.dup2(original, stream)
        for descriptor in (*originals, null):
            os.close(descriptor)


# The end of a process

STOP_SIGNALS = signal.SIGTERM, signal.SIGHUP, signal.SIGINT


@contextmanager
def stoppable() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, so that worker processes end too.

    They raise KeyboardInterrupt with the signal's number. An ignored signal (nohup) stays ignored.
    The exception is lost in a callback of compiled code; then `check_stop` raises it again.
    """

    def stop(number: int, _: object) -> None:
        _stops.append(number)
        raise KeyboardInterrupt(number)

    handlers = {
        number: signal.getsignal(number)
        for number in STOP_SIGNALS
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
    }
    for number in handlers:
        signal.signal(number, stop)
    try:
        yield
        check_stop()
    finally:
        _stops.clear()
        for number, handler in handlers.items():
            signal.signal(number, handler)


_stops: list[int] = []  # numbers of the signals that arrived within `stoppable`


def check_stop() -> None:
    """Raise KeyboardInterrupt if a signal to stop has arrived (see `stoppable`)."""
    if _stops:
        raise KeyboardInterrupt(_stops[0])


@contextmanager
def held_signals() -> Iterator[None]:
    """Hold back the signals that stop a program until the end of the block.

    Python's handler for Ctrl-C and that of `stoppable` raise an exception. If they run while
    compiled code makes Python objects, that code goes on without them: the process ends in
    SystemError or a segmentation fault. So one frame of the odometry is finished first.
    """
    if threading.current_thread() is not threading.main_thread():  # handlers run in no other thread
        yield
        return
    arrived: list[int] = []
    handlers = {
        number: signal.getsignal(number)
        for number in STOP_SIGNALS
        if callable(signal.getsignal(number))
    }
    for number in handlers:
        signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for stop in arrived:
            signal.raise_signal(stop)


def leave_ctrl_c_to_parent() -> None:
    """Let this worker process ignore Ctrl-C, which reaches its parent too, and end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def end_with_parent() -> None:
    """Let the system kill this worker process when its parent ends (Linux only).

    It does so even if the parent is killed.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() == 1:
            os._exit(1)  # the parent has ended already


def interrupt_without(*ancestors: int) -> None:
    """Send SIGTERM to this process when it or one of its ancestors loses its parent (Linux only).

    It is sent even if the parent was killed. ancestors: process ids. A thread looks once a second.
    """

    def parents() -> list[str]:
        stats = (Path(f"/proc/{process}/stat").read_text() for process in (os.getpid(), *ancestors))
        return [stat.rpartition(")")[2].split()[1] for stat in stats]

    def watch() -> None:
        with suppress(OSError):
            at_start = parents()
            while parents() == at_start:
                time.sleep(1)
        os.kill(os.getpid(), signal.SIGTERM)

    if Path("/proc/self/stat").exists():
        threading.Thread(target=watch, daemon=True).start()
