"""Recordings of robots: when each message arrived, how large it was, on which topic; and the poses among them.

See docs/methods.md, "Recordings of robots".
"""

from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from os import PathLike

import numpy as np

from bufgym.traces.formats.bag_files import MAX_TOPICS, Message
from bufgym.traces.formats.bag_poses import PoseCollector
from bufgym.traces.formats.clocks import LogTimes, warn_of_shared_times
from bufgym.traces.formats.faults import StrPath, fault, heard
from bufgym.traces.formats.splits import Seams, Split, damage_errors, split_messages, splits
from bufgym.traces.plausible import warn_of_jumps
from bufgym.traces.poses import Poses
from bufgym.traces.sheet import NONE, Sheet
from bufgym.traces.trace import Int64Array
from bufgym.utils.errors import BufgymError


@dataclass(frozen=True, eq=False)
class Bag:
    """What a recording holds, in order of arrival."""

    path: str  # the file or folder
    kind: str  # "mcap", "ros1" or "rosbag2"
    topics: dict[str, str]  # topic -> type, in order of name; "A and B" where messages of two types came
    time_ns: Int64Array  # int64[n], when the recorder logged each message, ns since its epoch; non-decreasing
    size_bytes: Int64Array  # int64[n], serialised, at least 1
    topic: Int64Array  # int64[n], which of `topics`
    place: Int64Array  # int64[n], its number in the order of the files, from 0
    poses: Poses | None = None  # the poses of the requested odometry, None if none was requested
    poses_from_ns: int = 0  # when the poses' times begin, ns since the recorder's epoch
    files: tuple[Split, ...] = ()  # in the order in which they were read
    sheet: Sheet = NONE  # facts of header stamps, and doubts


def matching(source: str, names: Sequence[str], patterns: Sequence[str] | None) -> list[str]:
    """The topics among ``names`` that fit a name or a pattern such as ``/camera/*``; all of them for None."""
    if patterns is None:
        return list(names)
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in names):
            raise BufgymError(f"{source}: no topic {pattern!r}; it has: {', '.join(names) or 'none'}")
    return [name for name in names if any(fnmatchcase(name, pattern) for pattern in patterns)]


def read_bag(
    path: StrPath | Sequence[StrPath],
    odom: str | None = None,
    advance: Callable[[int], object] = int,
    clock: str = "log",
) -> Bag:
    """Read every message's arrival time, size and topic, and the poses of one topic.

    Args:
        path: an MCAP file, a ROS 1 bag, a rosbag2 folder or ``.db3`` file (see `splits`); several are read as one, in
            order of time, and named after the first.
        odom: topic to take poses from, of one frame alone (``TOPIC:FRAME``; for tf, ``TOPIC:PARENT:CHILD``, also over
            a chain of transforms, with those of ``/tf_static``), of one publisher alone (``TOPIC@2``).
        advance: called with 1 for each message read, as a progress bar's update.
        clock: "log" takes the recorder's log times; "stamps" the clock of the header stamps of the topic with most of
            them, on which every message arrives in the order of log times.
    """
    if clock not in ("log", "stamps"):
        raise BufgymError(f"clock = {clock!r}: must be one of log, stamps")
    with heard() as doubts:
        bag = _read(path, odom, advance, clock)
    return replace(bag, sheet=Sheet(bag.sheet.facts, tuple(doubts)))


def _read(path: StrPath | Sequence[StrPath], odom: str | None, advance: Callable[[int], object], clock: str) -> Bag:
    files = splits(path)
    if not isinstance(path, str | PathLike):
        path = path[0] if len(path) == 1 else files[0].path
    collector = None if odom is None else PoseCollector(path, odom)
    types: dict[str, str] = {}  # of every topic, also of those without messages
    times, sizes, seams = LogTimes(path), array("q"), Seams()
    for file, (channel, logged_ns, data) in split_messages(files, types):
        if len(types) > MAX_TOPICS:
            raise fault(path, f"more than {MAX_TOPICS} topics: must be fewer")
        with damage_errors(file, f"message {len(sizes) + 1} on {channel.topic} is "):
            times.add(channel, logged_ns, data)
            seams.add(file, logged_ns)
            sizes.append(max(1, len(data)))
            if collector is not None and collector.wants(channel.topic):
                collector.add(file, channel, logged_ns, data)
        advance(1)
    seams.said(path)
    order, size_bytes = times.order(), np.array(sizes, np.int64)
    topics = {name: types.get(name, "") for name in sorted({*types, *times.topics})}
    places = {name: k for k, name in enumerate(topics)}
    place = np.array([places[name] for name in times.topics], np.int64)
    topic = place[times.topic[order]]
    warn_of_shared_times(path, times.time_ns[order], topic, list(topics))
    facts, on_stamps = times.stamps(clock == "stamps")
    on_clock = on_stamps if clock == "stamps" else np.copy
    time_ns, kind = on_clock(times.time_ns[order]), files[0].kind
    bag = Bag(str(path), kind, topics, time_ns, size_bytes[order], topic, order, sheet=Sheet(facts), files=tuple(files))
    if collector is None:
        return bag
    from_ns, poses = collector.poses(topics)
    if clock == "stamps":
        pose_ns = on_stamps(from_ns + poses.time_us * 1000)
        from_ns, time_us = int(pose_ns[0]), (pose_ns - pose_ns[0]) // 1000
        last = np.append(time_us[1:] != time_us[:-1], True)
        poses = Poses(
            time_us[last], poses.position_m[last], poses.quaternion[last], poses.format, int(pose_ns[0]) // 1000
        )
    warn_of_jumps(path, poses)
    return replace(bag, poses=poses, poses_from_ns=from_ns)


def messages(bag: Bag) -> Iterator[Message]:
    """Read every message of a recording again, in the bag's own order, with the bag's times.

    A message is held back until those before it have been read. Raises as ``read_bag``.
    """
    ranks = np.argsort(bag.place).tolist()
    held: dict[int, Message] = {}
    due = 0
    for rank, (_, message) in zip(ranks, split_messages(list(bag.files), {}), strict=False):
        held[rank] = message
        while due in held:
            channel, _, data = held.pop(due)
            yield channel, int(bag.time_ns[due]), data
            due += 1
