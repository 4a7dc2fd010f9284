"""Commands to robots: which topics carry them, until when each may be executed, and which a stop withdraws.

A command is a message on ``/robots/NAME/command`` or below ``/robots/NAME/to/``. It has a deadline by the relay's
clock: the one that its sender gave it, and at most the rule's ``command_s`` after the relay took it. A stop is a
message on ``/robots/NAME/stop``. It has no deadline, overtakes everything, and withdraws each command to the robot that
the relay took before it. It holds until it is released there, as ``bufgym_robot.wire.ledger`` says. On the same topic
the relay gives everybody the robot's ledger.
"""

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final

from bufgym_robot.wire.ledger import MOST_CHARACTERS, Ledger, Stop, read
from bufgym_robot.wire.messages import OWN, Message, RefusedError

COMMAND_S: Final = 3.0
"""Time for which a command may be executed, if no rule says otherwise."""
STOP: Final = "stop"
HARMLESS: Final = ("policy", "stop", "cancel", "pose")
"""Commands that move nothing, so a robot takes them while a stop holds."""
_TOPIC: Final = re.compile("/robots/([^/]+)/(?:command|to/.+)")
_STOP: Final = re.compile(f"/robots/([^/]+)/{STOP}")
MOST_ROBOTS: Final = 10_000
"""Robots whose stops a relay knows."""
_MOST_CHARACTERS: Final = 20_000  # of the ids that a release names


@lru_cache(MOST_ROBOTS)
def robot_of(topic: str) -> str:
    """Give the robot that the topic's commands are for; empty for any other topic."""
    found = _TOPIC.fullmatch(topic)
    return "" if found is None else found[1]


@lru_cache(MOST_ROBOTS)
def stopped_robot(topic: str) -> str:
    """Give the robot whose stops the topic carries; empty for any other topic."""
    found = _STOP.fullmatch(topic)
    return "" if found is None else found[1]


def is_stop(topic: str) -> bool:
    """Whether the topic carries a robot's stops."""
    return bool(stopped_robot(topic))


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
    """Read what a client says on a stop's topic: ``command`` (stop or release), ``id``, and ``of``: ids of stops.

    Raises RefusedError: it is neither.
    """
    said = _object(message)
    of = said.get("of", "")
    found = {name: str(said.get(name, "")) for name in ("command", "id")}
    found["of"] = " ".join(map(str, of)) if isinstance(of, list) else str(of)
    is_short = len(found["id"]) <= MOST_CHARACTERS and len(found["of"]) <= _MOST_CHARACTERS
    if found["command"] not in (STOP, "release") or not found["id"] or not is_short:
        rule = 'must be {"command": "stop", "id": ...} or {"command": "release", "id": ..., "of": the stops\' ids}'
        raise RefusedError("wrong", f"topic {message.topic}: {bytes(message.payload[:60])!r}: {rule}")
    return found


def told(robot: str, ledger: Ledger, now_us: int) -> Message:
    """The message with which a relay says a robot's stops."""
    payload = json.dumps({"stops": ledger.as_json()}, separators=(",", ":")).encode()
    return Message(f"/robots/{robot}/{STOP}", payload, sender=OWN, stamp_us=now_us, at_us=now_us)


def heard_stops(message: Message) -> list[Stop]:
    """Read the stops that a message of a ledger, or a robot's status, says."""
    return list(read(_object(message).get("stops")))
