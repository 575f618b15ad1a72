"""Faults of the machine: killed commands and workers, full and read-only disks, odd names."""

import ctypes
import os
import re
import resource
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from functools import partial

import psutil
import pytest
from trials import (
    contents,
    finish,
    no_temporary_files,
    refused,
    resumes,
    run,
    snapshot,
    start,
    succeed,
    thesis,
    wait_for,
)


@pytest.fixture
def disk(tmp_path):
    """Give disk(kilobytes, "ro" or "rw"), which makes or resizes a small disk."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def sized(kilobytes, *options):
        words = ",".join(
            [f"size={kilobytes}k", *(["remount"] if os.path.ismount(folder) else []), *options]
        )
        if subprocess.run(
            ["mount", "-t", "tmpfs", "-o", words, "tmpfs", folder], capture_output=True
        ).returncode:
            pytest.skip("only root may mount a small disk")
        return folder

    yield sized
    subprocess.run(["umount", "-l", folder], capture_output=True)


@pytest.mark.torture
@pytest.mark.parametrize("name, kilobytes", [("path", 0), ("study", 40)])
def test_a_read_only_disk_and_a_full_one(words, disk, tmp_path, name, kilobytes):
    """The error names the output; with room made, the same command resumes."""
    disk(1000, "ro")
    refused(run(words(name, "disk/out"), tmp_path), "disk/")
    (disk(max(4, kilobytes), "rw") / "other").write_bytes(bytes(0 if kilobytes else 4096))
    refused(run(words(name, "disk/out"), tmp_path), "disk/out", left=["disk/*"])
    no_temporary_files(tmp_path)
    disk(100_000)
    resumes(words, name, tmp_path, "disk/out")


def family(process):
    return psutil.Process(process.pid).children(recursive=True)


@pytest.mark.torture
def test_a_killed_worker(words, tmp_path):
    process, workers = start(words("study"), tmp_path), []

    def has_workers():
        workers[:] = [each for each in family(process) if "popen_loky" in " ".join(each.cmdline())]
        return process.poll() is not None or workers

    wait_for(has_workers)
    workers[0].kill()
    refused(finish(process), "process was", left=["out", "out/*"])
    resumes(words, "study", tmp_path)


def begin(command, where, number):
    """Start a command that heeds a signal, and wait until it has changed a file."""
    heed = None
    if number != signal.SIGKILL:
        # whoever started the tests may ignore the signal, as nohup does
        heed = partial(signal.signal, number, signal.SIG_DFL)
    before, process = snapshot(where), start(command, where, before=heed)
    wait_for(lambda: process.poll() is not None or snapshot(where) != before, 600)
    return process


def stop(process, number):
    """Send a signal: Ctrl-C to all processes, as a terminal does, others to the first one.

    SIGKILL stops all of make's, as a crash would: make alone could not tell those that it started.
    All its processes must end, and unless it is killed it must say so in one line.
    """
    processes, is_make = family(process), "make" in process.args
    if number == signal.SIGINT or is_make and number == signal.SIGKILL:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    stdout, stderr = process.communicate(timeout=60)
    assert psutil.wait_procs(processes, 20)[1] == []
    assert process.returncode != 0 and "Traceback" not in stderr, stderr
    # what a whole run prints is its summary
    if number != signal.SIGKILL and not is_make and not stdout:
        assert process.returncode == 128 + number and stderr.count("stopped") == 1, stderr


KILL, CTRL_C, TERM = signal.SIGKILL, signal.SIGINT, signal.SIGTERM


@pytest.mark.torture
@pytest.mark.parametrize("name", ["study", "figures"])
def test_a_command_that_is_stopped_at_five_moments_ends_in_the_same_bytes(words, tmp_path, name):
    """Each run goes on where the one before was stopped, and has more time than that one."""
    out = tmp_path / "out"
    shown = out / "figures" if name == "figures" else out
    process, started = begin(words(name), tmp_path, KILL), time.monotonic()
    ended = finish(process)
    assert ended.returncode == 0, ended.stderr
    seconds, expected = time.monotonic() - started, contents(shown)
    shutil.rmtree(out)
    for place, number in enumerate((KILL, CTRL_C, TERM, KILL, CTRL_C), 1):
        process = begin(words(name), tmp_path, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(place / 10 * seconds)
        if process.poll() is None:
            stop(process, number)
    succeed(words(name), tmp_path)
    assert contents(shown) == expected
    no_temporary_files(tmp_path)


def test_a_first_use_without_caches_begins_soon(folder, tmp_path):
    """No compiler is loaded; four small frames take no time worth naming."""
    command = ["odometry", "--kitti", "kitti", "--sequence", "00", "--output", "path.txt"]
    python, *words = thesis(*command)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = succeed([python, "-X", "importtime", *words], folder, NUMBA_CACHE_DIR=tmp_path / "numba")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    imported = set(re.findall(r"import time:.*\| +(\w+)", done.stderr))
    assert not imported & {"numba", "llvmlite", "tensorflow", "matplotlib", "opencv_exact"}
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 6


ODD = 'it\'s "50%" <script>&$x$_ é漢\n{b} #[1]*' + os.fsdecode(b"caf\xe9")


def without_network():
    """Take the network from a process, which only root may do."""
    if os.geteuid() == 0:
        ctypes.CDLL(None).unshare(0x40000000)  # CLONE_NEWNET


@pytest.mark.torture
def test_odd_names_and_no_network_work_and_data_is_only_read(small_world, small_labels, tmp_path):
    root, out = tmp_path / ODD, tmp_path / f"out {ODD}"
    shutil.copytree(small_world / "kitti", root / "kitti")
    shutil.copytree(small_labels / "00", root / "labels")
    kitti, labels = ["--kitti", root / "kitti"], ["--labels", root / "labels"]
    drawn = ["--plot", out / f"{ODD}.svg"]
    masks = ["--masks", out / f"masks {ODD}"]
    quick = ["--sequences", "00", "--repetitions", 1, "--widths", 2, 3, "--jobs", 1]
    quick += ["--controls", 3]
    before = snapshot(root)
    for words in (
        ["masks", *kitti, "--sequence", "00", *labels, "--dilation", 3, "--output", masks[1]],
        ["odometry", *kitti, "--sequence", "00", *masks, "--output", out / ODD, *drawn],
        ["study", *kitti, *labels, *masks, *quick, "--output", out / "study"],
        ["predict", "--images", root / "kitti/sequences/00", "--output", out / "labels {2}"],
    ):
        succeed(thesis(*words), root.parent, before=without_network)
        assert snapshot(root) == before, words
    page = (out / "study" / "index.html").read_text()
    assert "&lt;script&gt;&amp;" in page and "<script" not in page
