"""Long runs: a folder for one run at a time, a log, a summary at the end, and one line for what the machine lacks.

Nothing here needs another package, so that it works where the memory for one is lacking.
"""

import ctypes
import errno
import fcntl
import logging
import os
import re
import resource
import secrets
import signal
import sys
import threading
import time
from contextlib import contextmanager, suppress
from datetime import timedelta
from logging.handlers import MemoryHandler
from pathlib import Path

from thesis_repro import InputError, one_line

LOG = "log.txt"
RECORD = "made-from.json"  # in every folder of results, see `stages.stage`
LIST = "written.log"  # beside the record: what was written there, see `files.atomic`
TEMPORARY = re.compile(r"\..*\.thesis-repro-[0-9a-f]{8}(\.\w+)?")  # the names that `temporary` gives
# what a user can do about an error of the system, by its number
ROOM, ACCESS = "make room on its disk, or name a folder on another", "name a folder that you may write to"
REMEDIES = {errno.ENOSPC: ROOM, errno.EDQUOT: ROOM, errno.EFBIG: "allow larger files (ulimit -f)", errno.EROFS: ACCESS,
            errno.EACCES: ACCESS, errno.EPERM: ACCESS, errno.EMFILE: "allow more open files (ulimit -n)",
            errno.EIO: "check its disk, or the connection to it"}
NO_MEMORY = "memory ran out; free some, or work with fewer processes (--jobs, JOBS), and start again"
WORKER_KILLED = ("a process was killed, most likely because memory ran out; start again with fewer processes (--jobs, "
                 "JOBS), and it goes on")
# what libraries write in errors of their own
NO_MEMORY_TEXTS = ("MemoryError", "nsufficient memory", "annot allocate memory", "nable to allocate", "bad_alloc",
                  "ut of memory", "ResourceExhausted", "failed to map segment", "can't start new thread")

_log = logging.getLogger("thesis_repro")
_log.addHandler(logging.NullHandler())
_log.setLevel(logging.INFO)
_log.propagate = False


def explain(error):
    """One line for bad input, or for what the machine lacks: space, permission, memory; None for any other error.

    It names the file, where there is one, and says what to do. The errors that led to this one count too.
    """
    if isinstance(error, InputError):
        return str(error)
    while error is not None:
        number, name, text = number_of(error), getattr(error, "filename", None), f"{type(error).__name__}: {error}"
        if number == errno.ENOMEM or any(words in text for words in NO_MEMORY_TEXTS):
            return NO_MEMORY
        if text.startswith("TerminatedWorkerError"):  # of joblib
            return WORKER_KILLED
        if number in REMEDIES or isinstance(error, OSError) and name is not None and number is not None:
            return f"{name or 'a file'}: {os.strerror(number)}; {REMEDIES.get(number, 'check the path')}"
        error = error.__cause__ or error.__context__
    return None


def number_of(error):
    """The system's number of an error, or None. HDF5 and others give the system's text alone."""
    named = (number for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(number) in str(error))
    return getattr(error, "errno", None) or next(named, None)


def need_addresses(gigabytes):
    """Raise InputError where `ulimit -v` is too little for the libraries, some of which then end without a message."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < gigabytes * 2**30:
        raise InputError(f"ulimit -v {limit // 1024}: too little memory; allow {gigabytes * 2**20} or more")


def remedy(text):
    """What to do about an error of which only the text is known, to be put behind it; empty for most errors."""
    remedies = dict.fromkeys(NO_MEMORY_TEXTS, NO_MEMORY)
    remedies |= {os.strerror(number): remedy for number, remedy in REMEDIES.items()}
    return next((f"; {remedy}" for words, remedy in remedies.items() if words in text), "")


def report_error(error):
    """Print why a command ends, and return its exit status. Raises an error that `explain` does not know."""
    line = explain(error)
    if line is None:
        raise error
    print(f"error: {one_line(line)}", file=sys.stderr)
    return 1


def temporary(path):
    """A path beside `path` that nobody can foresee, under which it is written."""
    return path.with_name(f".{path.stem[:40]}.thesis-repro-{secrets.token_hex(4)}{path.suffix}")


def sweep(folder):
    """Delete half-written files of killed runs below a folder of results; no other run may be at work in it."""
    for path in Path(folder).rglob(".*"):
        if TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


_held = set()  # the folders that this process holds, by device and inode


@contextmanager
def claimed(folder):
    """Hold a folder, made where there is none, for this process until the block ends, in whatever way it ends.

    Raises InputError where another process holds it.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; name a folder for the results")
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with locked(folder):
            yield
    finally:
        with suppress(OSError):
            for path in new:  # those that are still empty
                path.rmdir()


@contextmanager
def locked(path):
    """Hold a folder or file that is there, as `claimed` does; within the block, this process may hold it again."""
    status = os.stat(path)
    key = status.st_dev, status.st_ino
    if key in _held:
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)  # its lock ends with the process, so a killed run leaves none
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{path}: another run is at work there; wait, or name another folder") from None
        except OSError:
            pass  # a file system without locks
        _held.add(key)
        yield
    finally:
        _held.discard(key)
        os.close(descriptor)


# The log


class _LogFile(MemoryHandler):
    """The log of a run. It starts once the folder holds results, so that a run which is refused leaves nothing."""

    def __init__(self, folder, ours):
        super().__init__(1, target=logging.FileHandler(folder / LOG, delay=True, encoding="utf-8"), flushOnClose=False)
        self.target.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
        self.target.handleError = lambda record: None  # the results report a full disk; the log need not
        self.folder, self.ours, self.warnings, self.started = folder, ours, 0, time.monotonic()

    def shouldFlush(self, record):
        self.warnings += record.levelno == logging.WARNING
        self.ours = self.ours or any(self.folder.glob(RECORD)) or any(self.folder.glob(f"*/{RECORD}"))
        return self.ours

    def end(self, text):
        """Print what came of the run, how long it took, how many warnings there were, and where the log is."""
        seconds = timedelta(seconds=round(time.monotonic() - self.started))
        say(f"{text}\n{seconds} h; warnings: {self.warnings}; log: {self.folder / LOG}")


@contextmanager
def logged(folder, what, ours=False):
    """Log what is printed, every warning, and the error that ends the block, in a folder; yields the `_LogFile`.

    what: the first line. ours: the folder holds results already; otherwise the log starts with its record.
    """
    handler = _LogFile(Path(folder), ours)
    loggers = _log, logging.getLogger("py.warnings")
    for logger in loggers:
        logger.addHandler(handler)
    logging.captureWarnings(True)
    _log.info(what)
    try:
        yield handler
    except Exception as error:
        reason = explain(error)
        _log.error(reason or type(error).__name__, exc_info=reason is None)
        raise
    except BaseException as error:
        _log.error("stopped: %s", type(error).__name__)
        raise
    finally:
        logging.captureWarnings(False)
        for logger in loggers:
            logger.removeHandler(handler)
        with suppress(OSError):
            handler.target.close()


def say(text, warning=False):
    """Print a text and log it."""
    print(text, flush=True)
    note(text, logging.WARNING if warning else logging.INFO)


def remark(text, warning=False):
    """Print a line beside the results, on standard error, and log it."""
    print(f"warning: {one_line(text)}" if warning else one_line(text), file=sys.stderr, flush=True)
    note(text, logging.WARNING if warning else logging.INFO)


# The end of a process


class Stopped(KeyboardInterrupt):
    """A signal that asks this process to end; its number is the argument."""


@contextmanager
def stoppable():
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, so that its processes end with it.

    A signal that the caller ignores (nohup) stays ignored.
    """
    def stop(number, _):
        raise Stopped(number)

    in_main_thread = threading.current_thread() is threading.main_thread()
    numbers = [number for number in (signal.SIGTERM, signal.SIGHUP)
               if in_main_thread and signal.getsignal(number) == signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def end_with_parent():
    """Let the system kill this process when the one that started it ends, in whatever way (Linux alone)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() == 1:
            os._exit(1)  # it has ended already


def note(text, level=logging.ERROR):
    """Log a text."""
    for line in text.splitlines():
        _log.log(level, line)
