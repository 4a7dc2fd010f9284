"""Protocol on a relay's WebSockets: a binary frame is one message, a text frame is a JSON object with an ``op``.

A binary message is big endian and has a header of 32 bytes, then topic, type, encoding and sender in UTF-8, then the
payload. ``docs/guide/relay.md`` has the table. In JSON the same message is an object whose ``data`` is the value itself
for the encoding ``json``, and otherwise the payload in base64.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Mapping
from typing import Any, Final, NamedTuple, NoReturn

from bufgym.errors import BufgymError

PATH: Final = "/relay"
SUBPROTOCOL: Final = "bufgym.relay.v1"
VERSION: Final = 1
MESSAGE: Final = 1
"""The one kind of binary frame."""
NO_DROP: Final = 1
"""Flag of a no_drop message."""
MAX_NAME_BYTES: Final = 255
"""Length limit of a topic, type, encoding or sender."""
MAX_SEQ: Final = 2**53
"""Largest number; JavaScript's numbers are exact up to this."""
MAX_STAMP_US: Final = 2**53

_HEADER: Final = struct.Struct("!2s7B3sIQq")
"""Magic; version, kind, flags, bytes of topic, type, encoding and sender; zeros; bytes of the payload; seq; stamp."""
HEADER_BYTES: Final = _HEADER.size
_MAGIC: Final = b"bR"


class WireError(BufgymError):
    """Data that is not a frame of this protocol."""


class Message(NamedTuple):
    """One message of a topic."""

    topic: str
    payload: bytes | memoryview
    encoding: str = "json"
    """How to read the payload: json, cdr, ros1, jpeg, png, or a name that sender and receivers know."""
    type: str = ""
    """Type as in ROS, such as ``sensor_msgs/msg/LaserScan``; empty if unknown."""
    sender: str = ""
    """Sender's name, filled in by the relay."""
    seq: int = 0
    """Number of a no_drop message; free for the sender's use in any other message."""
    stamp_us: int = 0
    """Time of the put by its sender's clock, us since 1970."""
    no_drop: bool = False


def encode(message: Message) -> bytes:
    """Make the binary frame; names are checked as in ``decode``."""
    _check(message)
    names = [name.encode() for name in (message.topic, message.type, message.encoding, message.sender)]
    return b"".join(
        (
            _HEADER.pack(
                _MAGIC,
                VERSION,
                MESSAGE,
                NO_DROP if message.no_drop else 0,
                *map(len, names),
                b"\0\0\0",
                len(message.payload),
                message.seq,
                message.stamp_us,
            ),
            *names,
            message.payload,
        )
    )


def decode(data: bytes, max_bytes: int = 2**26) -> Message:
    """Read the message of a binary frame of at most ``max_bytes``.

    Raises WireError: it is not such a frame.
    """
    if not HEADER_BYTES <= len(data) <= max_bytes:
        raise WireError(f"frame of {len(data)} bytes: must be from {HEADER_BYTES} to {max_bytes}")
    magic, version, kind, flags, *lengths, zeros, payload_bytes, seq, stamp_us = _HEADER.unpack_from(data)
    if (magic, version, kind, zeros) != (_MAGIC, VERSION, MESSAGE, b"\0\0\0") or flags > NO_DROP:
        raise WireError(f"header {data[:12]!r}: must be {_MAGIC!r}, version {VERSION}, kind {MESSAGE}, a known flag")
    names, at = [], HEADER_BYTES
    for length in lengths:
        try:
            names.append(data[at : at + length].decode())
        except UnicodeDecodeError:
            raise WireError(f"name {data[at : at + length]!r}: must be UTF-8") from None
        at += length
    if len(data) != at + payload_bytes:
        raise WireError(f"frame of {len(data)} bytes: must be {at + payload_bytes}, as its header says")
    topic, kind_name, encoding, sender = names
    message = Message(
        topic, memoryview(data)[at:], encoding, kind_name, sender, seq, stamp_us, no_drop=bool(flags & NO_DROP)
    )
    _check(message)
    return message


def _check(message: Message) -> None:
    check_topic(message.topic)
    for what in ("encoding", "type", "sender"):
        check_name(what, getattr(message, what))
    if not message.encoding:
        raise WireError("encoding: must not be empty")
    if not 0 <= message.seq <= MAX_SEQ:
        raise WireError(f"seq = {message.seq}: must be from 0 to {MAX_SEQ}")
    if abs(message.stamp_us) > MAX_STAMP_US:
        raise WireError(f"stamp_us = {message.stamp_us}: must be at most {MAX_STAMP_US}")


def check_topic(topic: str) -> None:
    """Check that a topic's name is valid and begins with ``/``."""
    check_name("topic", topic)
    if not topic.startswith("/"):
        raise WireError(f"topic {topic!r}: must begin with '/'")


def check_name(what: str, name: str) -> None:
    """Check that a name is short and printable."""
    if not name.isprintable() or (not name.isascii() and _utf8_bytes(what, name) > MAX_NAME_BYTES):
        raise WireError(f"{what} {name!r}: must be printable, at most {MAX_NAME_BYTES} bytes")
    if len(name) > MAX_NAME_BYTES:
        raise WireError(f"{what} {name!r}: must be at most {MAX_NAME_BYTES} bytes")


def _utf8_bytes(what: str, name: str) -> int:
    try:
        return len(name.encode())
    except UnicodeEncodeError:
        raise WireError(f"{what} {name!r}: must be UTF-8") from None


# --- JSON ------------------------------------------------------------------------------------------------------------

_ANY: Final = object
_MESSAGE: Final = {
    "topic": (str, True),
    "data": (_ANY, True),
    "encoding": (str, False),
    "type": (str, False),
    "seq": (int, False),
    "stamp_us": (int, False),
    "no_drop": (bool, False),
}
FIELDS: Final[Mapping[str, Mapping[str, tuple[Any, bool]]]] = {
    "hello": {
        "version": (int, True),
        "name": (str, False),
        "session": (str, False),
        "token": (str, False),
        "form": (str, False),
        "received": (int, False),
        "acked": (int, False),
    },
    "welcome": {"version": (int, True), "received": (int, True), "window": (int, True), "rules": (list, True)},
    "subscribe": {
        "id": (str, True),
        "topic": (str, True),
        "policy": (str, False),
        "capacity": (int, False),
        "priority": (float, False),
        "durable": (bool, False),
    },
    "subscribed": {"id": (str, True)},
    "unsubscribe": {"id": (str, True)},
    "publish": _MESSAGE,
    "message": {**_MESSAGE, "sender": (str, True)},
    "ack": {"seq": (int, True)},
    "recordings": {"files": (list, False)},
    "replay": {"id": (str, True), "file": (str, True), "from_us": (int, True), "most_bytes": (int, True)},
    "replayed": {"id": (str, True), "messages": (list, True)},
    "delivered": {"seq": (int, True), "receivers": (int, True), "lost": (int, True)},
    "refused": {"what": (str, True), "code": (str, True), "why": (str, True)},
}
"""op -> field -> (its kind, whether it is required). Other fields are allowed, as a later version may have more."""
FORMS: Final = ("binary", "json")


def say(op: str, **fields: Any) -> str:
    """Make the text frame of an ``op``."""
    return json.dumps({"op": op, **fields}, separators=(",", ":"), allow_nan=False)


def heard(text: str) -> dict[str, Any]:
    """Read a text frame and check its ``op`` and the kinds of its fields.

    Raises WireError: it is not a frame of this protocol.
    """
    try:
        said = json.loads(text, parse_constant=no_constant)
    except (ValueError, RecursionError) as error:
        raise WireError(f"text {text[:60]!r}: must be JSON: {error}") from None
    if not isinstance(said, dict) or not isinstance(said.get("op"), str) or said["op"] not in FIELDS:
        raise WireError(f"text {text[:60]!r}: must be an object whose op is one of {', '.join(FIELDS)}")
    for field, (kind, needed) in FIELDS[said["op"]].items():
        if field not in said:
            if needed:
                raise WireError(f"{said['op']}: {field} is missing")
        elif not _is(said[field], kind):
            raise WireError(f"{said['op']}: {field} = {said[field]!r}: must be a {_KINDS[kind]}")
    return said


_KINDS: Final = {int: "whole number >= 0", str: "text", bool: "true or false", float: "number", list: "list"}


def _is(value: Any, kind: Any) -> bool:
    if kind is int:
        return type(value) is int and 0 <= value <= MAX_SEQ
    if kind is float:
        return type(value) in (int, float) and abs(value) <= MAX_SEQ
    return isinstance(value, kind)


def no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")


def to_json(message: Message, op: str = "message") -> str:
    """Make a message's text frame: ``message`` from the relay, ``publish`` to it."""
    data: Any
    if message.encoding == "json":
        try:
            data = json.loads(bytes(message.payload), parse_constant=no_constant)
        except (ValueError, RecursionError) as error:
            raise WireError(f"topic {message.topic}: payload must be JSON, as its encoding says: {error}") from None
    else:
        data = base64.b64encode(message.payload).decode()
    fields = message._asdict()
    del fields["payload"]
    return say(op, **fields, data=data)


def from_json(said: Mapping[str, Any]) -> Message:
    """Read the message of a received ``publish`` or ``message``."""
    encoding = said.get("encoding", "json")
    if encoding == "json":
        payload = json.dumps(said["data"], separators=(",", ":")).encode()
    elif isinstance(said["data"], str):
        try:
            payload = base64.b64decode(said["data"], validate=True)
        except (binascii.Error, ValueError) as error:
            raise WireError(f"data: must be base64: {error}") from None
    else:
        raise WireError(f"data: must be base64 text for encoding {encoding!r}")
    message = Message(
        said["topic"],
        payload,
        encoding,
        said.get("type", ""),
        said.get("sender", ""),
        said.get("seq", 0),
        said.get("stamp_us", 0),
        no_drop=said.get("no_drop", False),
    )
    _check(message)
    return message
