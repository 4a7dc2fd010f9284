"""The files of recordings: every message in an MCAP file, a ROS 1 bag or a SQLite file, in the order of the file.

A recording may be untrusted, so none of its own figures is trusted. A record is no longer than the file, a chunk
unpacks to no more than MAX_CHUNK_BYTES, and the whole to no more than `files.unpacked_limit` of its size. SQLite views
can make a small file endless. So rosbag2's SQLite files are read by two plain queries.
"""

import bz2
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bufgym.traces.formats.definitions import BagTopic, ros_type
from bufgym.traces.formats.packed import unzstd
from bufgym.utils.files import unpacked_limit

if TYPE_CHECKING:
    import sqlite3

# A chunk of a recording has some MB, a robot some hundred topics; more is a mistake, or a bomb.
MAX_CHUNK_BYTES: Final = 2**28
MAX_TOPICS: Final = 10_000
BETWEEN_TYPES: Final = " and "
MCAP_MAGIC: Final = b"\x89MCAP0\r\n"

_RECORD: Final = struct.Struct("<BQ")  # an MCAP record's kind and length
_MESSAGE: Final = struct.Struct("<HIQQ")  # bagTopic, sequence number, when it was logged and when it was published, ns

Message = tuple[BagTopic, int, bytes]
"""Its channel, when it was logged in ns, and its serialised form."""
Doubt = Callable[[str], object]
"""Called with words on a file that was read and may still be wrong."""


class RefusedError(ValueError):
    """A rule that a sound file may break too: a limit, or a form that is not read."""


class Unpacked:
    """Counts what comes out of a recording."""

    def __init__(self, packed_bytes: int) -> None:
        self.most_bytes = unpacked_limit(packed_bytes)
        self._left = self.most_bytes

    def add(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise RefusedError(f"unpacks to more than {self.most_bytes} bytes: must be less, or be unpacked before")


class _Bounded(io.BufferedReader):
    """A file that reads no more than it holds, so that a damaged length does not become an allocation."""

    ends_early = False  # whether a read beyond the end is the file's end, and not a part of what was asked for

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.left = self.size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1) -> bytes:
        if self.ends_early and size is not None and size > self.left:
            raise EOFError
        data = super().read(self.left if size is None or size < 0 else min(size, self.left))
        self.left -= len(data)
        return data


def mcap(path: Path, types: dict[str, str], doubt: Doubt = str) -> Iterator[Message]:
    """Every message of an MCAP file, or of several joined; adds every topic to ``types``, even without messages."""
    with _Bounded(path) as file:
        unpacked, count = Unpacked(file.size), 0
        while True:
            yield from _one_mcap(file, unpacked, types)
            count += 1
            if not file.peek(len(MCAP_MAGIC)).startswith(MCAP_MAGIC):
                break
        if count > 1:
            doubt(f"holds {count} MCAP files, joined: all are read")
        if file.left:
            doubt(f"{file.left:,} bytes follow its end: they are not read")


def _one_mcap(file: _Bounded, unpacked: Unpacked, types: dict[str, str]) -> Iterator[Message]:
    """The messages up to the end that the file says it has."""
    from mcap import records
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.stream_reader import StreamReader

    schemas: dict[int, tuple[str, str, str]] = {}  # name, definition and its language
    channels: dict[int, BagTopic] = {}

    def declared(record: Any) -> None:
        if isinstance(record, records.Schema):
            schemas[record.id] = record.name, record.data.decode("utf-8", "replace"), record.encoding
        elif isinstance(record, records.Channel):
            name, definition, language = schemas.get(record.schema_id, ("", "", ""))
            type = ros_type(name)
            _add(types, record.topic, type)
            publisher, encoding = record.metadata.get("callerid", ""), record.message_encoding
            channels[record.id] = BagTopic(record.topic, type, encoding, definition, language, record.id, publisher)

    reader = StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES)
    for record in _ours_may_end(reader.records, file):
        declared(record)
        if isinstance(record, records.Message):
            yield channels[record.channel_id], record.log_time, record.data
        elif isinstance(record, records.Chunk):
            for kind, content in _records(_chunk(record, unpacked)):
                if kind == Opcode.MESSAGE:
                    number, _, logged_ns, _ = _MESSAGE.unpack_from(content)
                    yield channels[number], logged_ns, bytes(content[_MESSAGE.size :])
                elif kind == Opcode.SCHEMA:
                    declared(records.Schema.read(ReadDataStream(io.BytesIO(content))))
                elif kind == Opcode.CHANNEL:
                    declared(records.Channel.read(ReadDataStream(io.BytesIO(content))))


def _ours_may_end(records: Iterator[Any], file: _Bounded) -> Iterator[Any]:
    """The records; a file that bufgym was writing when it was killed ends with its last whole record."""
    try:
        for record in records:
            file.ends_early = file.ends_early or getattr(record, "library", "") == "bufgym"
            yield record
    except EOFError:
        file.left = 0  # a part of a record


def _records(chunk: bytes) -> Iterator[tuple[int, memoryview]]:
    """(kind, content) of the records in a chunk, one at a time: millions of small ones do not become objects."""
    view, at = memoryview(chunk), 0
    while at < len(view):
        kind, length = _RECORD.unpack_from(view, at)
        at += _RECORD.size
        if length > len(view) - at:
            raise ValueError("a record longer than its chunk")
        yield kind, view[at : at + length]
        at += length


def _chunk(chunk: Any, unpacked: Unpacked) -> bytes:
    """The chunk's records; it must hold as much as it says."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise RefusedError(f"a chunk of {size} bytes: must be at most {MAX_CHUNK_BYTES}")
    unpacked.add(size)
    if chunk.compression == "zstd":
        data = unzstd(chunk.data, size)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise RefusedError(f"compression {chunk.compression!r}: must be zstd, lz4 or none")
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes that says {size}")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a chunk whose checksum is wrong")
    return data


def _add(types: dict[str, str], topic: str, type: str) -> None:
    """Note a topic's type; two publishers may send different types on one topic, which then has both."""
    known = [name for name in types.get(topic, "").split(BETWEEN_TYPES) if name]
    types[topic] = BETWEEN_TYPES.join(known if type in known or not type else [*known, type])


def sqlite(path: Path, types: dict[str, str], doubt: Doubt = str) -> Iterator[Message]:
    """Every message of one of rosbag2's SQLite files; one with a journal must be a copy, because SQLite changes it."""
    import sqlite3  # few read such files, and all that read a trace look whether it is a recording

    mode = "mode=rw" if journals(path) else "mode=ro&immutable=1"
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True)) as base:
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CHUNK_BYTES)
        base.execute("PRAGMA trusted_schema = OFF")
        kinds = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('messages', 'topics')"
        if base.execute(kinds).fetchone() != (2,):
            raise RefusedError("no table of messages and topics")
        channels: dict[int, BagTopic] = {}
        definitions = dict(_definitions(base))
        for number, topic, type, encoding in base.execute("SELECT id, name, type, serialization_format FROM topics"):
            if encoding != "cdr" or not isinstance(topic, str) or not isinstance(type, str):
                raise RefusedError(f"topic {topic!r} of type {type!r} in {encoding!r}: must be text, in cdr")
            if len(channels) > MAX_TOPICS:
                break  # who reads on says so
            definition, language = definitions.get(type, ("", ""))
            type = ros_type(type)
            _add(types, topic, type)
            channels[number] = BagTopic(topic, type, "cdr", definition, language, number)
        for number, logged_ns, data in base.execute("SELECT topic_id, timestamp, data FROM messages"):
            if not isinstance(logged_ns, int) or not isinstance(data, bytes):
                raise RefusedError("a message's time must be a whole number, and its data bytes")
            yield channels[number], logged_ns, data
        pages, page_bytes = (base.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size"))
        if (left := path.stat().st_size - pages * page_bytes) > 0:
            doubt(f"{left:,} bytes follow its end: they are not read")


def _definitions(base: "sqlite3.Connection") -> Iterator[tuple[str, tuple[str, str]]]:
    """Each type that a SQLite file defines, as since ROS 2 Iron, with the text and its language."""
    import sqlite3

    if base.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'message_definitions'").fetchone():
        query = "SELECT topic_type, encoded_message_definition, encoding FROM message_definitions"
        # A text over the limit of a message is no definition.
        with suppress(sqlite3.DataError):
            for type, definition, language in base.execute(f"{query} LIMIT {MAX_TOPICS}"):
                yield str(type), (str(definition), str(language))


def journals(path: Path) -> list[str]:
    """Endings of the files beside a SQLite file that hold a part of its messages."""
    files = {ending: Path(f"{path}{ending}") for ending in ("-wal", "-journal")}
    return [ending for ending, file in files.items() if file.is_file() and file.stat().st_size]


def ros1(path: Path, types: dict[str, str], doubt: Doubt = str) -> Iterator[Message]:
    """Every message of a ROS 1 bag."""
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import IndexData

    class _InFile(IndexData):
        """An entry of a bag's index, which compares by its place in the file."""

        def __lt__(self, other: Any) -> bool:
            return (self.chunk_pos, self.offset) < (other.chunk_pos, other.offset)

    class _ToItsEnd(Reader):
        """Notes where the bag ends by its own word."""

        ends_at = path.stat().st_size

        def read_chunk_info(self) -> Any:
            about = super().read_chunk_info()
            self.ends_at = self.bio.tell()  # type: ignore[union-attr]  # is open
            return about

    with _ToItsEnd(path) as reader:
        unpacked = Unpacked(path.stat().st_size)
        if (left := path.stat().st_size - reader.ends_at) > 0:
            doubt(f"{left:,} bytes follow its end, as where bags were joined: they are not read (give each as a file)")
        for place, chunk in reader.chunks.items():
            reader.chunks[place] = chunk._replace(decompressor=_limited(chunk.decompressor, unpacked))
        channels: dict[int, BagTopic] = {}
        for connection in reader.connections:
            _add(types, connection.topic, connection.msgtype)
            about = connection.msgdef.data, "ros1msg", connection.id, getattr(connection.ext, "callerid", None) or ""
            channels[connection.id] = BagTopic(connection.topic, connection.msgtype, "ros1", *about)
        # The reader merges by time. In order of the file, a clock that went back shows.
        reader.indexes = {number: sorted(map(_InFile._make, index)) for number, index in reader.indexes.items()}
        for connection, logged_ns, data in reader.messages(list(reader.connections)):
            yield channels[connection.id], logged_ns, data


def _limited(decompress: Callable[[bytes], bytes], unpacked: Unpacked) -> Callable[[bytes], bytes]:
    """The decompression of a ROS 1 chunk, limited to MAX_CHUNK_BYTES of output."""
    import lz4.frame

    decompressors: dict[Any, Callable[[], Any]] = {
        bz2.decompress: bz2.BZ2Decompressor,
        lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
    }
    if decompress not in decompressors:
        return decompress

    def limited(data: bytes) -> bytes:
        content: bytes = decompressors[decompress]().decompress(data, max_length=MAX_CHUNK_BYTES + 1)
        if len(content) > MAX_CHUNK_BYTES:
            raise RefusedError(f"a chunk of more than {MAX_CHUNK_BYTES} bytes: must be at most that")
        unpacked.add(len(content))
        return content

    return limited


SOURCES: Final = {"mcap": mcap, "ros1": ros1, "rosbag2": sqlite}  # Reader of each kind of file
