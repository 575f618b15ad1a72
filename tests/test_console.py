"""Locks of folders, deletion of old results, logs, and one line for errors of the machine."""

import ctypes
import errno
import fcntl
import logging
import os
import signal
import warnings

import pytest

from thesis_repro import InputError, console, files, odometry, results
from thesis_repro.kitti import Sequence


def test_a_folder_is_locked_by_one_process(tmp_path):
    folder = tmp_path / "out"
    with results.claimed(folder), results.claimed(folder):  # one process may lock it twice
        results.stage(folder, size=3)
        other = os.open(folder, os.O_RDONLY)  # as in another process
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    fcntl.flock(other, fcntl.LOCK_EX)
    for attempt in (lambda: results.claimed(folder).__enter__(), lambda: results.stage(folder)):
        with pytest.raises(InputError, match="out: "):
            attempt()
    os.close(other)
    assert not results._held


def test_a_failed_run_leaves_no_empty_folders(tmp_path):
    with pytest.raises(ZeroDivisionError), results.claimed(tmp_path / "a" / "b"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file: "), results.claimed(tmp_path / "file"):
        pass


def test_temporary_files_of_a_killed_run_are_deleted(tmp_path):
    folder = results.stage(tmp_path / "out", size=3)
    (folder / "in").mkdir()
    temporary, hidden = files.temporary_path(folder / "in" / "a.png"), folder / "in" / ".hidden"
    temporary.touch()
    hidden.touch()
    results.stage(folder, size=3)
    assert not temporary.exists() and hidden.exists()
    # a run that was killed while it wrote its record
    other = tmp_path / "other"
    other.mkdir()
    files.temporary_path(other / results.RECORD).touch()
    assert [path.name for path in results.stage(other, size=3).iterdir()] == [results.RECORD]


def test_a_killed_move_of_old_results_is_finished_and_the_log_stays(tmp_path, monkeypatch):
    folder = results.stage(tmp_path / "out", size=3)
    results.stage(folder / "in", size=3)
    for path in (folder / "result", folder / "in" / "result"):
        files.write_text(path, "old")
    (folder / console.LOG).touch()
    with monkeypatch.context() as patch:
        moved, rename = [], type(folder).rename

        def killed(path, target):
            if moved:
                raise KeyboardInterrupt
            moved.append(rename(path, target))

        patch.setattr(type(folder), "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            results.stage(folder, size=4)
    assert results.record(folder) == {"size": 3}
    results.stage(folder, size=4)
    assert {path.name for path in folder.iterdir()} == {results.RECORD, console.LOG}
    assert len(list(tmp_path.glob("out.old-*/**/result"))) == 2


# as numpy raises it
NOT_CLOSED = ValueError("Can't close the ZIP file")
NOT_CLOSED.__context__ = OSError(errno.ENOSPC, "x", "a.npz")


@pytest.mark.parametrize(
    "error, says",
    [
        (PermissionError(errno.EACCES, "x", "a.png"), "a.png"),
        (OSError("Can't write data (error message = 'No space left on device')"), "No space left"),
        (NOT_CLOSED, "a.npz"),
        (MemoryError(), "memory"),
        (RuntimeError("can't start new thread"), "memory"),
        (InputError("a.png: truncated"), "a.png"),
    ],
)
def test_errors_of_the_machine_are_one_line(error, says, capsys):
    assert console.report_error(error) == 1
    line = capsys.readouterr().err
    assert line.startswith("error: ") and says in line and line.count("\n") == 1
    with pytest.raises(ZeroDivisionError):  # unexpected errors are raised
        console.report_error(ZeroDivisionError("1/0"))


@pytest.mark.parametrize("named", [False, True])
def test_a_full_disk_names_the_file_and_not_the_temporary_file(tmp_path, named):
    with pytest.raises(OSError, match="No space left on device") as caught:
        with files.atomic(tmp_path / "a.txt") as temporary:
            raise OSError(errno.ENOSPC, "x", str(temporary) if named else None)
    assert caught.value.filename == str(tmp_path / "a.txt") and list(tmp_path.iterdir()) == []


def test_a_log_has_messages_warnings_and_the_error(tmp_path, capsys):
    warnings.simplefilter("always")  # pytest restores the filters
    with pytest.raises(InputError), console.logged(tmp_path / "out", "thesis-repro study") as run:
        results.stage(tmp_path / "out", size=3)
        warnings.warn("odd", stacklevel=1)
        console.log.warning("sequence 00 failed")
        run.end("3 runs")
        raise InputError("bad")
    printed = capsys.readouterr()
    assert printed.out.startswith("3 runs\n") and printed.err == "warning: sequence 00 failed\n"
    lines = (tmp_path / "out" / console.LOG).read_text().splitlines()
    assert "INFO    thesis-repro study" in lines[0] and lines[-1].endswith("ERROR   bad")
    assert any("WARNING" in line and "odd" in line for line in lines)
    handlers = logging.getLogger("thesis_repro").handlers
    assert not any(isinstance(handler, console._LogFile) for handler in handlers)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_compiled_code_loses_stops_at_the_next_frame(tiny_kitti, number):
    """Exceptions are lost in callbacks of C, as while Numba compiles."""
    # shells start background jobs with SIGINT ignored, which `stoppable` respects
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt), console.stoppable():
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()
        with pytest.raises(KeyboardInterrupt):
            odometry.run(Sequence(tiny_kitti, "00"))
    assert len(odometry.run(Sequence(tiny_kitti, "00")).poses) == 4
