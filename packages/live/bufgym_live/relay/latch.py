"""A robot's stop: it holds against driving and goals until somebody releases it."""

import asyncio
from typing import Any

from bufgym_live.relay.orders import moves
from bufgym_live.relay.wire import Message


class Latch:
    """Set by a stop, cleared by the release that names it."""

    def __init__(self) -> None:
        self.is_set = False
        self._id = self._by = ""
        self._at_us = 0  # when the relay took the stop
        self._came = asyncio.Event()
        self._work: asyncio.Task[Any] | None = None

    @property
    def status(self) -> dict[str, str] | None:
        """The stop that holds, for the robot's status: its id, and who said it."""
        return {"id": self._id, "by": self._by} if self.is_set else None

    def stop(self, id: str, by: str, at_us: int) -> bool:
        """Take a stop; return whether it is new, not one that was said before."""
        if id and id == self._id:
            return False
        self.is_set, self._id, self._by, self._at_us = True, id, by, at_us
        came, self._came = self._came, asyncio.Event()
        came.set()
        if self._work is not None:
            self._work.cancel()  # now, not in a later turn of the event loop: until then it could go on
        return True

    def release(self, of: str) -> str:
        """Release the stop with this id; return why not, or an empty text."""
        if of != self._id:
            return f"another stop holds, by {self._by}: release that"
        self.is_set = False
        return ""

    def refusal(self, message: Message) -> str:
        """Say why a stop forbids a command, or nothing: it holds, or the relay took the command before it."""
        if not moves(message):
            return ""
        if self.is_set:
            return f"stopped by {self._by}: release it first"
        return f"withdrawn: stopped by {self._by}" if 0 < message.at_us <= self._at_us else ""

    async def unless_stopped(self, work: "asyncio.Task[Any]") -> str:
        """Wait for the work on a command; a stop cancels it, and does not wait. Return why it did not end, if so."""
        self._work, came = work, self._came
        stopped = asyncio.ensure_future(came.wait())
        try:
            await asyncio.wait((work, stopped), return_when=asyncio.FIRST_COMPLETED)
        except asyncio.CancelledError:  # the connection has ended: the command comes again
            work.cancel()
            raise
        finally:
            stopped.cancel()
            self._work = None
        if came.is_set():
            return f"withdrawn: stopped by {self._by}"
        await work
        return ""
