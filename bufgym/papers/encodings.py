"""Bytes of a ROS message in ROS 1, ROS 2, Robofleet's flatbuffer and rosbridge's JSON.

| encoding | format |
|---|---|
| `ros1` | ROS 1 binary |
| `cdr` | ROS 2 CDR, encapsulation header included |
| `robofleet` | Robofleet's flatbuffer as its client sends it: the message's type and topic inside |
| `robofleet-bare` | the same without type and topic |
| `json` | rosbridge's publish operation as rosbridge_suite writes it: spaces after `,` and `:`, uint8[] in base64 |
| `json-numbers` | the same as JSON.stringify writes it: no spaces, uint8[] as a list of numbers, 0.0 as 0 |

Robofleet generates its schema from ROS 1 message definitions with msg2fbs in github.com/ut-amrl/robofleet. Each
message, nested or not, is a table with its metadata in slot 0 and then its fields in order. Time is a struct of two
uint32, and every array is a vector. `flatc` writes the larger fields of a table first. We derive the tables from the
same definitions, which come with `rosbags`, and write them with `flatbuffers`. The extra ``robofleet`` installs both.
"""

from __future__ import annotations

import base64
import functools
import importlib
import inspect
import json
import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from bufgym.ground.errors import BufgymError, install

Content = dict[str, Any]
"""Fields of a message by their ROS 2 names. Nested messages are Contents or lists of them; arrays are numpy's."""

ENCODINGS: Final = ("ros1", "cdr", "robofleet", "robofleet-bare", "json", "json-numbers")
MAX_BYTES: Final = 2**28
"""Size limit of a message; its JSON is already 1 GB."""

_STATUS_TYPE: Final = "amrl_msgs/msg/RobofleetStatus"
_STATUS_FIELDS: Final = "string status\nbool is_ok\nfloat32 battery_level\nstring location\n"
_TIME: Final = "builtin_interfaces/msg/Time"


# --- messages --------------------------------------------------------------------------------------------------------


def laser_scan(
    beams: int = 1080, intensities: int = 0, no_return: float = 0.0, frame_id: str = "laser", seed: int = 0
) -> Content:
    """A scan of 270 degrees; a share ``no_return`` of the ``beams`` meets nothing and reads infinity."""
    _whole("beams", beams, 4)
    _whole("intensities", intensities, 4)
    if not 0 <= no_return <= 1:
        raise BufgymError(f"no_return = {no_return!r}: must be from 0 to 1")
    uniform = _uniform(seed)
    ranges = uniform.uniform(0.1, 30.0, beams).astype(np.float32)
    ranges[uniform.permutation(beams)[: round(no_return * beams)]] = np.inf
    width = 1.5 * math.pi
    limits = {"angle_min": -width / 2, "angle_max": width / 2, "angle_increment": width / max(1, beams - 1)}
    timing = {"time_increment": 0.025 / max(1, beams), "scan_time": 0.025, "range_min": 0.1, "range_max": 30.0}
    return {
        "header": _header(frame_id),
        **{name: float(np.float32(value)) for name, value in (limits | timing).items()},
        "ranges": ranges,
        "intensities": uniform.uniform(0, 4000, intensities).astype(np.float32),
    }


def nav_sat_fix(frame_id: str = "gps", seed: int = 0) -> Content:
    """A fix with 7 decimals of a degree, 3 of a metre, and a diagonal covariance."""
    uniform = _uniform(seed)
    east, north, up = np.round(uniform.uniform(0.5, 9.0, 3), 4)
    return {
        "header": _header(frame_id),
        "status": {"status": 0, "service": 1},
        "latitude": round(30.28 + uniform.uniform(0, 0.01), 7),
        "longitude": round(-97.73 - uniform.uniform(0, 0.01), 7),
        "altitude": round(160 + uniform.uniform(0, 30), 3),
        "position_covariance": np.diag([east, north, up]).ravel(),
        "position_covariance_type": 2,
    }


def compressed_image(data_bytes: int = 75_000, format: str = "jpeg", frame_id: str = "cam", seed: int = 0) -> Content:
    """A JPEG-like image: markers at both ends, and between them noise in which 0 follows each 255, as in JPEG."""
    _whole("data_bytes", data_bytes, 1, least=4)
    data = _uniform(seed).integers(0, 256, data_bytes).astype(np.uint8)
    data[1:][data[:-1] == 255] = 0
    data[:2], data[-2:] = (0xFF, 0xD8), (0xFF, 0xD9)
    return {"header": _header(frame_id), "format": _text("format", format), "data": data}


def point_cloud2(points: int = 10_000, point_step: int = 16, frame_id: str = "lidar", seed: int = 0) -> Content:
    """Points x, y, z and intensity, each a float32, then zeros up to ``point_step`` bytes a point."""
    _whole("point_step", point_step, 1, least=16)
    _whole("points", points, point_step)
    cloud = np.zeros((points, point_step), np.uint8)
    cloud[:, :16] = _uniform(seed).uniform(-50, 50, (points, 4)).astype("<f4").view(np.uint8)
    names = ("x", "y", "z", "intensity")
    return {
        "header": _header(frame_id),
        "height": 1,
        "width": points,
        "fields": [{"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate(names)],
        "is_bigendian": False,
        "point_step": point_step,
        "row_step": points * point_step,
        "data": cloud.ravel(),
        "is_dense": True,
    }


def pose_stamped(frame_id: str = "map", seed: int = 0) -> Content:
    """A pose on the ground, in the full precision of float64."""
    return {"header": _header(frame_id), "pose": _pose(_uniform(seed))}


def odometry(frame_id: str = "odom", child_frame_id: str = "base_link", seed: int = 0) -> Content:
    """A pose and a twist on the ground, each with a diagonal covariance."""
    uniform = _uniform(seed)
    ahead, turning = uniform.uniform(0, 2), uniform.uniform(-1, 1)
    twist = {"linear": {"x": ahead, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": turning}}
    return {
        "header": _header(frame_id),
        "child_frame_id": _text("child_frame_id", child_frame_id),
        "pose": {"pose": _pose(uniform), "covariance": np.diag(uniform.uniform(0, 0.1, 6)).ravel()},
        "twist": {"twist": twist, "covariance": np.diag(uniform.uniform(0, 0.1, 6)).ravel()},
    }


def robofleet_status(status: str = "autonomous", location: str = "building 1, floor 2", seed: int = 0) -> Content:
    """A robot's report to the fleet about its own state."""
    battery = float(np.float32(_uniform(seed).uniform(0, 1)))
    status, location = _text("status", status), _text("location", location)
    return {"status": status, "is_ok": True, "battery_level": battery, "location": location}


KINDS: Final[dict[str, tuple[str, Callable[..., Content]]]] = {
    "LaserScan": ("sensor_msgs/msg/LaserScan", laser_scan),
    "NavSatFix": ("sensor_msgs/msg/NavSatFix", nav_sat_fix),
    "CompressedImage": ("sensor_msgs/msg/CompressedImage", compressed_image),
    "PointCloud2": ("sensor_msgs/msg/PointCloud2", point_cloud2),
    "PoseStamped": ("geometry_msgs/msg/PoseStamped", pose_stamped),
    "Odometry": ("nav_msgs/msg/Odometry", odometry),
    "RobofleetStatus": (_STATUS_TYPE, robofleet_status),
}
"""Kind -> its ROS type and the function that builds its content."""


def content(kind: str, **parameters: Any) -> Content:
    """Build a message of ``kind`` with seeded content; ``parameters`` go to its builder, such as ``beams``."""
    build = _kind(kind)[1]
    known = inspect.signature(build).parameters
    for name in parameters:
        if name not in known:
            raise BufgymError(f"{kind}: no parameter {name!r}; it has: {', '.join(known)}")
    return build(**parameters)


# --- encodings -------------------------------------------------------------------------------------------------------


def encode(kind: str, message: Content, encoding: str, topic: str = "/robot/topic") -> bytes:
    """Encode ``message`` as bytes.

    Args:
        kind: a key of ``KINDS``.
        message: what ``content`` returns.
        encoding: one of ``ENCODINGS``.
        topic: goes into the flatbuffer and the JSON.

    Raises:
        BufgymError: an unknown kind or encoding; rosbags or flatbuffers is not installed (extra ``robofleet``).
    """
    type_name, topic = _kind(kind)[0], _text("topic", topic)
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
    raise BufgymError(f"unknown encoding {encoding!r}; known: {', '.join(ENCODINGS)}")


def sizes(kind: str, topic: str = "/robot/topic", **parameters: Any) -> dict[str, int]:
    """Count the bytes of a message of ``kind`` in each of ``ENCODINGS``; arguments as in ``content``."""
    message = content(kind, **parameters)
    return {encoding: len(encode(kind, message, encoding, topic)) for encoding in ENCODINGS}


@functools.cache
def stores() -> dict[str, Any]:
    """ "ros1" and "cdr" -> the message definitions of ROS 1 Noetic and ROS 2 Humble, with Robofleet's status."""
    typesys = _library("rosbags.typesys")
    made = {"ros1": typesys.get_typestore(typesys.Stores.ROS1_NOETIC)}
    made["cdr"] = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for store in made.values():
        store.register(typesys.get_types_from_msg(_STATUS_FIELDS, _STATUS_TYPE))
    return made


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
    builder = _library("flatbuffers").Builder(1024)
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


# --- small parts -----------------------------------------------------------------------------------------------------


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        extra = "ros" if name.startswith("rosbags") else "robofleet"
        raise BufgymError(f"encoding messages needs {error.name}: {install(extra)}") from None


def _kind(kind: str) -> tuple[str, Callable[..., Content]]:
    if kind not in KINDS:
        raise BufgymError(f"unknown kind of message {kind!r}; known: {', '.join(KINDS)}")
    return KINDS[kind]


def _whole(name: str, number: int, bytes_each: int, least: int = 0) -> None:
    if isinstance(number, bool) or not isinstance(number, int) or not least <= number <= MAX_BYTES // bytes_each:
        raise BufgymError(f"{name} = {number!r}: must be a whole number from {least} to {MAX_BYTES // bytes_each}")


def _text(name: str, text: str) -> str:
    if not isinstance(text, str) or not text.isascii() or len(text) > 255:
        raise BufgymError(f"{name} = {text!r}: must be a text of at most 255 ASCII letters")
    return text


def _uniform(seed: int) -> np.random.Generator:
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise BufgymError(f"seed = {seed!r}: must be a whole number >= 0")
    return np.random.Generator(np.random.PCG64(seed))


def _header(frame_id: str) -> Content:
    return {
        "seq": 4711,
        "stamp": {"sec": 1_600_000_000, "nanosec": 123_456_789},
        "frame_id": _text("frame_id", frame_id),
    }


def _pose(uniform: np.random.Generator) -> Content:
    x, y, yaw = uniform.uniform(-50, 50), uniform.uniform(-50, 50), uniform.uniform(-math.pi, math.pi)
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": turn}
