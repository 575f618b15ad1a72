"""Run independent calls in processes of this machine or on the workers of a Dask cluster.

Joblib's Dask backend stops all calls as soon as one is lost. So this module uses Dask's futures: if
a call is lost, the pool yields the reason, a string, as its result and continues.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError

from thesis_repro.errors import InputError
from thesis_repro.running import messages
from thesis_repro.running.settings import scheduler_address

TIMEOUT = 8  # seconds that a scheduler has to answer

Calls = Sequence[tuple]
Results = Iterator[tuple[int, Any]]


class Pool(NamedTuple):
    """Something that makes calls at the same time.

    `run(function, calls)` yields (index of the call, result) in the order in which the calls end.
    """

    size: int  # number of calls that run at the same time
    run: Callable


@contextmanager
def open_pool(processes: int, scheduler: str | None = None) -> Iterator[Pool]:
    """Open a pool on a Dask scheduler or, without one, on processes of this machine.

    processes: their number. scheduler: its address, "tcp://host:8786".
    Raises InputError if the scheduler does not answer or has no workers.
    """
    if scheduler_address(scheduler) is None:
        yield Pool(processes, partial(_here, processes))
        return
    from dask.distributed import Client  # imported here because it takes a second

    # hide warnings about workers that come and go
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, ValueError, ImportError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise InputError(
            f"Dask scheduler {scheduler}: does not answer ({reason}); start one with 'dask scheduler' "
            "and give the address that it prints, tcp://host:port"
        ) from None
    with client:
        if not client.nthreads():
            raise InputError(
                f"Dask scheduler {scheduler}: has no workers; start some with "
                f"'dask worker {scheduler} --nthreads 1'"
            )
        yield Pool(sum(client.nthreads().values()), partial(_on_workers, client))


def _here(size: int, function: Callable, calls: Calls) -> Results:
    parallel = joblib.Parallel(
        n_jobs=size,
        return_as="generator_unordered",
        initializer=_start_process,
        initargs=(messages.prints_messages(),),
    )
    numbered = joblib.delayed(_numbered)
    work = (numbered(index, function, call) for index, call in enumerate(calls))
    try:
        yield from parallel(work)
    except TerminatedWorkerError:
        raise InputError(messages.WORKER_KILLED) from None


def _start_process(prints_messages: bool) -> None:
    messages.leave_ctrl_c_to_parent()
    if prints_messages:
        messages.print_messages()


def _numbered(index: int, function: Callable, call: tuple) -> tuple[int, Any]:
    return index, function(*call)


def _on_workers(client: Any, function: Callable, calls: Calls) -> Results:
    """Yield the results of a cluster.

    If a worker dies, Dask restarts its call on another worker, up to three times.
    """
    from dask.distributed import as_completed

    indices = {}
    for index, call in enumerate(calls):
        future = client.submit(function, *call, pure=False)
        indices[future] = index
    for future in as_completed(list(indices), loop=client.loop):
        if client.status != "running" and future.status != "finished":
            raise InputError(
                f"Dask scheduler {client.scheduler.address}: no longer answers; finished runs are kept; "
                "start it again, then repeat the command"
            )
        yield indices[future], _result_or_reason(future)


def _result_or_reason(future: Any) -> Any:
    """Return the result of a future that ended, or the reason, one line, why it has none."""
    if future.status == "finished":
        return future.result()
    if future.status == "error":
        return str(future.exception()).splitlines()[0]
    return f"the cluster reports: {future.status}"
