"""Small recordings written with the libraries that robots' recorders use."""

import functools
import math
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from ros_cases import made
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

ROS2, ROS1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000

Entry = tuple[int, str, str, bytes]
"""Time in ms from START_NS, topic, type, serialised message."""


def _bytes(message: Any, type: str, store: Any) -> bytes:
    return bytes(store.serialize_ros1(message, type) if store is ROS1 else store.serialize_cdr(message, type))


def odometry(x_m: float, yaw_deg: float, store: Any = ROS2, scale: float = 1.0, stamp_ms: int = -1) -> bytes:
    """nav_msgs/Odometry at (x, 0, 0), turned about z; ``scale``: length of the quaternion; a negative stamp is none."""
    of, half = functools.partial(made, store), math.radians(yaw_deg) / 2
    turn = of("geometry_msgs/msg/Quaternion", z=scale * math.sin(half), w=scale * math.cos(half))
    place = of("geometry_msgs/msg/Pose", position=of("geometry_msgs/msg/Point", x=x_m), orientation=turn)
    sec, nanosec = (0, 0) if stamp_ms < 0 else divmod(START_NS + stamp_ms * MS, 10**9)
    stamp = of("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    header = of("std_msgs/msg/Header", stamp=stamp, frame_id="odom")
    pose = of("geometry_msgs/msg/PoseWithCovariance", pose=place)
    message = of("nav_msgs/msg/Odometry", header=header, child_frame_id="base", pose=pose)
    return _bytes(message, "nav_msgs/msg/Odometry", store)


def text(content: str, store: Any = ROS2) -> bytes:
    return _bytes(store.types["std_msgs/msg/String"](data=content), "std_msgs/msg/String", store)


def drive(store: Any = ROS2) -> list[Entry]:
    """1 m forward in the first second, then a turn of 90 degrees in the next; a picture every 500 ms."""
    entries = [
        (0, "/odom", "nav_msgs/msg/Odometry", odometry(0, 0, store)),
        (1000, "/odom", "nav_msgs/msg/Odometry", odometry(1, 0, store)),
        (2000, "/odom", "nav_msgs/msg/Odometry", odometry(1, 90, store)),
    ]
    for k in range(5):
        entries.append((500 * k, "/camera/left", "std_msgs/msg/String", text("x" * (100 * k + 100), store)))
    entries.append((700, "/status", "std_msgs/msg/String", text("ok", store)))
    return sorted(entries)


def write_mcap(
    path: Path,
    entries: list[Entry],
    compression: CompressionType = CompressionType.ZSTD,
    encoding: str = "cdr",
    definition: str = "",
    language: str = "ros2msg",
) -> Path:
    """An MCAP file with the entries in the order given, all types of this definition."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression, chunk_size=2048)
        writer.start(profile="ros2" if encoding == "cdr" else "ros1")
        channels: dict[str, int] = {}
        for ms, topic, type, data in entries:
            if topic not in channels:
                schema = writer.register_schema(type, language, definition.encode())
                channels[topic] = writer.register_channel(topic, encoding, schema)
            time_ns = START_NS + ms * MS
            writer.add_message(channels[topic], log_time=time_ns, publish_time=time_ns, data=data)
        writer.finish()
    return path


def write_rosbag2(
    path: Path, entries: list[Entry], storage: StoragePlugin, compression: CompressionMode = CompressionMode.NONE
) -> Path:
    """A rosbag2 folder."""
    writer = Writer2(path, version=8, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    return _written(writer, path, entries, ROS2)


def write_ros1(path: Path, entries: list[Entry], compression: Any = None) -> Path:
    """A ROS 1 bag."""
    writer = Writer1(path)
    if compression is not None:
        writer.set_compression(compression)
    return _written(writer, path, entries, ROS1)


def _written(writer: Any, path: Path, entries: list[Entry], store: Any) -> Path:
    with writer:
        types = {topic: type for _, topic, type, _ in entries}
        connections = {t: writer.add_connection(t, type, typestore=store) for t, type in types.items()}
        for ms, topic, _, data in entries:
            writer.write(connections[topic], START_NS + ms * MS, data)
    return path
