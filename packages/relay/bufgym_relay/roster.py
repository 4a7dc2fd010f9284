"""Robots that were here: when each last said its status and what it said, kept over a relay's restarts.

For a robot that has said nothing for a while the relay publishes ``/robots/NAME/last``, and gives it to later
subscribers as it does with latched topics. Its stamp is the relay's time of the last status. Whoever may send there
removes the robot by the payload ``null``. Nobody may publish anything else.
"""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from typing import Final, NamedTuple

from bufgym_relay.store import Store
from bufgym_robot.wire import messages as wire

AWAY_S: Final = 5.0
"""Silence after which a robot is away; ``fleet.js`` has it too."""
SAVE_S: Final = 10.0  # Time between two savings: so much of "last seen" a kill of the relay may cost
MOST_ROBOTS: Final = 1_000
GONE: Final = b"null"
_FIELDS: Final = ("ok", "text", "estop", "battery", "location")
_MOST_BYTES: Final = 2_000  # of what is kept of a status
_READ_BYTES: Final = 2**16  # of a status that is read
_TOPIC: Final = re.compile("/robots/([^/]+)/(status|last)")


@lru_cache(10 * MOST_ROBOTS)
def is_last(topic: str) -> bool:
    """Whether it is the topic of a robot that was here."""
    found = _TOPIC.fullmatch(topic)
    return found is not None and found[2] == "last"


@lru_cache(10 * MOST_ROBOTS)
def status_of(topic: str) -> str:
    """Give the robot whose status the topic carries; empty for any other topic."""
    found = _TOPIC.fullmatch(topic)
    return found[1] if found is not None and found[2] == "status" else ""


def _said(payload: bytes) -> str:
    """Return what is kept of a status, as JSON."""
    with suppress(ValueError, RecursionError):
        status = json.loads(payload)
        if isinstance(status, dict):
            said = {name: status[name] for name in _FIELDS if name in status}
            if len(text := json.dumps(said)) <= _MOST_BYTES:
                return text
    return "{}"


class _Heard(NamedTuple):
    """A robot's latest status: the relay's clock, the time in us since 1970, and the payload."""

    clock_s: float
    at_us: int
    payload: bytes


class Roster:
    """Give it each message; ``publish`` is called with what a robot that is away said last."""

    def __init__(
        self,
        store: Store,
        publish: Callable[[wire.Message], None],
        clock: Callable[[], float],
        now_us: Callable[[], int],
    ) -> None:
        self._store, self._publish, self._clock, self._now_us = store, publish, clock, now_us
        self._here: dict[str, _Heard] = {}
        """Robots by their names, the one that was heard longest ago first."""
        self._saved_s = clock()

    def __call__(self, message: wire.Message) -> None:
        """Take note of a robot's status, or of its removal."""
        found = _TOPIC.fullmatch(message.topic)
        if found is None or message.encoding != "json":
            return
        name, topic = found.groups()
        if topic == "status":
            payload = bytes(message.payload) if len(message.payload) <= _READ_BYTES else b""
            self._here.pop(name, None)
            self._here[name] = _Heard(self._clock(), self._now_us(), payload)
            if len(self._here) > MOST_ROBOTS:
                del self._here[next(iter(self._here))]
        elif message.payload == GONE:
            self._here.pop(name, None)
            self._store.forget_robot(name)

    def away(self) -> Iterator[wire.Message]:
        """Give what the robots that the store has said last."""
        for name, at_us, said in self._store.robots():
            yield wire.Message(
                f"/robots/{name}/last", said.encode(), sender=wire.OWN, stamp_us=at_us, at_us=max(0, at_us)
            )

    def tick(self) -> None:
        """Publish what robots said last that have gone silent, and save all now and then."""
        now_s = self._clock()
        gone = [name for name, heard in self._here.items() if now_s - heard.clock_s > AWAY_S]
        if gone or now_s - self._saved_s >= SAVE_S:
            self.close()
            self._saved_s = now_s
        for name in gone:
            _, at_us, payload = self._here.pop(name)
            said = _said(payload).encode()
            self._publish(wire.Message(f"/robots/{name}/last", said, sender=wire.OWN, stamp_us=at_us, at_us=at_us))

    def close(self) -> None:
        """Save all robots."""
        rows = [(name, heard.at_us, _said(heard.payload)) for name, heard in self._here.items()]
        self._store.keep_robots(rows, MOST_ROBOTS)
