"""Classes that stand for messages whose package is not installed, so that rclpy relays them serialized.

rclpy has no generic subscription or publisher. A class gives it the type support, a table of C functions.
Serialized messages pass through none of them, so the table of another message does, with names replaced. Fast DDS reads
names from two tables, one for serializing and one for introspection.
"""

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Any, Final

from bufgym.utils.errors import BufgymError

_FAST_DDS: Final = "rmw_fastrtps_cpp"
_NAMED: Final = {b"rosidl_typesupport_fastrtps_c": ("::msg", 7), b"rosidl_typesupport_introspection_c": ("__msg", 8)}
"""Tables that begin with namespace and name: how the namespace ends in each, and its length in pointers."""
_Support: Any = ctypes.c_void_p * 6
"""``rosidl_message_type_support_t``: identifier, table, its lookup, hash, description, sources."""
_TABLE, _LOOKUP, _HASH = 1, 2, 3  # members of it
_Lookup: Any = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)
_Hash: Any = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_NO_HASH: Final = ctypes.create_string_buffer(33)  # version 0: the type's description is not known
_kept: list[Any] = []  # C memory of all classes made, which ROS uses until the process ends


@cache
def stand_in(type_name: str) -> Any:
    """Make a class for messages of a type as in ``sensor_msgs/msg/Image``; it takes and gives bytes alone.

    Raises:
        BufgymError: ROS 2 runs on another middleware than Fast DDS.
    """
    import rclpy
    from rcl_interfaces.msg import Log

    if rclpy.get_rmw_implementation_identifier() != _FAST_DDS:
        raise BufgymError(f"messages of {type_name}, which is not installed here, pass through {_FAST_DDS} alone")
    package, _, name = type_name.split("/")
    meta: Any = type(Log)
    meta.__import_type_support__()
    new, get = ctypes.pythonapi.PyCapsule_New, ctypes.pythonapi.PyCapsule_GetPointer
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    other = get(meta._TYPE_SUPPORT, None)
    support = _Support.from_address(other)
    find = _Lookup(support[_LOOKUP])
    no_hash = _Hash(lambda _: ctypes.addressof(_NO_HASH))
    named = {
        identifier: _renamed(find(other, identifier), words, (f"{package}{end}", name), no_hash)
        for identifier, (end, words) in _NAMED.items()
    }
    made = _changed(support, {_LOOKUP: _Lookup(lambda _, identifier: named.get(identifier)), _HASH: no_hash})
    return type(meta)(name, (meta,), {"_TYPE_SUPPORT": new(made, None, None)})(name, (), {"__slots__": ()})


def _renamed(address: int, words: int, names: Sequence[str], no_hash: Any) -> int:
    """Copy the type support at this address, with other names at the start of its table; the copy's address."""
    support = _Support.from_address(address)
    table = (ctypes.c_void_p * words).from_address(support[_TABLE])
    new = _changed(table, dict(enumerate(ctypes.create_string_buffer(one.encode()) for one in names)))
    return _changed(support, {_TABLE: new, _HASH: no_hash})


def _changed(pointers: Any, changes: dict[int, Any]) -> int:
    """Copy an array of pointers with some of them changed; the copy's address."""
    copy = type(pointers)(*pointers)
    for k, new in changes.items():
        copy[k] = new if isinstance(new, int) else ctypes.cast(new, ctypes.c_void_p).value
    _kept.extend((copy, *changes.values()))
    return ctypes.addressof(copy)
