"""Frames of a connection, received ahead while one of them has to wait."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any, Final, Self

from bufgym_live.robot.channels import Channel
from bufgym_live.robot.frames import DATA, Frame

MOST_AHEAD: Final = 256  # Frames, as many as a sender sends before an ack
MOST_AHEAD_BYTES: Final = 2**20
"""Bytes of bodies after which no more are received ahead."""


class Ahead:
    """Frames of ``channel`` in order; ``expect`` is called with bodies of messages that come while one waits.

    So thirty topics that each wait for something of their own wait together, and are still handed on in order.
    """

    def __init__(self, channel: Channel, expect: Callable[[bytes | memoryview], None]) -> None:
        self._channel, self._expect = channel, expect
        self._frames: deque[Frame] = deque()
        self._coming: asyncio.Task[Frame] | None = None

    async def receive(self) -> Frame:
        """Return the next frame."""
        if self._frames:
            return self._frames.popleft()
        if self._coming is None:
            return await self._channel.receive()
        coming, self._coming = self._coming, None
        return await coming

    async def during(self, work: Awaitable[Any]) -> None:
        """Wait for ``work``; receive meanwhile."""
        working = asyncio.ensure_future(work)
        try:
            while not working.done():
                await asyncio.wait([working, *self._next()], return_when=asyncio.FIRST_COMPLETED)
                self._look()
        finally:
            working.cancel()
        await working

    def _next(self) -> list[asyncio.Task[Frame]]:
        """The task of the next frame, where one is to be received."""
        if self._coming is None:
            if len(self._frames) >= MOST_AHEAD or sum(len(one.body) for one in self._frames) >= MOST_AHEAD_BYTES:
                return []
            self._coming = asyncio.create_task(self._channel.receive())
        return [] if self._coming.done() else [self._coming]  # one that failed is told in its turn

    def _look(self) -> None:
        if self._coming is not None and self._coming.done() and not self._coming.exception():
            frame, self._coming = self._coming.result(), None
            self._frames.append(frame)
            if frame.kind == DATA:
                self._expect(frame.body)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        if self._coming is not None:
            self._coming.cancel()
            with contextlib.suppress(asyncio.CancelledError, OSError):
                await self._coming
