"""Faults of the machine: killed commands and workers, full and read-only disks, little memory.

Odd names, no network and a read-only cache must work.
"""

import ctypes
import os
import random
import resource
import shlex
import shutil
import signal
import subprocess
import time
from functools import partial

import psutil
import pytest
from trials import (
    ROOT,
    contents,
    environment,
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


@pytest.mark.parametrize(
    "name, limit, megabytes, named",
    [
        ("odometry.txt", resource.RLIMIT_AS, 300, "memory"),
        long("synthesize", resource.RLIMIT_AS, 700, "memory"),
        long("predict", resource.RLIMIT_AS, 3080, "memory"),
        long("study", resource.RLIMIT_AS, 2000, "memory"),
        long("odometry.png", resource.RLIMIT_FSIZE, 1 / 256, "out.png"),
    ],
)
def test_limits_of_memory_and_of_file_size(words, tmp_path, name, limit, megabytes, named):
    set_limit = partial(resource.setrlimit, limit, (int(megabytes * 2**20),) * 2)
    refused(run(words(name), tmp_path, before=set_limit), named, left=["out", "out/*"])


@pytest.mark.torture
@pytest.mark.parametrize("name", ["synthesize", "study"])
def test_a_killed_worker(words, tmp_path, name):
    def workers():
        return [
            child
            for child in psutil.Process(process.pid).children()
            if "popen_loky" in " ".join(child.cmdline())
        ]

    process = start(words(name), tmp_path)
    wait_for(lambda: process.poll() is not None or workers())
    time.sleep(0.5)
    assert process.poll() is None, "it ended before a worker could be killed"
    workers()[0].kill()
    refused(finish(process), "a process was killed")
    resumes(words, name, tmp_path)


@pytest.mark.torture
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_a_terminated_study_ends_its_workers(words, tmp_path, number):
    heed = None
    if number != signal.SIGKILL:  # which nobody can ignore, nor ask for
        # whoever started the tests may ignore the signal, as nohup does
        heed = partial(signal.signal, number, signal.SIG_DFL)
    process = start(words("study"), tmp_path, before=heed)
    wait_for(
        lambda: (
            list((tmp_path / "out").rglob("pass-*"))
            or process.poll() is not None
            or len(psutil.Process(process.pid).children()) > 2
        )
    )
    workers = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode in (128 + number, -signal.SIGKILL) and workers
    assert psutil.wait_procs(workers, 20)[1] == []
    resumes(words, "study", tmp_path)


@pytest.mark.parametrize("around", ["{} | head -1", "{} >&-", "{} >&- 2>&-"])
def test_closed_streams_are_no_error(words, tmp_path, around):
    command = shlex.join(map(str, words("odometry.txt")))
    result = run(["bash", "-c", around.format(command)], tmp_path)
    assert result.returncode == 0 and "Traceback" not in result.stderr
    assert (tmp_path / "out.txt").exists()


def test_a_deleted_working_folder(words, tmp_path):
    command = shlex.join(map(str, words("odometry.txt")))
    lines = f"mkdir gone; cd gone; rmdir ../gone; {command}"
    refused(run(["bash", "-c", lines], tmp_path), "working folder")


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


def without_root_privileges():
    """Drop the capabilities of root that ignore permissions of files."""
    if os.geteuid() == 0:
        for capability in (1, 2, 3):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER
            ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


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
        "both.svg",
        "study",
        "labels {2}",
        "world",
    }
    page = (out / "study" / "index.html").read_text()
    assert "&lt;b&gt;&amp;" in page and "&lt;i&gt;&amp;" in page
    assert not any(tag in page for tag in ("<script", "<b>", "<i>", 'src="http'))


@pytest.mark.torture
def test_make_takes_odd_folders_and_refuses_unknown_settings(tiny_kitti, tmp_path):
    # make expands $ and ends at a line break
    odd = tmp_path / ODD.replace("$x$_", "").replace("\n", " ")
    tiny_kitti.rename(odd)

    def make(*words):
        return subprocess.run(
            ["make", "-C", ROOT, "-o", ".venv/ready", *words],
            capture_output=True,
            text=True,
            env=environment(),
        )

    assert make("check-data", f"KITTI={odd}").returncode == 0
    planned = make("-n", "figures", "PROFILE=smoke", f"KITTI={odd}", f"BUILD={tmp_path / 'build'}")
    assert (
        planned.returncode == 0 and f"{tmp_path / 'build'}/kitti-it-s-50-script-" in planned.stdout
    ), planned
    for target, word, named in (
        ("figures", "EPOCHS=0", "EPOCHS=0: "),
        ("figures", "EPOCH=3", "EPOCH: "),
        ("figures", "KITTI=", "KITTI"),
        ("figures", "GPU=no", "GPU=no"),
        ("figures", "PYTHON=none", "none is no Python"),
        ("figures", "FIGURES=a b", "FIGURES"),
        ("figures", "DASK_SCHEDULER=mine", "mine"),
        ("weights", f"CAMVID={odd}", "KITTI_SEMANTIC"),
        ("weights", f"KITTI_SEMANTIC={odd}", "CAMVID"),
    ):
        answer = make(target, word, f"BUILD={tmp_path / 'other'}")
        assert answer.returncode != 0 and not (tmp_path / "other").exists(), answer
        assert named in answer.stderr and "Traceback" not in answer.stderr, answer


@pytest.mark.torture
def test_caches_that_cannot_be_written(tmp_path, tiny_kitti):
    package, home = tmp_path / "package" / "thesis_repro", tmp_path / "home"
    shutil.copytree(ROOT / "thesis_repro", package, ignore=shutil.ignore_patterns("__pycache__"))
    home.mkdir()
    folders = [home, package.parent, package, *package.rglob("*/")]
    for folder in folders:
        folder.chmod(0o555)
    no_caches = dict.fromkeys(
        ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "NUMBA_CACHE_DIR", "KERAS_HOME")
    )
    for words, output in (
        ("odometry --kitti kitti --sequence 00 --plot path.png", "path.png"),
        ("predict --images kitti/sequences/00 --output out", "out"),
    ):
        result = succeed(
            thesis(*words.split()),
            tmp_path,
            before=without_root_privileges,
            PYTHONPATH=package.parent,
            HOME=home,
            **no_caches,
        )
        assert {path.split("/")[0] for path in result.left} == {
            output
        } and "Traceback" not in result.stderr
    for folder in folders:
        folder.chmod(0o755)
