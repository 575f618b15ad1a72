"""Runs on a real Dask cluster on this machine: a scheduler and two workers, each a process."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pandas as pd
import pytest
from trials import ROOT, wait_for

from keypoint_study import runner
from keypoint_study.jobs import first_jobs, runs_of
from keypoint_study.sources import Source
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.running import workers

pytestmark = pytest.mark.slow

LOCAL = ("--host", "127.0.0.1", "--no-dashboard")


def start(folder, *arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "dask", *map(str, arguments), *LOCAL]
    with open(folder / "dask.log", "a") as log:
        return subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=environment)


@contextmanager
def started_scheduler(folder):
    """(its process, its address) of a scheduler."""
    file = folder / "scheduler.json"
    places = ("--port", "0", "--dashboard-address", "127.0.0.1:0", "--scheduler-file", file)
    process = start(folder, "scheduler", *places)
    try:
        wait_for(lambda: file.is_file() and file.read_text().strip().endswith("}"))
        yield process, pd.read_json(file, typ="series")["address"]
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a scheduler; it has no workers but those of `two_workers`."""
    with started_scheduler(tmp_path_factory.mktemp("scheduler")) as (_, address):
        yield address


@contextmanager
def started_workers(folder, address, count):
    options = ("--no-nanny", "--nthreads", 1, "--local-directory", folder / "scratch")
    processes = [start(folder, "worker", address, *options) for _ in range(count)]
    from dask.distributed import Client

    try:
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=120)
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_an_unusable_scheduler_is_one_line(scheduler, monkeypatch):
    monkeypatch.setattr(workers, "TIMEOUT", 1)
    # without workers, none, no address
    for address in (scheduler, "tcp://127.0.0.1:9", "nonsense://127.0.0.1:9"):
        with pytest.raises(InputError, match=address) as error, workers.open_pool(1, address):
            pass
        assert "\n" not in str(error.value)


@pytest.mark.torture
def test_a_cluster_gives_the_same_bits_although_a_worker_is_killed(
    small_world, small_labels, scheduler, tmp_path
):
    opened = [Sequence(small_world / "kitti", name) for name in ("00", "01")]
    jobs = first_jobs(opened, {"thesis": (5,)}, repetitions=2)
    runs = runs_of(jobs, opened, [Source(small_labels)])
    here = runner.run_all(runs, tmp_path / "here")
    there = tmp_path / "there"

    def kill(worker):
        wait_for(lambda: list(there.rglob("[!.]*.csv")))
        worker.kill()

    with started_workers(tmp_path, scheduler, 2) as processes:
        killer = threading.Thread(target=kill, args=processes[:1])
        killer.start()
        result = runner.run_all(runs, there, scheduler=scheduler)
        killer.join()
    pd.testing.assert_frame_equal(result.table, here.table, check_exact=True)


@pytest.mark.torture
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_scheduler_that_ends_or_hangs_is_named(tmp_path, monkeypatch, capfd, number):
    monkeypatch.setattr(workers, "TIMEOUT", 3)
    with (
        started_scheduler(tmp_path) as (process, address),
        started_workers(tmp_path, address, 1),
        pytest.raises(InputError, match=f"{address}: no longer answers"),
        workers.open_pool(1, address) as pool,
    ):
        threading.Timer(2, process.send_signal, [number]).start()
        list(pool.run(time.sleep, [(60,)]))
    assert "Traceback" not in capfd.readouterr().err
