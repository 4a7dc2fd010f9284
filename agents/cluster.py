"""Functions on a Ray or Dask cluster, for training.

joblib's Ray backend (``bufgym.benchmark.cluster``) makes new processes at every call, and processes of several programs
may wait for one another for ever. So training calls a cluster directly.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from bufgym.benchmark.cluster import WorkerDiedError, connected_ray, dask_client
from bufgym.ground.errors import BufgymError
from bufgym.ground.libraries import library

Call = Callable[..., Any]
CallEach = Callable[[Call, Sequence[tuple[Any, ...]]], list[Any]]
"""(function, arguments of each call) -> results in the order of the calls."""


@contextmanager
def running(backend: str, address: str | None) -> Iterator[str]:
    """Yield the address of a ``ray`` or ``dask`` cluster; without one, run a cluster on this machine meanwhile.

    Raises BufgymError: the library is missing, or nothing answers at the address.
    """
    with _client(backend, address) as client:
        yield client.scheduler.address if backend == "dask" else client.get_runtime_context().gcs_address


@contextmanager
def connected(backend: str, address: str | None) -> Iterator[CallEach]:
    """Yield a caller that runs functions on a ``ray`` or ``dask`` cluster, where they must be importable.

    A Ray task, or a Dask worker with one thread, has a process to itself, which keeps the function's caches.

    Raises BufgymError as ``running`` does. The calls raise WorkerDiedError.
    """
    with _client(backend, address) as client:
        if backend == "dask":
            died: tuple[type[Exception], ...] = (library("distributed", "dask").KilledWorker,)

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
        client, own = (dask_client(address), True) if backend == "dask" else connected_ray(address)
    except OSError as error:  # includes Ray's ConnectionError
        raise BufgymError(f"{backend}: no cluster at {address}: {' '.join(str(error).split())}") from None
    try:
        yield client
    finally:
        if own:
            (client.close if backend == "dask" else client.shutdown)()
