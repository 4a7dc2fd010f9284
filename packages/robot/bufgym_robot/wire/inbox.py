"""Messages that have come while the program is still at work on the last one."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Final

from bufgym_robot.wire.messages import HEADER_BYTES, Message

MOST_BYTES: Final = 2**20  # Most bytes that wait beside the newest; the oldest messages go, except no_drop ones


class Inbox:
    """One message waits at most, because the relay's queue decides on the others.

    While an answer is awaited all are read: the program may wait for it, and it comes behind them.
    """

    def __init__(self, awaited: Callable[[], bool] = lambda: False) -> None:
        self._awaited = awaited
        self._waiting: deque[Message] = deque()
        self._bytes = 0
        self._room, self._came = asyncio.Event(), asyncio.Event()

    def look(self) -> None:
        """Look whether an answer is awaited."""
        self._room.set()

    async def put(self, message: Message) -> None:
        """Add a message; return when the next may be read."""
        while self._bytes > MOST_BYTES and (oldest := next((one for one in self._waiting if not one.no_drop), None)):
            self._waiting.remove(oldest)
            self._bytes -= HEADER_BYTES + len(oldest.payload)
        self._waiting.append(message)
        self._bytes += HEADER_BYTES + len(message.payload)
        self._came.set()
        while self._waiting and not self._awaited():
            self._room.clear()
            await self._room.wait()

    async def __aiter__(self) -> AsyncIterator[Message]:
        """Yield the messages, without an end."""
        while True:
            await self._came.wait()
            self._came.clear()
            while self._waiting:
                message = self._waiting.popleft()
                self._bytes -= HEADER_BYTES + len(message.payload)
                self._room.set()
                yield message
