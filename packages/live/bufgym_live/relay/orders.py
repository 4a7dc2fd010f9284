"""Commands to robots: which topics carry them, until when each may be executed, and which a stop withdraws.

A command is a message on ``/robots/NAME/command`` or below ``/robots/NAME/to/``. It has a deadline by the relay's
clock: the one that its sender gave it, and at most the rule's ``command_s`` after the relay took it. A stop is a
message on ``/robots/NAME/stop``. It has no deadline, overtakes everything, and withdraws each command to the robot that
the relay took before it. It holds until it is released there.
"""

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final

from bufgym_live.relay.wire import Message, RefusedError

COMMAND_S: Final = 3.0
"""Time for which a command may be executed, if no rule says otherwise."""
STOP: Final = "stop"
HARMLESS: Final = ("policy", "stop", "cancel", "pose")
"""Commands that move nothing, so a robot takes them while a stop holds."""
_TOPIC: Final = re.compile("/robots/([^/]+)/(?:command|to/.+)")
_STOP: Final = re.compile(f"/robots/([^/]+)/{STOP}")
_MOST_ROBOTS: Final = 10_000
_MOST_CHARACTERS: Final = 300  # of a stop's id and of who says it


@lru_cache(_MOST_ROBOTS)
def robot_of(topic: str) -> str:
    """Give the robot that the topic's commands are for; empty for any other topic."""
    found = _TOPIC.fullmatch(topic)
    return "" if found is None else found[1]


@lru_cache(_MOST_ROBOTS)
def is_stop(topic: str) -> bool:
    """Whether the topic carries a robot's stops."""
    return _STOP.fullmatch(topic) is not None


def right(topic: str) -> str:
    """Give the topic that a rule must allow: whoever may command a robot may stop it."""
    found = _STOP.fullmatch(topic)
    return topic if found is None else f"/robots/{found[1]}/command"


def _object(message: Message) -> Mapping[str, Any]:
    with suppress(ValueError, RecursionError):
        said = json.loads(bytes(message.payload))
        if isinstance(said, dict):
            return said
    return {}


def moves(message: Message) -> bool:
    """Whether a command may move its robot; ROS's velocity of zeros does not."""
    if message.topic.endswith("/command"):
        return _object(message).get("command") not in HARMLESS
    return "Twist" not in message.type or any(bytes(message.payload[4:]))


def order(message: Message) -> dict[str, str]:
    """Read what is said on a stop's topic: ``command`` (stop or release), ``id``, ``by``, and ``of``, a stop's id.

    Raises RefusedError: it is neither.
    """
    said = _object(message)
    found = {name: str(said.get(name, ""))[:_MOST_CHARACTERS] for name in ("command", "id", "by", "of")}
    if found["command"] not in (STOP, "release") or not found["id"]:
        rule = 'must be {"command": "stop", "id": ...} or {"command": "release", "id": ..., "of": the stop\'s id}'
        raise RefusedError("wrong", f"topic {message.topic}: {bytes(message.payload[:60])!r}: {rule}")
    return found


class Orders:
    """A relay's view of commands: deadlines, and the stops that hold."""

    def __init__(self) -> None:
        self._stops: dict[str, tuple[int, dict[str, str]]] = {}
        """Robot -> when the relay took its last stop, and what was said since."""

    def dated(self, message: Message, most_s: float, now_us: int, by: str | None) -> Message:
        """Give a message that was taken at ``at_us`` its deadline, and a stop the name of who says it, if there is one.

        Raises RefusedError: the deadline is over, or a stop of the robot holds.
        """
        if message.until_us and now_us > message.until_us:
            late = f"{(now_us - message.until_us) / 1e6:.1f} s after its deadline"
            raise RefusedError("too_late", f"topic {message.topic}: came {late}")
        latest_us = message.at_us + round(most_s * 1e6)
        until_us = min(message.until_us or latest_us, latest_us)
        if found := _STOP.fullmatch(message.topic):
            return self._ordered(message, found[1], until_us, by)
        robot = robot_of(message.topic)
        if not robot:
            return message
        if now_us > until_us:
            raise RefusedError("too_late", f"topic {message.topic}: waited longer than the {most_s:g} s of its rule")
        said = self._stops.get(robot, (0, {}))[1]
        if said.get("command") == STOP and moves(message):
            raise RefusedError("stopped", f"{robot} was stopped by {said['by']}: release it first")
        return message._replace(until_us=until_us)

    def _ordered(self, message: Message, robot: str, until_us: int, by: str | None) -> Message:
        """Take note of a stop or a release."""
        said = order(message)
        said["by"] = said["by"] if by is None else by
        at_us, before = self._stops.get(robot, (0, {}))
        if said["command"] == STOP:
            at_us, until_us = message.at_us, 0
        elif before.get("command") == STOP and before["id"] != said["of"]:
            raise RefusedError("stopped", f"{robot} was stopped again, by {before['by']}: release that")
        self._stops.pop(robot, None)
        self._stops[robot] = at_us, said
        if len(self._stops) > _MOST_ROBOTS:
            del self._stops[next(iter(self._stops))]
        payload = json.dumps(said, separators=(",", ":")).encode()
        return message._replace(payload=payload, encoding="json", type="", until_us=until_us)

    def is_over(self, message: Message, now_us: int) -> bool:
        """Whether a command that waited is not to be sent on: it is late, or a stop has withdrawn it."""
        robot = robot_of(message.topic)
        if not robot or not message.at_us:
            return bool(message.until_us) and now_us > message.until_us
        at_us, said = self._stops.get(robot, (0, {}))
        stopped = message.at_us <= at_us or said.get("command") == STOP
        return (0 < message.until_us < now_us) or (stopped and moves(message))
