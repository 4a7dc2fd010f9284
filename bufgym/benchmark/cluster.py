"""Parallel execution through joblib: processes or threads of this machine, or a Ray or Dask cluster."""

import itertools
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym.utils.processes import end_with

BACKENDS = ("loky", "threading", "sequential", "ray", "dask")


class WorkerDiedError(BufgymError):
    """A worker process died during its work: killed, out of memory, or crashed in compiled code."""


def check(jobs: int, backend: str) -> None:
    """Raise an error for processes or a backend that there cannot be."""
    if jobs < -1 or jobs == 0:
        raise BufgymError(f"jobs = {jobs}: must be a whole number >= 1, or -1 for one a core")
    if backend not in BACKENDS:
        raise BufgymError(f"backend = {backend!r}: must be one of {', '.join(BACKENDS)}")


def spread(
    calls: Iterable[tuple[Any, tuple[Any, ...]]], count: int, jobs: int, backend: str, address: str | None
) -> Iterator[Any]:
    """Run these (function, arguments), at most ``count``; yield the results as they become ready.

    ``address`` names the head of the Ray or Dask cluster, by default that of the environment variable RAY_ADDRESS or
    DASK_SCHEDULER_ADDRESS; None in both starts and ends a cluster on this machine.

    Raises WorkerDiedError: results that other workers had not returned by then are lost.
    """
    from concurrent.futures.process import BrokenProcessPool  # with processes come queues, pickles and logs

    joblib = library("joblib", "bench")
    wrapped = (joblib.delayed(function)(*arguments) for function, arguments in calls)
    # Worker processes end with this process, even before they have work. They never end by themselves, because loky
    # loses work that reaches a worker at that moment.
    own: dict[str, Any] = {"initializer": end_with, "initargs": (os.getpid(),), "idle_worker_timeout": 10**6}
    own = own if backend == "loky" else {}
    with _connected(backend, address):
        # joblib's Ray backend returns results only when all are there, so it gets a few calls at a time.
        ray = backend == "ray"
        at_once = 4 * joblib.effective_n_jobs(jobs) if ray else count
        for _ in range(0, count, at_once):
            some = itertools.islice(wrapped, at_once)
            try:
                form = "list" if ray else "generator_unordered"
                yield from joblib.Parallel(n_jobs=jobs, return_as=form, **own)(some)
            except BrokenProcessPool:
                raise WorkerDiedError(
                    "a worker process ended before its work did (killed, or out of memory?)"
                ) from None


@contextmanager
def _connected(backend: str, address: str | None) -> Iterator[None]:
    joblib = library("joblib", "bench")
    with nullcontext() if backend != "dask" else dask_client(address):
        if backend == "ray":
            connected_ray(address)
            library("ray.util.joblib", "ray").register_ray()
        with joblib.parallel_config(backend=backend):
            yield


def dask_client(address: str | None) -> Any:
    distributed = library("distributed", "dask")
    address = address or library("dask", "dask").config.get("scheduler-address", None)
    if address is not None:
        return distributed.Client(address)
    return distributed.Client(processes=True, threads_per_worker=1, dashboard_address=None)


def connected_ray(address: str | None) -> tuple[Any, bool]:
    """Connect the module ``ray``; also return whether it was unconnected before."""
    ray = library("ray", "ray")
    if own := not ray.is_initialized():
        ray.init(address=address, log_to_driver=False)
    return ray, own
