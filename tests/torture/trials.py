"""Trials by the real command line: start a command as a process, and demand that it fails as it should."""

import fnmatch
import os
import signal
import subprocess
import sys
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from thesis_repro import longrun

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 900  # seconds; a command that takes longer hangs
# what tests/conftest.py sets for the tests' own process and a user does not have
NOT_THE_USERS = {"TF_CPP_MIN_LOG_LEVEL", "SM_FRAMEWORK", "NO_ALBUMENTATIONS_UPDATE"}


class Result(NamedTuple):
    """How a command ended. left: files and folders below its working folder that are new, changed or gone."""

    returncode: int
    stdout: str
    stderr: str
    left: list = ()


def thesis(*words):
    return [sys.executable, "-m", "thesis_repro", *map(str, words)]


def environment(**changes):
    """A user's environment: without what the tests set for themselves; None takes a variable out."""
    own = {name: value for name, value in os.environ.items()
           if name not in NOT_THE_USERS and not name.startswith("THESIS_REPRO_")}
    own |= {"PYTHONPATH": str(ROOT), "THESIS_REPRO_PROGRESS": os.devnull} | changes
    return {name: str(value) for name, value in own.items() if value is not None}


def start(command, where, before=None, **changes):
    """Start a command in a folder, as the leader of a process group of its own; returns the Popen.

    before: called in the new process first, to take something from it. changes: of the environment.
    """
    return subprocess.Popen(list(map(str, command)), cwd=where, env=environment(**changes), preexec_fn=before,
                            start_new_session=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def finish(process):
    """Wait for what `start` started; a command that hangs is killed with all its processes."""
    try:
        stdout, stderr = process.communicate(timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        kill(process)
        raise
    return Result(process.returncode, stdout, stderr)


def run(command, where, **options):
    """Start a command and wait for it; see `start`."""
    before = snapshot(where)
    return finish(start(command, where, **options))._replace(left=changes(before, snapshot(where)))


def succeed(command, where, **options):
    result = run(command, where, **options)
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    return result


def kill(process):
    """SIGKILL a process that `start` started, and all that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def snapshot(where):
    """What lies below a folder but logs, {relative path: size and date}; None for folders. It may be in use."""
    versions = {}
    for path in (Path(folder, name) for folder, folders, names in os.walk(where) for name in (*folders, *names)):
        with suppress(FileNotFoundError):
            status = path.lstat()
            if path.name != longrun.LOG:
                versions[path.relative_to(where)] = None if path.is_dir() else (status.st_size, status.st_mtime_ns)
    return versions


def changes(before, after):
    """Paths that are new, changed or gone between two snapshots."""
    return sorted({str(path) for path, _ in before.items() ^ after.items()})


def refused(result, named, code=1, left=()):
    """Demand of a command that it ended with `code` and one line of error that has the text `named`.

    Nothing in its folder may be new or changed but what the patterns `left` allow ("out/*").
    """
    output = f"exit {result.returncode}\n{result.stdout}\n{result.stderr}"
    assert result.returncode == code and "Traceback" not in result.stdout + result.stderr, output
    lines = [line for line in result.stderr.splitlines() if line.startswith(("error: ", "wrong: "))]
    assert len(lines) == 1 and str(named) in lines[0], f"not one line that names {named}: {output}"
    more = [path for path in result.left if not any(fnmatch.fnmatch(path, pattern) for pattern in left)]
    assert not more, f"left behind: {', '.join(more)}\n{output}"


def contents(folder):
    """Every file below a folder by path, without what no two runs share: times, dates and the log."""
    return {str(path.relative_to(folder)): _content(path) for path in sorted(Path(folder).rglob("*"))
            if path.is_file() and path.name not in (longrun.LOG, longrun.LIST)}


def _content(path):
    if path.suffix == ".csv" and "runs" in path.parts:
        table = pd.read_csv(path, dtype=str)
        return table[[name for name in table if not name.endswith("_seconds")]].to_csv()
    if path.suffix == ".keras":
        with zipfile.ZipFile(path) as file:
            return {name: file.read(name) for name in file.namelist() if name.endswith(".h5")}
    return path.read_bytes()


def same(results, wanted):
    other = sorted(path for path in results.keys() | wanted.keys() if results.get(path) != wanted.get(path))
    assert not other, f"not what an undisturbed run leaves: {', '.join(other)}"


def whole_again(words, name, where, output="out"):
    """What was disturbed now ends well, with nothing stray, and leaves what an undisturbed run does."""
    for folder in (output, "whole"):
        succeed(words(name, folder), where)
    nothing_stray(where)
    same(contents(where / output), contents(where / "whole"))


def nothing_stray(where):
    stray = [path for path in snapshot(where) if longrun.TEMPORARY.fullmatch(path.name)]
    assert not stray, f"left half written: {', '.join(map(str, stray))}"
