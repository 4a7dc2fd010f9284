"""What goes over a relay's WebSockets: binary frames are a message each, text frames are JSON objects with an ``op``.

A binary message, big endian (``PROTOCOL.md``): a header of 32 bytes, then topic, type, encoding
and sender in UTF-8, then the payload. In JSON the same message is an object whose ``data`` is the value itself
where the encoding is ``json``, and base64 of the payload where it is not.
"""

import base64
import json
import struct
from collections.abc import Mapping
from typing import Annotated, Any, Final, NamedTuple

import msgspec
from msgspec import Meta

from bufgym.utils import strict_json
from bufgym.utils.errors import BufgymError

PATH: Final = "/relay"
SUBPROTOCOL: Final = "bufgym.relay.v1"
UNKNOWN: Final = "nobody knows whether it was executed"
OWN: Final = "relay"  # The relay's name as a sender, and the prefix of its topics
MAX_FRAME_BYTES: Final = 2**26
PING_S: Final = 20.0  # Time between two pings of either end
PONG_S: Final = 60.0  # Time for a pong, which on a slow link waits long behind the message being sent
MAX_JSON_BYTES: Final = 2**20  # Size limit of a text frame and of a JSON payload, which take time to read
MAX_ORDER_CHARACTERS: Final = 2**16  # Size limit of a client's text frame that publishes nothing
VERSION: Final = 1
MESSAGE: Final = 1  # The one kind of binary frame
NO_DROP: Final = 1  # A flag
TIMES: Final = 2  # A flag: two times by the relay's clock follow the header
ORDER: Final = 4  # A flag: a command's number and the stops that the relay knew follow
MAX_NAME_BYTES: Final = 255  # Of a topic, a type, an encoding, a sender
MAX_SEQ: Final = 2**53  # Numbers are exact in JavaScript up to this
MAX_STAMP_US: Final = 2**53
MAX_SEEN: Final = 2**14  # Characters of the stops that a command names

_HEADER: Final = struct.Struct("!2s7B3sIQq")
"""Magic; version, kind, flags, bytes of topic, type, encoding and sender; zeros; bytes of the payload; seq; stamp."""
HEADER_BYTES: Final = _HEADER.size
_TIMES: Final = struct.Struct("!QQ")
_ORDER: Final = struct.Struct("!QH")
"""The command's number; bytes of the stops."""
_MAGIC: Final = b"bR"


class WireError(BufgymError):
    """What came is no frame of this protocol."""


class RefusedError(BufgymError):
    """A request that the relay refuses; ``code`` gives the reason in a word."""

    def __init__(self, code: str, why: str) -> None:
        super().__init__(why)
        self.code = code


class Message(NamedTuple):
    """One message of a topic."""

    topic: str
    payload: bytes | memoryview
    encoding: str = "json"
    """How to read the payload: json, cdr, ros1, jpeg, png, or a name that sender and receivers know."""
    type: str = ""
    """As in ROS, ``sensor_msgs/msg/LaserScan``; empty if unknown."""
    sender: str = ""
    """The relay fills it in."""
    seq: int = 0
    """A no_drop message's number on its way; any other's is its sender's own business."""
    stamp_us: int = 0
    """When it was put, us since 1970, by its sender's clock."""
    no_drop: bool = False
    at_us: int = 0
    """When the relay took it, us by the relay's clock. The relay fills it in."""
    until_us: int = 0
    """Deadline, us by the relay's clock: later it is not executed. 0: none."""
    number: int = 0
    """A command's own number, the same however often it is sent; 0 of all else. The relay fills it in."""
    seen: str = ""
    """The robot's stops that the relay knew when it took a command, as ``Ledger.seen``. The relay fills it in."""


def encode(message: Message) -> bytes:
    """The binary frame; names are checked, as in ``decode`` are."""
    _check(message)
    names = [name.encode() for name in (message.topic, message.type, message.encoding, message.sender)]
    numbers = len(message.payload), message.seq, message.stamp_us
    times = _TIMES.pack(message.at_us, message.until_us) if message.at_us or message.until_us else b""
    seen = message.seen.encode()
    order = _ORDER.pack(message.number, len(seen)) + seen if message.number or seen else b""
    flags = NO_DROP * message.no_drop | TIMES * bool(times) | ORDER * bool(order)
    header = _HEADER.pack(_MAGIC, VERSION, MESSAGE, flags, *map(len, names), b"\0\0\0", *numbers)
    return b"".join((header, times, order, *names, message.payload))


def decode(data: bytes, max_bytes: int = MAX_FRAME_BYTES) -> Message:
    """The message of a binary frame of at most ``max_bytes``.

    Raises WireError: it is none.
    """
    if not HEADER_BYTES <= len(data) <= max_bytes:
        raise WireError(f"frame of {len(data)} bytes: must be from {HEADER_BYTES} to {max_bytes}")
    magic, version, kind, flags, *lengths, zeros, payload_bytes, seq, stamp_us = _HEADER.unpack_from(data)
    if (magic, version, kind, zeros) != (_MAGIC, VERSION, MESSAGE, b"\0\0\0") or flags > NO_DROP | TIMES | ORDER:
        raise WireError(f"header {data[:12]!r}: must be {_MAGIC!r}, version {VERSION}, kind {MESSAGE}, a known flag")
    names, at, at_us, until_us, number, seen = [], HEADER_BYTES, 0, 0, 0, ""
    least = at + _TIMES.size * bool(flags & TIMES) + _ORDER.size * bool(flags & ORDER)
    if len(data) < least:
        raise WireError(f"frame of {len(data)} bytes: must be at least {least}, as its header says")
    if flags & TIMES:
        at_us, until_us = _TIMES.unpack_from(data, at)
        at += _TIMES.size
    if flags & ORDER:
        number, seen_bytes = _ORDER.unpack_from(data, at)
        at += _ORDER.size
        seen = bytes(data[at : at + seen_bytes]).decode(errors="replace")
        at += seen_bytes
    for length in lengths:
        try:
            names.append(data[at : at + length].decode())
        except UnicodeDecodeError:
            raise WireError(f"name {data[at : at + length]!r}: must be UTF-8") from None
        at += length
    if len(data) != at + payload_bytes:
        raise WireError(f"frame of {len(data)} bytes: must be {at + payload_bytes}, as its header says")
    topic, kind_name, encoding, sender = names
    payload, no_drop = memoryview(data)[at:], bool(flags & NO_DROP)
    message = Message(
        topic, payload, encoding, kind_name, sender, seq, stamp_us, no_drop, at_us, until_us, number, seen
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
    if not 0 <= message.at_us <= MAX_STAMP_US or not 0 <= message.until_us <= MAX_STAMP_US:
        raise WireError(f"at_us = {message.at_us}, until_us = {message.until_us}: must be from 0 to {MAX_STAMP_US}")
    if not 0 <= message.number <= MAX_SEQ or len(message.seen) > MAX_SEEN:
        raise WireError(f"number = {message.number}: must be from 0 to {MAX_SEQ}, with at most {MAX_SEEN} of stops")


def check_topic(topic: str) -> None:
    """A topic's name begins with ``/``."""
    check_name("topic", topic)
    if not topic.startswith("/"):
        raise WireError(f"topic {topic!r}: must begin with '/'")


def check_name(what: str, name: str) -> None:
    """A name is short, and prints as it stands: so it is UTF-8."""
    if not is_name(name):
        raise WireError(f"{what} {name!r}: must be printable, at most {MAX_NAME_BYTES} bytes")


def check_robot(name: str) -> None:
    """Raise WireError if a robot's topics cannot have this name."""
    check_name("robot", name)
    longest = MAX_NAME_BYTES - len("/robots//command")
    if not name or "/" in name or len(name.encode()) > longest:
        raise WireError(f"robot {name!r}: must be a printable text without '/' of at most {longest} bytes")


def is_name(name: str) -> bool:
    """Whether it may be a name."""
    return name.isprintable() and len(name.encode()) <= MAX_NAME_BYTES


Number = Annotated[int, Meta(ge=0, le=MAX_SEQ)]
_MESSAGE: Final = {
    "topic": str,
    "data": Any,
    "encoding?": str,
    "type?": str,
    "seq?": Number,
    "stamp_us?": Annotated[int, Meta(ge=-MAX_STAMP_US, le=MAX_STAMP_US)],
    "no_drop?": bool,
    "until_us?": Number,
}
FIELDS: Final[Mapping[str, Mapping[str, Any]]] = {
    "hello": {
        "version": Number,
        **dict.fromkeys(("name?", "session?", "robot?", "token?", "form?"), str),
        **dict.fromkeys(("received?", "acked?"), Number),
        "open?": list[Number],
        "whys?": dict[str, str],
    },
    "welcome": {
        "version": Number,
        "received": Number,
        "window": Number,
        "rules": list[Any],
        "max_message_bytes?": Number,
        "clock_us?": Number,
    },
    "clock": {"clock_us?": Number},
    "subscribe": {
        "id": str,
        "topic": str,
        "policy?": str,
        "capacity?": Number,
        "priority?": Annotated[float, Meta(ge=-MAX_SEQ, le=MAX_SEQ)],
        "durable?": bool,
    },
    "subscribed": {"id": str},
    "unsubscribe": {"id": str},
    "may": {"topics": list[str]},
    "rights": {"rights": dict[str, Any]},
    "publish": {**_MESSAGE, "data": msgspec.Raw},
    "message": {**_MESSAGE, "sender": str, "at_us?": Number, "number?": Number, "seen?": str},
    "ack": {"seq": Number, "why?": str},
    "recordings": {"files?": list[Any]},
    "replay": {"id": str, "file": str, "from_us": Number, "most_bytes": Number},
    "replayed": {"id": str, "messages": list[Any]},
    "delivered": {"seq": Number, "receivers": Number, "lost": Number, "why?": str},
    "stopped": {"topic": str, "id": str},
    "refused": {"what": str, "code": str, "why": str},
}
"""op -> field -> its type; "?" follows the name of a field that may be left out. A later version may have more."""


def _kind(op: str, fields: Mapping[str, Any]) -> Any:
    """Make the type of an ``op``; fields that may be left out stand behind the others."""
    needed = [(name, kind) for name, kind in fields.items() if name[-1] != "?"]
    optional = [(name[:-1], kind, None) for name, kind in fields.items() if name[-1] == "?"]
    return msgspec.defstruct(op, [*needed, *optional])


class _Order(msgspec.Struct):
    op: str


_KINDS: Final = {op: _kind(op, fields) for op, fields in FIELDS.items()}
FORMS: Final = ("binary", "json")


def say(op: str, **fields: Any) -> str:
    """The text frame of an ``op``."""
    return json.dumps({"op": op, **fields}, separators=(",", ":"), allow_nan=False)


def written(topic: str, data: Any) -> bytes:
    """The payload of a message of JSON; raises WireError if ``data`` cannot be written so."""
    try:
        return json.dumps(data, separators=(",", ":"), allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise WireError(f"topic {topic!r}: data must be JSON: {error}") from None


def heard(text: str, most_characters: int = MAX_FRAME_BYTES) -> dict[str, Any]:
    """The object of a text frame: its ``op`` is known, its fields are of their kinds.

    The ``data`` that is published is not parsed, and stays ``msgspec.Raw``. All else has at most so many characters.

    Raises WireError: it is none of this protocol.
    """
    try:
        op = msgspec.json.decode(text, type=_Order).op
    except msgspec.ValidationError:
        op = ""
    except (ValueError, RecursionError) as error:
        raise WireError(f"text {text[:60]!r}: must be JSON: {error}") from None
    if op not in FIELDS:
        raise WireError(f"text {text[:60]!r}: must be an object whose op is one of {', '.join(FIELDS)}")
    if op != "publish" and len(text) > most_characters:
        raise WireError(f"{op}: text of {len(text)} characters: must be at most {most_characters}")
    try:
        if op == "publish":
            fields = msgspec.structs.asdict(msgspec.json.decode(text, type=_KINDS[op]))
            return {"op": op, **{name: value for name, value in fields.items() if value is not None}}
        said: dict[str, Any] = strict_json.loads(text)
        msgspec.convert(said, _KINDS[op])
    except msgspec.ValidationError as error:
        raise WireError(f"{op}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise WireError(f"text {text[:60]!r}: must be JSON: {error}") from None
    return said


def to_json(message: Message) -> str:
    """The message as a text frame from the relay, which has seen that JSON is JSON."""
    fields = {name: value for name, value in message._asdict().items() if value or name not in ("number", "seen")}
    del fields["payload"]
    if message.encoding != "json":
        return say("message", **fields, data=base64.b64encode(message.payload).decode())
    return f'{say("message", **fields)[:-1]},"data":{bytes(message.payload).decode()}}}'


def from_json(said: Mapping[str, Any]) -> Message:
    """The message of a ``publish`` that was heard; its JSON is checked later."""
    encoding = said.get("encoding", "json")
    try:
        data = said["data"]
        payload = (
            bytes(data) if encoding == "json" else base64.b64decode(msgspec.json.decode(data, type=str), validate=True)
        )
    except ValueError as error:
        raise WireError(f"data: must be base64 text for encoding {encoding!r}: {error}") from None
    fields = {name: said[name] for name in Message._fields if name in said}
    message = Message(**{**fields, "payload": payload})
    _check(message)
    return message
