"""What a machine does to long runs: full and read-only disks, a second run, dead workers, wrong clocks, no memory."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from trials import clear, contents, finish, kill, lost_unless, nothing_stray, same, snapshot, spawn

HERE = Path(__file__).parent
TRAINING = [sys.executable, HERE / "small_training.py"]
AGAIN = "the same command then goes on"


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


@pytest.fixture
def many_frames(tmp_path):
    """40 small images, for several batches of label maps."""
    folder = tmp_path / "images"
    folder.mkdir()
    for index, image in enumerate(np.random.default_rng(0).integers(0, 256, (40, 48, 64), np.uint8)):
        cv2.imwrite(str(folder / f"{index:06d}.png"), image)
    return folder


@pytest.fixture(scope="module")
def small_model(tmp_path_factory):
    from thesis_repro.cityscapes import N_CLASSES
    from thesis_repro.segmentation.unet import build_unet

    path = tmp_path_factory.mktemp("model") / "model.keras"
    build_unet((64, 64, 1), N_CLASSES, 4).save(path)
    return path


def study(small_world, small_labels, output, *more):
    return ["study", "--kitti", small_world / "kitti", "--labels", small_labels, "--widths", 5, "--repetitions", 1,
            "--output", output, *more]


def run(command, where, **options):
    """Any command, started where the ledger's files are; with what it left."""
    seen = snapshot(where)
    return finish(spawn(command, where, **options), where, seen)


# A full disk


def test_a_full_disk_while_a_world_is_written(ledger, command, disk, small_world, tmp_path):
    with ledger("faults", "disk full: pictures of the embedded world"):
        disk(300)
        clear(command("synthesize", "disk/world", "--profile", "smoke"), "disk/world/", "No space left", AGAIN,
              left=["disk/*"])
        nothing_stray(tmp_path)
        disk(100_000)
        assert command("synthesize", "disk/world", "--profile", "smoke").returncode == 0
        same(contents(tmp_path / "disk" / "world"), contents(small_world))


@pytest.mark.parametrize("kilobytes", [pytest.param(0, id="at once"), pytest.param(60, id="later")])
def test_a_full_disk_while_label_maps_are_written(ledger, command, disk, many_frames, small_model, tmp_path, kilobytes):
    words = ["predict", "--images", "images", "--model", small_model, "--output"]
    with ledger("faults", f"disk full: label maps, {kilobytes} kB"):
        fill(disk(max(4, kilobytes)), 0 if kilobytes else 4)
        clear(command(*words, "disk/labels"), "disk/labels/", "No space left", AGAIN, left=["disk/*"])
        nothing_stray(tmp_path)
        disk(100_000)
        assert command(*words, "disk/labels").returncode == command(*words, "whole").returncode == 0
        same(contents(tmp_path / "disk" / "labels"), contents(tmp_path / "whole"))


def fill(folder, kilobytes):
    (folder / "other").write_bytes(bytes(1024 * kilobytes))


def test_a_full_disk_while_masks_are_written(ledger, command, disk, small_world, small_labels, tmp_path):
    words = ["masks", "--kitti", small_world / "kitti", "--sequence", "00", "--labels", small_labels / "00",
             "--dilation", 5, "--output"]
    with ledger("faults", "disk full: masks"):
        disk(40)
        clear(command(*words, "disk/masks"), "disk/masks/", "No space left", AGAIN, left=["disk/*"])
        nothing_stray(tmp_path)
        disk(100_000)
        assert command(*words, "disk/masks").returncode == command(*words, "whole").returncode == 0
        same(contents(tmp_path / "disk" / "masks"), contents(tmp_path / "whole"))


@pytest.mark.parametrize("option, name", [
    pytest.param("--output", "poses.txt", marks=pytest.mark.short), ("--tum", "path.tum"), ("--plot", "path.svg"),
    ("--plot", "path.png"), ("--video", "seen.mp4")])
def test_a_full_disk_at_the_end_of_a_run(ledger, command, disk, tiny_kitti, tmp_path, option, name):
    with ledger("faults", f"disk full: {option} {name}"):
        fill(disk(4), 4)
        clear(command("odometry", "--kitti", tiny_kitti, "--sequence", "00", option, f"disk/{name}"),
              f"disk/{name}", "No space left", AGAIN)
        assert [path.name for path in (tmp_path / "disk").iterdir()] == ["other"]


@pytest.mark.parametrize("kilobytes, what", [(4, "its first record"), (40, "runs"), (60, "figures and page")])
def test_a_full_disk_in_a_study(ledger, command, disk, small_world, small_labels, tmp_path, kilobytes, what):
    with ledger("faults", f"disk full: a study's {what}"):
        fill(disk(kilobytes), 4 if kilobytes == 4 else 0)
        result = command(*study(small_world, small_labels, "disk/study"))
        result.stderr = result.stderr.strip().splitlines()[-1]
        clear(result, "disk/study", "No space left", AGAIN, left=["disk/*"])
        nothing_stray(tmp_path)
        disk(100_000)
        for output in ("disk/study", "whole"):
            assert command(*study(small_world, small_labels, output)).returncode == 0
        same(contents(tmp_path / "disk" / "study"), contents(tmp_path / "whole"))


def test_a_full_disk_in_training(ledger, disk, tmp_path):
    with ledger("faults", "disk full: model and state of a training"):
        disk(150)
        clear(run([*TRAINING, "disk/model", 2], tmp_path), "disk/model", "No space left", AGAIN, left=["disk/*"])
        nothing_stray(tmp_path)
        disk(100_000)
        for output in ("disk/model", "whole"):
            assert run([*TRAINING, output, 2], tmp_path).returncode == 0
        same(contents(tmp_path / "disk" / "model"), contents(tmp_path / "whole"))


def test_a_full_disk_while_the_page_is_written(ledger, disk, tmp_path):
    with ledger("faults", "disk full: the page of a run"):
        fill(disk(4), 4)
        clear(run([sys.executable, "-m", "thesis_repro.report.page"], tmp_path,
                  THESIS_REPRO_FIGURES=tmp_path / "disk", THESIS_REPRO_BUILD=tmp_path / "build"),
              "disk/index.html", "No space left", AGAIN)


def test_a_full_disk_while_notebooks_are_executed(ledger, disk, tmp_path):
    import nbformat

    code = "from thesis_repro.files import write_text\nwrite_text('disk/one.txt', 'one' * 2000)"
    for what, cell, says in (("a figure", code, "disk/one.txt"), ("the notebook", "print('done' * 20_000)", "disk/")):
        with ledger("faults", f"disk full: {what} of make figures"):
            nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell)]), tmp_path / "one.ipynb")
            disk(8)
            result = run([sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", "--log-level=CRITICAL",
                          "--NotebookExporter.default_preprocessors=thesis_repro.report.execute.Execution",
                          "--Execution.log_file=disk/log/one.log", "--output-dir=disk/log", "one.ipynb"], tmp_path)
            result.stderr = result.stderr.partition("\nthe whole report")[0]
            clear(result, says, "No space left", AGAIN, left=["disk/*"])
            shutil.rmtree(tmp_path / "disk" / "log")


def test_files_that_may_not_grow(ledger, command, tiny_kitti):
    """As a quota or `ulimit -f` has it, and without root."""
    with ledger("faults", "a limit on the size of files: a plot"):
        clear(command("odometry", "--kitti", tiny_kitti, "--sequence", "00", "--plot", "path.png",
                      before=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))),
              "path.png", "File too large", "ulimit -f")


# Disks that cannot be written to


def test_data_that_cannot_be_written_to(ledger, command, small_world, small_labels, tmp_path):
    """A read-only mount of all that is read."""
    data = tmp_path / "data"
    for name, source in (("world", small_world), ("labels", small_labels)):
        (data / name).mkdir(parents=True)
        if subprocess.run(["mount", "--bind", "-o", "ro", source, data / name], capture_output=True).returncode:
            pytest.skip("only root may mount a folder read-only")
    kitti, labels = data / "world" / "kitti", data / "labels"
    try:
        assert subprocess.run(["touch", kitti / "x"], capture_output=True).returncode
        where = ["--kitti", kitti, "--sequence", "00"]
        for words in (["check-data", "--kitti", kitti, "--cityscapes", data / "world" / "cityscapes"],
                      ["odometry", *where, "--labels", labels / "00", "--dilation", 5],
                      ["masks", *where, "--labels", labels / "00", "--dilation", 5, "--output", "masks"],
                      ["predict", "--images", kitti / "sequences" / "00", "--output", "maps"],
                      study(data / "world", labels, "study")):
            with ledger("faults", f"read-only data: {words[0]}"):
                result = command(*words)
                lost_unless(result.returncode == 0, f"{result.stdout}\n{result.stderr}")
    finally:
        for name in ("world", "labels"):
            subprocess.run(["umount", "-l", data / name], capture_output=True)


@pytest.mark.parametrize("words", [
    ["synthesize", "disk/world", "--profile", "smoke"],
    pytest.param(["odometry", "--sequence", "00", "--output", "disk/poses.txt"], marks=pytest.mark.short),
    ["odometry", "--sequence", "00", "--video", "disk/seen.mp4"],
    ["masks", "--sequence", "00", "--dilation", 5, "--output", "disk/masks"],
    ["predict", "--output", "disk/maps"], ["study", "--repetitions", 1, "--output", "disk/study"]],
    ids=lambda words: f"{words[0]} {words[-1]}")
def test_results_that_cannot_be_written(ledger, command, disk, small_world, small_labels, words):
    kitti = small_world / "kitti"
    words = words + {"odometry": ["--kitti", kitti], "masks": ["--kitti", kitti, "--labels", small_labels / "00"],
                     "predict": ["--images", kitti / "sequences" / "00"],
                     "study": ["--kitti", kitti, "--labels", small_labels]}.get(words[0], [])
    disk(1000, "ro")
    with ledger("faults", f"read-only results: {words[0]}"):
        clear(command(*words), "disk/", "name a")


def test_a_build_folder_that_cannot_be_written(ledger, disk, tmp_path):
    disk(1000, "ro")
    for what, command in (("training", [*TRAINING, "disk/model", 1]),
                          ("the page", [sys.executable, "-m", "thesis_repro.report.page"])):
        with ledger("faults", f"read-only results: {what}"):
            clear(run(command, tmp_path, THESIS_REPRO_BUILD=tmp_path / "disk" / "build"), "disk/",
                  "Read-only file system", "name a folder")


def test_a_folder_without_permission(ledger, command, tiny_kitti, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    folder.chmod(0o555)
    if os.geteuid() == 0 and subprocess.run(["chattr", "+i", folder], capture_output=True).returncode:
        pytest.skip("root may write everywhere here")
    try:
        with ledger("faults", "no permission to write"):
            clear(command("odometry", "--kitti", tiny_kitti, "--sequence", "00", "--output", "mine/poses.txt"),
                  "mine/poses.txt", "name another")
    finally:
        subprocess.run(["chattr", "-i", folder], capture_output=True)


# Two runs on one folder


@pytest.mark.parametrize("name", ["synthesize", "training", "predict", "study"])
def test_two_runs_on_one_folder(ledger, tmp_path, small_world, small_labels, name):
    command = {"training": [*TRAINING, "out", 3],
               "synthesize": thesis("synthesize", "out", "--profile", "smoke"),
               "predict": thesis("predict", "--images", small_world / "kitti" / "sequences" / "00", "--output", "out"),
               "study": thesis(*study(small_world, small_labels, "out"))}[name]
    first = spawn(command, tmp_path)
    try:
        wait_for(lambda: list((tmp_path / "out").rglob("made-from.json")) or first.poll() is not None)
        if name == "training":  # which holds its folder while it trains
            wait_for(lambda: (tmp_path / "out" / "state.npz").is_file())
        os.killpg(first.pid, signal.SIGSTOP)  # so that it is at work for as long as the second one is
        with ledger("faults", f"two runs on one folder: {name}"):
            assert first.poll() is None, "it ended before a second one could begin"
            clear(run(command, tmp_path), "out", "another run is at work there; wait", left=["out/log.txt"])
            os.killpg(first.pid, signal.SIGCONT)
            result = finish(first)
            lost_unless(result.returncode == 0, f"the first did not end well: {result.stderr}")
            nothing_stray(tmp_path)
    finally:
        kill(first)


def thesis(*words):
    return [sys.executable, "-m", "thesis_repro", *words]


def wait_for(condition, seconds=120):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"waited {seconds} s"
        time.sleep(0.01)


def test_a_killed_run_holds_no_folder(ledger, tmp_path, small_world, small_labels):
    command = thesis(*study(small_world, small_labels, "out", "--jobs", 2))
    with ledger("faults", "a run on the folder of a killed one"):
        process = spawn(command, tmp_path)
        wait_for(lambda: list((tmp_path / "out").rglob("made-from.json")))
        os.kill(process.pid, signal.SIGKILL)  # it alone: the processes that it started may outlive it for a moment
        result = run(command, tmp_path)
        lost_unless(result.returncode == 0, f"{result.stdout}\n{result.stderr}")
        kill(process)


# Workers and schedulers that vanish


def children(process):
    listed = subprocess.run(["ps", "--ppid", str(process.pid), "-o", "pid=,args="], capture_output=True, text=True)
    return [int(line.split()[0]) for line in listed.stdout.splitlines()]


@pytest.mark.parametrize("name", ["synthesize", "study"])
def test_a_process_that_dies(ledger, tmp_path, small_world, small_labels, name):
    """As the system ends one where memory runs out."""
    command = {"synthesize": thesis("synthesize", "out", "--profile", "smoke"),
               "study": thesis(*study(small_world, small_labels, "out", "--jobs", 2))}[name]
    with ledger("faults", f"a process of {name} is killed"):
        process = spawn(command, tmp_path)
        wait_for(lambda: process.poll() is not None or "popen_loky" in str(workers(process)))
        time.sleep(0.5)
        victims = [pid for pid, arguments in workers(process).items() if "popen_loky" in arguments]
        assert victims and process.poll() is None, "it ended before one could be killed"
        os.kill(victims[0], signal.SIGKILL)
        result = finish(process)
        clear(result, "a process was killed", "memory", "start again")
        assert run(command, tmp_path).returncode == 0
        nothing_stray(tmp_path)
        if name == "synthesize":
            same(contents(tmp_path / "out"), contents(small_world))


def workers(process):
    """Processes that a process started, {number: command line}."""
    found = {}
    for pid in children(process):
        try:
            found[pid] = Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
        except OSError:
            pass
    return found


def dask():
    """The module of the tests on Dask, for its scheduler and workers."""
    sys.path.insert(0, str(HERE.parent / "study"))
    import test_dask

    return test_dask


@pytest.fixture
def cluster(tmp_path):
    """A scheduler with two slow workers: (its address, its process, {number: process} of the workers)."""
    test_dask, folder = dask(), tmp_path / "cluster"
    folder.mkdir()
    (folder / "slow.py").write_text(test_dask.PRELOAD.format(checkpoint=4, log=str(folder / "frames.log")))
    file = folder / "scheduler.json"
    scheduler = test_dask.start(folder, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
                                "--dashboard-address", "127.0.0.1:0", "--scheduler-file", file)
    started = [scheduler]
    try:
        wait_for(lambda: file.is_file() and file.read_text().strip().endswith("}"))
        address = json.loads(file.read_text())["address"]
        started += [test_dask.start(folder, "worker", address, "--no-nanny", "--nthreads", 1, "--no-dashboard",
                                    "--host", "127.0.0.1", "--preload", folder / "slow.py", "--local-directory",
                                    folder / "scratch") for _ in range(2)]
        from dask.distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
        yield address, scheduler, {process.pid: process for process in started[1:]}, folder / "frames.log"
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_a_worker_of_a_cluster_dies(ledger, cluster, tmp_path, small_world, small_labels):
    address, _, workers_of, log = cluster
    with ledger("faults", "a Dask worker is killed"):
        process = spawn(thesis(*study(small_world, small_labels, "out", "--dask", address)), tmp_path)
        wait_for(lambda: process.poll() is not None or log.is_file() and log.read_text().count("\n") > 8)
        next(iter(workers_of.values())).kill()
        result = finish(process)
        lost_unless(result.returncode == 0, f"{result.stdout}\n{result.stderr}")
        assert run(thesis(*study(small_world, small_labels, "whole")), tmp_path).returncode == 0
        same(contents(tmp_path / "out"), contents(tmp_path / "whole"))


def test_all_workers_or_the_scheduler_of_a_cluster_vanish(ledger, cluster, tmp_path, small_world, small_labels):
    address, scheduler, _, log = cluster
    words = study(small_world, small_labels, "out")
    with ledger("faults", "the Dask scheduler vanishes"):
        process = spawn(thesis(*words, "--dask", address), tmp_path)
        wait_for(lambda: process.poll() is not None or log.is_file() and log.read_text().count("\n") > 8)
        scheduler.kill()
        clear(finish(process), f"Dask scheduler {address}", "start it again")
        assert run(thesis(*words), tmp_path).returncode == 0
        assert run(thesis(*study(small_world, small_labels, "whole")), tmp_path).returncode == 0
        same(contents(tmp_path / "out"), contents(tmp_path / "whole"))
        nothing_stray(tmp_path)


# A clock that jumps


def date_all(folder, year):
    """Give all that lies below a folder one date."""
    when = time.mktime((year, 6, 1, 12, 0, 0, 0, 0, 0))
    for path in [folder, *Path(folder).rglob("*")]:
        os.utime(path, (when, when))


@pytest.mark.parametrize("year", [1990, 2037])
def test_dates_of_files_decide_nothing(ledger, command, tmp_path, small_world, small_labels, year):
    labels = tmp_path / "labels"
    shutil.copytree(small_labels, labels)
    words = ["study", "--kitti", small_world / "kitti", "--sequences", "00", "--labels", labels, "--widths", 5,
             "--repetitions", 1, "--output"]
    with ledger("faults", f"a clock in the year {year}"):
        assert command(*words, "out").returncode == 0
        date_all(tmp_path / "out", year)
        done = contents(tmp_path / "out")
        result = command(*words, "out")
        assert result.returncode == 0 and "of them from before" in result.stdout, "done again for its date"
        same(contents(tmp_path / "out"), done)
        for path in (labels / "00").glob("*.png"):  # other label maps, of a date on the wrong side
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(path), np.where(image == 7, 11, image))
        date_all(labels, 2037 if year == 1990 else 1990)
        result = command(*words, "out")
        assert result.returncode == 0 and command(*words, "whole").returncode == 0
        same(contents(tmp_path / "out"), contents(tmp_path / "whole"))


# Memory that runs short


@pytest.mark.parametrize("name, megabytes", [
    pytest.param("odometry", 300, marks=pytest.mark.short), ("masks", 600), ("predict", 1500),
    ("predict", 3080), ("synthesize", 700), ("study", 500)])
def test_too_little_memory_for_the_libraries(ledger, command, small_world, small_labels, name, megabytes):
    kitti = small_world / "kitti"
    words = {"odometry": ["odometry", "--kitti", kitti, "--sequence", "00"],
             "masks": ["masks", "--kitti", kitti, "--sequence", "00", "--labels", small_labels / "00", "--dilation", 5,
                       "--output", "out"],
             "predict": ["predict", "--images", kitti / "sequences" / "00", "--output", "out"],
             "synthesize": ["synthesize", "out", "--profile", "smoke"],
             "study": study(small_world, small_labels, "out", "--jobs", 2)}[name]
    with ledger("faults", f"{name} with {megabytes} MB of address space"):
        clear(command(*words, before=lambda: allow(megabytes)), "memory", left=["out", "out/*"])


def allow(megabytes):
    resource.setrlimit(resource.RLIMIT_AS, (megabytes * 2**20,) * 2)


@pytest.mark.parametrize("name", ["odometry", "masks", "study"])
def test_too_little_memory_for_the_work(ledger, command, tmp_path, name):
    """Frames of 121 megapixels, in files of some kilobytes."""
    images, labels = tmp_path / "kitti" / "sequences" / "00" / "image_0", tmp_path / "labels" / "00"
    for folder in (images, labels):
        folder.mkdir(parents=True)
        for index in range(3):
            shape = (11_000, 11_000) if folder == images else (64, 64)
            cv2.imwrite(str(folder / f"{index:06d}.png"), np.full(shape, 7, np.uint8))
    (images.parent / "calib.txt").write_text("P0: 700 0 5500 0 0 700 5500 0 0 0 1 0\n")
    (images.parent / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (tmp_path / "kitti" / "poses").mkdir()
    (tmp_path / "kitti" / "poses" / "00.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {n}\n" for n in range(3)))
    where = ["--kitti", "kitti", "--sequence", "00", "--labels", "labels/00", "--dilation", 5]
    words = {"odometry": ["odometry", *where], "masks": ["masks", *where, "--output", "out"],
             "study": study(tmp_path, tmp_path / "labels", "out", "--jobs", 1)}[name]
    with ledger("faults", f"{name} of large frames with 1100 MB of address space"):
        clear(command(*words, before=lambda: allow(1100)), "memory ran out", left=["out", "out/*"])
        nothing_stray(tmp_path)
