"""Topic information that a relay sends with each message: name, type and quality of service.

It takes some 60 bytes. Every message has it, so that either end may restart at any time.
"""

import importlib
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from bufgym.ground.errors import BufgymError, install
from bufgym_live.robot.frames import FrameError

DEPTH: Final = 10  # Default history depth, because DDS does not announce a publisher's own
_MAX_NAME_BYTES: Final = 255
_HEAD: Final = struct.Struct("!BBBH")  # bytes of name and type, flags, depth
_RELIABLE, _TRANSIENT_LOCAL = 1, 2
_NAME: Final = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_TYPE: Final = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)


@contextmanager
def needs_rclpy() -> Iterator[None]:
    """Raise an error that says how to get ROS 2 if the block can't import it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise BufgymError(
            f"bufgym_live.robot.ros2 needs {error.name}: source ROS 2's set-up, or {install('bufgym-live[ros2]')}"
        ) from None


@dataclass(frozen=True)
class Published:
    """A topic with its publishers' settings on the robot."""

    name: str  # name with its namespace, such as "/camera/image"
    type: str  # "sensor_msgs/msg/Image"
    reliable: bool = True
    transient_local: bool = False
    depth: int = DEPTH

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name) or len(self.name) > _MAX_NAME_BYTES:
            raise BufgymError(f"topic {self.name!r}: must be a name of ROS 2 as in /camera/image")
        if not _TYPE.fullmatch(self.type) or len(self.type) > _MAX_NAME_BYTES:
            raise BufgymError(f"topic {self.name}: type {self.type!r}: must read as sensor_msgs/msg/Image")

    @property
    def qos(self) -> Any:
        """The ``QoSProfile`` to subscribe and to republish with."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        return QoSProfile(
            depth=max(1, self.depth),
            reliability=ReliabilityPolicy.RELIABLE if self.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.transient_local else DurabilityPolicy.VOLATILE,
        )

    @property
    def message_class(self) -> Any:
        """Class of its messages; raises an error if their package is not installed."""
        package, _, name = self.type.split("/")
        try:
            return getattr(importlib.import_module(f"{package}.msg"), name)
        except (ModuleNotFoundError, AttributeError):
            raise BufgymError(f"topic {self.name}: messages of {self.type}, which is not installed here") from None

    def head(self) -> bytes:
        """Header sent before each of its messages."""
        name, kind = self.name.encode(), self.type.encode()
        flags = _RELIABLE * self.reliable | _TRANSIENT_LOCAL * self.transient_local
        return _HEAD.pack(len(name), len(kind), flags, min(self.depth, 2**16 - 1)) + name + kind


def parse(body: bytes | memoryview) -> tuple[Published, bytes]:
    """Parse received bytes; return the topic and the serialized message.

    Raises:
        FrameError: no relay sends such bytes.
    """
    try:
        name_bytes, type_bytes, flags, depth = _HEAD.unpack_from(body)
        start, end = _HEAD.size + name_bytes, _HEAD.size + name_bytes + type_bytes
        name, kind = bytes(body[_HEAD.size : start]).decode(), bytes(body[start:end]).decode()
        topic = Published(name, kind, bool(flags & _RELIABLE), bool(flags & _TRANSIENT_LOCAL), depth)
    except (struct.error, UnicodeDecodeError, BufgymError) as error:
        raise FrameError(f"no message of a relay: {error}") from None
    return topic, bytes(body[end:])


def published(node: Any, name: str, but_not: str) -> Published | None:
    """Find the topic as the node sees it; None while only nodes named ``but_not`` publish it.

    It is best effort if any publisher is, and transient local if all are, so that one subscription gets them all.
    """
    found = [one for one in node.get_publishers_info_by_topic(name) if one.node_name != but_not]
    if not found:
        return None
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    qualities = [one.qos_profile for one in found]
    return Published(
        name,
        found[0].topic_type,
        all(quality.reliability == ReliabilityPolicy.RELIABLE for quality in qualities),
        all(quality.durability == DurabilityPolicy.TRANSIENT_LOCAL for quality in qualities),
        max(quality.depth for quality in qualities) or DEPTH,
    )
