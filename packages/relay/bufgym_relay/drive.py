"""Teleoperation: a robot moves only as long as messages of the person who drives it come in time.

Messages on ``/robots/NAME/drive`` are JSON, ``{"linear": 0.3, "angular": -0.2, "for_ms": 400}``: m/s ahead, rad/s to
the left, and the message's deadline. It holds for so long from its stamp on, by the sender's clock as the promptest of
the sender's messages shows it. So what waited on a stalled link moves nothing, and a robot whose link is cut stops.
"""

import asyncio
import json
import math
import struct
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any, Final, NamedTuple

from bufgym.utils.errors import BufgymError
from bufgym_relay import wire

TOPIC: Final = "drive"
MOST_MS: Final = 1_000
"""Longest deadline that a message may have."""
TWIST: Final = "geometry_msgs/msg/Twist"
_TWIST: Final = struct.Struct("<6d")
_DRIFT: Final = 1e-3  # most that two clocks drift apart, s for each s


class Velocity(NamedTuple):
    """Velocity in the plane: m/s ahead, rad/s to the left."""

    linear: float
    angular: float


STILL: Final = Velocity(0.0, 0.0)


def _read(message: wire.Message) -> tuple[Velocity, float]:
    """Return a message's velocity and deadline in s."""
    try:
        match json.loads(bytes(message.payload)):
            case {"linear": float() | int() as linear, "angular": float() | int() as angular, "for_ms": int() as ms}:
                if math.isfinite(linear) and math.isfinite(angular) and 0 <= ms <= MOST_MS:
                    return Velocity(float(linear), float(angular)), ms / 1e3
    except (ValueError, OverflowError):
        pass
    rule = f"must be JSON with the finite numbers linear and angular, and for_ms from 0 to {MOST_MS}"
    raise BufgymError(f"topic {message.topic}: {bytes(message.payload[:60])!r}: {rule}")


def check_speed(message: wire.Message, most: float) -> None:
    """Raise RefusedError if a message drives a robot at more than ``most`` m/s or rad/s, or at no number."""
    if message.topic.endswith(f"/{TOPIC}"):
        numbers: Sequence[float] = _read(message)[0]
    elif message.type == TWIST and len(message.payload) == _TWIST.size + 4:
        numbers = _TWIST.unpack_from(message.payload, 4)
    else:
        return
    # A number that is none is not at most anything.
    if fastest := [number for number in numbers if not abs(number) <= most]:
        rule = f"must be at most {most:g} m/s and rad/s, the speed of the rule"
        raise wire.RefusedError("wrong", f"topic {message.topic}: {fastest[0]:g}: {rule}")


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

    def take(self, message: wire.Message) -> None:
        """Take a message; ignore it beyond its deadline, behind a later one, or while another client drives.

        Raises BufgymError: it is none that drives.
        """
        velocity, for_s = _read(message)
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


class Drivers:
    """Entries of a relay's audit log: who drove which robot, from when and for how long."""

    def __init__(self, audit: Callable[..., None], clock: Callable[[], float]) -> None:
        self._audit, self._clock = audit, clock
        self._spans: dict[tuple[str, str], tuple[dict[str, Any], float, float]] = {}
        """(session, topic) -> fields of the entry, first and last message in s."""

    def note(self, topic: str, session: str, **who: str) -> None:
        """Note a message; the first one makes an entry."""
        if topic.endswith(f"/{TOPIC}"):
            now_s = self._clock()
            about, first_s, _ = self._spans.get((session, topic), ({}, now_s, now_s))
            if not about:
                about = {"topic": topic, "session": session, **who}
                self._audit("drives", **about)
            self._spans[session, topic] = about, first_s, now_s

    def tick(self, quiet_s: float = MOST_MS / 1e3) -> None:
        """Make the last entry of those who have sent nothing for ``quiet_s``."""
        for key, (about, first_s, last_s) in list(self._spans.items()):
            if self._clock() - last_s >= quiet_s:
                del self._spans[key]
                self._audit("drove", **about, seconds=round(last_s - first_s, 1))
