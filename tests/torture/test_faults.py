"""Faults of the machine: killed commands and workers, full and read-only disks, odd names."""

import ctypes
import os
import random
import shutil
import signal
import subprocess
import time
from functools import partial

import psutil
import pytest
from trials import (
    contents,
    finish,
    kill,
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


def long(*case):
    return pytest.param(*case, marks=pytest.mark.torture)  # not in `make test`


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


@pytest.mark.parametrize(
    "name, kilobytes",
    [
        ("odometry.txt", 0),
        long("odometry.webm", 0),
        long("synthesize", 300),
        long("training", 40),
        long("predict", 24),
        long("study", 40),
    ],
)
def test_a_read_only_disk_and_a_full_one(words, disk, tmp_path, name, kilobytes):
    """The error names the output; with room made, the same command resumes."""
    disk(1000, "ro")
    refused(run(words(name, "disk/out"), tmp_path), "disk/")
    (disk(max(4, kilobytes), "rw") / "other").write_bytes(bytes(0 if kilobytes else 4096))
    refused(run(words(name, "disk/out"), tmp_path), "disk/out", left=["disk/*"])
    no_temporary_files(tmp_path)
    disk(100_000)
    resumes(words, name, tmp_path, "disk/out")


@pytest.mark.torture
def test_a_killed_worker(words, tmp_path):
    process = start(words("study"), tmp_path)
    wait_for(lambda: process.poll() is not None or workers_of(process))
    workers_of(process)[0].kill()
    refused(finish(process), "process was", left=["out", "out/*"])
    resumes(words, "study", tmp_path)


def workers_of(process):
    children = psutil.Process(process.pid).children(recursive=True)
    return [child for child in children if "popen_loky" in " ".join(child.cmdline())]


@pytest.mark.torture
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_stopped_study_ends_its_workers_and_resumes(words, tmp_path, number):
    heed = None
    if number != signal.SIGKILL:  # which nobody can ignore, nor ask for
        # whoever started the tests may ignore the signal, as nohup does
        heed = partial(signal.signal, number, signal.SIG_DFL)
    process = start(words("study"), tmp_path, before=heed)
    wait_for(lambda: process.poll() is not None or workers_of(process))
    workers = workers_of(process)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    if number != signal.SIGKILL:
        assert process.returncode == 128 + number and stderr.count("stopped") == 1, stderr
        assert "Traceback" not in stderr
    assert workers and psutil.wait_procs(workers, 20)[1] == []
    resumes(words, "study", tmp_path)


@pytest.mark.torture
@pytest.mark.parametrize(
    "name, kills", [("synthesize", 6), ("training", 4), ("predict", 4), ("study", 7)]
)
def test_a_command_that_writes(words, tmp_path, name, kills):
    """Kill a command `kills` times while it writes, then let it end.

    Kills are spread over the time of the undisturbed run. A run may end before it is killed.
    """
    out = tmp_path / "out"

    def begin():
        """Start the command and wait until a file has changed."""
        before, process = snapshot(tmp_path), start(words(name), tmp_path)
        wait_for(lambda: process.poll() is not None or snapshot(tmp_path) != before, 600)
        return process

    process, started = begin(), time.monotonic()
    assert finish(process).returncode == 0
    seconds, expected = time.monotonic() - started, contents(out)
    draw = random.Random(1)
    shutil.rmtree(out)
    killed = 0
    for number in draw.sample(range(kills), kills):
        process = begin()
        # a resumed run is shorter
        time.sleep((number + draw.random()) / kills * seconds / (1 + killed))
        if process.poll() is None:
            kill(process)
            killed += 1
        else:
            assert finish(process).returncode == 0
            assert contents(out) == expected
            shutil.rmtree(out)
            killed = 0
    succeed(words(name), tmp_path)
    assert contents(out) == expected
    no_temporary_files(tmp_path)


# Odd surroundings; data must not be changed

ODD = 'it\'s "50%" <script>&$x$_ é漢\n{b} #[1]*'
SEQUENCE = "=<b>&\"'$_$ %s é|![a](http:x.png)\n" + os.fsdecode(b"caf\xe9")


def without_network():
    """Take the network from a process, which only root may do."""
    if os.geteuid() == 0:
        ctypes.CDLL(None).unshare(0x40000000)  # CLONE_NEWNET


@pytest.mark.torture
def test_odd_names_and_no_network_work_and_data_is_only_read(folder, tmp_path):
    root = tmp_path / ODD
    root.mkdir()
    out, labels = root / 'out %d "x"', (folder / "labels").rename(root / "labels <i>&")
    (folder / "kitti").rename(root / "kitti")
    (root / "kitti/sequences/00").rename(root / "kitti/sequences" / SEQUENCE)
    (root / "kitti/poses/00.txt").rename(root / f"kitti/poses/{SEQUENCE}.txt")
    where = ["--kitti", root / "kitti", "--sequence", SEQUENCE]
    before = snapshot(root / "kitti"), snapshot(labels)
    for words in (
        [
            "odometry",
            *where,
            "--labels",
            labels,
            "--dilation",
            3,
            "--output",
            out / "p'$_$.txt",
            "--tum",
            out / "%s\n.tum",
            "--plot",
            out / "%d.svg",
            "--video",
            out / "%03d é.webm",
        ],
        ["masks", *where, "--labels", labels, "--dilation", 3, "--output", out / "masks\n&"],
        [
            "odometry",
            *where,
            "--masks",
            out / "masks\n&",
            "--output",
            out / "q<script>.txt",
            "--plot",
            out / "$_$.png",
        ],
        ["check-data", "--kitti", root / "kitti", "--deep"],
        [
            "study",
            "--kitti",
            root / "kitti",
            "--labels",
            labels,
            "--masks",
            out / "masks\n&",
            "--repetitions",
            1,
            "--widths",
            2,
            3,
            "--jobs",
            1,
            "--controls",
            3,
            "--output",
            out / "study",
        ],
        [
            "predict",
            "--images",
            root / "kitti/sequences" / SEQUENCE,
            "--output",
            out / "labels {2}",
        ],
        ["synthesize", out / "world", "--profile", "smoke"],
    ):
        succeed(thesis(*words), tmp_path, before=without_network)
        assert (snapshot(root / "kitti"), snapshot(labels)) == before, words
    assert {path.name for path in out.iterdir()} == {
        "p'$_$.txt",
        "%s\n.tum",
        "%d.svg",
        "%03d é.webm",
        "masks\n&",
        "q<script>.txt",
        "$_$.png",
        "study",
        "labels {2}",
        "world",
    }
    page = (out / "study" / "index.html").read_text()
    assert "&lt;b&gt;&amp;" in page and "&lt;i&gt;&amp;" in page
    assert not any(tag in page for tag in ("<script", "<b>", "<i>", 'src="http'))
