"""Where independent calls run: in processes of this machine, or on the workers of a Dask cluster.

A pool has a `size`, how many calls run at once, and `run(function, calls)`, which yields (index of the call, what it
returned) in the order in which they end. Joblib's Dask backend ends all calls with the first that is lost. So the
futures are Dask's own here: of a call whose worker died for good the pool yields the reason, a string, and goes on.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from thesis_repro import InputError, longrun
from thesis_repro.settings import scheduler_address

TIMEOUT = 8  # seconds for a scheduler to answer


@contextmanager
def open_pool(processes: int, scheduler: str | None = None) -> Iterator["Processes | Workers"]:
    """The pool of a Dask scheduler ("tcp://host:8786"), or `processes` processes of this machine where it is None.

    Raises InputError where no scheduler answers, and where it has no workers.
    """
    if scheduler_address(scheduler) is None:
        yield Processes(processes)
        return
    from dask.distributed import Client  # takes a second

    for name in ("distributed", "distributed.client"):  # their warnings of workers that come and go
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(f"Dask scheduler {scheduler}: none answers there ({reason}); start one with 'dask scheduler' "
                         "and give the address that it prints, tcp://host:port") from None
    with client:
        if not client.nthreads():
            raise InputError(f"Dask scheduler {scheduler}: has no workers; start some with "
                             f"'dask worker {scheduler} --nthreads 1'")
        yield Workers(client, str(scheduler))


class Processes:
    def __init__(self, size: int) -> None:
        self.size = size

    def run(self, function: Callable, calls: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
        work = joblib.Parallel(n_jobs=self.size, return_as="generator_unordered")(
            joblib.delayed(_numbered)(index, function, call) for index, call in enumerate(calls))
        try:
            yield from work
        except TerminatedWorkerError:
            raise InputError(longrun.WORKER_KILLED) from None


def _numbered(index: int, function: Callable, call: tuple) -> tuple[int, Any]:
    return index, function(*call)


class Workers:
    def __init__(self, client: Any, scheduler: str) -> None:
        self.client, self.scheduler = client, scheduler
        self.size = sum(client.nthreads().values())

    def run(self, function: Callable, calls: Sequence[tuple]) -> Iterator[tuple[int, Any]]:
        """Dask starts a call whose worker dies on another one, up to three times."""
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
