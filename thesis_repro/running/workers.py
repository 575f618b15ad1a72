"""Run independent calls in processes of this machine or on the workers of a Dask cluster.

Both are executors of `concurrent.futures`. (Joblib's own backend for Dask waits forever for a call
whose workers died.)
"""

import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from threading import RLock
from typing import Any, NamedTuple

from joblib.externals.loky import ProcessPoolExecutor
from tqdm import tqdm

from thesis_repro.errors import InputError
from thesis_repro.running import program

TIMEOUT = 8  # seconds that a scheduler has to answer
# Workers share the cores, so a library in one of them uses one thread, as joblib has it.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
LOST = "a worker process was lost; finished results are kept; repeat the command"


class Pool(NamedTuple):
    """Workers. size: number of calls that run at the same time. executor: None for this process.

    check: raises InputError if the workers can no longer be reached; called every TIMEOUT seconds.
    """

    size: int
    executor: Executor | None = None
    check: Callable | None = None

    def run(self, function: Callable, calls: Iterable[tuple]) -> Iterator[Any]:
        """Yield the results of calls, which are tuples of arguments, in their order."""
        if self.executor is None:
            for call in calls:
                program.check_stop()
                yield function(*call)
            return
        with program.starting_workers():
            futures = [self.executor.submit(function, *call) for call in calls]
        for future in futures:
            program.check_stop()
            while self.check:
                if wait([future], TIMEOUT).done:
                    break
                self.check()
            yield future.result()


def _begin() -> None:
    """Prepare a worker process."""
    program.leave_ctrl_c_to_parent()
    program.keep_freed_memory()
    tqdm.set_lock(RLock())  # its own is a semaphore of the system, which an ended worker leaves


def open_pool(processes: int, scheduler: str | None = None) -> AbstractContextManager[Pool]:
    """Open a pool on a Dask scheduler or, without one, on processes of this machine.

    processes: their number; one is this process. scheduler: its address, "tcp://host:8786".
    Raises InputError if the scheduler does not answer or has no workers, or if a worker is lost.
    """
    return _here(processes) if scheduler is None else _on_cluster(scheduler)


@contextmanager
def _here(processes: int) -> Iterator[Pool]:
    executor = _processes(processes) if processes > 1 else None
    if executor is None:
        yield Pool(1)
        return
    try:
        yield Pool(processes, executor)
    except BrokenExecutor:
        raise InputError(LOST) from None
    finally:
        executor.shutdown(kill_workers=True)


def _processes(number: int) -> ProcessPoolExecutor | None:
    """Start processes of this machine; None, with a warning, if the system has no semaphores."""
    try:
        with program.unstopped():  # not joblib's shared executor, which callers may use, too
            return ProcessPoolExecutor(number, initializer=_begin, env=ONE_THREAD)
    except OSError as error:  # they lie in /dev/shm, which a container may lack
        program.log.warning(
            f"/dev/shm: {error.strerror}, so one process does all; --jobs 1 asks for one"
        )
        return None


@contextmanager
def _on_cluster(scheduler: str) -> Iterator[Pool]:
    from dask.distributed import Client, KilledWorker  # imported here because it takes a second

    for name in ("distributed", "distributed.client"):  # workers and the scheduler may come and go
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        raise InputError(
            f"Dask scheduler {scheduler}: does not answer ({type(error).__name__}); start one with "
            "'dask scheduler' and give the address that it prints, tcp://host:port"
        ) from None

    def check() -> None:
        try:
            client.sync(client.scheduler.identity, callback_timeout=TIMEOUT)
        except (OSError, TimeoutError):
            raise InputError(
                f"Dask scheduler {scheduler}: no longer answers; finished results are kept; start it "
                "again, with workers, and repeat the command"
            ) from None

    try:
        size = sum(client.nthreads().values())
        if not size:
            raise InputError(
                f"Dask scheduler {scheduler}: has no workers; start some with "
                f"'dask worker {scheduler} --nthreads 1'"
            )
        yield Pool(size, client.get_executor(pure=False), check)
    except (KilledWorker, CancelledError):
        check()
        raise InputError(LOST) from None
    finally:
        with suppress(RuntimeError, OSError, TimeoutError):  # now and then, if its scheduler ended
            client.close()
