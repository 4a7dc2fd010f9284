"""Poses from the messages of one topic of a recording: odometry, poses, or one transform of tf."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.trajectories import MAX_POSITION_M, NORM_TOLERANCE
from bufgym.traces.poses import Poses, unit

_POSE_TYPES: Final = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
}
_TF_TYPES: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
# Robots have dozens of transforms; an error message lists no more than these.
_LISTED_FRAMES: Final = 8


@dataclass(frozen=True)
class BagTopic:
    """What the messages of one topic are."""

    topic: str  # its name
    type: str  # the ROS message type, such as "nav_msgs/msg/Odometry"; the schema's name elsewhere
    encoding: str  # "cdr", "ros1" or what the MCAP file says


def carries_poses(type: str) -> bool:
    """Whether poses can be taken from messages of this type."""
    return type in _POSE_TYPES or type in _TF_TYPES


class PoseCollector:
    """Decodes the messages of one topic and keeps their poses."""

    def __init__(self, path: StrPath, spec: str) -> None:
        """
        Args:
            path: the recording, for error messages.
            spec: a topic, or ``TOPIC:PARENT:CHILD``.
        """
        self.path = path
        self.topic, *frames = spec.split(":")
        if len(frames) not in (0, 2):
            raise BufgymError(f"odom = {spec!r}: must be a topic, or TOPIC:PARENT:CHILD for one transform of tf")
        self._frames = tuple(frames)
        self._poses: dict[tuple[str, ...], list[tuple[int, tuple[float, ...]]]] = {}

    def add(self, channel: BagTopic, time_ns: int, data: bytes) -> None:
        """Keep the poses of a message that was logged at `time_ns`."""
        message = self._decoded(channel, data)
        if channel.type in _POSE_TYPES:
            pose = _POSE_TYPES[channel.type](message)
            self._keep((), time_ns, pose.position, pose.orientation)
            return
        for stamped in message.transforms:
            frames = (stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/"))
            self._keep(frames, time_ns, stamped.transform.translation, stamped.transform.rotation)

    def poses(self, topics: dict[str, str]) -> tuple[int, Poses]:
        """Time of the first (ns), and the poses with times from there; of poses at the same time the last counts."""
        if self.topic not in topics:
            raise BufgymError(f"{self.path}: no topic {self.topic!r}; it has: {', '.join(topics) or 'none'}")
        if self._frames:
            frames = tuple(name.lstrip("/") for name in self._frames)
        else:
            frames = next(iter(self._poses)) if len(self._poses) == 1 else ()
        if frames not in self._poses:
            known = [f"{self.topic}:{':'.join(pair)}" for pair in sorted(self._poses) if pair]
            more = f" and {len(known) - _LISTED_FRAMES} more" if len(known) > _LISTED_FRAMES else ""
            pairs = ", ".join(known[:_LISTED_FRAMES]) + more
            rule = f"say which transform: {pairs}" if pairs else "has no pose"
            raise BufgymError(f"{self.path}: odom = {':'.join((self.topic, *self._frames))!r}: {rule}")
        by_ns = dict(sorted(self._poses[frames], key=lambda pose: pose[0]))
        from_ns = min(by_ns)
        # Two within a microsecond are one.
        by_us = {(time_ns - from_ns) // 1000: values for time_ns, values in by_ns.items()}
        if len(by_us) < 2:
            raise BufgymError(f"{self.path}: odom = {self.topic!r} has {len(by_us)} pose: needs at least 2")
        values = np.array(list(by_us.values()))
        return from_ns, Poses(np.array(list(by_us), np.int64), values[:, :3], unit(values[:, 3:]), self.topic)

    def _decoded(self, channel: BagTopic, data: bytes) -> Any:
        if not carries_poses(channel.type):
            rule = f"must be one of {', '.join(_POSE_TYPES)}, {', '.join(_TF_TYPES)}"
            raise BufgymError(f"{self.path}: {self.topic} carries {channel.type or 'no known type'}: {rule}")
        if channel.encoding not in ("cdr", "ros1"):
            raise BufgymError(f"{self.path}: {self.topic} is encoded in {channel.encoding!r}: must be cdr or ros1")
        store = typestore(channel.encoding)
        decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1
        return decode(data, channel.type)

    def _keep(self, frames: tuple[str, ...], time_ns: int, position: Any, quaternion: Any) -> None:
        poses = self._poses.setdefault(frames, [])
        field = f"{self.topic}, pose {len(poses)}"
        values = (position.x, position.y, position.z, quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        # Written so that NaN fails.
        if not all(abs(value) <= MAX_POSITION_M for value in values[:3]):
            rule = f"must be finite and within {MAX_POSITION_M:g} m"
            raise fault(self.path, rule, value=values[:3], field=f"{field}, position")
        norm = math.hypot(*values[3:])
        if not abs(norm - 1) <= NORM_TOLERANCE:
            raise fault(self.path, "must be 1 within 1 %", value=f"{norm:.6g}", field=f"{field}, norm")
        poses.append((time_ns, values))


@cache
def typestore(encoding: str) -> Any:
    """The message types that rosbags knows in this encoding, "cdr" or "ros1"."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if encoding == "cdr" else Stores.ROS1_NOETIC)
    for name in _TF_TYPES:
        if name not in store.fielddefs:
            store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    return store
