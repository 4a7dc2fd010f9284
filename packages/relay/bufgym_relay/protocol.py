"""A relay's decisions about a client, without sockets: its admission, its requests, its refusals.

All functions are pure but ``check``, which counts the message in its sender's quota.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from bufgym.model.checks import whole
from bufgym_relay.config import DEFAULT_CAPACITY, Config, Rule
from bufgym_relay.quota import Quota
from bufgym_relay.roster import GONE, is_last
from bufgym_relay.rules import Identity, Permissions
from bufgym_relay.stored import StoredSession
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.messages import RefusedError, WireError
from bufgym_robot.wire.orders import is_stop
from bufgym_robot.wire.patterns import pattern

if TYPE_CHECKING:
    from bufgym_relay.policies import Rule as Chosen

MAX_PRIORITY: Final = 1e6
MOST_WHY: Final = 300  # Characters of why a command was not executed
MOST_OPEN: Final = 256  # Messages whose outcome a client asks for with its hello
MAX_CAPACITY: Final = 1_000  # Largest L of a subscriber's queue
ORDERS: Final = ("subscribe", "unsubscribe", "may", "publish", "ack", "clock", "recordings", "replay")
_TOLD: Final = ("send", "receive", "topic", "command_s")  # of a rule, to its client
_DIGITS: Final = bytes.maketrans(b"123456789E", b"000000000e")
_LARGE: Final = (b"e000", b"e+000", 200 * b"0")  # parts of numbers that may not be finite, with all digits made zeros
_SESSION: Final = re.compile(r"[\w.-]{1,64}", re.ASCII)


class Admitted(NamedTuple):
    """What a client that is let in may do, and has said of itself."""

    permissions: Permissions
    name: str  # sender's name as others see it
    session: str
    temporary: bool  # whether the session ends with the connection
    form: str
    received: int  # highest number of a no_drop message that it has
    acked: int  # highest number of its own that a relay has acked
    robot: str = ""  # the robot that it claims to be
    open: tuple[int, ...] = ()  # numbers of its own of which it has not heard how they ended
    whys: Mapping[int, str] = MappingProxyType({})  # number of a message that it has -> why it did not execute it


def hello(data: bytes | str) -> dict[str, Any]:
    """Read a client's first frame."""
    said = wire.heard(data) if isinstance(data, str) else {"op": "a binary frame"}
    if said["op"] != "hello":
        raise WireError(f"{said['op']}: must be hello first")
    if said["version"] != wire.VERSION or said.get("form", "binary") not in wire.FORMS:
        raise WireError(f"hello: must be of version {wire.VERSION}, of form {' or '.join(wire.FORMS)}")
    return said


def admit(said: Mapping[str, Any], identity: Identity, rules: Sequence[Rule], fresh: str) -> Admitted:
    """Let in who has said this hello; ``fresh`` names a session that has no name.

    Raises BufgymError: no rule is for it, or a name is wrong.
    """
    permissions = Permissions(rules, identity)
    if not permissions.rules:
        raise RefusedError("unauthorized", "no rule allows anything to this identity")
    session, name = said.get("session", fresh), said.get("name", identity.email or identity.address)
    if not _SESSION.fullmatch(session):
        raise WireError(f"hello: session = {session!r}: must be 1 to 64 letters, digits, '-', '_', '.'")
    wire.check_name("hello: name", name)
    if not name or name == wire.OWN:
        raise WireError(f"hello: name = {name!r}: must be a name, not the relay's")
    numbers = int(said.get("received", 0)), int(said.get("acked", 0))
    if max(numbers) >= wire.MAX_SEQ:
        raise WireError(f"hello: received, acked = {numbers}: must be less than {wire.MAX_SEQ}, for a next one")
    robot, open = said.get("robot", ""), tuple(said.get("open", ())[:MOST_OPEN])
    told = list(said.get("whys", {}).items())[:MOST_OPEN]
    whys = {int(seq): why[:MOST_WHY] for seq, why in told if seq.isdecimal() and len(seq) <= 16}
    if robot and "session" not in said:
        raise WireError("hello: robot: needs a session of a name")
    return Admitted(
        permissions, name, session, "session" not in said, said.get("form", "binary"), *numbers, robot, open, whys
    )


def welcome(config: Config, admitted: Admitted, identity: Identity, received: int, clock_us: int) -> dict[str, Any]:
    """The fields of the answer to a hello."""
    rules = admitted.permissions.rules
    return {
        "version": wire.VERSION,
        "name": admitted.name,
        "session": admitted.session,
        "identity": identity.as_json(),
        "received": received,
        "clock_us": clock_us,
        "no_drop": config.no_drop,
        "latched": config.latched,
        "window": config.store.window,
        "keep_s": config.store.keep_s,
        "max_message_bytes": config.limits.message_bytes,
        "policies": config.policies,
        "default_policy": config.policies[0],
        "default_capacity": DEFAULT_CAPACITY,
        "rules": [{name: getattr(rule, name) for name in _TOLD} for rule in rules],
    }


def asked(data: bytes | str, max_bytes: int) -> wire.Message | dict[str, Any]:
    """What a later frame asks: to publish a message, or another order."""
    if isinstance(data, bytes):
        return wire.decode(data, max_bytes)
    if len(data) > wire.MAX_JSON_BYTES:
        raise WireError(f"text of {len(data)} characters: must be at most {wire.MAX_JSON_BYTES}")
    said = wire.heard(data, wire.MAX_ORDER_CHARACTERS)
    if said["op"] not in ORDERS:
        raise WireError(f"{said['op']}: must be one of {', '.join(ORDERS)}")
    return wire.from_json(said) if said["op"] == "publish" else said


def check(
    message: wire.Message, session: StoredSession, permissions: Permissions, quota: Quota, no_drop: bool, now_s: float
) -> bool:
    """Whether a message of this session is new, not taken before; ``no_drop`` is its topic.

    Raises RefusedError: its sender may not publish it.
    """
    topic, received = message.topic, session.received
    if message.no_drop and 0 < message.seq <= received:
        return False
    quota.message(len(message.payload), now_s)
    if topic.startswith(f"/{wire.OWN}/") or not permissions.allow("send", topic):
        raise RefusedError("unauthorized", f"topic {topic}: no rule allows to send there")
    if not is_stop(topic):  # whatever else its sender says
        quota.topic(topic, session.name)
    if message.no_drop != no_drop:
        raise RefusedError("wrong", f"topic {topic}: is {'not ' if message.no_drop else ''}no_drop here")
    check_json(message)
    if is_last(topic) and (message.encoding != "json" or message.payload != GONE):
        raise RefusedError("wrong", f"topic {topic}: only null may be published here, which removes the robot")
    if message.no_drop and message.seq != received + 1:
        raise RefusedError("out_of_order", f"seq = {message.seq}: must be {received + 1}")
    return True


def check_json(message: wire.Message) -> None:
    """Raise RefusedError if the payload is not the JSON that its encoding promises."""
    topic = message.topic
    if message.encoding == "json":
        if len(message.payload) > wire.MAX_JSON_BYTES:
            raise RefusedError("too_large", f"topic {topic}: JSON must be at most {wire.MAX_JSON_BYTES} bytes")
        try:
            text = bytes(message.payload).decode()
            msgspec.json.decode(text, type=msgspec.Raw)  # as strict as a parser, and makes no objects
            zeros = bytes(message.payload).translate(_DIGITS)
            if any(part in zeros for part in _LARGE):
                msgspec.json.decode(text)
        except (ValueError, RecursionError) as error:
            raise RefusedError("wrong", f"topic {topic}: payload must be JSON: {error}") from None


def subscription(
    said: Mapping[str, Any], config: Config, policy: Chosen | None, temporary: bool, left_bytes: Callable[[], int]
) -> Subscription:
    """The subscription that is asked for, under a ``policy`` that the configuration names, or else None.

    Raises BufgymError: it is not to be had.
    """
    if policy is None:
        raise RefusedError("wrong", f"policy {said['policy']!r}: must be one of {', '.join(config.policies)}")
    capacity, priority = said.get("capacity", DEFAULT_CAPACITY), float(said.get("priority", 1.0))
    durable = said.get("durable", False)
    whole("capacity", capacity, 1, MAX_CAPACITY)
    if not 0 <= priority <= MAX_PRIORITY:
        raise RefusedError("wrong", f"priority = {priority}: must be from 0 to {MAX_PRIORITY:g}")
    if durable and temporary:
        raise RefusedError("wrong", "durable: needs a session of a name")
    wire.check_name("id", said["id"])
    topics = pattern(said["topic"])
    return Subscription(said["id"], topics, policy, capacity, priority=priority, durable=durable, left_bytes=left_bytes)
