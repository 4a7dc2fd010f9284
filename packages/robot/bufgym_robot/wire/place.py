"""Where a robot is, and how far the scene has moved: by the poses of one topic, in one frame.

A robot has many topics with poses, in frames that differ by metres, and goals are poses too. So one topic is the
source: the one that is named, otherwise the first Odometry. Until an Odometry comes, it is the first topic with other
poses that are no goals.
"""

import math
from typing import Any

from bufgym.traces.formats.bag_poses import ODOMETRY, Frames, carries_poses
from bufgym_robot.wire import ros_messages
from bufgym_robot.wire.odometry import Odometry, followed


class Place:
    """Give it each message with ``take``; ``x`` and ``location`` are the latest."""

    def __init__(self, named: str | None = None) -> None:
        """``named`` is ``TOPIC``, ``TOPIC:FRAME`` or ``TOPIC:PARENT:CHILD``, the last for a transform of tf."""
        topic, self._odometry = ("", Odometry()) if named is None else followed(named)
        self.topic = topic.lstrip("/")
        """The source, without the slash at the start; empty until it is known."""
        self.location: dict[str, float | str] | None = None
        """x, y, yaw and their frame."""
        self._named, self._type = named is not None, ""

    @property
    def x(self) -> float:
        """Motion so far in fields of view."""
        return self._odometry.x

    @property
    def frames(self) -> Frames | None:
        """Frames of the poses that count; None until there is one."""
        return self._odometry.frames

    def take(self, topic: str, payload: bytes, type: str, encoding: str) -> tuple[Any, Any] | None:
        """Return position and orientation if this message says where the robot is."""
        if encoding not in ("cdr", "ros1") or not carries_poses(topic, type) or not self._is_source(topic, type):
            return None
        pose = self._odometry.take(ros_messages.read(payload, type, encoding))
        if pose is not None and self.frames is not None:
            location = ros_messages.planar(*pose)
            if all(map(math.isfinite, location.values())):
                self.location = {**location, "frame": self.frames[0]}
        return pose

    def _is_source(self, topic: str, type: str) -> bool:
        topic = topic.lstrip("/")
        if not self._named and self._type != ODOMETRY and (type == ODOMETRY or (not self.topic and "Pose" in type)):
            moved = self._odometry.x
            self.topic, self._type, self._odometry = topic, type, Odometry()
            self._odometry.x = moved
        return topic == self.topic
