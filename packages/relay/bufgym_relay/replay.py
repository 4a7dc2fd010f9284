"""A relay's recordings for its page, in JSON pieces with only the topics that the viewer may receive.

A recorder's file is a plain sequence of MCAP records, which may still grow. The file is walked once and an index of
times is kept, so that a piece from its middle can be read directly.
"""

import base64
import bisect
import io
import json
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader

from bufgym.utils import strict_json
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire import messages as wire

MOST_BYTES: Final = 4 * 2**20  # Limit on the payloads of a piece
_MAGIC: Final = b"\x89MCAP0\r\n"
_WORK_S: Final = 0.001  # time without a pause
_REST_S: Final = 0.002  # length of a pause
_STEP_BYTES: Final = 2**18  # distance between two indexed places of a file


def recordings(folder: Path | None) -> list[dict[str, Any]]:
    """List the files of a relay's recordings, the latest first."""
    files = list[dict[str, Any]]()
    for path in [] if folder is None or not folder.is_dir() else folder.glob("*.mcap"):
        with suppress(OSError):  # it has just been deleted
            stat = path.stat()
            files.append({"name": path.name, "bytes": stat.st_size, "modified_us": stat.st_mtime_ns // 1000})
    return sorted(files, key=lambda file: (file["modified_us"], file["name"]), reverse=True)


def piece(
    folder: Path | None, file: str, from_us: int, most_bytes: int, may_receive: Callable[[str], bool]
) -> dict[str, Any]:
    """Read messages of the recording ``file`` from ``from_us`` until payloads exceed ``most_bytes``.

    ``next_us`` is where the next piece begins, None at the end.
    """
    if folder is None or file not in {one["name"] for one in recordings(folder)}:
        raise BufgymError(f"recording {file!r}: there is none of this name")
    recording = _index(folder / file)
    recording.walk()
    messages: list[dict[str, Any]] = []
    left_bytes, last_us, next_us = min(most_bytes, MOST_BYTES), -1, None
    for record in recording.messages(from_us):
        time_us = record.log_time // 1000
        if left_bytes <= 0 and time_us > last_us:
            next_us = time_us
            break
        topic, type, encoding = recording.channels[record.channel_id]
        if not may_receive(topic):
            continue
        try:
            data = strict_json.loads(record.data) if encoding == "json" else base64.b64encode(record.data).decode()
        except ValueError:
            continue
        left_bytes -= len(record.data)
        last_us = time_us
        about = {"topic": topic, "type": type, "encoding": encoding, "sender": "", "no_drop": False}
        messages.append({**about, "seq": record.sequence, "stamp_us": time_us, "data": data})
    return {"messages": messages, "next_us": next_us, "first_us": recording.first_us, "last_us": recording.last_us}


def answer_text(id: str, *asked: Any) -> str:
    """Give the text frame with a ``piece``; written bit by bit, because others wait while JSON is written."""
    try:
        part = piece(*asked)
    except (McapError, OSError, LookupError, UnicodeDecodeError) as error:
        raise BufgymError(f"recording {asked[1]!r}: cannot be read: {type(error).__name__}: {error}") from None
    texts, breath = list[str](), _Breath()
    for message in part.pop("messages"):
        texts.append(json.dumps(message, separators=(",", ":"), allow_nan=False))
        breath.take()
    return f'{wire.say("replayed", id=id, **part)[:-1]},"messages":[{",".join(texts)}]}}'


class _Breath:
    """Pauses of a thread that computes, in which the event loop's thread gets on."""

    def __init__(self) -> None:
        self._since_s = time.monotonic()

    def take(self) -> None:
        """Pause if the last pause was some time ago."""
        if time.monotonic() - self._since_s > _WORK_S:
            time.sleep(_REST_S)
            self._since_s = time.monotonic()


class _WholeReads(io.BufferedReader):
    """A file that gives as many bytes as are asked for, or raises EndOfFile."""

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EndOfFile
        return data


class _Index:
    """Index of one recording."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, tuple[str, str, str]] = {}
        """Number -> topic, type, encoding."""
        self.first_us = self.last_us = 0
        self._schemas: dict[int, str] = {0: ""}
        self._times, self._offsets = list[int](), list[int]()
        self._end = len(_MAGIC)

    def walk(self) -> None:
        """Index the records written since the last call."""
        for offset, record, end in self._records(self._end):
            if isinstance(record, Schema):
                self._schemas[record.id] = "" if record.name == "object" else record.name
            elif isinstance(record, Channel):
                self.channels[record.id] = record.topic, self._schemas[record.schema_id], record.message_encoding
            elif isinstance(record, Chunk):
                raise BufgymError(f"recording {self.path.name}: has chunks, which no relay writes")
            elif isinstance(record, Message):
                self.last_us = record.log_time // 1000
                if not self._times:
                    self.first_us = self.last_us
                if not self._offsets or offset - self._offsets[-1] >= _STEP_BYTES:
                    self._times.append(self.last_us)
                    self._offsets.append(offset)
            self._end = end

    def messages(self, from_us: int) -> Iterator[Message]:
        """Yield the messages from that time on, as far as the walk came."""
        if self._offsets:
            place = max(0, bisect.bisect_left(self._times, from_us) - 1)
            for _, record, end in self._records(self._offsets[place]):
                if end > self._end:
                    return  # written since the walk, perhaps on a channel that it did not see
                if isinstance(record, Message) and record.log_time // 1000 >= from_us:
                    yield record

    def _records(self, offset: int) -> Iterator[tuple[int, McapRecord, int]]:
        """Yield each whole record from ``offset`` on, between its two ends in the file."""
        # The last record may still be being written, or was cut off.
        with suppress(EndOfFile), _WholeReads(io.FileIO(self.path)) as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise BufgymError(f"recording {self.path.name}: must be an MCAP file")
            file.seek(offset)
            breath = _Breath()
            for record in StreamReader(file, skip_magic=True, emit_chunks=True).records:
                yield offset, record, file.tell()
                offset = file.tell()
                breath.take()


@lru_cache(maxsize=16)
def _index(path: Path) -> _Index:
    return _Index(path)
