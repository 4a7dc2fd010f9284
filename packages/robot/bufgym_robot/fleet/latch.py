"""A robot's stop: it holds against driving and goals until somebody releases it, also over the robot's restarts."""

import asyncio
from collections.abc import Iterable
from typing import Any

from bufgym_robot.wire.ledger import Ledger, Stop
from bufgym_robot.wire.messages import Message
from bufgym_robot.wire.orders import moves


class Latch:
    """A robot's own ledger, and the work that a stop ends."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._came = asyncio.Event()
        self._by = ""  # who said the last stop
        self._works: set[asyncio.Task[Any]] = set()  # several after a break

    @property
    def is_set(self) -> bool:
        """Whether a stop holds."""
        return bool(self.ledger.held)

    @property
    def status(self) -> dict[str, str] | None:
        """The last stop that holds, for the robot's status: its id, and who said it."""
        held = self.ledger.held
        return {"id": held[-1].id, "by": held[-1].by} if held else None

    def take(self, stops: Iterable[Stop]) -> list[Stop]:
        """Take note of stops and releases; return those that are new."""
        new = self.ledger.take(stops)
        for stop in new:
            self._by = stop.by if stop.holds else self._by
        if any(stop.holds for stop in new):
            came, self._came = self._came, asyncio.Event()
            came.set()
            for work in self._works:
                work.cancel()  # now, not in a later turn of the event loop: until then it could go on
        return new

    def refusal(self, message: Message) -> str:
        """Say why a stop forbids a command, or nothing: it holds, or the relay took the command before it."""
        return self.ledger.refusal(message.seen) if moves(message) else ""

    async def unless_stopped(self, work: "asyncio.Task[Any]") -> str:
        """Wait for the work on a command; a stop cancels it, and does not wait. Return why it did not end, if so."""
        self._works.add(work)
        came = self._came
        stopped = asyncio.ensure_future(came.wait())
        try:
            await asyncio.wait((work, stopped), return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopped.cancel()
            self._works.discard(work)
        if came.is_set():
            work.cancel()
            return f"withdrawn: stopped by {self._by}"
        await work
        return ""
