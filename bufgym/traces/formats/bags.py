"""Recordings of robots: when each message arrived, how large it was, on which topic; and the poses among them.

| recording | read with |
|---|---|
| MCAP file, or a folder of them (rosbag2 with mcap storage) | `mcap` |
| ROS 1 bag (`.bag`), rosbag2 with sqlite3 storage (its folder, or the `.db3` alone) | `rosbags` |

Both come with the extra ``ros``. The kind is recognised by the content, not by the name. A message arrives when the
recorder logged it, and its size is that of its serialised form (CDR or ROS 1), which is what a bridge forwards. A
message without content counts as 1 byte. Poses come from nav_msgs/Odometry, geometry_msgs/PoseStamped and
PoseWithCovarianceStamped, and from tf, at the same arrival times.

A recording that breaks off (as when a robot loses power) is refused as a whole; the recorder's own tools (``mcap
recover``, ``rosbag reindex``) save what can be saved.
"""

from __future__ import annotations

import bz2
import io
import os
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Final

import numpy as np

from bufgym.errors import BufgymError
from bufgym.traces.formats.bag_poses import Channel, PoseCollector
from bufgym.traces.formats.faults import StrPath, fault, os_errors
from bufgym.traces.poses import Poses
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

MAX_BAG_MESSAGES: Final = 10**7
# A chunk of a recording has some MB; a longer one is a mistake, or a compression bomb.
MAX_CHUNK_BYTES: Final = 2**30

_MAGICS: Final = {b"\x89MCAP0\r\n": "mcap", b"#ROSBAG V": "ros1", b"SQLite format 3\0": "rosbag2"}

_Message = tuple[Channel, int, bytes]
"""Its channel, when it was logged in ns, and its serialised form."""


@dataclass(frozen=True, eq=False)
class Bag:
    """What a recording holds, in order of arrival."""

    path: str
    """The file or folder."""
    kind: str
    """"mcap", "ros1" or "rosbag2"."""
    topics: dict[str, str]
    """Topic -> type, in order of name."""
    time_ns: Int64Array
    """int64[n], when the recorder logged each message, ns since its epoch; non-decreasing."""
    size_bytes: Int64Array
    """int64[n], serialised, at least 1."""
    topic: Int64Array
    """int64[n], which of `topics`."""
    poses: Poses | None = None
    """The poses of the requested odometry, None if none was requested."""
    poses_from_ns: int = 0
    """When the poses' times begin, ns since the recorder's epoch."""


def matching(source: str, names: Sequence[str], patterns: Sequence[str] | None) -> list[str]:
    """The topics among ``names`` that fit a name or a pattern such as ``/camera/*``; all of them for None.

    Raises:
        BufgymError: a name or pattern that fits no topic; the message lists the topics.
    """
    if patterns is None:
        return list(names)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise BufgymError(f"{source}: no topic {pattern!r}; it has: {', '.join(names) or 'none'}")
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def is_bag(path: StrPath) -> bool:
    """Whether this is a recording, by its first bytes (a folder: by its content), whatever its name."""
    return _kind(Path(path)) != ""


def read_bag(path: StrPath, odom: str | None = None) -> Bag:
    """Read every message's arrival time, size and topic, and the poses of one topic.

    Args:
        path: an MCAP file, a ROS 1 bag, a rosbag2 folder or ``.db3`` file.
        odom: topic to take poses from; for tf, which holds many, ``TOPIC:PARENT:CHILD``.

    Raises:
        TraceError: missing, not a recording, cut off, damaged, more than 10**7 messages, longer than 10**7 s.
        BufgymError: the extra ``ros`` is not installed; ``odom`` is no topic or carries no poses.
    """
    kind = _kind(Path(path))
    if not kind:
        rule = "must be an MCAP file, a ROS 1 bag, or a rosbag2 folder or .db3 file"
        raise fault(path, rule if Path(path).exists() else "no such file")
    collector = None if odom is None else PoseCollector(path, odom)
    types: dict[str, str] = {}
    numbers: dict[str, int] = {}
    columns = (array("q"), array("q"), array("q"))
    with _damage_errors(path):
        for channel, logged_ns, data in _SOURCES[kind](Path(path), types):
            if len(columns[0]) >= MAX_BAG_MESSAGES:
                raise fault(path, f"more than {MAX_BAG_MESSAGES} messages: must be fewer")
            row = (logged_ns, max(1, len(data)), numbers.setdefault(channel.topic, len(numbers)))
            for column, value in zip(columns, row, strict=True):
                column.append(value)
            if collector is not None and channel.topic == collector.topic:
                collector.add(channel, logged_ns, data)
        time_ns, size_bytes, number = (np.array(column, np.int64) for column in columns)
    if len(time_ns) and int(time_ns.max()) - int(time_ns.min()) > MAX_DURATION_S * 10**9:
        raise fault(path, f"spans more than {MAX_DURATION_S} s: must be at most that")
    # Recorders with several threads do not log in order of time.
    order = np.argsort(time_ns, kind="stable")
    topics = {name: types.get(name, "") for name in sorted(set(types) | set(numbers))}
    place = np.array([list(topics).index(name) for name in numbers], np.int64)
    topic = place[number[order]] if len(numbers) else number
    bag = Bag(str(path), kind, topics, time_ns[order], size_bytes[order], topic)
    if collector is None:
        return bag
    from_ns, poses = collector.poses(topics)
    return replace(bag, poses=poses, poses_from_ns=from_ns)


# --- the three kinds -------------------------------------------------------------------------------------------------


def _kind(path: Path) -> str:
    """ "mcap", "ros1", "rosbag2", or "" for anything else."""
    with os_errors(path, "opened"):
        if path.is_dir():
            if next(path.glob("*.mcap"), None) is not None:
                return "mcap"
            return "rosbag2" if (path / "metadata.yaml").is_file() else ""
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            head = file.read(16)
    return next((kind for magic, kind in _MAGICS.items() if head.startswith(magic)), "")


@contextmanager
def _damage_errors(path: StrPath) -> Iterator[None]:
    """Turn whatever the libraries raise on a damaged file into one error that names the file."""
    try:
        yield
    except BufgymError:
        raise
    except ModuleNotFoundError as error:
        raise BufgymError(f'{path}: reading recordings needs {error.name}: pip install "bufgym[ros]"') from None
    except Exception as error:
        # Parsers of binary formats raise nearly anything on bytes that are not what they should be.
        words = " ".join(str(error).split()) or "no more data"
        raise fault(path, f"cut off or damaged: {type(error).__name__}: {words[:160]}") from error


class _Bounded(io.BufferedReader):
    """A file that reads no more than it holds, so that a damaged length does not become an allocation."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(self._left if size is None or size < 0 else min(size, self._left))
        self._left -= len(data)
        return data


def _mcap(path: Path, types: dict[str, str]) -> Iterator[_Message]:
    """Every message of an MCAP file, or of all in a folder; adds every topic to ``types``, even without messages."""
    from mcap import records
    from mcap.stream_reader import StreamReader, breakup_chunk

    for file_path in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        schemas: dict[int, str] = {}
        channels: dict[int, Channel] = {}
        with _Bounded(file_path) as file:
            reader = StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES)
            for record in reader.records:
                parts = breakup_chunk(_unpacked(record), True) if isinstance(record, records.Chunk) else [record]
                for part in parts:
                    if isinstance(part, records.Schema):
                        schemas[part.id] = part.name
                    elif isinstance(part, records.Channel):
                        types[part.topic] = _type(schemas.get(part.schema_id, ""))
                        channels[part.id] = Channel(part.topic, types[part.topic], part.message_encoding)
                    elif isinstance(part, records.Message):
                        yield channels[part.channel_id], part.log_time, part.data


def _unpacked(chunk: Any) -> Any:
    """The chunk, decompressed; it must hold as much as it says, and no more than MAX_CHUNK_BYTES."""
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes: must be at most {MAX_CHUNK_BYTES}")
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(chunk.data) as reader:
            data = reader.read(size + 1)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"compression {chunk.compression!r}: must be zstd, lz4 or none")
    if len(data) != size:
        raise ValueError(f"a chunk of {len(data)} bytes that says {size}")
    return replace(chunk, compression="", data=data)


def _ros1(path: Path, types: dict[str, str]) -> Iterator[_Message]:
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        for place, chunk in reader.chunks.items():
            reader.chunks[place] = chunk._replace(decompressor=_limited(chunk.decompressor))
        yield from _by_rosbags(reader, "ros1", types)


def _rosbag2(path: Path, types: dict[str, str]) -> Iterator[_Message]:
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    # A .db3 file without its folder may have any name.
    storage = Reader(path) if path.is_dir() else Sqlite3Reader(path)
    storage.open()
    with closing(storage):
        yield from _by_rosbags(storage, "cdr", types)


def _by_rosbags(reader: Any, encoding: str, types: dict[str, str]) -> Iterator[_Message]:
    """Every message of an open reader."""
    channels = {}
    for connection in reader.connections:
        types[connection.topic] = connection.msgtype
        channels[connection.id] = Channel(connection.topic, connection.msgtype, encoding)
    for connection, logged_ns, data in reader.messages(list(reader.connections)):
        yield channels[connection.id], logged_ns, data


def _limited(decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """The decompression of a ROS 1 chunk, limited to MAX_CHUNK_BYTES of output."""
    import lz4.frame

    decompressors: dict[Any, Callable[[], Any]] = {
        bz2.decompress: bz2.BZ2Decompressor,
        lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
    }
    if decompress not in decompressors:
        return decompress

    def limited(data: bytes) -> bytes:
        unpacked: bytes = decompressors[decompress]().decompress(data, max_length=MAX_CHUNK_BYTES + 1)
        if len(unpacked) > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk of more than {MAX_CHUNK_BYTES} bytes: must be at most that")
        return unpacked

    return limited


_SOURCES: Final = {"mcap": _mcap, "ros1": _ros1, "rosbag2": _rosbag2}


def _type(schema: str) -> str:
    """A ROS 1 type name ("nav_msgs/Odometry") as in ROS 2; any other name unchanged."""
    package, _, name = schema.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else schema
