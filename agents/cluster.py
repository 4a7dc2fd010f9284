"""Functions on a Ray or Dask cluster, for training.

joblib's Ray backend (``bufgym.benchmark.cluster``) makes new processes at every call, and processes of several programs
may wait for one another for ever. So training calls a cluster directly.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from agents.settings import Cluster
from bufgym.benchmark.cluster import WorkerDiedError, connected_ray, dask_client
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library

Call = Callable[..., Any]
CallEach = Callable[[Call, Sequence[tuple[Any, ...]]], list[Any]]
"""(function, arguments of each call) -> results in the order of the calls."""


@contextmanager
def running(cluster: Cluster) -> Iterator[Cluster]:
    """Yield the cluster with its address; without one, run a cluster on this machine meanwhile.

    Raises BufgymError: the library is missing, or nothing answers at the address.
    """
    with _client(cluster) as client:
        found = client.scheduler.address if cluster.backend == "dask" else client.get_runtime_context().gcs_address
        yield replace(cluster, address=found)


@contextmanager
def connected(cluster: Cluster) -> Iterator[CallEach]:
    """Yield a caller that runs functions on a cluster, where they must be importable.

    A Ray task, or a Dask worker with one thread, has a process to itself, which keeps the function's caches.

    Raises BufgymError as ``running`` does. The calls raise WorkerDiedError.
    """
    with _client(cluster) as client:
        if cluster.backend == "dask":
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
                raise WorkerDiedError(
                    f"{cluster.backend}: workers ended before their work did (out of memory?)"
                ) from None

        yield each


@contextmanager
def _client(cluster: Cluster) -> Iterator[Any]:
    """Yield Dask's client, or the connected module ``ray``."""
    dask = cluster.backend == "dask"
    try:
        client, own = (dask_client(cluster.address), True) if dask else connected_ray(cluster.address)
    except OSError as error:  # includes Ray's ConnectionError
        raise BufgymError(
            f"{cluster.backend}: no cluster at {cluster.address}: {' '.join(str(error).split())}"
        ) from None
    try:
        yield client
    finally:
        if own:
            (client.close if dask else client.shutdown)()
