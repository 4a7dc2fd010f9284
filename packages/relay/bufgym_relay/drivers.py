"""The relay's part in teleoperation: the speed that a rule allows, and who drove which robot."""

import struct
from collections.abc import Callable, Sequence
from typing import Any, Final

from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.driving import MOST_MS, TOPIC, read

TWIST: Final = "geometry_msgs/msg/Twist"
_TWIST: Final = struct.Struct("<6d")


def check_speed(message: wire.Message, most: float) -> None:
    """Raise RefusedError if a message drives a robot at more than ``most`` m/s or rad/s, or at no number."""
    if message.topic.endswith(f"/{TOPIC}"):
        numbers: Sequence[float] = read(message)[0]
    elif message.type == TWIST and len(message.payload) == _TWIST.size + 4:
        numbers = _TWIST.unpack_from(message.payload, 4)
    else:
        return
    # A number that is none is not at most anything.
    if fastest := [number for number in numbers if not abs(number) <= most]:
        rule = f"must be at most {most:g} m/s and rad/s, the speed of the rule"
        raise wire.RefusedError("wrong", f"topic {message.topic}: {fastest[0]:g}: {rule}")


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
