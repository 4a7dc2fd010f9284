"""What sender and receiver say to each other: a header of fixed length, and a body.

The sender greets with the name of its stream. The receiver answers with the number of the message that it expects next,
so that after a broken connection nothing is sent twice that arrived once, and nothing is lost, and with the largest
body that it takes. Then each message (DATA) is answered by an ACK with its number. A sender that has sent all says
GOODBYE.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

GREETING, DATA, ACK, GOODBYE = 1, 2, 3, 4
_KINDS: Final = (GREETING, DATA, ACK, GOODBYE)

_HEADER: Final = struct.Struct("!2sBxIQQqdI")
"""Magic, kind, bytes of the body, number, seq, when it was put (us), x, topic."""
HEADER_BYTES: Final = _HEADER.size
_MAGIC: Final = b"bG"
MAX_BODY_BYTES: Final = 2**26
STREAM_BYTES: Final = 16
"""Of a stream's name, which is random."""


class FrameError(ConnectionError):
    """The peer does not speak as it should; the connection is given up."""


class Frame(NamedTuple):
    """One thing said."""

    kind: int
    """GREETING, DATA, ACK or GOODBYE."""
    number: int
    """Of the message: its place among those that the socket dequeued; in a receiver's greeting the next expected."""
    seq: int = 0
    """Its place among those that were put; in a receiver's greeting the bytes of a body at most."""
    at_us: int = 0
    """When it was put, by the queue's clock."""
    x: float = 0.0
    topic: int = 0
    body: bytes | memoryview = b""


def header(frame: Frame) -> bytes:
    """What goes before the frame's body."""
    return _HEADER.pack(_MAGIC, frame.kind, len(frame.body), frame.number, frame.seq, frame.at_us, frame.x, frame.topic)


def parse(data: bytes | bytearray | memoryview, max_body_bytes: int) -> tuple[Frame, int]:
    """(the frame of a header, without its body; bytes of the body).

    Raises:
        FrameError: a header that no peer of ours sends.
    """
    if len(data) < HEADER_BYTES:
        raise FrameError(f"{len(data)} bytes: must be at least {HEADER_BYTES}, those of a header")
    magic, kind, body_bytes, number, seq, at_us, x, topic = _HEADER.unpack_from(data)
    if magic != _MAGIC or kind not in _KINDS:
        raise FrameError(f"header {bytes(data[:3])!r}: must begin with {_MAGIC!r} and a kind of {_KINDS}")
    most_bytes = {GREETING: STREAM_BYTES, DATA: max_body_bytes}.get(kind, 0)
    if body_bytes > most_bytes:
        raise FrameError(f"body of {body_bytes} bytes: must be at most {most_bytes}")
    return Frame(kind, number, seq, at_us, x, topic), body_bytes


def whole(data: bytes, max_body_bytes: int) -> Frame:
    """The frame that is all of ``data``; errors as for ``parse``."""
    frame, body_bytes = parse(data, max_body_bytes)
    if len(data) != HEADER_BYTES + body_bytes:
        raise FrameError(f"message of {len(data)} bytes: must be {HEADER_BYTES + body_bytes}, as its header says")
    return frame._replace(body=memoryview(data)[HEADER_BYTES:])
