"""Takes serialized messages together with their publishers, which rclpy does not tell.

A subscription in ``untaken`` is left alone by rclpy's executor. ``take_all`` asks rcl, the library below rclpy.
"""

import ctypes
import hashlib
from collections.abc import Iterator
from functools import cache
from typing import Any, Final, NamedTuple

from bufgym.utils.errors import BufgymError

_INFO_BYTES: Final = 256  # more than ``rmw_message_info_t`` has in any release
_STAMP, _GID, _GID_BYTES = 0, 40, 16  # offsets in it: of the source's stamp, of the publisher's id behind a pointer
_TAKEN, _NONE_LEFT = 0, 401  # RCL_RET_OK, RCL_RET_SUBSCRIPTION_TAKE_FAILED


class Taken(NamedTuple):
    """A message as its subscription had it."""

    message: bytes
    source: int
    """Number of its publisher, as ``source_of`` makes it."""
    stamp_ns: int
    """Time of its publication by its publisher's clock."""


class _Allocator(ctypes.Structure):
    """``rcutils_allocator_t``: four functions and their state."""

    _fields_ = (("pointers", ctypes.c_void_p * 5),)


class _Bytes(ctypes.Structure):
    """``rcutils_uint8_array_t``, whose memory rcl enlarges by its own allocator."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("size", ctypes.c_size_t),
        ("room", ctypes.c_size_t),
        ("allocator", _Allocator),
    )


def source_of(gid: bytes) -> int:
    """Make a publisher's number from its id in DDS."""
    return int.from_bytes(hashlib.blake2b(gid[:_GID_BYTES], digest_size=8).digest())


def take_all(subscription: Any) -> Iterator[Taken]:
    """Take what the subscription has.

    Raises:
        BufgymError: rcl can't take a message.
    """
    with subscription.handle:
        while (taken := _take(subscription)) is not None:
            yield taken


def _take(subscription: Any) -> Taken | None:
    rcl, rcutils = _library("librcl.so"), _library("librcutils.so")
    rcutils.rcutils_get_default_allocator.restype = _Allocator
    info, data = ctypes.create_string_buffer(_INFO_BYTES), _Bytes()
    data.allocator = rcutils.rcutils_get_default_allocator()
    try:
        place = ctypes.c_void_p(subscription.handle.pointer)
        code = rcl.rcl_take_serialized_message(place, ctypes.byref(data), info, None)
        if code == _NONE_LEFT:
            return None
        if code != _TAKEN:
            raise BufgymError(f"topic {subscription.topic_name}: rcl_take_serialized_message returned {code}")
        gid = info.raw[_GID : _GID + _GID_BYTES]
        stamp_ns = int.from_bytes(info.raw[_STAMP : _STAMP + 8], "little", signed=True)
        return Taken(ctypes.string_at(data.data, data.size), source_of(gid), stamp_ns)
    finally:
        if data.data:
            rcutils.rcutils_uint8_array_fini(ctypes.byref(data))


@cache
def _library(name: str) -> Any:
    try:
        return ctypes.CDLL(name)
    except OSError as error:
        raise BufgymError(f"latched topics need rcl, which rclpy has loaded under another name: {error}") from None


@cache
def untaken() -> Any:
    """A callback group whose subscriptions rclpy's executor never takes from; it calls their events."""
    from rclpy.callback_groups import CallbackGroup
    from rclpy.subscription import Subscription

    class Untaken(CallbackGroup):  # type: ignore[misc]
        def can_execute(self, entity: Any) -> bool:
            return not isinstance(entity, Subscription)

        def beginning_execution(self, entity: Any) -> bool:
            return not isinstance(entity, Subscription)

        def ending_execution(self, entity: Any) -> None:
            pass

    return Untaken()
