"""Logs, errors in one line, and signals that stop a program."""

import errno
import os
import platform
import signal
import subprocess
import sys
from unittest.mock import Mock

import pytest

from thesis_repro.errors import InputError
from thesis_repro.running import files, program, workers


@pytest.fixture(autouse=True)
def handlers():
    """Restore the handlers of signals, which a program sets once."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    "error, says",
    [
        (PermissionError(errno.EACCES, "Permission denied", "a.png"), "a.png"),
        (OSError("Can't write data (error message = 'No space left on device')"), "No space left"),
        (MemoryError(), "memory"),
        (InputError("a.png: truncated"), "a.png"),
        (ImportError("a.so: failed to map segment from shared object", name="numpy"), "memory"),
    ],
)
def test_bad_input_and_errors_of_the_machine_are_one_line(error, says, capsys):
    assert program.run(Mock(side_effect=error)) == 1
    line = capsys.readouterr().err
    assert line.startswith("error: ") and says in line and line.count("\n") == 1


@pytest.mark.parametrize(
    "target, status, says", [("| true", 141, ""), (">/dev/full", 1, "error: [Errno 28]")]
)
def test_what_cannot_be_printed_ends_without_a_traceback(target, status, says):
    code = "from thesis_repro.running import program; program.run_main(lambda: print('x' * 99999))"
    command = f'sleep 0.1; {sys.executable} -c "{code}" {target}; exit ${{PIPESTATUS[0]}}'
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert ended.returncode == status and ended.stderr[: len(says) or 1] == says


def test_unexpected_errors_are_raised():
    with pytest.raises(ZeroDivisionError):
        program.run(Mock(side_effect=ZeroDivisionError))


def test_warnings_and_the_summary_are_printed_apart(capsys):
    program.print_messages()
    program.log.warning("sequence 00 failed")
    program.summary("3 runs", 2)
    printed = capsys.readouterr()
    assert printed.out.startswith("3 runs\n") and "from an earlier run: 2" in printed.out
    assert printed.err == "warning: sequence 00 failed\n"


@pytest.mark.parametrize("number, status", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_waits_for_the_end_of_a_step(number, status, capsys):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have ignored it
    steps = []

    def main():
        for step in files.progress(range(3)):
            signal.raise_signal(number)
            steps.append(step)

    assert program.run(main) == status
    assert steps == [0] and capsys.readouterr().err.count("stopped") == 1


def test_a_signal_outside_of_steps_stops_at_once():
    signal.signal(signal.SIGINT, signal.default_int_handler)
    assert program.run(lambda: signal.raise_signal(signal.SIGINT)) == 130


def test_an_ignored_signal_stays_ignored():
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert program.run(lambda: signal.raise_signal(signal.SIGTERM)) == 0


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no mallopt")
def test_freed_memory_of_an_image_is_kept_for_the_next():
    code = (
        "import resource, numpy as np\n"
        "from thesis_repro.running import program\n"
        "{}\n"
        "def images(): return [np.ones((376, 1241), np.uint8) for _ in range(16)]\n"
        "for _ in range(3): images()\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "for _ in range(20): images()\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)\n"
    )
    pages = [
        int(subprocess.check_output([sys.executable, "-c", code.format(call)], text=True))
        for call in ("", "program.keep_freed_memory()")
    ]
    assert pages[1] < pages[0] / 10


@pytest.mark.parametrize(
    "given, left", [("4,2", "4"), ("2", "2"), ("4,", "4"), ("", None), ("all", None)]
)
def test_levels_of_threads_become_one_number(given, left, monkeypatch):
    """OpenMP reads a list, Numba one number."""
    monkeypatch.setenv("OMP_NUM_THREADS", given)
    seen = []
    assert program.run(lambda: seen.append(os.environ.get("OMP_NUM_THREADS"))) == 0
    assert seen == [left]


def test_a_system_without_semaphores_gets_one_process_and_one_line(monkeypatch, caplog):
    refuse = Mock(side_effect=OSError(errno.EROFS, "Read-only file system"))
    monkeypatch.setattr(workers, "ProcessPoolExecutor", refuse)
    with workers.open_pool(2) as pool:
        assert pool.size == 1 and list(pool.run(pow, [(2, 3)])) == [8]
    (line,) = caplog.messages
    assert "/dev/shm" in line and "--jobs 1" in line
