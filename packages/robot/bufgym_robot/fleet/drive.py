"""Teleoperation: a robot moves only as long as messages of the person who drives it come in time.

Each holds for its deadline from its stamp on, by the sender's clock as the promptest of the sender's messages shows it.
So what waited on a stalled link moves nothing, and a robot whose link is cut stops.
"""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Final

from bufgym_robot.wire.driving import STILL, Velocity, read
from bufgym_robot.wire.messages import Message

_DRIFT: Final = 1e-3  # most that two clocks drift apart, s for each s


class Drive:
    """Dead man's rule: ``move`` is called with each velocity in turn, and with ``STILL`` at the last one's deadline."""

    def __init__(
        self, move: Callable[[Velocity], Awaitable[None]], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._move, self._clock = move, clock
        self._came = asyncio.Event()
        self._velocity, self._until_s = STILL, -math.inf
        self._sender, self._stamp_us = "", 0
        self._stopped = False
        self._let_go: set[str] | None = None  # who has said zeros since the last stop; None before the first
        self._behind_s, self._heard_s = math.inf, 0.0  # own clock minus the sender's, and when that was last measured

    @property
    def velocity(self) -> Velocity:
        """Velocity that is allowed now."""
        return self._velocity if self._clock() < self._until_s else STILL

    @property
    def driver(self) -> str:
        """Name of the client that moves the robot now; empty while it stands."""
        return "" if self.velocity == STILL else self._sender

    def take(self, message: Message) -> None:
        """Take a message; ignore it beyond its deadline, behind a later one, or while another client drives.

        Raises BufgymError: it is none that drives.
        """
        velocity, for_s = read(message)
        if self._let_go is not None:
            if velocity == STILL:
                self._let_go.add(message.sender)
            elif self._stopped:
                self._let_go.discard(message.sender)
            if self._stopped or message.sender not in self._let_go:
                return
        now_s, stamp_s = self._clock(), message.stamp_us / 1e6
        if message.sender != self._sender:
            if self.driver:
                return
            self._sender, self._stamp_us, self._behind_s = message.sender, 0, math.inf
        if message.stamp_us <= self._stamp_us:
            return
        self._stamp_us = message.stamp_us
        self._behind_s = min(now_s - stamp_s, self._behind_s + _DRIFT * (now_s - self._heard_s))
        self._heard_s = now_s
        self._velocity, self._until_s = velocity, stamp_s + self._behind_s + for_s
        self._came.set()

    def stop(self) -> None:
        """Stand still until ``go``; whoever holds a key then must let go, and say zeros, before a velocity counts."""
        self._velocity, self._let_go, self._stopped = STILL, set(), True
        self._came.set()

    def go(self) -> None:
        """Take velocities again."""
        self._stopped = False

    async def run(self) -> None:
        """Move as the messages say, until cancelled; then stop."""
        moves = False
        try:
            while True:
                with suppress(TimeoutError):
                    async with asyncio.timeout(self._until_s - self._clock() if moves else None):
                        await self._came.wait()
                self._came.clear()
                velocity = self.velocity
                if moves or velocity != STILL:
                    moves = True
                    await self._move(velocity)
                moves = velocity != STILL
        finally:
            if moves:
                await self._move(STILL)
