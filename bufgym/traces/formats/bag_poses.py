"""Poses from the messages of one topic of a recording: odometry, poses, or one transform of tf."""

import math
import re
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.formats.definitions import TF_TYPES, check_definition, check_form
from bufgym.traces.formats.definitions import BagTopic as BagTopic
from bufgym.traces.formats.definitions import typestore as typestore
from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.trajectories import MAX_POSITION_M, NORM_TOLERANCE
from bufgym.traces.poses import Poses, unit

ODOMETRY: Final = "nav_msgs/msg/Odometry"
_POSE_TYPES: Final = (ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
# Names of topics on which a pose is where a robot shall go, or what a person says. The page's frames.js has them too.
_GOAL: Final = re.compile(
    r"(^|[/_])(goals?|targets?|(way|set)_?points?|clicked|desired|cmd|command|(goal|target|set|initial)_?pose)"
    r"([^a-z/][^/]*)?(/(pose|local|global))?$"
)
# Robots have dozens of transforms; an error message lists no more than these.
_LISTED_FRAMES: Final = 8

Frames = tuple[str, str]
"""The frame in which a pose is, and the frame whose pose it is (empty where the message does not say)."""


def carries_poses(topic: str, type: str) -> bool:
    """Whether the messages of this topic say where a robot is; a goal does not."""
    return type in TF_TYPES or type == ODOMETRY or (type in _POSE_TYPES and not is_goal(topic))


def is_goal(topic: str) -> bool:
    """Whether a topic's name, such as ``/goal_pose`` or ``/initialpose``, says that its poses are no places."""
    return _GOAL.search(topic.lower()) is not None


def named_source(spec: str) -> tuple[str, tuple[str, ...]]:
    """Split ``TOPIC``, ``TOPIC:FRAME`` or ``TOPIC:PARENT:CHILD`` into the topic and its frames."""
    topic, *frames = spec.split(":")
    if len(frames) > 2:
        raise BufgymError(f"odom = {spec!r}: must be a topic, TOPIC:FRAME, or TOPIC:PARENT:CHILD for a transform of tf")
    if is_goal(topic):
        raise BufgymError(f"odom = {spec!r}: {topic} is a goal, no place where the robot is: name its odometry")
    return topic, tuple(name.lstrip("/") for name in frames)


def placed(message: Any) -> Iterator[tuple[Any, Frames, Any, Any]]:
    """Header, frames, position and orientation of each pose in a message of ROS 1 or 2."""
    for stamped in getattr(message, "transforms", ()):
        pose = stamped.transform
        yield stamped.header, _frames(stamped), pose.translation, pose.rotation
    if hasattr(message, "pose"):
        pose = message.pose
        while hasattr(pose, "pose"):
            pose = pose.pose
        yield message.header, _frames(message), pose.position, pose.orientation


def _frames(stamped: Any) -> Frames:
    return stamped.header.frame_id.lstrip("/"), getattr(stamped, "child_frame_id", "").lstrip("/")


class PoseCollector:
    """Decodes the messages of one topic and keeps their poses."""

    def __init__(self, path: StrPath, spec: str) -> None:
        """Take the recording, for error messages, and what ``named_source`` splits."""
        self.path, self._spec = path, spec
        self.topic, self._frames = named_source(spec)
        self._checked: set[BagTopic] = set()
        self._count = 0
        self._poses: dict[Frames, list[tuple[int, tuple[float, ...]]]] = {}

    def add(self, channel: BagTopic, time_ns: int, data: bytes) -> None:
        """Keep the poses of a message that was logged at `time_ns`."""
        self._count += 1
        for _, frames, position, orientation in placed(self._decoded(channel, data)):
            self._keep(frames, time_ns, position, orientation)

    def poses(self, topics: dict[str, str]) -> tuple[int, Poses]:
        """Time of the first (ns), and the poses with times from there; of poses at the same time the last counts."""
        if self.topic not in topics:
            raise BufgymError(f"{self.path}: no topic {self.topic!r}; it has: {', '.join(topics) or 'none'}")
        fitting = [frames for frames in self._poses if frames[: len(self._frames)] == self._frames]
        if len(fitting) != 1:
            known = [f"{self.topic}:{':'.join(filter(None, frames))}" for frames in sorted(self._poses)]
            more = f" and {len(known) - _LISTED_FRAMES} more" if len(known) > _LISTED_FRAMES else ""
            what = "has no pose" if not known else f"say which frames: {', '.join(known[:_LISTED_FRAMES])}{more}"
            raise BufgymError(f"{self.path}: odom = {self._spec!r}: {what}")
        by_ns = dict(sorted(self._poses[fitting[0]], key=lambda pose: pose[0]))
        from_ns = min(by_ns)
        # Two within a microsecond are one.
        by_us = {(time_ns - from_ns) // 1000: values for time_ns, values in by_ns.items()}
        if len(by_us) < 2:
            raise BufgymError(f"{self.path}: odom = {self.topic!r} has {len(by_us)} pose: needs at least 2")
        values = np.array(list(by_us.values()))
        return from_ns, Poses(np.array(list(by_us), np.int64), values[:, :3], unit(values[:, 3:]), self.topic)

    def _decoded(self, channel: BagTopic, data: bytes) -> Any:
        if not carries_poses(channel.topic, channel.type):
            rule = f"must be one of {', '.join(_POSE_TYPES)}, {', '.join(TF_TYPES)}"
            raise BufgymError(f"{self.path}: {self.topic} carries {channel.type or 'no known type'}: {rule}")
        if channel.encoding not in ("cdr", "ros1"):
            raise BufgymError(f"{self.path}: {self.topic} is encoded in {channel.encoding!r}: must be cdr or ros1")
        if channel not in self._checked:
            check_definition(self.path, channel)
            self._checked.add(channel)
        if channel.encoding == "cdr":
            check_form(self.path, f"message {self._count} on {self.topic}", data)
        store = typestore(channel.encoding)
        decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1
        try:
            return decode(data, channel.type)
        except Exception as error:
            words = " ".join(str(error).split())[:160] or "no more data"
            rule = f"cut off or damaged, or of another definition than {channel.type} has in ROS"
            raise fault(self.path, f"message {self._count} on {self.topic} is {rule}: {words}") from error

    def _keep(self, frames: Frames, time_ns: int, position: Any, quaternion: Any) -> None:
        poses = self._poses.setdefault(frames, [])
        field = f"{self.topic}, pose {len(poses) + 1}"
        values = (position.x, position.y, position.z, quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        # Written so that NaN fails.
        if not all(abs(value) <= MAX_POSITION_M for value in values[:3]):
            rule = f"must be finite and within {MAX_POSITION_M:g} m"
            raise fault(self.path, rule, value=values[:3], field=f"{field}, position")
        norm = math.hypot(*values[3:])
        if not abs(norm - 1) <= NORM_TOLERANCE:
            raise fault(self.path, "must be 1 within 1 %", value=f"{norm:.6g}", field=f"{field}, norm")
        poses.append((time_ns, values))
