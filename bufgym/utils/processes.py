"""Processes that work for this one: they end with it."""

import functools
import os
import threading
import time
from typing import Final

PATIENCE_S: Final = 1.0  # Time between a worker's checks that its parent process is alive


@functools.cache
def end_with(parent: int) -> None:
    """End this process soon after ``parent``, the process number of its parent, has ended.

    A killed parent's workers would hold its pipes and files for ever. It may be gone when a worker calls this.
    """
    threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PATIENCE_S)
    os._exit(1)
