"""Recordings of robots: when each message arrived, how large it was, on which topic; and the poses among them.

| recording | read with |
|---|---|
| MCAP file, or a folder of them (rosbag2 with mcap storage) | `mcap` |
| ROS 1 bag (`.bag`), rosbag2 with sqlite3 storage (its folder, or the `.db3` alone) | `rosbags` |

Both come with the extra ``ros``. The kind is told from the content, not from the name. A message's arrival is the time
at which the recorder logged it, its size that of its serialised form (CDR or ROS 1), which is what a bridge sends on.
Poses are taken from nav_msgs/Odometry, geometry_msgs/PoseStamped and PoseWithCovarianceStamped, and from tf, at the
same arrival times. A message without content counts as 1 byte.

What breaks in the middle (a robot that lost power leaves its recording cut off) is refused as a whole; the recorder's
own tools (``mcap recover``, ``rosbag reindex``) save what can be saved.
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

from bufgym.errors import BufgymError, TraceError, where
from bufgym.traces.bag_poses import Channel, PoseTaker
from bufgym.traces.files import StrPath
from bufgym.traces.poses import Poses
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

MAX_BAG_MESSAGES: Final = 10**7
# A chunk of a recording is some MB; a longer one is a mistake, or a compression bomb.
MAX_CHUNK_BYTES: Final = 2**30

_MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
_ROS1_MAGIC: Final = b"#ROSBAG V"
_SQLITE_MAGIC: Final = b"SQLite format 3\0"

_Message = tuple[Channel, int, bytes]


@dataclass(frozen=True, eq=False)
class Bag:
    """What a recording holds, in order of arrival.

    Attributes:
        path: the file or folder.
        kind: "mcap", "ros1" or "rosbag2".
        topics: topic -> type, in order of name.
        time_ns: int64[n], when the recorder logged each message, ns since its epoch; non-decreasing.
        size_bytes: int64[n], serialised, at least 1.
        topic: int64[n], which of ``topics``.
        poses: of the odometry that was asked for; their times begin at ``poses_from_ns``.
    """

    path: str
    kind: str
    topics: dict[str, str]
    time_ns: Int64Array
    size_bytes: Int64Array
    topic: Int64Array
    poses: Poses | None = None
    poses_from_ns: int = 0


def matching(source: str, names: Sequence[str], patterns: Sequence[str] | None) -> list[str]:
    """Those of the topics ``names`` that are named, or fit a pattern such as ``/camera/*``; all for None.

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
    """Whether this is a recording by its first bytes (a folder: by what lies in it), whatever its name."""
    return _kind(Path(path)) != ""


def read_bag(path: StrPath, odom: str | None = None) -> Bag:
    """Read every message's arrival time, size and topic, and the poses of one topic.

    Args:
        path: an MCAP file, a ROS 1 bag, a rosbag2 folder or ``.db3`` file.
        odom: topic to take poses from; of tf, which holds many, ``TOPIC:PARENT:CHILD``.

    Raises:
        TraceError: missing, not a recording, cut off, damaged, more than 10**7 messages, longer than 10**7 s.
        BufgymError: the extra ``ros`` is not installed; ``odom`` is no topic or carries no poses.
    """
    kind = _kind(Path(path))
    if not kind:
        rule = "must be an MCAP file, a ROS 1 bag, or a rosbag2 folder or .db3 file"
        raise TraceError(where(path, None, None, rule if Path(path).exists() else "no such file"))
    taken = None if odom is None else PoseTaker(path, odom)
    topics: dict[str, str] = {}
    number: dict[str, int] = {}
    columns = (array("q"), array("q"), array("q"))
    with _damage_told(path):
        for channel, time_ns, data in _SOURCES[kind](Path(path), topics):
            if len(columns[0]) >= MAX_BAG_MESSAGES:
                raise TraceError(where(path, None, None, f"more than {MAX_BAG_MESSAGES} messages: must be fewer"))
            entry = (time_ns, max(1, len(data)), number.setdefault(channel.topic, len(number)))
            for column, value in zip(columns, entry, strict=True):
                column.append(value)
            if taken is not None and channel.topic == taken.topic:
                taken.add(channel, time_ns, data)
        time_ns_, size, met = (np.array(column, np.int64) for column in columns)
    if len(time_ns_) and int(time_ns_.max()) - int(time_ns_.min()) > MAX_DURATION_S * 10**9:
        raise TraceError(where(path, None, None, f"spans more than {MAX_DURATION_S} s: must be at most that"))
    # Recorders with several threads do not log in order of time.
    order = np.argsort(time_ns_, kind="stable")
    names = sorted(set(topics) | set(number))
    rank = np.array([names.index(name) for name in number], np.int64)
    topic = rank[met[order]] if len(number) else met
    kinds = {name: topics.get(name, "") for name in names}
    bag = Bag(str(path), kind, kinds, time_ns_[order], size[order], topic)
    if taken is None:
        return bag
    from_ns, poses = taken.poses(kinds)
    return replace(bag, poses=poses, poses_from_ns=from_ns)


# --- the three kinds -------------------------------------------------------------------------------------------------


def _kind(path: Path) -> str:
    """ "mcap", "ros1", "rosbag2", or "" for anything else."""
    try:
        if path.is_dir():
            if next(path.glob("*.mcap"), None) is not None:
                return "mcap"
            return "rosbag2" if (path / "metadata.yaml").is_file() else ""
        if not path.is_file():
            return ""
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise TraceError(where(path, None, None, f"cannot be opened: {error.strerror or error}")) from error
    for magic, kind in ((_MCAP_MAGIC, "mcap"), (_ROS1_MAGIC, "ros1"), (_SQLITE_MAGIC, "rosbag2")):
        if head.startswith(magic):
            return kind
    return ""


@contextmanager
def _damage_told(path: StrPath) -> Iterator[None]:
    """Whatever the libraries stumble over in a damaged file, as one error that names the file."""
    try:
        yield
    except BufgymError:
        raise
    except ModuleNotFoundError as error:
        raise BufgymError(f'{path}: reading recordings needs {error.name}: pip install "bufgym[ros]"') from None
    except Exception as error:
        # Parsers of binary formats raise nearly anything on bytes that are not what they should be.
        words = " ".join(str(error).split()) or "no more data"
        what = f"cut off or damaged: {type(error).__name__}: {words[:160]}"
        raise TraceError(where(path, None, None, what)) from error


class _Bounded(io.BufferedReader):
    """A file of which never more is asked than it holds: a damaged length must not become an allocation."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1) -> bytes:
        data = super().read(self._left if size is None or size < 0 else min(size, self._left))
        self._left -= len(data)
        return data


def _mcap(path: Path, topics: dict[str, str]) -> Iterator[_Message]:
    """Every message of an MCAP file, or of all in a folder; ``topics`` learns of those without messages, too."""
    from mcap import records
    from mcap.stream_reader import StreamReader, breakup_chunk

    for each in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        schemas: dict[int, str] = {}
        channels: dict[int, Channel] = {}
        with _Bounded(each) as file:
            reader = StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES)
            for record in reader.records:
                inside = breakup_chunk(_unpacked(record), True) if isinstance(record, records.Chunk) else [record]
                for part in inside:
                    if isinstance(part, records.Schema):
                        schemas[part.id] = part.name
                    elif isinstance(part, records.Channel):
                        type = _type(schemas.get(part.schema_id, ""))
                        channels[part.id] = Channel(part.topic, type, part.message_encoding)
                        topics[part.topic] = type
                    elif isinstance(part, records.Message):
                        yield channels[part.channel_id], part.log_time, part.data


def _unpacked(chunk: Any) -> Any:
    """The chunk without its compression, which may not hold more than it says nor more than MAX_CHUNK_BYTES."""
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


def _ros1(path: Path, topics: dict[str, str]) -> Iterator[_Message]:
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        for at, chunk in reader.chunks.items():
            reader.chunks[at] = chunk._replace(decompressor=_limited(chunk.decompressor))
        yield from _by_rosbags(reader, "ros1", topics)


def _rosbag2(path: Path, topics: dict[str, str]) -> Iterator[_Message]:
    from rosbags.rosbag2 import Reader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    # A .db3 file without its folder may have any name.
    storage = Reader(path) if path.is_dir() else Sqlite3Reader(path)
    storage.open()
    with closing(storage):
        yield from _by_rosbags(storage, "cdr", topics)


def _by_rosbags(reader: Any, encoding: str, topics: dict[str, str]) -> Iterator[_Message]:
    """Every message of an open reader."""
    known = {}
    for connection in reader.connections:
        topics[connection.topic] = connection.msgtype
        known[connection.id] = Channel(connection.topic, connection.msgtype, encoding)
    for connection, time_ns, data in reader.messages(list(reader.connections)):
        yield known[connection.id], time_ns, data


def _limited(decompress: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """A ROS 1 chunk's decompression, which may give no more than MAX_CHUNK_BYTES."""
    import lz4.frame

    made: dict[Any, Callable[[], Any]] = {
        bz2.decompress: bz2.BZ2Decompressor,
        lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor,
    }
    if decompress not in made:
        return decompress

    def limited(data: bytes) -> bytes:
        unpacked: bytes = made[decompress]().decompress(data, max_length=MAX_CHUNK_BYTES + 1)
        if len(unpacked) > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk of more than {MAX_CHUNK_BYTES} bytes: must be at most that")
        return unpacked

    return limited


_SOURCES: Final[dict[str, Callable[[Path, dict[str, str]], Iterator[_Message]]]] = {
    "mcap": _mcap,
    "ros1": _ros1,
    "rosbag2": _rosbag2,
}


def _type(schema: str) -> str:
    """A ROS 1 name ("nav_msgs/Odometry") as in ROS 2; any other as it stands."""
    package, _, name = schema.partition("/")
    return f"{package}/msg/{name}" if name and "/" not in name else schema
