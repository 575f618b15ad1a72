"""Where independent calls run: in processes of this machine, or on the workers of a Dask cluster.

Joblib's Dask backend ends all calls with the first that is lost. So the futures are Dask's own here: of a call whose
worker died for good the pool yields the reason, a string, and goes on.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from thesis_repro import InputError, longrun
from thesis_repro.settings import scheduler_address

TIMEOUT = 8  # seconds for a scheduler to answer

Calls = Sequence[tuple]
Results = Iterator[tuple[int, Any]]


class Pool(NamedTuple):
    """`run` yields (index of the call, what the function returned) in the order in which the calls end."""

    size: int  # calls that run at once
    run: Callable


@contextmanager
def open_pool(processes: int, scheduler: str | None = None) -> Iterator[Pool]:
    """The pool of a Dask scheduler ("tcp://host:8786"), or `processes` processes of this machine where it is None.

    Raises InputError where no scheduler answers, and where it has no workers.
    """
    if scheduler_address(scheduler) is None:
        yield Pool(processes, partial(_here, processes))
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
        yield Pool(sum(client.nthreads().values()), partial(_on_workers, client))


def _here(size: int, function: Callable, calls: Calls) -> Results:
    work = joblib.Parallel(n_jobs=size, return_as="generator_unordered", initializer=longrun.end_with_parent)(
        joblib.delayed(_numbered)(index, function, call) for index, call in enumerate(calls))
    try:
        yield from work
    except TerminatedWorkerError:
        raise InputError(longrun.WORKER_KILLED) from None


def _numbered(index: int, function: Callable, call: tuple) -> tuple[int, Any]:
    return index, function(*call)


def _on_workers(client: Any, function: Callable, calls: Calls) -> Results:
    """Dask starts a call whose worker dies on another one, up to three times."""
    from dask.distributed import as_completed

    index = {client.submit(function, *call, pure=False): number for number, call in enumerate(calls)}
    for future in as_completed(list(index), loop=client.loop):
        if client.status != "running" and future.status != "finished":
            raise InputError(f"Dask scheduler {client.scheduler.address}: answers no more; what was finished is kept, "
                             "so start it again, and then the same command")
        error = future.exception() if future.status == "error" else f"the cluster says: {future.status}"
        yield index[future], future.result() if future.status == "finished" else str(error).splitlines()[0]
