"""Python's values as kernels take them: their kinds, and the words that C reads.

Arrays are the same memory, so their owner keeps them alive during a call. Tuples are copied, number by number.
"""

import ctypes
import functools
import sys
from collections.abc import Callable
from types import FunctionType
from typing import Any

import numpy as np

from bufgym.kernels.kinds import (
    BOOL,
    FLOAT,
    INT,
    NARROW,
    NONE,
    SINGLE,
    Array,
    Given,
    KernelError,
    Kind,
    Number,
    Pointer,
    Record,
    Tuple,
    array_kind,
    record_kind,
)  # fmt: skip
from bufgym.kernels.source import plain

_NUMBERS: dict[type, Number] = {
    bool: BOOL, int: INT, float: FLOAT, np.bool_: BOOL, np.float64: FLOAT, np.float32: SINGLE,
    **dict.fromkeys((np.int64, np.int32, np.uint32, np.int16, np.uint16, np.int8, np.uint8), INT),
}  # fmt: skip
_ANNOTATED: dict[Any, Number] = {kind: number for kind, number in ((float, FLOAT), (int, INT), (bool, BOOL))}
_ANNOTATED |= {kind.__name__: number for kind, number in _ANNOTATED.items()}
_C: dict[Any, Any] = {
    BOOL: ctypes.c_bool, INT: ctypes.c_int64, SINGLE: ctypes.c_float, FLOAT: ctypes.c_double,
    **{kind: getattr(ctypes, f"c_{kind.c.removesuffix('_t')}") for kind in NARROW.values()},
}  # fmt: skip
_CONVERTED: dict[Any, Callable[[Any], Any]] = {BOOL: bool, INT: int, SINGLE: float, FLOAT: float}


class NotNumbersError(Exception):
    """A kernel that gives arrays, records or their like, which live in C alone: Python runs its source."""


def key_of(value: Any) -> Any:
    """What is equal for values of equal kinds, and quick to find."""
    found = type(value)
    if found in _NUMBERS or value is None:
        return found
    if isinstance(value, np.ndarray):
        return value.dtype, value.ndim
    if isinstance(value, tuple):
        return found, *map(key_of, value)
    if isinstance(value, np.void):
        return found, value.dtype
    return getattr(value, "key", None) or plain(value)


def annotated(kind: Kind, annotation: Any) -> Kind:
    """The kind of a number for a parameter or field of this annotation: a whole number for a ``float`` is FLOAT."""
    return _ANNOTATED.get(annotation, kind) if isinstance(kind, Number) else kind


def kind_of(value: Any) -> Kind:
    """The kind of a value of Python; KernelError for one that no kernel takes."""
    if value is None:
        return NONE
    if number := _NUMBERS.get(type(value)):
        return number
    if isinstance(value, np.ndarray):
        return array_kind(value.dtype, value.ndim)
    if isinstance(value, tuple):
        names: tuple[str, ...] = getattr(value, "_fields", ())
        hints = getattr(type(value), "__annotations__", {})
        kinds = [kind_of(item) for item in value]
        items = [annotated(k, hints.get(n)) for k, n in zip(kinds, names, strict=True)] if names else kinds
        return Tuple(tuple(items), names, type(value).__name__ if names else "tuple")
    if isinstance(value, np.void):
        return record_kind(value.dtype)
    if isinstance(kind := getattr(value, "kind", None), Pointer):
        return kind
    if isinstance(plain(value), FunctionType):
        return Given(plain(value))
    raise KernelError(f"a kernel takes no {type(value).__name__}: numbers, arrays, records, tuples and functions")


def fields(kind: Kind, inside: bool) -> list[Any]:
    """The types of a value's words; a tuple ``inside`` another is part of it, elsewhere its address."""
    if isinstance(kind, Number):
        return [_C[kind]]
    if isinstance(kind, Array):
        return [ctypes.c_void_p, *[ctypes.c_int64] * kind.axes]
    if isinstance(kind, Tuple) and inside:
        return [struct_of(kind.items, True)]
    return [] if kind is NONE or isinstance(kind, Given) else [ctypes.c_void_p]


@functools.cache
def struct_of(kinds: tuple[Kind, ...], inside: bool, result: Kind = None) -> Any:
    """The struct of values of these kinds, one after the other, with room for a result."""
    types = [one for kind in kinds for one in fields(kind, inside)]
    named = [(f"w{k}", one) for k, one in enumerate(types)]
    if result:
        named.append(("result", *fields(result, True)))
    return type("Struct", (ctypes.Structure,), {"_fields_": named or [("none", ctypes.c_char)]})


def _read_address(array: Any) -> int:
    """Where an array's numbers begin: NumPy's C interface has that behind an object's head. In .15 us, not .9."""
    return ctypes.c_void_p.from_address(id(array) + _HEAD).value or 0


_HEAD = object.__basicsize__
_probe = np.zeros(1)
address_of: Callable[[Any], int] = _read_address
if sys.implementation.name != "cpython" or _read_address(_probe) != _probe.ctypes.data:
    address_of = lambda array: array.ctypes.data  # noqa: E731


def words(kinds: tuple[Kind, ...], values: Any, kept: list[Any], inside: bool = False) -> list[Any]:
    """The words of values of these kinds.

    Structs that they point to go to ``kept``, and (copy, array) for each array whose numbers do not lie side by side.
    """
    found: list[Any] = []
    for kind, value in zip(kinds, values, strict=True):
        if type(kind) is Array:
            if not value.flags.c_contiguous:
                kept.append((np.array(value, order="C"), value))
                value = kept[-1][0]
            found += address_of(value), *value.shape
        elif isinstance(kind, Number):
            found.append(_CONVERTED[kind](value))
        elif isinstance(kind, Tuple):
            made = struct_of(kind.items, True)(*words(kind.items, value, kept, True))
            kept.append(made)
            found.append(made if inside else ctypes.addressof(made))
        elif isinstance(kind, Pointer):
            found.append(value.address)
        elif isinstance(kind, Record):
            found.append(value.__array_interface__["data"][0])
    return found


def value_of(kind: Kind, found: Any) -> Any:
    """A result of C as a value of Python."""
    if isinstance(kind, Tuple):
        return tuple(value_of(item, getattr(found, f"w{k}")) for k, item in enumerate(kind.items))
    return found


def spelled(kind: Kind) -> str:
    """The kind of a result in a word: numbers, and tuples of numbers."""
    if kind is None:
        return "none"
    items = kind.items if isinstance(kind, Tuple) else (kind,)
    if not all(isinstance(item, Number) for item in items) or getattr(kind, "names", None):
        raise NotNumbersError
    return " ".join(map(str, items)) + " tuple" * isinstance(kind, Tuple)


def read(text: str) -> Kind:
    """The kind that ``spelled`` wrote."""
    by_name = {str(kind): kind for kind in _C}
    *items, last = text.split()
    if last == "tuple":
        return Tuple(tuple(by_name[item] for item in items))
    return None if last == "none" else by_name[last]
