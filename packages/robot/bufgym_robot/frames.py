"""Frames between sender and receiver: a header of fixed length, and a body.

The sender greets with the name of its stream. The receiver answers with the largest body that it takes and the number
of the next message that it expects. So after a broken connection no message is lost, and none that arrived is sent
again. Each message (DATA) is then answered by an ACK with its number. A sender that has sent all says GOODBYE.

Latched state (LATCHED) is no message of the queue and has numbers of its own. The receiver answers it by LATCHED with
its number and no body. The receiver's greeting also names its run, so that a sender knows one that was restarted.

A sender with nothing on its way says PING each second, which TCP acks (``path_watch``); the receiver does not answer,
because it may be busy for long with the message before.
"""

import contextlib
import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

GREETING, DATA, ACK, GOODBYE, LATCHED, PING = 1, 2, 3, 4, 5, 6
_KINDS: Final = (GREETING, DATA, ACK, GOODBYE, LATCHED, PING)

_HEADER: Final = struct.Struct("!2sBxIQQqdI")
"""Magic, kind, bytes of the body, number, seq, time of the put in us, x, topic."""
HEADER_BYTES: Final = _HEADER.size
_MAGIC: Final = b"bG"
MAX_BODY_BYTES: Final = 2**26
STREAM_BYTES: Final = 16  # Length of a stream's name, which is random


class FrameError(ConnectionError):
    """A violation of the protocol by the peer; the connection is given up."""


class Frame(NamedTuple):
    """One frame."""

    kind: int  # GREETING, DATA, ACK, GOODBYE, LATCHED or PING
    number: int
    """Index of the message among all that the socket dequeued; in a receiver's greeting the next one expected."""
    seq: int = 0
    """Index of the message among all that were put; in a receiver's greeting the largest body in bytes; of latched
    state its publisher."""
    at_us: int = 0
    """Time of the put by the queue's clock; in a receiver's greeting its run; of latched state its publication."""
    x: float = 0.0
    topic: int = 0
    body: bytes | memoryview = b""


def header(frame: Frame) -> bytes:
    """Make the header, which goes before the frame's body."""
    return _HEADER.pack(_MAGIC, frame.kind, len(frame.body), frame.number, frame.seq, frame.at_us, frame.x, frame.topic)


def parse(data: bytes | bytearray | memoryview, max_body_bytes: int) -> tuple[Frame, int]:
    """Read a header; return its frame without the body, and the bytes of the body.

    Raises:
        FrameError: the header is invalid.
    """
    if len(data) < HEADER_BYTES:
        raise FrameError(f"{len(data)} bytes: must be at least {HEADER_BYTES}, those of a header")
    magic, kind, body_bytes, number, seq, at_us, x, topic = _HEADER.unpack_from(data)
    if magic != _MAGIC or kind not in _KINDS:
        raise FrameError(f"header {bytes(data[:3])!r}: must begin with {_MAGIC!r} and a kind of {_KINDS}")
    most_bytes = {GREETING: STREAM_BYTES, DATA: max_body_bytes, LATCHED: max_body_bytes}.get(kind, 0)
    if body_bytes > most_bytes:
        raise FrameError(f"body of {body_bytes} bytes: must be at most {most_bytes}")
    return Frame(kind, number, seq, at_us, x, topic), body_bytes


def whole(data: bytes, max_body_bytes: int) -> Frame:
    """Read ``data`` as one whole frame; errors as for ``parse``."""
    frame, body_bytes = parse(data, max_body_bytes)
    if len(data) != HEADER_BYTES + body_bytes:
        raise FrameError(f"message of {len(data)} bytes: must be {HEADER_BYTES + body_bytes}, as its header says")
    return frame._replace(body=memoryview(data)[HEADER_BYTES:])


class Room:
    """Room for the bodies that arrive at one receiver at the same time, over all its connections."""

    def __init__(self, most_bytes: int) -> None:
        self.left_bytes = most_bytes

    @contextlib.contextmanager
    def taken(self, size_bytes: int) -> Iterator[None]:
        """Take room until the block ends; raise a FrameError if too little is left."""
        if size_bytes > self.left_bytes:
            raise FrameError(f"body of {size_bytes} bytes: must wait, {self.left_bytes} are left for all senders")
        self.left_bytes -= size_bytes
        try:
            yield
        finally:
            self.left_bytes += size_bytes
