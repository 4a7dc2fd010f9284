"""Work that several threads share."""

import os
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor


class Threads:
    """Does the same work on each part of a batch at once, the first part here and the others in threads.

    Kernels hold no lock of Python's, and rows share no memory that a step writes.
    """

    def __init__(self, numbers: NDArray[np.int64], num_threads: int) -> None:
        """``numbers``, int64[n], are rows or cells. They are split into at most ``num_threads`` parts."""
        parts = np.array_split(numbers, min(num_threads, len(numbers)))
        self.parts = [np.ascontiguousarray(part) for part in parts]
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def each(self, work: Callable[[int, NDArray[np.int64]], None]) -> None:
        """Call ``work`` with every part's number and numbers; return when all are done."""
        if len(self.parts) == 1:
            work(0, self.parts[0])
            return
        if self._pool is None or self._process != os.getpid():  # threads do not survive a fork
            from concurrent.futures import ThreadPoolExecutor  # not at start-up: most batches have one part

            self._pool, self._process = ThreadPoolExecutor(len(self.parts) - 1, "bufgym"), os.getpid()
        running = [self._pool.submit(work, k, part) for k, part in enumerate(self.parts[1:], 1)]
        work(0, self.parts[0])
        for part in running:
            part.result()
