"""Messages of ROS in CDR and in ROS 1's encoding, read and converted without ROS (the library ``rosbags``)."""

import contextlib
import functools
import math
from dataclasses import fields, is_dataclass
from typing import Any

from bufgym.utils.errors import BufgymError


def _types(encoding: str) -> Any:
    from bufgym.traces.formats.bag_poses import typestore  # not at a relay's start: it brings the compiler

    return typestore(encoding)


def load() -> None:
    """Load the types of both versions, which the first message would wait for."""
    for encoding in ("cdr", "ros1"):
        _types(encoding)


def read(payload: bytes, type: str, encoding: str = "cdr") -> Any:
    """Decode a message; raise a BufgymError if it is not of this type."""
    try:
        if encoding == "ros1":
            return _types("ros1").deserialize_ros1(payload, type)
        return _types("cdr").deserialize_cdr(payload, type)
    except Exception as error:  # what does not fit fails in many ways
        raise BufgymError(f"message of {len(payload)} bytes: no {type} in {encoding}: {error}") from None


def planar(place: Any, turn: Any) -> dict[str, float]:
    """Project a position and an orientation to the plane."""
    yaw = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    return {"x": round(place.x, 3), "y": round(place.y, 3), "yaw": round(yaw, 4)}


def modern(payload: bytes, type: str, encoding: str) -> tuple[str, bytes]:
    """Convert a ROS 1 payload of a type common to both versions to CDR; return (encoding, payload)."""
    if encoding == "ros1" and type in _types("cdr").types:
        with contextlib.suppress(Exception):  # same type name, but another definition
            message = _moulded(_types("ros1").deserialize_ros1(payload, type), _types("cdr"))
            return "cdr", bytes(_types("cdr").serialize_cdr(message, type))
    return encoding, payload


def _moulded(value: Any, types: Any) -> Any:
    """Convert a message to the other version of ROS; only a header's sequence number differs."""
    if isinstance(value, list):
        return [_moulded(one, types) for one in value]
    if not is_dataclass(value):
        return value
    kind = types.types[getattr(value, "__msgtype__")]  # noqa: B009  (a field of the library's own)
    return kind(**{one.name: _moulded(getattr(value, one.name, 0), types) for one in fields(kind)})


def as_ros1(payload: bytes, type: str) -> bytes:
    """Convert a message from CDR to ROS 1."""
    try:
        message = _moulded(_types("cdr").deserialize_cdr(payload, type), _types("ros1"))
        return bytes(_types("ros1").serialize_ros1(message, type))
    except Exception as error:  # what does not fit fails in many ways
        raise BufgymError(f"message of {len(payload)} bytes: no {type}: {error}") from None


@functools.lru_cache(1_000)
def definition(type: str, encoding: str = "cdr") -> bytes:
    """Write the type's definition with all types that it uses, as in recordings; empty for an unknown type."""
    version = 1 if encoding == "ros1" else 2
    if encoding not in ("cdr", "ros1") or type not in _types(encoding).types:
        return b""
    return str(_types(encoding).generate_msgdef(type, ros_version=version)[0]).encode()
