"""Bytes of a ROS message in ROS 1, ROS 2, Robofleet's flatbuffer and rosbridge's JSON.

    ros1            ROS 1 binary
    cdr             ROS 2 CDR, encapsulation header included
    robofleet       Robofleet's flatbuffer as its client sends it: the message's type and topic inside
    robofleet-bare  the same without type and topic
    json            rosbridge's publish operation as rosbridge_suite writes it: spaces after , and :, uint8[] in base64
    json-numbers    the same as JSON.stringify writes it: no spaces, uint8[] as a list of numbers, 0.0 as 0

Robofleet makes its schema from ROS 1 definitions with msg2fbs in github.com/ut-amrl/robofleet. Each message, nested or
not, is a table with its metadata in slot 0 and then its fields in order. Time is a struct of two uint32, every array a
vector, and `flatc` writes the larger fields of a table first. We derive the tables from the same definitions, which
come with `rosbags`, and write them with `flatbuffers`: the extra `robofleet` of `packages/robot` installs both.
"""

from __future__ import annotations

import base64
import functools
import json
import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from bufgym.utils.errors import unknown
from bufgym.utils.libraries import library

Content = dict[str, Any]
"""Fields of a message by their ROS 2 names. Nested messages are Contents or lists of them; arrays are numpy's."""

ENCODINGS: Final = ("ros1", "cdr", "robofleet", "robofleet-bare", "json", "json-numbers")

_TIME: Final = "builtin_interfaces/msg/Time"


def _laser_scan(uniform: np.random.Generator, beams: int = 1080) -> Content:
    """A scan of 270 degrees."""
    ranges = uniform.uniform(0.1, 30.0, beams).astype(np.float32)
    width = 1.5 * math.pi
    limits = {"angle_min": -width / 2, "angle_max": width / 2, "angle_increment": width / max(1, beams - 1)}
    timing = {"time_increment": 0.025 / max(1, beams), "scan_time": 0.025, "range_min": 0.1, "range_max": 30.0}
    numbers = {name: float(np.float32(value)) for name, value in (limits | timing).items()}
    return {**numbers, "ranges": ranges, "intensities": np.zeros(0, np.float32)}


def _nav_sat_fix(uniform: np.random.Generator) -> Content:
    """A fix with 7 decimals of a degree, 3 of a metre, and a diagonal covariance."""
    east, north, up = np.round(uniform.uniform(0.5, 9.0, 3), 4)
    return {
        "status": {"status": 0, "service": 1},
        "latitude": round(30.28 + uniform.uniform(0, 0.01), 7),
        "longitude": round(-97.73 - uniform.uniform(0, 0.01), 7),
        "altitude": round(160 + uniform.uniform(0, 30), 3),
        "position_covariance": np.diag([east, north, up]).ravel(),
        "position_covariance_type": 2,
    }


def _compressed_image(uniform: np.random.Generator, data_bytes: int = 75_000, format: str = "jpeg") -> Content:
    """A JPEG-like image: markers at both ends, and between them noise in which 0 follows each 255, as in JPEG."""
    data = uniform.integers(0, 256, data_bytes).astype(np.uint8)
    data[1:][data[:-1] == 255] = 0
    data[:2], data[-2:] = (0xFF, 0xD8), (0xFF, 0xD9)
    return {"format": format, "data": data}


def _point_cloud2(uniform: np.random.Generator, points: int = 10_000) -> Content:
    """Points x, y, z and intensity, each a float32."""
    cloud = uniform.uniform(-50, 50, (points, 4)).astype("<f4").view(np.uint8)
    names = ("x", "y", "z", "intensity")
    return {
        "height": 1,
        "width": points,
        "fields": [{"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate(names)],
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 16 * points,
        "data": cloud.ravel(),
        "is_dense": True,
    }


def _pose_stamped(uniform: np.random.Generator) -> Content:
    """A pose on the ground, in the full precision of float64."""
    x, y, yaw = uniform.uniform(-50, 50), uniform.uniform(-50, 50), uniform.uniform(-math.pi, math.pi)
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {"pose": {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turn}}


class Kind(NamedTuple):
    type: str  # its ROS type
    frame_id: str  # the frame_id of its header by default
    build: Callable[..., Content]  # (generator, parameters such as ``beams``) -> its fields besides the header


KINDS: Final = {
    "LaserScan": Kind("sensor_msgs/msg/LaserScan", "laser", _laser_scan),
    "NavSatFix": Kind("sensor_msgs/msg/NavSatFix", "gps", _nav_sat_fix),
    "CompressedImage": Kind("sensor_msgs/msg/CompressedImage", "cam", _compressed_image),
    "PointCloud2": Kind("sensor_msgs/msg/PointCloud2", "lidar", _point_cloud2),
    "PoseStamped": Kind("geometry_msgs/msg/PoseStamped", "map", _pose_stamped),
}


def content(kind: str, seed: int = 0, frame_id: str | None = None, **parameters: Any) -> Content:
    """Build a message of ``kind`` with seeded content; ``parameters`` go to its builder, such as ``beams``."""
    stamp = {"sec": 1_600_000_000, "nanosec": 123_456_789}
    name = KINDS[kind].frame_id if frame_id is None else frame_id
    built = KINDS[kind].build(np.random.Generator(np.random.PCG64(seed)), **parameters)
    return {"header": {"seq": 4711, "stamp": stamp, "frame_id": name}, **built}


def encode(kind: str, message: Content, encoding: str, topic: str = "/robot/topic") -> bytes:
    """Encode ``message``, made by ``content``, as bytes; ``topic`` goes into the flatbuffer and the JSON."""
    type_name = KINDS[kind].type
    if encoding in ("ros1", "cdr"):
        store = stores()[encoding]
        serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
        return bytes(serialize(_typed(store, type_name, message), type_name))
    if encoding in ("robofleet", "robofleet-bare"):
        return _flatbuffer(type_name, message, topic if encoding == "robofleet" else None)
    if encoding in ("json", "json-numbers"):
        numbers = encoding == "json-numbers"
        operation = {"op": "publish", "topic": topic, "msg": _json(message, numbers)}
        return json.dumps(operation, separators=(",", ":") if numbers else None, allow_nan=False).encode()
    raise unknown("encoding", encoding, ENCODINGS)


@functools.cache
def stores() -> dict[str, Any]:
    """ "ros1" and "cdr" -> the message definitions of ROS 1 Noetic and ROS 2 Humble."""
    typesys = library("rosbags.typesys", "ros")
    kinds = {"ros1": typesys.Stores.ROS1_NOETIC, "cdr": typesys.Stores.ROS2_HUMBLE}
    return {encoding: typesys.get_typestore(kind) for encoding, kind in kinds.items()}


def _typed(store: Any, type_name: str, value: Content) -> Any:
    """The message as an instance of the class that rosbags has for it."""
    fields = {}
    for name, (node, of) in store.fielddefs[type_name][1]:
        inner = of[0][1] if node.name in ("ARRAY", "SEQUENCE") else of
        if not isinstance(inner, str):  # a scalar, a text, an array of numbers
            fields[name] = value[name]
        elif isinstance(value[name], list):
            fields[name] = [_typed(store, inner, item) for item in value[name]]
        else:
            fields[name] = _typed(store, inner, value[name])
    return store.types[type_name](**fields)


def _flatbuffer(type_name: str, message: Content, topic: str | None) -> bytes:
    builder = library("flatbuffers", "bufgym-robot[robofleet]").Builder(1024)
    metadata = 0
    if topic is not None:
        texts = [builder.CreateString(text) for text in (type_name.replace("/msg/", "/"), topic)]
        builder.StartObject(2)
        for slot in (1, 0):
            builder.PrependUOffsetTRelativeSlot(slot, texts[slot], 0)
        metadata = builder.EndObject()
    builder.Finish(_table(builder, type_name, message, metadata))
    return bytes(builder.Output())


def _table(builder: Any, type_name: str, value: Content, metadata: int = 0) -> int:
    """Write one message as a table, after the objects that it refers to; return its offset."""
    slots: list[tuple[int, str, Any]] = [(4, "UOffsetTRelative", metadata)]
    for name, (node, of) in stores()["ros1"].fielddefs[type_name][1]:
        item = value[name]
        if node.name == "BASE" and of[0] == "string":
            slots.append((4, "UOffsetTRelative", builder.CreateString(item)))
        elif node.name == "BASE":
            slots.append((np.dtype(of[0]).itemsize, of[0].capitalize(), item))
        elif of == _TIME:
            slots.append((4, "Struct", item))
        elif node.name == "NAME":
            slots.append((4, "UOffsetTRelative", _table(builder, of, item)))
        elif isinstance(item, np.ndarray):
            slots.append((4, "UOffsetTRelative", builder.CreateNumpyVector(item)))
        else:
            tables = [_table(builder, of[0][1], item) for item in item]
            builder.StartVector(4, len(tables), 4)
            for offset in reversed(tables):
                builder.PrependUOffsetTRelative(offset)
            slots.append((4, "UOffsetTRelative", builder.EndVector()))
    builder.StartObject(len(slots))
    for size in (8, 4, 2, 1):
        for slot in reversed(range(len(slots))):
            bytes_, type_, item = slots[slot]
            if bytes_ != size:
                continue
            if type_ == "Struct":
                builder.Prep(4, 8)
                builder.PrependUint32(item["nanosec"])
                builder.PrependUint32(item["sec"])
                item = builder.Offset()
            getattr(builder, f"Prepend{type_}Slot")(slot, item, 0)
    return int(builder.EndObject())


def _json(value: Any, numbers: bool) -> Any:
    """Convert for json.dumps: times get ROS 1 names, infinity and not-a-number become null."""
    if isinstance(value, dict):
        names = {"sec": "secs", "nanosec": "nsecs"}
        return {names.get(name, name): _json(item, numbers) for name, item in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == np.uint8 and not numbers:
        return base64.b64encode(value.tobytes()).decode()
    if isinstance(value, list | np.ndarray):
        return [_json(item, numbers) for item in (value if isinstance(value, list) else value.tolist())]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return int(value) if numbers and isinstance(value, float) and value.is_integer() else value
