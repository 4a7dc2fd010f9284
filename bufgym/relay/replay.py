"""A relay's recordings for its page, in JSON pieces with only the topics that the viewer may receive.

A recorder's file is a plain sequence of MCAP records, which may still grow. The file is walked once and an index of
times is kept, so that a piece from its middle can be read directly.
"""

from __future__ import annotations

import base64
import bisect
import io
import json
import struct
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from bufgym.ground.errors import BufgymError

MOST_BYTES: Final = 4 * 2**20
"""Limit on the payloads of a piece."""
_MAGIC: Final = b"\x89MCAP0\r\n"
_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
"""Channel, sequence number, log time and publish time in ns."""
_SCHEMA, _CHANNEL, _MESSAGES, _CHUNK = 3, 4, 5, 6
_STEP_BYTES: Final = 2**18
"""Distance between two indexed places of a file."""


def recordings(folder: Path | None) -> list[dict[str, Any]]:
    """List the files of a relay's recordings, the latest first."""
    paths = [] if folder is None or not folder.is_dir() else folder.glob("*.mcap")
    stats = [(path.name, path.stat()) for path in paths]
    files = [{"name": name, "bytes": stat.st_size, "modified_us": stat.st_mtime_ns // 1000} for name, stat in stats]
    return sorted(files, key=lambda file: (file["modified_us"], file["name"]), reverse=True)


def piece(
    folder: Path | None, file: str, from_us: int, most_bytes: int, may_receive: Callable[[str], bool]
) -> dict[str, Any]:
    """Read messages of the recording ``file`` from ``from_us`` until payloads exceed ``most_bytes``.

    ``next_us`` is where the next piece begins, None at the end.
    """
    if folder is None or file not in {one["name"] for one in recordings(folder)}:
        raise BufgymError(f"recording {file!r}: there is none of this name")
    recording = _recording(folder / file)
    recording.walk()
    messages: list[dict[str, Any]] = []
    left_bytes, last_us, next_us = min(most_bytes, MOST_BYTES), -1, None
    for channel, seq, time_us, payload in recording.messages(from_us):
        if left_bytes <= 0 and time_us > last_us:
            next_us = time_us
            break
        topic, type, encoding = recording.channels[channel]
        if not may_receive(topic):
            continue
        try:
            data = json.loads(payload) if encoding == "json" else base64.b64encode(payload).decode()
        except ValueError:
            continue
        left_bytes -= len(payload)
        last_us = time_us
        messages.append(
            {
                "topic": topic,
                "type": type,
                "encoding": encoding,
                "sender": "",
                "seq": seq,
                "stamp_us": time_us,
                "no_drop": False,
                "data": data,
            }
        )
    return {"messages": messages, "next_us": next_us, "first_us": recording.first_us, "last_us": recording.last_us}


class _Recording:
    """Index of one file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, tuple[str, str, str]] = {}
        """Number -> topic, type, encoding."""
        self.first_us = self.last_us = 0
        self._schemas: dict[int, str] = {0: ""}
        self._times: list[int] = []
        self._offsets: list[int] = []
        self._end = len(_MAGIC)

    def walk(self) -> None:
        """Index the records written since the last call."""
        for kind, offset, content in self._records(self._end):
            if kind in (_SCHEMA, _CHANNEL):
                self._declare(kind, content)
            elif kind == _CHUNK:
                raise BufgymError(f"recording {self.path.name}: has chunks, which no relay writes")
            elif kind == _MESSAGES:
                self.last_us = _MESSAGE.unpack_from(content)[2] // 1000
                if not self._times:
                    self.first_us = self.last_us
                if not self._offsets or offset - self._offsets[-1] >= _STEP_BYTES:
                    self._times.append(self.last_us)
                    self._offsets.append(offset)
            self._end = offset + _RECORD.size + len(content)

    def messages(self, from_us: int) -> Iterator[tuple[int, int, int, bytes]]:
        """Yield channel, number, recording time in us and payload of each message from that time on."""
        if not self._offsets:
            return
        place = max(0, bisect.bisect_left(self._times, from_us) - 1)
        for kind, _, content in self._records(self._offsets[place]):
            if kind == _MESSAGES:
                channel, seq, logged_ns, _ = _MESSAGE.unpack_from(content)
                if logged_ns // 1000 >= from_us:
                    yield channel, seq, logged_ns // 1000, content[_MESSAGE.size :]

    def _declare(self, kind: int, content: bytes) -> None:
        from mcap import records
        from mcap.data_stream import ReadDataStream

        stream = ReadDataStream(io.BytesIO(content))
        if kind == _SCHEMA:
            schema = records.Schema.read(stream)
            self._schemas[schema.id] = "" if schema.name == "object" else schema.name
        else:
            channel = records.Channel.read(stream)
            self.channels[channel.id] = channel.topic, self._schemas[channel.schema_id], channel.message_encoding

    def _records(self, offset: int) -> Iterator[tuple[int, int, bytes]]:
        """Yield kind, offset and content of each whole record from ``offset`` on."""
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise BufgymError(f"recording {self.path.name}: must be an MCAP file")
            file.seek(offset)
            while offset + _RECORD.size <= size:
                kind, length = _RECORD.unpack(file.read(_RECORD.size))
                if offset + _RECORD.size + length > size:
                    return  # the record is still being written, or was cut off
                yield kind, offset, file.read(length)
                offset += _RECORD.size + length


@lru_cache(maxsize=16)
def _recording(path: Path) -> _Recording:
    return _Recording(path)
