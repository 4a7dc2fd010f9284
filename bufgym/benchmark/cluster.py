"""Where a benchmark runs: processes or threads of this machine, or a Ray or Dask cluster, all through joblib.

What works with a cluster for hours, as training does, calls it directly (``begun``, ``connected``): joblib's Ray
backend makes new processes at every call, and those of several programs may wait for one another for ever.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from typing import Any

from bufgym.errors import BufgymError, install

BACKENDS = ("loky", "threading", "sequential", "ray", "dask")


PATIENCE_S = 1.0
"""How often a worker looks whether the process that began it is still there."""


@functools.cache
def end_with(parent: int) -> None:
    """From now on this process ends soon after ``parent`` (a process number), which began it, has ended.

    A parent that is killed takes none of its workers along: they would hold its pipes and files for ever. It may be
    gone already when a worker comes this far.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PATIENCE_S)
    os._exit(1)


class WorkerDiedError(BufgymError):
    """A worker process ended in the middle of its work: killed, out of memory, or crashed by compiled code."""


def spread(
    calls: Iterable[tuple[Any, tuple[Any, ...]]], count: int, jobs: int, backend: str, address: str | None
) -> Iterator[Any]:
    """The results of these (function, arguments), ``count`` at most, in the order in which they become ready.

    ``address``: of the head of the Ray or Dask cluster; None: one on this machine, begun and ended here.

    Raises WorkerDiedError: what other workers had not handed over by then is lost.
    """
    joblib = _imported("joblib", "bench")
    wrapped = (joblib.delayed(function)(*arguments) for function, arguments in calls)
    with _connected(backend, address):
        # joblib's Ray backend hands results over only when all are there: a few at a time.
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
    """What joblib's own worker processes are told: to end with this one, also before they have work, and not by
    themselves, as loky loses work that comes to one at that moment."""
    if backend != "loky":
        return {}
    return {"initializer": end_with, "initargs": (os.getpid(),), "idle_worker_timeout": 10**6}


@contextmanager
def _connected(backend: str, address: str | None) -> Iterator[None]:
    """joblib's backend of that name, connected."""
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
"""(function, arguments of each call) -> the results, in the order of the calls."""


@contextmanager
def begun(backend: str, address: str | None) -> Iterator[str]:
    """The address of a ``ray`` or ``dask`` cluster: that one, or of one on this machine, which ends here.

    Raises BufgymError: the library is missing, or nothing answers at the address.
    """
    with _client(backend, address) as client:
        yield client.scheduler.address if backend == "dask" else client.get_runtime_context().gcs_address


@contextmanager
def connected(backend: str, address: str | None) -> Iterator[CallEach]:
    """What calls a function on a ``ray`` or ``dask`` cluster, as often as wished. It must be importable there.

    A Ray task and a Dask worker with one thread have a process to themselves, which keeps what the function caches.

    Raises BufgymError: as ``begun``; the calls raise WorkerDiedError.
    """
    with _client(backend, address) as client:
        if backend == "dask":
            died: tuple[type[Exception], ...] = (_imported("distributed", "dask").KilledWorker,)

            def call_each(function: Call, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
                # Not pure: a call with the same arguments is a call of its own.
                futures = [client.submit(function, *own, pure=False) for own in arguments]
                return list(client.gather(futures))

        else:
            errors = client.exceptions
            died = (errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError)
            remote_of = functools.cache(client.remote)  # each one made is sent to the cluster again

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
    """Dask's client, or the module ``ray`` while it is connected."""
    try:
        client, own = (_dask_client(address), True) if backend == "dask" else _ray(address)
    except OSError as error:  # Ray's ConnectionError is one, too
        raise BufgymError(f"{backend}: no cluster at {address}: {' '.join(str(error).split())}") from None
    try:
        yield client
    finally:
        if own:
            (client.close if backend == "dask" else client.shutdown)()


def _ray(address: str | None) -> tuple[Any, bool]:
    """The module ``ray``, connected; whether it was not before."""
    ray = _imported("ray", "ray")
    if own := not ray.is_initialized():
        ray.init(address=address, log_to_driver=False)
    return ray, own


def _imported(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise BufgymError(f"{module} is missing: {install(extra)}") from None
