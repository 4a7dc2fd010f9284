"""Takes serialized messages together with their publishers, which rclpy does not tell.

A subscription in ``untaken`` is left alone by rclpy's executor. ``take_all`` asks rcl, the library below rclpy.

rclpy's executor makes a new wait set of all subscriptions for each message. ``Hearing`` has none: DDS itself wakes
asyncio's loop, by a number in a descriptor for each subscription.
"""

import asyncio
import contextlib
import ctypes
import hashlib
import os
from collections.abc import Callable, Iterator
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
    info, data = ctypes.create_string_buffer(_INFO_BYTES), _Bytes(allocator=_allocator())
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


class Hearing:
    """Calls ``heard`` in this loop with each serialized message of a subscription in ``untaken``, until ``end``."""

    def __init__(self, subscription: Any, heard: Callable[[bytes], None]) -> None:
        self.subscription, self._heard = subscription, heard
        self._loop, self._bell = asyncio.get_running_loop(), os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._loop.add_reader(self._bell, self._take)
        # rcl calls a function of C with a pointer and the number of new messages; libc's takes a descriptor and a
        # number. No Python runs in a thread of DDS, which may hold a lock that a taker waits for.
        self._tell(ctypes.CDLL(None).eventfd_write, self._bell)

    @staticmethod
    def possible() -> bool:
        """Whether this system has such descriptors."""
        return hasattr(os, "eventfd")

    def _tell(self, function: Any, about: int | None) -> None:
        set_callback = _library("librcl.so").rcl_subscription_set_on_new_message_callback
        with self.subscription.handle:
            place = ctypes.c_void_p(self.subscription.handle.pointer)
            if code := set_callback(place, function, ctypes.c_void_p(about)):
                raise BufgymError(f"topic {self.subscription.topic_name}: rcl can't tell of messages, error {code}")

    def _take(self) -> None:
        os.eventfd_read(self._bell)
        with self.subscription.handle:
            while (taken := self.subscription.handle.take_message(self.subscription.msg_type, True)) is not None:
                self._heard(taken[0])

    def end(self) -> None:
        """Hear no more; the subscription may have been destroyed."""
        from rclpy.exceptions import InvalidHandle

        self._loop.remove_reader(self._bell)
        with contextlib.suppress(InvalidHandle):
            self._tell(None, None)
        os.close(self._bell)


@cache
def _library(name: str) -> Any:
    try:
        return ctypes.CDLL(name)
    except OSError as error:
        raise BufgymError(f"latched topics need rcl, which rclpy has loaded under another name: {error}") from None


@cache
def _allocator() -> _Allocator:
    default = _library("librcutils.so").rcutils_get_default_allocator
    default.restype = _Allocator
    found: _Allocator = default()
    return found


@cache
def untaken() -> Any:
    """A callback group of which rclpy's executor takes nothing, neither messages nor events.

    To wait for a subscription's events alone returns at once, again and again, while it has messages.
    """
    from rclpy.callback_groups import CallbackGroup

    class Untaken(CallbackGroup):  # type: ignore[misc]
        def can_execute(self, entity: Any) -> bool:
            return False

        def beginning_execution(self, entity: Any) -> bool:
            return False

        def ending_execution(self, entity: Any) -> None:
            pass

    return Untaken()


class _Ready:
    """Stands in for rclpy's wait set, and says of each event that it may have come."""

    def add_event(self, event: Any) -> int:
        return 0

    def is_ready(self, kind: str, index: int) -> bool:
        return True


def call_events(subscription: Any) -> None:
    """Call the callbacks of a subscription in ``untaken`` with its events that are new."""
    for handler in subscription.event_handlers:
        handler.add_to_wait_set(_Ready())
        handler.is_ready(_Ready())
        event = handler.take_data()
        if getattr(event, "total_count_change", 0) > 0:
            handler.callback(event)
