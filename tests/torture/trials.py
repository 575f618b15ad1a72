"""Trials by the real command line: start a command as a process, and demand that it fails in one clear line."""

import fnmatch
import io
import json
import os
import signal
import subprocess
import sys
import zipfile
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import pytest

from thesis_repro import longrun

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 300  # seconds; a command that takes longer hangs
KINDS, OUTCOMES = ("kills", "faults", "bad inputs"), ("clear", "unclear", "lost")
# what tests/conftest.py sets for the tests' own process and a user does not have
NOT_THE_USERS = {"TF_CPP_MIN_LOG_LEVEL", "SM_FRAMEWORK", "NO_ALBUMENTATIONS_UPDATE"}


class Lost(AssertionError):
    """Worse than an unclear word: results are lost or wrong, or a command takes bad input for good or hangs."""


def lost_unless(condition, what):
    if not condition:
        raise Lost(what)


@dataclass
class Ledger:
    """What was tried and how it came out: rows of (kind, what, outcome)."""

    rows: list = field(default_factory=list)

    def record(self, kind, what, outcome):
        assert kind in KINDS and outcome in OUTCOMES, (kind, outcome)
        self.rows.append((kind, what, outcome))

    @contextmanager
    def __call__(self, kind, what, times=1):
        """One trial, or `times` of them: "clear" where the block ends well, "lost" where it raises `Lost`, or else
        "unclear". What it raises fails the test as well."""
        outcome = "unclear"
        try:
            yield
            outcome = "clear"
        except (Lost, subprocess.TimeoutExpired):
            outcome = "lost"
            raise
        except pytest.skip.Exception:
            times = 0
            raise
        finally:
            for _ in range(times):
                self.record(kind, what, outcome)

    def text(self):
        """The counts by kind as a table, and the names of all that was not clear."""
        counts = Counter((kind, outcome) for kind, _, outcome in self.rows)
        lines = [f"{'':12}{'tried':>8}" + "".join(f"{outcome:>9}" for outcome in OUTCOMES)]
        for kind in KINDS:
            row = [counts[kind, outcome] for outcome in OUTCOMES]
            lines.append(f"{kind:12}{sum(row):8}" + "".join(f"{count:9}" for count in row))
        return "\n".join(lines + [f"{outcome}: {kind}: {what}" for kind, what, outcome in self.rows
                                  if outcome != "clear"])


@dataclass
class Result:
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str
    left: list  # files and folders below `where` that are new or changed, as texts relative to it


def environment(**changes):
    """A user's environment: without what the tests set for themselves; None takes a variable out."""
    own = {name: value for name, value in os.environ.items()
           if name not in NOT_THE_USERS and not name.startswith("THESIS_REPRO_")}
    own |= {"PYTHONPATH": str(ROOT), "THESIS_REPRO_PROGRESS": os.devnull} | changes
    return {name: str(value) for name, value in own.items() if value is not None}


def start(*words, where, before=None, **changes):
    """Start `thesis-repro WORDS` as the leader of a process group of its own; returns the Popen.

    where: the folder it is started in. before: called in the new process just before, to take something from it.
    """
    return spawn([sys.executable, "-m", "thesis_repro", *words], where, before, **changes)


def spawn(command, where, before=None, **changes):
    """Start any command as `start` does."""
    return subprocess.Popen(list(map(str, command)), cwd=where, env=environment(**changes), preexec_fn=before,
                            start_new_session=True, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def finish(process, where=None, seen=None, timeout=TIMEOUT):
    """Wait for what `start` started; a command that hangs is killed with all its processes."""
    try:
        stdout, stderr = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        kill(process)
        raise
    left = [] if seen is None else sorted(str(path) for path in changed(seen, snapshot(where)))
    return Result(process.returncode, stdout, stderr, left)


def kill(process):
    """SIGKILL a process that `start` started, and all that it started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass
    process.communicate()


def snapshot(where):
    """What lies below a folder, {relative path: what tells it from another version}; folders have none.

    The folder may be in use: what is renamed away between its listing and its reading is left out.
    """
    found = {}
    for folder, folders, names in os.walk(where):
        for name in (*folders, *names):
            path = Path(folder, name)
            try:
                about = path.lstat()
            except FileNotFoundError:
                continue
            found[path.relative_to(where)] = None if path.is_dir() else (about.st_size, about.st_mtime_ns)
    return found


def changed(before, after):
    """Paths that are new, changed or gone."""
    return {path for path in before.keys() | after.keys()
            if (path in before, before.get(path)) != (path in after, after.get(path))}


def clear(result, *says, left=()):
    """Demand of a command that it failed as it should; an AssertionError says what is missing.

    A non-zero exit and no traceback; exactly one line on standard error, which has all of the texts `says`: the name of
    the file or setting, and a word of the remedy. Nothing new or changed in the folder that it was started in but what
    the patterns `left` allow ("out/*").
    """
    told = f"exit {result.returncode}\n{result.stdout}\n{result.stderr}"
    lost_unless(result.returncode != 0, f"bad input or a fault was taken for good: {told}")
    assert result.returncode > 0, f"ended by a signal: {told}"
    assert "Traceback" not in result.stdout + result.stderr, told
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, f"not one line: {told}"
    for text in says:
        assert str(text) in lines[0], f"{text!r} is not named: {told}"
    more = [path for path in result.left if not any(fnmatch.fnmatch(path, pattern) for pattern in left)]
    assert not more, f"left behind: {', '.join(more)}\n{told}"


def contents(folder):
    """Everything below a folder by path, without what no two runs share: times, dates and the log."""
    return {str(path.relative_to(folder)): _content(path) for path in sorted(Path(folder).rglob("*"))
            if path.is_file() and path.name != longrun.LOG and path.suffix != ".log"}


def _content(path):
    if path.suffix == ".csv" and "runs" in path.parts:
        table = pd.read_csv(path, dtype=str)
        return table[[name for name in table if not name.endswith("_seconds")]].to_csv()
    if path.suffix == ".keras":
        with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as file:
            return {name: file.read(name) for name in file.namelist() if name.endswith(".h5")}
    if path.suffix == ".ipynb":
        return [cell.get("outputs") for cell in json.loads(path.read_text())["cells"]]
    if path.suffix == ".html":  # the executed notebooks that it was made from hold times
        return path.read_text().partition("<!-- made from")[0]
    return path.read_bytes()


def same(found, wanted):
    other = sorted(path for path in found.keys() | wanted.keys() if found.get(path) != wanted.get(path))
    lost_unless(not other, f"not what an undisturbed run leaves: {', '.join(other)}")


def nothing_stray(where):
    stray = [path for path in snapshot(where) if longrun.TEMPORARY.fullmatch(path.name)]
    lost_unless(not stray, f"left half written: {', '.join(map(str, stray))}")
