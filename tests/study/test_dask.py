"""Runs on a real Dask cluster on this machine: a scheduler and two workers, each a process."""

import os
import signal
import subprocess
import sys
import threading
from collections import Counter

import pandas as pd
import pytest
from trials import ROOT, wait_for

from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.study import runner
from thesis_repro.study.jobs import first_jobs
from thesis_repro.study.sources import by_name
from thesis_repro.study.workers import open_pool

pytestmark = pytest.mark.slow

FRAMES, CHECKPOINT = 12, 4
# loaded by the workers: makes them slow enough to be killed in a pass, and logs the frames that
# they read
PRELOAD = """
import os, time
from thesis_repro.odometry import passes
from thesis_repro.data.kitti import Sequence

def slow(self, index, original=Sequence.frame):
    with open({log!r}, "a") as file:
        file.write(f"{{os.getpid()}} {{self.name}} {{index}}\\n")
    time.sleep(0.1)
    return original(self, index)

if passes.CHECKPOINT != {checkpoint}:  # Dask loads this more than once
    passes.CHECKPOINT = {checkpoint}
    Sequence.frame = slow
"""


def start(folder, *arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with open(folder / "dask.log", "a") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *map(str, arguments)],
            cwd=folder,
            stdout=log,
            stderr=log,
            env=environment,
        )


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a scheduler; it has no workers but those of `workers`."""
    folder = tmp_path_factory.mktemp("scheduler")
    file = folder / "scheduler.json"
    process = start(
        folder,
        "scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--dashboard-address",
        "127.0.0.1:0",
        "--scheduler-file",
        file,
    )
    try:
        wait_for(lambda: file.is_file() and file.read_text().strip().endswith("}"))
        yield pd.read_json(file, typ="series")["address"]
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def workers(scheduler, tmp_path):
    """({process number: process} of two workers, the file that logs the frames they read)."""
    log = tmp_path / "frames.log"
    log.touch()
    (tmp_path / "slow.py").write_text(PRELOAD.format(checkpoint=CHECKPOINT, log=str(log)))
    processes = [
        start(
            tmp_path,
            "worker",
            scheduler,
            "--no-nanny",
            "--nthreads",
            1,
            "--no-dashboard",
            "--host",
            "127.0.0.1",
            "--preload",
            tmp_path / "slow.py",
            "--local-directory",
            tmp_path / "scratch",
        )
        for _ in range(2)
    ]
    from dask.distributed import Client

    try:
        with Client(scheduler, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
        yield {process.pid: process for process in processes}, log
    finally:
        for process in processes:
            process.kill()
            process.wait()


def reads(log):
    return [
        (int(process), (name, int(index))) for process, name, index in map(str.split, log.open())
    ]


def test_an_unusable_scheduler_is_one_line(scheduler, monkeypatch):
    monkeypatch.setattr("thesis_repro.study.workers.TIMEOUT", 1)
    # without workers, none, no address
    for address in (scheduler, "tcp://127.0.0.1:9", "nonsense://127.0.0.1:9"):
        with pytest.raises(InputError, match=address) as error, open_pool(1, address):
            pass
        assert "\n" not in str(error.value)


def test_runs_of_a_killed_worker_resume(small_world, small_labels, workers, scheduler, tmp_path):
    opened = [Sequence(small_world / "kitti", name) for name in ("00", "01")]
    jobs = first_jobs(opened, {"thesis": (5, 15)}, repetitions=2)
    processes, log = workers
    here = runner.run_jobs(jobs, opened, small_labels, tmp_path / "here")
    there, killed, finished = tmp_path / "there", [], {}

    def kill():
        """Kill a worker within a pass that has a checkpoint, once other runs have finished."""

        def victims():
            last = dict(reads(log))  # the frame that each worker read last
            return [
                process
                for process, (_, index) in last.items()
                if index >= CHECKPOINT + 1 and index < FRAMES - 3
            ]

        wait_for(lambda: list(there.rglob("[!.]*.csv")) and victims())
        killed.extend(victims()[:1])
        os.kill(killed[0], signal.SIGKILL)
        processes[killed[0]].wait()
        finished.update({path: path.stat().st_mtime_ns for path in there.rglob("[!.]*.csv")})

    killer = threading.Thread(target=kill)
    killer.start()
    result = runner.run_jobs(jobs, opened, small_labels, there, scheduler=scheduler)
    killer.join()

    pd.testing.assert_frame_equal(result.table, here.table, check_exact=True)
    for job in jobs:
        one, two = (
            pd.read_csv(tmp_path / where / job.sequence / f"{job.name}.csv")
            for where in ("here", "there")
        )
        exact = [column for column in one if not column.endswith("_seconds")]
        pd.testing.assert_frame_equal(one[exact], two[exact], check_exact=True)
    # finished runs were kept, and the stopped pass resumed from its checkpoint
    assert 0 < len(finished) < len(jobs)
    assert finished == {path: path.stat().st_mtime_ns for path in finished}
    assert not list(there.rglob("pass-*"))
    name, stopped = [frame for process, frame in reads(log) if process == killed[0]][-1]
    times, passes = Counter(frame for _, frame in reads(log)), 2
    again = {frame for frame, count in times.items() if count > passes}
    assert again and again <= {(name, index) for index in range(CHECKPOINT, stopped + 1)}
    assert set(times.values()) == {passes, passes + 1} and len(times) == 2 * FRAMES


def test_a_worker_with_other_folders_or_other_code_is_reported(
    small_world, small_labels, tmp_path, monkeypatch
):
    opened = Sequence(small_world / "kitti", "00")
    jobs = first_jobs([opened], {"thesis": ()})
    runner.run_jobs(jobs, [opened], small_labels, tmp_path)
    record = runner.results.record(tmp_path / "00")
    inputs = opened, by_name(small_labels)
    elsewhere = runner._run_pass(jobs, *inputs, tmp_path / "elsewhere", record)
    (tmp_path / "00" / "baseline-0.csv").unlink()
    monkeypatch.setattr(runner, "_versions", lambda: {"code": "other", "opencv": "5"})
    older = runner._run_pass(jobs, *inputs, tmp_path, record)
    assert (
        elsewhere[jobs[0]] != older[jobs[0]] and not (tmp_path / "00" / "baseline-0.csv").exists()
    )
