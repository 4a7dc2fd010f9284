"""Limits of time and memory for what reads an input."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MOST_BYTES = 2 * 10**9
"""More than the process has when it begins."""
MOST_S = 60
"""An input, so that no busy machine is late."""


def late(*_: object) -> None:
    raise TimeoutError(f"more than {MOST_S} s")


@contextmanager
def limited() -> Iterator[None]:
    """Fail what takes longer than MOST_S, and on Linux what takes more than MOST_BYTES."""
    statm, address_space = Path("/proc/self/statm"), None
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(MOST_S)
    if statm.exists():
        import resource

        address_space = resource.getrlimit(resource.RLIMIT_AS)
        now = int(statm.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + MOST_BYTES, address_space[1]))
    try:
        yield
    finally:
        if address_space is not None:
            resource.setrlimit(resource.RLIMIT_AS, address_space)
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
