"""Frames of a connection, received ahead while one of them has to wait."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any, Final, Self

from bufgym_robot.channels import Channel
from bufgym_robot.frames import DATA, Frame

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
        self._waits = False
        self._reading: asyncio.Task[None] | None = None

    async def receive(self) -> Frame:
        """Return the next frame."""
        if not self._frames and self._reading is not None:
            await self._reading  # it has begun with the next one, or has the reason why there is none
        return self._frames.popleft() if self._frames else await self._channel.receive()

    async def during(self, work: Awaitable[Any]) -> None:
        """Wait for ``work``; receive meanwhile."""
        self._waits = True
        if self._reading is None:
            self._reading = asyncio.create_task(self._read())
        try:
            await work
        finally:
            self._waits = False

    async def _read(self) -> None:
        """Receive ahead until the work is done or there is enough; a task that failed stays, and is told in turn."""
        size_bytes = sum(len(one.body) for one in self._frames)
        while self._waits and len(self._frames) < MOST_AHEAD and size_bytes < MOST_AHEAD_BYTES:
            frame = await self._channel.receive()
            size_bytes += len(frame.body)
            self._frames.append(frame)
            if frame.kind == DATA:
                self._expect(frame.body)
        self._reading = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        if self._reading is not None:
            self._reading.cancel()
            with contextlib.suppress(asyncio.CancelledError, OSError):
                await self._reading
