"""Where calls run that do not depend on each other: in processes of this machine, or on the workers of a Dask cluster.

A pool has a `size`, how many calls can run at once, and `run(function, calls)`, which yields (index of the call, what
it returned) in the order in which they end. Of a call whose worker died for good it yields the reason, a string.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from thesis_repro import InputError, longrun
from thesis_repro.settings import scheduler_address

TIMEOUT = 8  # seconds for a scheduler to answer


class Pool(Protocol):
    size: int

    def run(self, function: Callable, calls: Sequence[tuple]) -> Iterator[tuple[int, Any]]: ...


@contextmanager
def open_pool(processes: int, scheduler: str | None = None) -> Iterator[Pool]:
    """The pool of a Dask scheduler ("tcp://host:8786"), or `processes` processes of this machine where it is None."""
    if scheduler_address(scheduler) is None:
        yield _Processes(processes)
        return
    from dask.distributed import Client  # takes a second

    # what the client would say about connections and workers that come and go
    for name in ("distributed", "distributed.client"):  # Dask gives each a level of its own
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        reason = str(error).strip().splitlines()
        raise InputError(f"Dask scheduler {scheduler}: none answers there "
                         f"({reason[0] if reason else type(error).__name__}); start one with 'dask scheduler' and give "
                         "the address that it prints, tcp://host:port") from None
    with client:
        if not client.nthreads():
            raise InputError(f"Dask scheduler {scheduler}: has no workers; start some with "
                             f"'dask worker {scheduler} --nthreads 1'")
        yield _Workers(client, str(scheduler))


class _Processes:
    def __init__(self, processes: int) -> None:
        self.size = processes

    def run(self, function: Callable, calls: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
        work = joblib.Parallel(n_jobs=self.size, return_as="generator_unordered")(
            joblib.delayed(_numbered)(index, function, call) for index, call in enumerate(calls))
        try:
            yield from work
        except TerminatedWorkerError:
            raise InputError(longrun.WORKER_KILLED) from None


def _numbered(index: int, function: Callable, call: tuple) -> tuple[int, Any]:
    return index, function(*call)


class _Workers:
    def __init__(self, client: Any, scheduler: str) -> None:
        self.client, self.scheduler = client, scheduler
        self.size = sum(client.nthreads().values())

    def run(self, function: Callable, calls: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
        """A call whose worker dies is started again on another one, by Dask, up to three times."""
        from dask.distributed import as_completed

        index = {self.client.submit(function, *call, pure=False): number for number, call in enumerate(calls)}
        for future in as_completed(list(index), loop=self.client.loop):
            if future.status == "finished":
                yield index[future], future.result()
            elif self.client.status != "running":
                raise InputError(f"Dask scheduler {self.scheduler}: answers no more; what was finished is kept, so "
                                 "start it again, and then the same command")
            else:
                error = future.exception() if future.status == "error" else None
                yield index[future], str(error or f"the cluster says: {future.status}").splitlines()[0]
