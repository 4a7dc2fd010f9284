"""A thread in which one part of the relay writes its files, so that a disk that stalls keeps nothing else waiting."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from typing import Any, Final, Protocol

STALL_S: Final = 1.0  # Time for one piece of work beyond which the disk is said to stall
MOST_BYTES: Final = 2**24  # Most bytes that wait; further work is left out
_WORK_BYTES: Final = 1_000  # memory of a piece of work beside its bytes


class EventLog(Protocol):
    """Takes entries, as the relay's audit log does."""

    def __call__(self, event: str, **fields: Any) -> None:
        """Have one entry written."""


class Disk:
    """Work of one part, done in order. It is itself an ``EventLog`` for the work, which runs in another thread."""

    def __init__(self, part: str, audit: EventLog) -> None:
        self.part, self._audit = part, audit
        self._thread = ThreadPoolExecutor(1, part)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: deque[tuple[Future[None], int]] = deque()
        self._waiting_bytes = self._left_out = 0
        self._began_s: float | None = None
        self._stalled = self._closed = False
        self._faults: set[str] = set()

    def __call__(self, event: str, **fields: Any) -> None:
        """Have an entry written to the audit log."""
        self.on_loop(self._audit, event, **fields)

    def on_loop(self, call: Callable[..., Any], *words: Any, **named: Any) -> None:
        """Have this called in the event loop, in order; at once while no loop has asked for work."""
        if self._loop is None:
            call(*words, **named)
        else:
            self._loop.call_soon_threadsafe(partial(call, *words, **named))

    @property
    def idle(self) -> bool:
        """Whether all that ``soon`` was asked for is done."""
        return not self._waiting or self._waiting[-1][0].done()

    @property
    def stalls(self) -> bool:
        """Whether a piece of work takes too long."""
        # Read once: the thread may set it to None at any moment.
        began_s = self._began_s
        return began_s is not None and time.monotonic() - began_s > STALL_S

    def do(self, work: Callable[..., Any], *words: Any) -> asyncio.Future[Any]:
        """Do ``work`` when all before it is done; the future has what it returns or raises."""
        self._loop = asyncio.get_running_loop()
        return asyncio.wrap_future(self._thread.submit(self._timed, work, *words))

    def soon(self, size_bytes: int, work: Callable[..., Any], *words: Any) -> None:
        """Do ``work``, which holds so many bytes, as ``later``; leave it out if too many wait, or after the end."""
        while self._waiting and self._waiting[0][0].done():
            self._waiting_bytes -= self._waiting.popleft()[1]
        size_bytes += _WORK_BYTES
        if self._closed or self._waiting_bytes + size_bytes > MOST_BYTES:
            self._left_out += 1
            return
        self._waiting.append((self.later(work, *words), size_bytes))
        self._waiting_bytes += size_bytes

    def later(self, work: Callable[..., Any], *words: Any) -> Future[None]:
        """Do ``work`` when all before it is done; log the first fault of each kind."""
        with suppress(RuntimeError):  # there is no loop yet
            self._loop = asyncio.get_running_loop()
        return self._thread.submit(self._bearably, work, *words)

    def _timed(self, work: Callable[..., Any], *words: Any) -> Any:
        self._began_s = time.monotonic()
        try:
            return work(*words)
        finally:
            self._began_s = None

    def _bearably(self, work: Callable[..., Any], *words: Any) -> None:
        try:
            self._timed(work, *words)
        except Exception as error:  # the rest of the relay goes on
            fault = f"{type(error).__name__}: {error}"
            if type(error).__name__ not in self._faults:
                self._faults.add(type(error).__name__)
                self("failed", part=self.part, why=fault)

    def tick(self) -> None:
        """Log whether the disk stalls, and how much was left out."""
        stalls = self.stalls
        if stalls and not self._stalled:
            self._audit("disk_stalls", part=self.part)
        elif self._stalled and not stalls:
            self._audit("disk_goes_on", part=self.part)
        self._stalled = stalls
        if self._left_out and not stalls:
            self._audit("left_out", part=self.part, times=self._left_out)
            self._left_out = 0

    def close(self, work: Callable[[], Any]) -> None:
        """Wait for the end of all, and of ``work`` after it; once is enough."""
        if self._closed:
            return
        self._closed = True
        self._thread.submit(self._bearably, work)
        self._thread.shutdown()
