"""Kinds of values in kernels: numbers, arrays, records, tuples and functions, and what each is in C.

Whole numbers are int64 and others float64, as in Python and NumPy. Arrays may keep narrower numbers. Those are read as
int64; float32 stays float32 until it meets a float64 or a whole number.
"""

import functools
import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.utils.errors import BufgymError


class KernelError(BufgymError):
    """A kernel that has no C, or was called with what it does not take: the message says where and why."""


@dataclass(frozen=True)
class Number:
    """A number: its name in C, and the order in which kinds give way to one another in arithmetic."""

    c: str
    rank: int
    dtype: str

    def __str__(self) -> str:
        return self.dtype


BOOL = Number("bool", 0, "b1")
INT = Number("int64_t", 2, "i8")
SINGLE = Number("float", 3, "f4")
FLOAT = Number("double", 4, "f8")
NARROW = {dtype: Number(f"{'u' * (dtype[0] == 'u')}int{8 * int(dtype[1])}_t", 1, dtype)
          for dtype in ("i1", "u1", "i2", "u2", "i4", "u4")}  # fmt: skip
"""Whole numbers that arrays keep in fewer bits. Kernels read them as ``INT``."""
_BY_DTYPE = {kind.dtype: kind for kind in (BOOL, INT, SINGLE, FLOAT)} | NARROW


@dataclass(frozen=True)
class Nothing:
    """None: settled when a kernel is translated, so that branches for the other case leave no code."""

    def __str__(self) -> str:
        return "none"


@dataclass(frozen=True)
class Text:
    """Text: only docstrings are, and nothing can be done with it."""


NONE = Nothing()


@dataclass(frozen=True)
class Record:
    """A record of an array, by its address: what changes it changes the array."""

    dtype: np.dtype[Any]

    def __str__(self) -> str:
        return f"record-{hashlib.sha256(repr(self.dtype.descr).encode()).hexdigest()[:8]}"

    def kind_of(self, field: str) -> Number:
        """The kind of one of its fields."""
        return _BY_DTYPE[self.dtype[field].str[1:]]


@dataclass(frozen=True)
class Array:
    """An array in C order with so many axes; a ``constant`` one is not written to."""

    item: Number | Record
    axes: int = 1
    constant: bool = False

    def __str__(self) -> str:
        return f"{self.item}[{',' * (self.axes - 1)}]{'c' * self.constant}"


@dataclass(frozen=True)
class Tuple:
    """A tuple; ``names`` are its fields' and ``title`` its class's, where it is a named one."""

    items: tuple[Any, ...]
    names: tuple[str, ...] = ()
    title: str = "tuple"

    def __str__(self) -> str:
        return f"{self.title}({', '.join(map(str, self.items))})"


@dataclass(frozen=True)
class Pointer:
    """A function that is handed over at run time: kinds of its arguments, and of its result (None for nothing)."""

    arguments: tuple[Any, ...]
    result: Any

    def __str__(self) -> str:
        return f"function({', '.join(map(str, self.arguments))}: {self.result})"


@dataclass(frozen=True)
class Given:
    """A function that is known when a kernel is translated, and becomes part of its code."""

    function: Any

    def __str__(self) -> str:
        return f"{self.function.__module__}.{self.function.__qualname__}"


Kind = Any
"""One of the classes above."""


def joined(one: Kind, other: Kind) -> Kind:
    """The kind of a variable that is now ``one`` and now ``other``; None if there is none."""
    if one is None or one == other:
        return other
    if other is None:
        return one
    if isinstance(one, Number) and isinstance(other, Number):
        if {one, other} == {INT, SINGLE}:
            return FLOAT
        wider = max(one, other, key=lambda kind: kind.rank)
        return INT if wider.rank == 1 else wider
    if isinstance(one, Array) and isinstance(other, Array) and (one.item, one.axes) == (other.item, other.axes):
        return Array(one.item, one.axes, one.constant or other.constant)
    if isinstance(one, Tuple) and isinstance(other, Tuple) and len(one.items) == len(other.items):
        items = tuple(joined(a, b) for a, b in zip(one.items, other.items, strict=True))
        named = one if one.names else other
        return None if None in items else Tuple(items, named.names, named.title)
    return None


@functools.cache
def _item_kind(dtype: np.dtype[Any]) -> Number | Record:
    if dtype.names:
        for name in dtype.names:
            if dtype[name].str[1:] not in _BY_DTYPE:
                raise KernelError(f"field {name!r} of a record is {dtype[name]}: kernels know whole numbers and floats")
        fields: dict[str, Any] = dict(dtype.fields or {})
        here: Any = {"names": dtype.names, "formats": [fields[n][0] for n in dtype.names]}
        here |= {"offsets": [fields[n][1] for n in dtype.names], "itemsize": dtype.itemsize}
        plain: np.dtype[Any] = np.dtype(here)
        if plain != np.dtype([(name, dtype[name]) for name in dtype.names], align=True):
            raise KernelError("a record's fields have gaps that C's do not have: make its dtype with align=True")
        return Record(np.dtype([(name, dtype[name].str) for name in dtype.names], align=True))
    if dtype.str[1:] not in _BY_DTYPE or not dtype.isnative:
        raise KernelError(f"an array is of {dtype}: kernels know whole numbers and floats")
    return _BY_DTYPE[dtype.str[1:]]


def array_kind(dtype: Any, axes: int = 1, constant: bool = False) -> Array:
    """The kind of arrays of ``dtype``."""
    return Array(_item_kind(np.dtype(dtype)), axes, constant)


def record_kind(dtype: Any) -> Record:
    """The kind of one record of ``dtype``."""
    kind = _item_kind(np.dtype(dtype))
    assert isinstance(kind, Record)
    return kind
