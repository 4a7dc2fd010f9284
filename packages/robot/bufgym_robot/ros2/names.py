"""Topic information that a relay sends with each message: name, type and quality of service.

It takes some 90 bytes. Every message has it, so that either end may restart at any time.
"""

import importlib
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

from bufgym.utils.errors import BufgymError, install
from bufgym_robot.frames import FrameError
from bufgym_robot.ros2.uninstalled import stand_in

DEPTH: Final = 10  # Default history depth, because DDS does not announce a publisher's own
_MAX_NAME_BYTES: Final = 255
_HEAD: Final = struct.Struct("!BBBHQQQ")  # bytes of name and type, flags, depth, deadline, lifespan, lease
_RELIABLE, _TRANSIENT_LOCAL, _MANUAL = 1, 2, 4
_LONGEST_NS: Final = 2**62  # more is no limit, as DDS says it
_NAME: Final = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
_TYPE: Final = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)


@contextmanager
def needs_rclpy() -> Iterator[None]:
    """Raise an error that says how to get ROS 2 if the block can't import it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise BufgymError(
            f"bufgym_robot.ros2 needs {error.name}: source ROS 2's set-up, or {install('bufgym-robot[ros2]')}"
        ) from None


@dataclass(frozen=True)
class Published:
    """A topic with its publishers' settings on the robot."""

    name: str  # name with its namespace, such as "/camera/image"
    type: str  # "sensor_msgs/msg/Image"
    reliable: bool = True
    transient_local: bool = False
    depth: int = DEPTH  # history depth; of a latched topic the number of its publishers
    manual: bool = False  # liveliness by topic, asserted by publishing; otherwise automatic
    deadline_ns: int = 0  # longest time between two messages; 0 is none, as in the two below
    lifespan_ns: int = 0  # age at which a message is worth nothing
    lease_ns: int = 0  # of its liveliness

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name) or len(self.name) > _MAX_NAME_BYTES:
            raise BufgymError(f"topic {self.name!r}: must be a name of ROS 2 as in /camera/image")
        if not _TYPE.fullmatch(self.type) or len(self.type) > _MAX_NAME_BYTES:
            raise BufgymError(f"topic {self.name}: type {self.type!r}: must read as sensor_msgs/msg/Image")

    @property
    def latched(self) -> bool:
        """Whether its last message of each publisher is state, owed to every late reader; a log is none."""
        return self.transient_local and self.name != "/rosout"

    @property
    def qos(self) -> Any:
        """The ``QoSProfile`` to subscribe and to republish with."""
        from rclpy.duration import Duration, Infinite
        from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

        def lasting(ns: int) -> Any:
            return Duration(nanoseconds=ns) if ns else Infinite

        return QoSProfile(
            depth=max(1, self.depth),
            reliability=ReliabilityPolicy.RELIABLE if self.reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if self.transient_local else DurabilityPolicy.VOLATILE,
            deadline=lasting(self.deadline_ns),
            lifespan=lasting(self.lifespan_ns),
            liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if self.manual else LivelinessPolicy.AUTOMATIC,
            liveliness_lease_duration=lasting(self.lease_ns),
        )

    @property
    def message_class(self) -> Any:
        """Class of its messages; raises an error if their package is not installed."""
        package, _, name = self.type.split("/")
        try:
            return getattr(importlib.import_module(f"{package}.msg"), name)
        except (ModuleNotFoundError, AttributeError):
            raise BufgymError(f"topic {self.name}: messages of {self.type}, which is not installed here") from None

    @property
    def serialized_class(self) -> Any:
        """Class to relay its messages with, as bytes; one that stands in for it if their package is not installed."""
        try:
            return self.message_class
        except BufgymError:
            return stand_in(self.type)

    def head(self) -> bytes:
        """Header sent before each of its messages."""
        name, kind = self.name.encode(), self.type.encode()
        flags = _RELIABLE * self.reliable | _TRANSIENT_LOCAL * self.transient_local | _MANUAL * self.manual
        times = self.deadline_ns, self.lifespan_ns, self.lease_ns
        return _HEAD.pack(len(name), len(kind), flags, min(self.depth, 2**16 - 1), *times) + name + kind


def overriding() -> Any:
    """Let parameters such as ``qos_overrides./camera.subscription.depth`` change any quality of service."""
    from rclpy.qos import QoSPolicyKind
    from rclpy.qos_overriding_options import QoSOverridingOptions

    return QoSOverridingOptions([kind for kind in QoSPolicyKind if kind.name != "INVALID"])


def resolved(node: Any, name: str) -> str:
    """Apply the node's namespace and remappings; raises an error if ROS 2 has no such names."""
    try:
        return str(node.resolve_topic_name(name))
    except Exception as error:  # rclpy's own, of several kinds
        raise BufgymError(f"topic {name!r}: {str(error).partition(', at ')[0]}") from None


def parse(body: bytes | memoryview) -> tuple[Published, bytes]:
    """Parse received bytes; return the topic and the serialized message.

    Raises:
        FrameError: no relay sends such bytes.
    """
    try:
        name_bytes, type_bytes, flags, depth, *times = _HEAD.unpack_from(body)
        start, end = _HEAD.size + name_bytes, _HEAD.size + name_bytes + type_bytes
        name, kind = bytes(body[_HEAD.size : start]).decode(), bytes(body[start:end]).decode()
        ruled = [bool(flags & bit) for bit in (_RELIABLE, _TRANSIENT_LOCAL, _MANUAL)]
        limits = [ns if ns < _LONGEST_NS else 0 for ns in times]
        topic = Published(name, kind, ruled[0], ruled[1], depth, ruled[2], *limits)
    except (struct.error, UnicodeDecodeError, BufgymError) as error:
        raise FrameError(f"no message of a relay: {error}") from None
    return topic, bytes(body[end:])


def publishers(node: Any, name: str, but_not: str) -> list[bytes]:
    """Ids in DDS of the topic's publishers, without those of nodes with ``but_not`` in their names."""
    return [bytes(one.endpoint_gid) for one in _publishers(node, name, but_not)]


def _publishers(node: Any, name: str, but_not: str) -> list[Any]:
    return [one for one in node.get_publishers_info_by_topic(name) if but_not not in one.node_name]


def circle(node: Any, name: str, receivers: str) -> str:
    """Say why sending the topic would send its copies again, too; "" if it would not.

    A node with ``receivers`` in its name publishes it beside others, in this node's domain.
    """
    nodes = [one.node_name for one in node.get_publishers_info_by_topic(name)]
    again = next((one for one in nodes if receivers in one), "")
    if not again or all(receivers in one for one in nodes):
        return ""
    remedy = f"give {again} another ROS_DOMAIN_ID, or start it with --ros-args -r {name}:=/base{name}"
    return f"{again} publishes it in this domain, too, and its copies would be sent again: {remedy}"


def published(node: Any, name: str, but_not: str) -> Published | None:
    """Find the topic as the node sees it; None while only nodes with ``but_not`` in their names publish it.

    It is best effort if any publisher is, and transient local if all are, so that one subscription gets them all. So
    with deadline, lifespan and liveliness: the weakest promise of any publisher. The depth of a latched topic is the
    number of its publishers.
    """
    found = _publishers(node, name, but_not)
    if not found:
        return None
    from rclpy.qos import DurabilityPolicy, LivelinessPolicy, ReliabilityPolicy

    qualities = [one.qos_profile for one in found]

    def weakest(duration: str) -> int:
        longest = max(int(getattr(quality, duration).nanoseconds) for quality in qualities)
        return longest if longest < _LONGEST_NS else 0

    topic = Published(
        name,
        found[0].topic_type,
        all(quality.reliability == ReliabilityPolicy.RELIABLE for quality in qualities),
        all(quality.durability == DurabilityPolicy.TRANSIENT_LOCAL for quality in qualities),
        max(quality.depth for quality in qualities) or DEPTH,
        all(quality.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC for quality in qualities),
        *map(weakest, ("deadline", "lifespan", "liveliness_lease_duration")),
    )
    return replace(topic, depth=len(found)) if topic.latched else topic
