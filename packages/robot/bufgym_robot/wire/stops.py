"""Stops and releases that a client says: each is said again on every connection until the relay has it."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable
from typing import Any

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.orders import STOP


class Stops:
    """Stops and releases of one client that the relay has not confirmed."""

    def __init__(self, dated: Callable[[wire.Message, float], wire.Message], who: str) -> None:
        """``dated`` gives a release its deadline by when it was put, or raises a BufgymError where that is over.

        ``who`` is this client's own name in stops, which nobody else has.
        """
        self._dated, self._who = dated, who
        self._numbers = itertools.count(1)
        self._waiting: dict[int, tuple[wire.Message, float, asyncio.Future[None]]] = {}
        """Number of a message -> the message, when it was put, and its answer."""

    def put(self, robot: str, **said: str) -> tuple[str, asyncio.Future[None]]:
        """Add one; return its id, and a future that is done once the relay has it."""
        number = next(self._numbers)
        id = f"{self._who}-{number}"
        topic = f"/robots/{robot}/{STOP}"
        message = wire.Message(topic, wire.written(topic, {**said, "id": id}), seq=number)
        answered: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting[number] = message, time.monotonic(), answered
        return id, answered

    async def send(self, send: Callable[[bytes], Awaitable[Any]]) -> None:
        """Send all that the relay has not confirmed."""
        for number, (message, put_s, _) in list(self._waiting.items()):
            try:
                dated = message if b'"release"' not in message.payload else self._dated(message, put_s)
            except BufgymError as error:
                self.refuse(number, error)
            else:
                await send(wire.encode(dated))

    def confirm(self, topic: str, id: str) -> None:
        """Note that the relay has the message ``id`` of ``topic``, and wake who waits for that."""
        for number, (message, _, answered) in list(self._waiting.items()):
            if message.topic == topic and f'"id":"{id}"'.encode() in message.payload:
                del self._waiting[number]
                if not answered.done():
                    answered.set_result(None)

    def refuse(self, number: int, error: BufgymError) -> bool:
        """Note that one is refused; return whether there is one of this number."""
        if number not in self._waiting:
            return False
        *_, answered = self._waiting.pop(number)
        if not answered.done():
            answered.set_exception(error)
            answered.exception()  # marks the error as seen, because nobody may await it
        return True

    def give_up(self, why: str) -> None:
        """Fail all, because no answer will come."""
        for number in list(self._waiting):
            self.refuse(number, BufgymError(why))
