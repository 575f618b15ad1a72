"""Folders of results: their inputs, locks and checkpoints; logs, signals, errors in one line."""

import ctypes
import errno
import fcntl
import logging
import os
import shutil
import signal
import warnings
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.running import compiled, files, folders, messages, results


def test_a_stage_keeps_results_of_the_same_inputs(tmp_path):
    folder = results.stage(tmp_path / "a", data="one", size=3)
    files.write_text(folder / "result", "kept")
    assert (
        results.stage(tmp_path / "a", size=3, data="one") == folder and (folder / "result").exists()
    )
    before = results.made_from(folder)
    results.stage(tmp_path / "a", data="other", size=3)
    assert not (folder / "result").exists() and results.made_from(folder) != before
    with pytest.raises(InputError, match="a: .*size"):
        results.stage(folder, replace=False, data="other", size=4)
    assert results.record(folder) == {"data": "other", "size": 3}


def test_a_folder_with_other_files_is_refused_and_kept(tmp_path):
    (tmp_path / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match=str(tmp_path)):
        results.stage(tmp_path, data="one")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]
    (tmp_path / folders.RECORD).write_text("[1, 2")  # a damaged record
    with pytest.raises(InputError, match="made-from.json: "):
        results.stage(tmp_path, data="one")


def test_a_checkpoint_is_read_back_and_holds_no_code(tmp_path):
    file = tmp_path / "state.npz"
    assert results.resume(file) is None
    results.store(file, {"epoch": 3}, {"0": np.eye(2), "job": np.arange(3)})
    job, arrays = results.resume(file)
    assert (
        job == {"epoch": 3}
        and np.array_equal(arrays["0"], np.eye(2))
        and np.array_equal(arrays["job"], [0, 1, 2])
    )
    np.savez(file, job="{}", **{"array 0": np.array([object()])})  # a pickle
    with pytest.raises(InputError, match="state.npz: "):
        results.resume(file)
    results.store(file, {}, {"0": np.zeros(1000)})
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(InputError, match="state.npz: "):
        results.resume(file)


HOUSE = {
    "house": "def f():\n    return 1\n",
    "garden": "x = 1\n",
    "room/__init__": "",
    "room/table": "import beside\nfrom package.room import chair\n",
    "room/chair": "from package import house\ny = house.f()\n",
    "room/words": "text = 'unread'\n",
}


@pytest.fixture
def version(tmp_path, monkeypatch):
    """A function that gives the digest of the code of a made-up package.

    Its arguments are a module and {file: code} of the files that differ from HOUSE.
    """
    monkeypatch.setattr(results, "_PACKAGE", tmp_path / "package")
    monkeypatch.setattr(results, "PROJECT", ("package",))
    (tmp_path / "beside.py").touch()  # another package beside this one

    def digest(module="package.room.table", changed=None):
        for name, text in {**HOUSE, **(changed or {})}.items():
            files.write_text(tmp_path / "package" / f"{name}.py", text)
        results.digest_of_code.cache_clear()
        return results.digest_of_code(module)

    yield digest
    results.digest_of_code.cache_clear()


@pytest.mark.parametrize(
    "changed",
    [
        {"house": '"""What it is."""\n\n# why\ndef f():\n    """What."""\n    return 1\n'},
        {"garden": "x = 2\n"},
        {"room/chair": "y = house.f()\nfrom package import house, garden\n", "garden": ""},
        # moved to another module
        {"house": "", "room/chair": "from package import house\ny = house.f()\n" + HOUSE["house"]},
    ],
)
def test_words_and_places_of_code_do_not_change_its_digest(version, changed):
    assert version(changed=changed) == version()


@pytest.mark.parametrize(
    "changed",
    [
        {"house": "def f():\n    return 2\n"},
        {"room/chair": "from package import house\ny = house.f()\nz = 2\n"},
        {"room/table": "import beside\nfrom package.room import chair, words\n"},
    ],
)
def test_changed_code_changes_its_digest(version, changed):
    assert version(changed=changed) != version()


def test_other_messages_do_not_change_the_digest_of_code(version):
    code = (
        "def g(x):\n    if x:\n        raise InputError(f'{x}: bad')\n    messages.log.info('so')\n"
    )
    same = "def g(x):\n    if x:\n        raise InputError('worse')\n    messages.log.info('not')\n"
    other = code.replace("if x", "if not x")
    digests = [version(changed={"room/chair": text}) for text in (code, same, other)]
    assert digests[0] == digests[1] != digests[2]
    with pytest.raises(ImportError, match="attic"):
        version("package.attic")


DATA = {"cityscapes", "kitti", "kitti_raw", "trajectories"}


@pytest.mark.parametrize(
    ("modules", "rooms"),
    [
        (["masks"], {"data", "masks"}),
        (["odometry", "study.jobs"], {"data", "masks", "odometry", "running", "study"}),
        (["segmentation.training"], {"data", "segmentation"}),
        (["segmentation.prediction"], {"data", "segmentation"}),
    ],
)
def test_the_rooms_that_results_come_from(modules, rooms):
    names = results.source_modules(*[f"thesis_repro.{name}" for name in modules])
    parts = [name.split(".")[1:] for name in names]
    assert {part[0] for part in parts} == rooms
    assert {part[1] for part in parts if part[0] == "data"} <= DATA
    assert {part[1] for part in parts if part[0] == "running"} <= {"compiled"}
    assert {part[1] for part in parts if part[0] == "study"} <= {"jobs", "controls", "sources"}


def test_digests_of_files_change_with_the_bytes_and_are_cached(tmp_path, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_BUILD", str(tmp_path / "build"))
    monkeypatch.setattr(results, "SETTLED", -1)
    paths = [tmp_path / "a", tmp_path / "b"]
    for path in paths:
        path.write_text("12")
    first = results.digest_of_files(paths)
    (tmp_path / "elsewhere").mkdir()
    assert (
        results.digest_of_files([shutil.copy(path, tmp_path / "elsewhere") for path in paths])
        == first
    )
    date = paths[1].stat().st_mtime_ns
    paths[1].write_text("21")  # the same length and date
    os.utime(paths[1], ns=(date, date))
    changed = results.digest_of_files(paths)
    assert changed != first
    monkeypatch.setattr(results, "_sha256", None)  # nothing may be read
    assert results.digest_of_files(paths) == changed
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe: "):
        results.digest_of_files([tmp_path / "pipe"])


def test_results_of_other_inputs_move_aside_with_all_that_was_added(tmp_path, capsys, monkeypatch):
    folder = results.stage(tmp_path / "a", size=3)
    monkeypatch.chdir(folder)
    messages.print_messages()
    for size in (3, 4, 5):
        results.stage(".", size=size)  # "." has no name
        files.write_text(folder / "in" / "result", f"result of {size}")
        (folder / "link").symlink_to("/nowhere")
        (folder / ".env").write_text(f"by hand, {size}")
    results.stage(folder, size=5)
    for path, size in ((folder, 5), (tmp_path / "a.old-1", 3), (tmp_path / "a.old-2", 4)):
        assert results.record(path) == {"size": size} and (path / "link").is_symlink()
        assert (path / "in" / "result").read_text() == f"result of {size}"
        assert (path / ".env").read_text() == f"by hand, {size}"
    assert capsys.readouterr().err.count("a.old-2") == 1
    results.stage(results.stage(tmp_path / "empty", size=1), size=2)
    assert not (tmp_path / "empty.old-1").exists()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "frame,x\n0,1.0\n1,2",  # cut off
        "frame,x\n0,10.0\n1,11.0\n",  # shifted
        "frame,x\n1,2.0\n0,1.0\n",  # reversed
        "frame,x\n0,1\n1,2\n",  # fewer digits
        "frame\n0\n1\n",  # without a column
    ],
)
def test_a_table_that_was_changed_is_moved_aside(tmp_path, text):
    path, other = tmp_path / "a.csv", tmp_path / "b.csv"
    assert not results.has_table(path)
    for written in (path, other):
        results.write_table(written, pd.DataFrame({"frame": [0, 1], "x": [1.0, 2.0]}))
    assert results.has_table(path)
    path.write_text(text)
    assert not results.has_table(path) and not path.exists() and results.has_table(other)
    assert (tmp_path / "a.csv.old-1").read_text() == text
    (tmp_path / folders.DIGESTS).unlink()  # as in a folder of an earlier version
    assert not results.has_table(other) and not other.exists()


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
    files.temporary_path(other / folders.RECORD).touch()
    assert [path.name for path in results.stage(other, size=3).iterdir()] == [folders.RECORD]


def test_a_killed_move_of_old_results_is_finished_and_the_log_stays(tmp_path, monkeypatch):
    folder = results.stage(tmp_path / "out", size=3)
    results.stage(folder / "in", size=3)
    for path in (folder / "result", folder / "in" / "result"):
        files.write_text(path, "old")
    (folder / folders.LOG).touch()
    with monkeypatch.context() as patch:
        rename = type(folder).rename

        def killed(path, target):
            rename(path, target)
            raise KeyboardInterrupt

        patch.setattr(type(folder), "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            results.stage(folder, size=4)
    assert results.record(folder) == {"size": 3}
    results.stage(folder, size=4)
    assert {path.name for path in folder.iterdir()} == {folders.RECORD, folders.LOG}
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
    assert messages.report_error(error) == 1
    line = capsys.readouterr().err
    assert line.startswith("error: ") and says in line and line.count("\n") == 1
    with pytest.raises(ZeroDivisionError):  # unexpected errors are raised
        messages.report_error(ZeroDivisionError("1/0"))


@pytest.mark.parametrize("named", [False, True])
def test_a_full_disk_names_the_file_and_not_the_temporary_file(tmp_path, named):
    with (
        pytest.raises(OSError, match="No space left on device") as caught,
        files.atomic(tmp_path / "a.txt") as temporary,
    ):
        raise OSError(errno.ENOSPC, "x", str(temporary) if named else None)
    assert caught.value.filename == str(tmp_path / "a.txt") and list(tmp_path.iterdir()) == []


def test_a_log_has_messages_warnings_and_the_error(tmp_path, capsys):
    warnings.simplefilter("always")  # pytest restores the filters
    messages.print_messages()
    with pytest.raises(InputError), messages.logged(tmp_path / "out", "thesis-repro study") as run:
        results.stage(tmp_path / "out", size=3)
        warnings.warn("odd", stacklevel=1)
        messages.log.warning("sequence 00 failed")
        run.end("3 runs")
        raise InputError("bad")
    printed = capsys.readouterr()
    assert printed.out.startswith("3 runs\n") and printed.err == "warning: sequence 00 failed\n"
    lines = (tmp_path / "out" / folders.LOG).read_text().splitlines()
    assert "INFO    thesis-repro study" in lines[0] and lines[-1].endswith("ERROR   bad")
    assert any("WARNING" in line and "odd" in line for line in lines)
    handlers = logging.getLogger("thesis_repro").handlers
    assert not any(isinstance(handler, messages._LogFile) for handler in handlers)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_that_compiled_code_loses_stops_at_the_next_frame(tiny_kitti, number):
    """Exceptions are lost in callbacks of C, as while Numba compiles."""
    # shells start background jobs with SIGINT ignored, which `stoppable` respects
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt), messages.stoppable():
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()
        with pytest.raises(KeyboardInterrupt):
            odometry.run(Sequence(tiny_kitti, "00"))
    assert len(odometry.run(Sequence(tiny_kitti, "00")).poses) == 4


class Interrupting:
    """Masks, frames and a function of Numba that get Ctrl-C; done: how often nothing was raised."""

    def __init__(self, frame):
        self.frame, self.done = frame, 0

    def interrupt(self, *_, **__):
        signal.raise_signal(signal.SIGINT)
        self.done += 1
        return self.frame

    __getitem__ = __array__ = compile = interrupt


@pytest.mark.parametrize("handler", [signal.default_int_handler, signal.SIG_IGN])
def test_ctrl_c_waits_for_compiled_code_and_then_has_its_usual_effect(
    tiny_kitti, tmp_path, monkeypatch, handler
):
    """For Python's own handler in a user's script; an ignored signal stays ignored."""
    monkeypatch.setattr(compiled, "_forget_stale_once", lambda *_: None)
    sequence = Sequence(tiny_kitti, "00")
    sent = Interrupting(sequence.frame(0) // 128 * 255)
    compiled._check_cache_before_use(sent, tmp_path)
    sent.stats = SimpleNamespace(cache_path=tmp_path)
    before = signal.signal(signal.SIGINT, handler)
    try:
        for call in (
            lambda: odometry.run(sequence, masks=sent),
            lambda: odometry.Odometry(sequence.intrinsics).step(sent),
            lambda: sent.compile(()),
        ):
            sent.done = 0
            if handler is signal.SIG_IGN:
                call()
            else:
                with pytest.raises(KeyboardInterrupt):
                    call()
                assert sent.done == 1
            assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_run_in_a_thread_leaves_signals_alone(tiny_kitti):
    with ThreadPoolExecutor() as pool:
        result = pool.submit(odometry.run, Sequence(tiny_kitti, "00")).result()
    assert len(result.poses) == 4


@pytest.mark.parametrize(
    "name, good, bad",
    [
        ("OMP_NUM_THREADS", "2", "abc"),
        ("NUMBA_NUM_THREADS", "1", "0"),
        ("OPENCV_FOR_THREADS_NUM", "0", "abc"),
        ("TQDM_MININTERVAL", "0.5", "abc"),
        ("SOURCE_DATE_EPOCH", "", "1.5"),
    ],
)
def test_a_variable_that_a_library_would_fail_with_is_named(monkeypatch, name, good, bad):
    monkeypatch.setenv("MPLBACKEND", "bogus")
    monkeypatch.setenv(name, good)
    messages.check_environment()
    assert os.environ["MPLBACKEND"] == "agg"
    monkeypatch.setenv(name, bad)
    with pytest.raises(InputError, match=f"{name}={bad}"):
        messages.check_environment()
