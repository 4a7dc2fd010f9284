"""Recordings of robots: when each message arrived, how large it was, on which topic; and the poses among them.

See docs/methods.md, "Recordings of robots".
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.ground.errors import BufgymError, install
from bufgym.traces.formats.bag_files import MAX_TOPICS, SOURCES, Message
from bufgym.traces.formats.bag_poses import PoseCollector
from bufgym.traces.formats.faults import StrPath, fault, os_errors
from bufgym.traces.poses import Poses
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

MAX_BAG_MESSAGES: Final = 10**7

_RULE: Final = "must be an MCAP file, a ROS 1 bag, or a rosbag2 folder or .db3 file"
_MAGICS: Final = {b"\x89MCAP0\r\n": "mcap", b"#ROSBAG V": "ros1", b"SQLite format 3\0": "rosbag2"}


@dataclass(frozen=True, eq=False)
class Bag:
    """What a recording holds, in order of arrival."""

    path: str  # the file or folder
    kind: str  # "mcap", "ros1" or "rosbag2"
    topics: dict[str, str]  # topic -> type, in order of name
    time_ns: Int64Array  # int64[n], when the recorder logged each message, ns since its epoch; non-decreasing
    size_bytes: Int64Array  # int64[n], serialised, at least 1
    topic: Int64Array  # int64[n], which of `topics`
    poses: Poses | None = None  # the poses of the requested odometry, None if none was requested
    poses_from_ns: int = 0  # when the poses' times begin, ns since the recorder's epoch


def matching(source: str, names: Sequence[str], patterns: Sequence[str] | None) -> list[str]:
    """The topics among ``names`` that fit a name or a pattern such as ``/camera/*``; all of them for None."""
    if patterns is None:
        return list(names)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise BufgymError(f"{source}: no topic {pattern!r}; it has: {', '.join(names) or 'none'}")
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def is_bag(path: StrPath) -> bool:
    """Whether this is a recording, by its first bytes (a folder: by its content), whatever its name."""
    return _kind(Path(path)) != ""


def read_bag(path: StrPath, odom: str | None = None, advance: Callable[[int], object] = int) -> Bag:
    """Read every message's arrival time, size and topic, and the poses of one topic.

    Args:
        path: an MCAP file, a ROS 1 bag, a rosbag2 folder or ``.db3`` file.
        odom: topic to take poses from, of one frame alone (``TOPIC:FRAME``; for tf, ``TOPIC:PARENT:CHILD``).
        advance: called with 1 for each message read, as a progress bar's update.

    Raises:
        TraceError: missing, not a recording, cut off, damaged, more than 10**7 messages or 10**4 topics, longer than
            10**7 s, unpacking to too much (see `bag_files`).
        BufgymError: the extra ``ros`` is not installed; ``odom`` is no topic or carries no poses.
    """
    kind = _kind(Path(path))
    if not kind:
        raise fault(path, _RULE if Path(path).exists() else "no such file")
    collector = None if odom is None else PoseCollector(path, odom)
    types: dict[str, str] = {}  # of every topic, also of those without messages
    numbers: dict[str, int] = {}
    columns = (array("q"), array("q"), array("q"))
    with _damage_errors(path):
        for channel, logged_ns, data in SOURCES[kind](Path(path), types):
            if len(types) > MAX_TOPICS:
                raise fault(path, f"more than {MAX_TOPICS} topics: must be fewer")
            if len(columns[0]) >= MAX_BAG_MESSAGES:
                raise fault(path, f"more than {MAX_BAG_MESSAGES} messages: must be fewer")
            row = (logged_ns, max(1, len(data)), numbers.setdefault(channel.topic, len(numbers)))
            for column, value in zip(columns, row, strict=True):
                column.append(value)
            advance(1)
            if collector is not None and channel.topic == collector.topic:
                collector.add(channel, logged_ns, data)
        time_ns, size_bytes, number = (np.array(column, np.int64) for column in columns)
    if len(time_ns) and int(time_ns.max()) - int(time_ns.min()) > MAX_DURATION_S * 10**9:
        raise fault(path, f"spans more than {MAX_DURATION_S} s: must be at most that")
    # Recorders with several threads do not log in order of time.
    order = np.argsort(time_ns, kind="stable")
    topics = {name: types.get(name, "") for name in sorted(set(types) | set(numbers))}
    places = {name: k for k, name in enumerate(topics)}
    place = np.array([places[name] for name in numbers], np.int64)
    topic = place[number[order]] if len(numbers) else number
    bag = Bag(str(path), kind, topics, time_ns[order], size_bytes[order], topic)
    if collector is None:
        return bag
    from_ns, poses = collector.poses(topics)
    return replace(bag, poses=poses, poses_from_ns=from_ns)


def messages(path: StrPath) -> Iterator[Message]:
    """Every message of a recording, in the order of the file.

    Raises: as ``read_bag``, where the file is damaged.
    """
    kind = _kind(Path(path))
    if not kind:
        raise fault(path, _RULE if Path(path).exists() else "no such file")
    with _damage_errors(path):
        yield from SOURCES[kind](Path(path), {})


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
        raise BufgymError(f"{path}: reading recordings needs {error.name}: {install('ros')}") from None
    except Exception as error:
        # Parsers of binary formats raise nearly anything on bytes that are not what they should be.
        words = " ".join(str(error).split()) or "no more data"
        raise fault(path, f"cut off or damaged: {type(error).__name__}: {words[:160]}") from error
