"""Long runs: a folder for one run at a time, a log, a summary at the end, and one line for what the machine lacks.

Nothing here needs another package, so that it works where the memory for one is lacking.
"""

import errno
import fcntl
import logging
import os
import re
import resource
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

from thesis_repro import InputError, one_line

LOG = "log.txt"
RECORD = "made-from.json"  # in every folder of results, see `stages.stage`
TEMPORARY = re.compile(r"\..+\.\d+(\.\w+)?")  # the names that `temporary` gives
GOES_ON = "the same command then goes on"
OTHER_FOLDER = "check who may read and write there, or name another folder"
# what a user can do about an error of the system, by its number
REMEDIES = {
    errno.ENOSPC: f"make room on its disk, or name a folder on another; {GOES_ON}",
    errno.EDQUOT: f"make room, or name a folder on another disk; {GOES_ON}",
    errno.EFBIG: f"allow larger files (ulimit -f); {GOES_ON}",
    errno.EROFS: "name a folder on a disk that may be written to",
    errno.EACCES: OTHER_FOLDER,
    errno.EPERM: OTHER_FOLDER,
    errno.EMFILE: f"allow more open files (ulimit -n); {GOES_ON}",
    errno.EIO: f"check its disk, or the connection to it; {GOES_ON}",
}
NO_MEMORY = f"memory ran out; free some, or work with fewer processes (--jobs, JOBS); {GOES_ON}"
WORKER_KILLED = ("a process was killed, most likely because memory ran out; what was finished is kept, so start again, "
                 "with fewer processes (JOBS or --jobs)")
# what libraries write in errors of their own
NO_MEMORY_TEXTS = ("nsufficient memory", "annot allocate memory", "nable to allocate", "bad_alloc", "ut of memory",
                  "failed to map segment", "can't start new thread")

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
        number, name, text = number_of(error), getattr(error, "filename", None), str(error)
        if (isinstance(error, MemoryError) or number == errno.ENOMEM or type(error).__name__ == "ResourceExhaustedError"
                or any(words in text for words in NO_MEMORY_TEXTS)):
            return NO_MEMORY
        if type(error).__name__ == "TerminatedWorkerError":  # of joblib
            return WORKER_KILLED
        if number in REMEDIES:
            return f"{name or 'a file'}: {os.strerror(number)}; {REMEDIES[number]}"
        if isinstance(error, OSError) and name is not None and number is not None:
            return f"{name}: {os.strerror(number)}; check the path"
        error = error.__cause__ or error.__context__
    return None


def number_of(error):
    """The system's number of an error, or None. HDF5 and others give the system's text alone."""
    if getattr(error, "errno", None) is not None:
        return error.errno
    return next((number for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(number) in str(error)),
                None)


def need_addresses(gigabytes):
    """Raise InputError where `ulimit -v` is less than the libraries take when they are loaded.

    Some of them end the process by a signal then, without a message.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < gigabytes * 2**30:
        raise InputError(f"ulimit -v {limit // 1024}: too little memory, for the libraries alone take more; allow "
                         f"{gigabytes * 2**20} or more, or unlimited")


def remedy(text):
    """What to do about an error of which only the text is known, to be put behind it; empty for most errors."""
    if "MemoryError" in text or any(words in text for words in NO_MEMORY_TEXTS):
        return f"; {NO_MEMORY}"
    return next((f"; {REMEDIES[number]}" for number in REMEDIES if os.strerror(number) in text), "")


def report_error(error):
    """Print in one line on standard error why a command ends, and return its exit status.

    Raises an error that `explain` does not know.
    """
    line = explain(error)
    if line is None:
        raise error
    print(f"error: {one_line(line)}", file=sys.stderr)
    return 1


def temporary(path):
    """The path beside `path` under which this process writes it."""
    return path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")


def sweep(folder):
    """Delete half-written files of killed runs below a folder of results; no other run may be at work in it."""
    for where, _, names in os.walk(folder):
        for name in names:
            if TEMPORARY.fullmatch(name):
                Path(where, name).unlink(missing_ok=True)


_held: dict[tuple, int] = {}  # how many times this process holds each folder, by device and inode


@contextmanager
def claimed(folder):
    """Hold a folder, made where there is none, for this process until the block ends, in whatever way it ends.

    Raises InputError where another process holds it. Where the file system knows no locks, everybody may go on.
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
        for path in new:  # those that are still empty
            with suppress(OSError):
                path.rmdir()


@contextmanager
def locked(path):
    """Hold a folder or file that is there, as `claimed` does."""
    descriptor = os.open(path, os.O_RDONLY)  # its lock ends with the process, so a killed run leaves none
    status = os.fstat(descriptor)
    key = status.st_dev, status.st_ino
    try:
        if key not in _held:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(f"{path}: another run is at work there; wait until it has ended, or name another "
                                 "folder") from None
            except OSError:
                pass
        _held[key] = _held.get(key, 0) + 1
        try:
            yield
        finally:
            _held[key] -= 1
            if not _held[key]:
                del _held[key]
    finally:
        os.close(descriptor)


# The log


class _LogFile(logging.FileHandler):
    """Starts its file once the folder holds results, so that a run which is refused leaves nothing."""

    def __init__(self, folder, ours):
        super().__init__(folder / LOG, delay=True, encoding="utf-8")
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
        self.folder, self.ours, self.waiting, self.warnings = folder, ours, [], 0

    def emit(self, record):
        self.warnings += record.levelno == logging.WARNING
        self.waiting.append(record)
        self.ours = self.ours or any(self.folder.glob(RECORD)) or any(self.folder.glob(f"*/{RECORD}"))
        while self.ours and self.waiting:
            super().emit(self.waiting.pop(0))

    def close(self):
        with suppress(OSError):
            super().close()

    def handleError(self, record):
        pass  # the results report a full disk; the log need not


class Run:
    """A long run with its log."""

    def __init__(self, handler):
        self._handler, self._started = handler, time.monotonic()

    def end(self, text):
        """Print what came of the run, how long it took, how many warnings there were, and where the log is."""
        count = self._handler.warnings
        say(f"{text}\n{duration(time.monotonic() - self._started)}; {count or 'no'} warning{'s' * (count != 1)}; "
            f"log: {self._handler.folder / LOG}")


@contextmanager
def logged(folder, what, ours=False):
    """Log what is printed, every warning, and the error that ends the block, in a folder; yields a `Run`.

    what: the first line. ours: the folder holds results already; otherwise the log starts with the folder's record.
    """
    handler = _LogFile(Path(folder), ours)
    loggers = _log, logging.getLogger("py.warnings")
    for logger in loggers:
        logger.addHandler(handler)
    logging.captureWarnings(True)
    _log.info(what)
    try:
        yield Run(handler)
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
        handler.close()


def say(text, warning=False):
    """Print a text and log it."""
    print(text, flush=True)
    note(text, logging.WARNING if warning else logging.INFO)


def note(text, level=logging.ERROR):
    """Log a text."""
    for line in text.splitlines():
        _log.log(level, line)


def duration(seconds):
    """A time in words of two units: "3 h 12 min"."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
