"""Run commands as a user does, each as a process, and check how they end and what they leave."""

import fnmatch
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from thesis.run_settings import ROOT
from thesis_repro.running import files
from thesis_repro.segmentation import ARITHMETIC

PACKAGES = "thesis_repro", "keypoint_study", "street_world", "opencv_exact"
# what thesis_repro.segmentation has set in this process
SET_BY_TESTS = {"SM_FRAMEWORK", "NO_ALBUMENTATIONS_UPDATE", "TF_CPP_MIN_LOG_LEVEL", *ARITHMETIC}

LINE_OF_TIMES = re.compile(rb"timed on|\(ms\)|frames a second|% of the time saved")


class Result(NamedTuple):
    """How a command ended. left: paths below its working folder that are new, changed or gone."""

    returncode: int
    stdout: str
    stderr: str
    left: list = ()


def copy_project(names, root):
    """Copy folders and files of the project into a folder."""
    for name in names:
        if (ROOT / name).is_dir():
            compiled = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / name, root / name, ignore=compiled)
        else:
            shutil.copy(ROOT / name, root)


def thesis(*words):
    return [sys.executable, "-m", "thesis_repro", *map(str, words)]


def environment(**changes):
    """A user's environment with some variables changed; None removes one."""
    variables = {
        name: value
        for name, value in os.environ.items()
        if name not in SET_BY_TESTS and not name.startswith("THESIS_REPRO_")
    }
    variables |= {
        "PYTHONPATH": f"{ROOT}:{ROOT}/notebooks",
        "THESIS_REPRO_PROGRESS": os.devnull,
    } | changes
    return {name: str(value) for name, value in variables.items() if value is not None}


def start(command, where, before=None, **changes):
    """Start a command in a folder.

    before: is called in the new process. changes: of the environment.
    """
    return subprocess.Popen(
        list(map(str, command)),
        cwd=where,
        env=environment(**changes),
        preexec_fn=before,
        start_new_session=True,
        text=True,
        errors="surrogateescape",
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s"
        time.sleep(0.005)


def finish(process):
    """Wait for a started command; one that hangs is killed."""
    try:
        stdout, stderr = process.communicate(timeout=900)
    except subprocess.TimeoutExpired:
        kill(process)
        raise
    return Result(process.returncode, stdout, stderr)


def run(command, where, **options):
    """Start a command and wait for it; options as for `start`."""
    before = snapshot(where)
    return finish(start(command, where, **options))._replace(left=changes(before, snapshot(where)))


def succeed(command, where, **options):
    result = run(command, where, **options)
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    return result


def kill(process):
    """SIGKILL a started command and its child processes."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def snapshot(where):
    """{path: (size, date)} of all files below a folder; True for folders.

    Files may vanish meanwhile.
    """
    versions = {}
    for folder, folders, names in os.walk(where):
        for name in (*folders, *names):
            path = Path(folder, name)
            with suppress(FileNotFoundError):
                status = path.lstat()
                version = name in folders or (status.st_size, status.st_mtime_ns)
                versions[path.relative_to(where)] = version
    return versions


def changes(before, after):
    """Paths that are new, changed or gone between two snapshots."""
    return sorted({str(path) for path, _ in before.items() ^ after.items()})


def refused(result, named, code=1, left=()):
    """Check the exit code and that one line of error has the text `named`.

    left: patterns ("out/*") of the only paths that may have changed.
    """
    output = f"exit {result.returncode}\n{result.stdout}\n{result.stderr}"
    assert result.returncode == code, output
    assert "Traceback" not in result.stdout + result.stderr, output
    lines = result.stderr.splitlines()
    errors = [
        line for line in lines if re.match("(thesis-repro( [a-z-]+)?: )?(error|wrong): ", line)
    ]
    assert len(errors) == 1, f"not one line: {output}"
    assert str(named) in errors[0], f"does not name {named}: {output}"
    expected = {path for pattern in left for path in fnmatch.filter(result.left, pattern)}
    unexpected = [path for path in result.left if path not in expected]
    assert not unexpected, f"left behind: {', '.join(unexpected)}\n{output}"


def contents(folder):
    """{path: digest} of all files below a folder.

    Times differ between runs: their tables, columns, lines and the figure of them are left out.
    """
    return {
        str(path.relative_to(folder)): sha256(_content(path)).hexdigest()
        for path in Path(folder).rglob("*")
        if path.is_file() and path.parent.name != "timings" and path.stem != "figure_4_17"
    }


def _content(path):
    if path.suffix in {".csv", ".md"} and "figures" in path.parts:
        lines = path.read_bytes().splitlines()
        return b"\n".join(line for line in lines if not LINE_OF_TIMES.search(line))
    if path.suffix == ".csv" and "runs" in path.parts:
        table = pd.read_csv(path, dtype=str)
        times = [name for name in table if name.endswith("_seconds")]
        return table.drop(columns=times).to_csv().encode()
    return path.read_bytes()


def resumes(words, name, where, output="out"):
    """Run a disturbed command again: it must succeed and leave the files of an undisturbed run."""
    for folder in (output, "whole"):
        succeed(words(name, folder), where)
    no_temporary_files(where)
    assert contents(where / output) == contents(where / "whole")


def no_temporary_files(where):
    assert [str(path) for path in snapshot(where) if files.TEMPORARY.fullmatch(path.name)] == []
