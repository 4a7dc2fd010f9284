"""A thread in which one part of the relay writes its files, so that a disk that stalls keeps nothing else waiting."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final

from bufgym_live.relay.audit import Audit

STALL_S: Final = 1.0  # Time for one piece of work beyond which the disk is said to stall
MOST_BYTES: Final = 2**24  # Most bytes that wait; further work is left out
_WORK_BYTES: Final = 1_000  # memory of a piece of work beside its bytes


class Disk:
    """Work of one part, done in order. It may log as to an ``Audit``, which has the entries after the next tick."""

    def __init__(self, part: str, audit: Audit) -> None:
        self._part, self._audit = part, audit
        self._thread = ThreadPoolExecutor(1, part)
        self._waiting: deque[tuple[Future[None], int]] = deque()
        self._waiting_bytes = self._left_out = 0
        self._began_s: float | None = None
        self._stalls = False
        self._entries: deque[tuple[str, dict[str, Any]]] = deque()
        self._faults: set[str] = set()

    def __call__(self, event: str, **fields: Any) -> None:
        """Have an entry written to the audit log."""
        self._entries.append((event, fields))

    @property
    def idle(self) -> bool:
        """Whether all is done."""
        return not self._waiting or self._waiting[-1][0].done()

    def soon(self, size_bytes: int, work: Callable[..., Any], *words: Any) -> None:
        """Do ``work``, which holds so many bytes, when all before it is done; leave it out if too many wait."""
        while self._waiting and self._waiting[0][0].done():
            self._waiting_bytes -= self._waiting.popleft()[1]
        size_bytes += _WORK_BYTES
        if self._waiting_bytes + size_bytes > MOST_BYTES:
            self._left_out += 1
            return
        self._waiting.append((self._thread.submit(self._do, work, *words), size_bytes))
        self._waiting_bytes += size_bytes

    def _do(self, work: Callable[..., Any], *words: Any) -> None:
        self._began_s = time.monotonic()
        try:
            work(*words)
        except Exception as error:  # the rest of the relay goes on
            fault = f"{type(error).__name__}: {error}"
            if type(error).__name__ not in self._faults:
                self._faults.add(type(error).__name__)
                self("failed", part=self._part, why=fault)
        self._began_s = None

    def tick(self) -> None:
        """Log what the thread has to say, and whether the disk stalls."""
        while self._entries:
            event, fields = self._entries.popleft()
            self._audit(event, **fields)
        began_s = self._began_s
        stalls = began_s is not None and time.monotonic() - began_s > STALL_S
        if stalls and not self._stalls:
            self._audit("disk_stalls", part=self._part)
        elif self._stalls and not stalls:
            self._audit("disk_goes_on", part=self._part)
        self._stalls = stalls
        if self._left_out and not stalls:
            self._audit("left_out", part=self._part, times=self._left_out)
            self._left_out = 0

    def close(self, work: Callable[[], Any]) -> None:
        """Wait for the end of all, and of ``work`` after it."""
        self._thread.submit(self._do, work)
        self._thread.shutdown()
        self.tick()
