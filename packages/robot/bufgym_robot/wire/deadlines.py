"""A client's part in deadlines: it dates its commands by the relay's clock, and sees which of others are late."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from bufgym_robot.wire.clock import ASK_S, RelayClock
from bufgym_robot.wire.messages import Message, RefusedError
from bufgym_robot.wire.orders import COMMAND_S, is_stop, right, robot_of
from bufgym_robot.wire.patterns import pattern


class Deadlines:
    """Deadlines of one session, under the rules of the relay's last welcome."""

    def __init__(self) -> None:
        self.clock = RelayClock()
        self._rules: list[Mapping[str, Any]] = []
        self._asked_s: float | None = None  # when the relay was asked for its time, until it answers

    def begin(self) -> None:
        """Begin anew with a hello, which asks for the relay's time, too."""
        self.clock.begin()
        self._asked_s = self.clock.clock()

    def welcomed(self, said: Mapping[str, Any]) -> None:
        """Take the welcome's rules and time."""
        self._rules = said["rules"]
        self.answered(said)

    def answered(self, said: Mapping[str, Any]) -> None:
        """Take the relay's answer with its time."""
        if "clock_us" in said:
            self.clock.heard(said["clock_us"], self._asked_s)
            self._asked_s = None

    async def ask(self, say: Callable[[str], Awaitable[None]]) -> None:
        """Ask for the relay's time again and again, one question at a time."""
        while True:
            if self._asked_s is None:
                self._asked_s = self.clock.clock()
                await say("clock")
            await asyncio.sleep(ASK_S)

    def dated(self, message: Message, put_s: float) -> Message:
        """Give a command the deadline of the relay's rule, by when it was put.

        Raises RefusedError: it is over.
        """
        if not (self.clock.known and (robot_of(message.topic) or is_stop(message.topic))):
            return message
        topic = right(message.topic)
        fits = (rule for rule in self._rules if rule.get("send") and pattern(rule["topic"]).whole(topic))
        until_s = put_s + next(fits, {}).get("command_s", COMMAND_S)
        if self.clock.clock() > until_s:
            raise RefusedError("too_late", f"topic {message.topic}: the relay could not be reached in time")
        return message._replace(until_us=self.clock.earliest_us(until_s))

    def is_late(self, message: Message) -> bool:
        """Whether a message's deadline may be over, by the relay's clock; a stop is never late."""
        is_order = is_stop(message.topic)
        return message.until_us > 0 and not is_order and self.clock.is_past(message.until_us)
