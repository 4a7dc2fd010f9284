"""Parallel execution through joblib: processes or threads of this machine, or a Ray or Dask cluster.

Long work such as training calls a cluster directly through ``begun`` and ``connected``. joblib's Ray backend makes new
processes at every call, and processes of several programs may wait for one another for ever.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from typing import Any

from bufgym.ground.errors import BufgymError, install
from bufgym.ground.processes import end_with

BACKENDS = ("loky", "threading", "sequential", "ray", "dask")


class WorkerDiedError(BufgymError):
    """A worker process died during its work: killed, out of memory, or crashed in compiled code."""


def spread(
    calls: Iterable[tuple[Any, tuple[Any, ...]]], count: int, jobs: int, backend: str, address: str | None
) -> Iterator[Any]:
    """Run these (function, arguments), at most ``count``; yield the results as they become ready.

    ``address`` names the head of the Ray or Dask cluster; None starts and ends a cluster on this machine.

    Raises WorkerDiedError: results that other workers had not returned by then are lost.
    """
    joblib = _imported("joblib", "bench")
    wrapped = (joblib.delayed(function)(*arguments) for function, arguments in calls)
    with _connected(backend, address):
        # joblib's Ray backend returns results only when all are there, so it gets a few calls at a time.
        ray = backend == "ray"
        at_once = 4 * joblib.effective_n_jobs(jobs) if ray else count
        for _ in range(0, count, at_once):
            some = itertools.islice(wrapped, at_once)
            try:
                yield from joblib.Parallel(
                    n_jobs=jobs, return_as="list" if ray else "generator_unordered", **_own(backend)
                )(some)
            except BrokenProcessPool:
                raise WorkerDiedError(
                    "a worker process ended before its work did (killed, or out of memory?)"
                ) from None


def _own(backend: str) -> dict[str, Any]:
    """Settings of joblib's worker processes: they end with this process, even before they have work. They never end by
    themselves, because loky loses work that reaches a worker at that moment."""
    if backend != "loky":
        return {}
    return {"initializer": end_with, "initargs": (os.getpid(),), "idle_worker_timeout": 10**6}


@contextmanager
def _connected(backend: str, address: str | None) -> Iterator[None]:
    """Connect joblib's backend of that name."""
    joblib = _imported("joblib", "bench")
    with nullcontext() if backend != "dask" else _dask_client(address):
        if backend == "ray":
            _ray(address)
            _imported("ray.util.joblib", "ray").register_ray()
        with joblib.parallel_config(backend=backend):
            yield


def _dask_client(address: str | None) -> Any:
    distributed = _imported("distributed", "dask")
    if address is not None:
        return distributed.Client(address)
    return distributed.Client(processes=True, threads_per_worker=1, dashboard_address=None)


Call = Callable[..., Any]
CallEach = Callable[[Call, Sequence[tuple[Any, ...]]], list[Any]]
"""(function, arguments of each call) -> results in the order of the calls."""


@contextmanager
def begun(backend: str, address: str | None) -> Iterator[str]:
    """Yield the address of a ``ray`` or ``dask`` cluster; without one, run a cluster on this machine meanwhile.

    Raises BufgymError: the library is missing, or nothing answers at the address.
    """
    with _client(backend, address) as client:
        yield client.scheduler.address if backend == "dask" else client.get_runtime_context().gcs_address


@contextmanager
def connected(backend: str, address: str | None) -> Iterator[CallEach]:
    """Yield a caller that runs functions on a ``ray`` or ``dask`` cluster, where they must be importable.

    A Ray task, or a Dask worker with one thread, has a process to itself, which keeps the function's caches.

    Raises BufgymError as ``begun`` does. The calls raise WorkerDiedError.
    """
    with _client(backend, address) as client:
        if backend == "dask":
            died: tuple[type[Exception], ...] = (_imported("distributed", "dask").KilledWorker,)

            def call_each(function: Call, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
                # Not pure, so that equal arguments are called again.
                futures = [client.submit(function, *own, pure=False) for own in arguments]
                return list(client.gather(futures))

        else:
            errors = client.exceptions
            died = (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError)
            remote_of = functools.cache(client.remote)  # a new one would be sent to the cluster again

            def call_each(function: Call, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
                return list(client.get([remote_of(function).remote(*own) for own in arguments]))

        def each(function: Call, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
            try:
                return call_each(function, arguments)
            except died:
                raise WorkerDiedError(f"{backend}: workers ended before their work did (out of memory?)") from None

        yield each


@contextmanager
def _client(backend: str, address: str | None) -> Iterator[Any]:
    """Yield Dask's client, or the connected module ``ray``."""
    try:
        client, own = (_dask_client(address), True) if backend == "dask" else _ray(address)
    except OSError as error:  # includes Ray's ConnectionError
        raise BufgymError(f"{backend}: no cluster at {address}: {' '.join(str(error).split())}") from None
    try:
        yield client
    finally:
        if own:
            (client.close if backend == "dask" else client.shutdown)()


def _ray(address: str | None) -> tuple[Any, bool]:
    """Connect the module ``ray``; also return whether it was unconnected before."""
    ray = _imported("ray", "ray")
    if own := not ray.is_initialized():
        ray.init(address=address, log_to_driver=False)
    return ray, own


def _imported(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise BufgymError(f"{module} is missing: {install(extra)}") from None
