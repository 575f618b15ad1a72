"""What a machine does to long runs: full and read-only disks, a second run, dead workers, wrong dates, no memory."""

import os
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from trials import contents, finish, kill, nothing_stray, refused, run, same, start, succeed, whole_again

short = pytest.mark.short


@pytest.fixture
def disk(tmp_path):
    """A small disk below `tmp_path`: disk(kilobytes) makes or resizes it; with "ro" nothing can be written."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def sized(kilobytes, *options):
        words = ",".join([f"size={kilobytes}k", *(["remount"] if os.path.ismount(folder) else []), *options])
        if subprocess.run(["mount", "-t", "tmpfs", "-o", words, "tmpfs", folder], capture_output=True).returncode:
            pytest.skip("only root may mount a small disk")
        return folder

    yield sized
    subprocess.run(["umount", "-l", folder], capture_output=True)


@pytest.mark.parametrize("name, kilobytes", [
    ("synthesize", 300), ("training", 150), ("predict", 0), ("predict", 24), ("masks", 24), ("study", 0), ("study", 40),
    ("study", 60), pytest.param("odometry.txt", 0, marks=short), ("odometry.tum", 0), ("odometry.svg", 0),
    ("odometry.png", 0), ("odometry.mp4", 0)])
def test_a_full_disk(words, disk, tmp_path, name, kilobytes):
    """It is named, and with room made the same command goes on to what an undisturbed run leaves."""
    (disk(max(4, kilobytes)) / "other").write_bytes(bytes(0 if kilobytes else 4096))
    refused(run(words(name, "disk/out"), tmp_path), "disk/out", left=["disk/*"])
    nothing_stray(tmp_path)
    disk(100_000)
    whole_again(words, name, tmp_path, "disk/out")


@pytest.mark.parametrize("name", ["synthesize", "training", "predict", "masks", "study", "odometry.mp4",
                                  pytest.param("odometry.txt", marks=short)])
def test_results_that_cannot_be_written(words, disk, tmp_path, name):
    disk(1000, "ro")
    refused(run(words(name, "disk/out"), tmp_path), "disk/")


@pytest.mark.parametrize("name", ["synthesize", "training", "predict", "study"])
def test_two_runs_on_one_folder(words, tmp_path, name):
    first = start(words(name), tmp_path)
    try:
        # a training holds its folder while it trains
        pattern = "state.npz" if name == "training" else "made-from.json"
        wait_for(lambda: list((tmp_path / "out").rglob(pattern)) or first.poll() is not None)
        os.killpg(first.pid, signal.SIGSTOP)  # so that it is at work for as long as the second one is
        assert first.poll() is None, "it ended before a second one could begin"
        refused(run(words(name), tmp_path), "out", left=["out/log.txt"])
        os.killpg(first.pid, signal.SIGCONT)
        assert finish(first).returncode == 0, "the first did not end well"
        nothing_stray(tmp_path)
    finally:
        kill(first)


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s"
        time.sleep(0.01)


@pytest.mark.parametrize("name", ["synthesize", "study"])
def test_a_process_that_dies(words, tmp_path, name):
    """As the system ends one where memory runs out."""
    def workers(process):
        listed = subprocess.run(["ps", "-ww", "--ppid", str(process.pid), "-o", "pid=,args="], capture_output=True,
                                text=True)  # -ww: however long the path of the interpreter is
        return [int(line.split()[0]) for line in listed.stdout.splitlines() if "popen_loky" in line]

    process = start(words(name), tmp_path)
    wait_for(lambda: process.poll() is not None or workers(process))
    time.sleep(0.5)
    assert process.poll() is None, "it ended before one could be killed"
    os.kill(workers(process)[0], signal.SIGKILL)
    refused(finish(process), "a process was killed")
    whole_again(words, name, tmp_path)


@pytest.mark.parametrize("year", [1990, 2037])
def test_dates_of_files_decide_nothing(words, tmp_path, small_labels, year):
    def date_all(folder, year):
        when = time.mktime((year, 6, 1, 12, 0, 0, 0, 0, 0))
        for path in [folder, *Path(folder).rglob("*")]:
            os.utime(path, (when, when))

    def study(_, output):
        return ["labels" if word == str(small_labels) else word for word in words("study", output)]

    shutil.copytree(small_labels, tmp_path / "labels")
    succeed(study("study", "out"), tmp_path)
    date_all(tmp_path / "out", year)
    earlier, runs = contents(tmp_path / "out"), list((tmp_path / "out/runs").rglob("*.csv"))
    succeed(study("study", "out"), tmp_path)
    same(contents(tmp_path / "out"), earlier)
    assert runs and {time.localtime(path.stat().st_mtime).tm_year for path in runs} == {year}, "done again"
    for path in (tmp_path / "labels").rglob("*.png"):  # other label maps, of a date on the wrong side
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(path), np.where(image == 7, 11, image))
    date_all(tmp_path / "labels", 2037 if year == 1990 else 1990)
    whole_again(study, "study", tmp_path)


@pytest.mark.parametrize("name, megabytes", [
    pytest.param("odometry.txt", 300, marks=short), ("masks", 600), ("predict", 1500), ("predict", 3080),
    ("synthesize", 700), ("study", 2000)])
def test_too_little_memory_for_the_libraries(words, tmp_path, name, megabytes):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 2**20,) * 2)

    refused(run(words(name), tmp_path, before=limit), "memory", left=["out", "out/*"])


def test_files_that_may_not_grow(words, tmp_path):
    """As a quota or `ulimit -f` has it, and without root."""
    refused(run(words("odometry.png"), tmp_path,
                before=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))), "out.png")
