"""What a field is, and how a table of fields becomes a kernel.

Each field names one function. ``writer`` makes the kernel that calls the functions of a table one after the other.
Their arguments are the *facts* of that table: what several fields share is computed once and handed to all of them.
"""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.kernels.source import generated

# So that 0 / (0 + reference) is 0 where nothing moved at all.
TINY = 1e-30

Function = Callable[..., float]


@dataclass(frozen=True)
class Field:
    """One observed quantity."""

    name: str
    """Unique over all tables."""
    per: str
    """"slot" for L + 1 entries, the newcomer's last; "candidate" for k + 1, the head's last; "context" for
    one."""
    group: str
    """Knowledge that it needs: queue (counting), time (a clock), motion (odometry), value (V), link (its own socket) or
    topic (the topics' settings and past)."""
    unit: str
    """Its unit, or how it is scaled to [0, 1]."""
    meaning: str
    """Meaning in words."""
    function: Function
    """Facts of its table -> number. A field of your own has the facts (buffer, arrival) for the context and
    (buffer, arrival, k) for a slot."""
    low: float = 0.0
    """Least value."""
    high: float = 1.0
    """Largest value."""
    compile: bool = True
    """Promises that the function is a kernel; otherwise it runs as ordinary Python."""

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle a field of a table by its place, as its function may have no name."""
        place = self.function.__module__, self.name
        return (_of_table, place) if _IN_TABLES.get(place) is self else super().__reduce_ex__(protocol)


_IN_TABLES: dict[tuple[str, str], Field] = {}
"""Module of the function, name of the field -> the field."""


def _of_table(module: str, name: str) -> Field:
    importlib.import_module(module)
    return _IN_TABLES[module, name]


def writer(fields: Sequence[Field], facts: str, first: int = 0) -> Any:
    """Make the kernel of a table: ``write(facts, column, rows)`` of slots or candidates, ``write(facts, row)`` else.

    It puts the i-th field's number at index ``first + i``. ``facts`` are the names of the functions' arguments.
    """
    into, index = ("column, rows", "rows[{}, column]") if fields[0].per != "context" else ("row", "row[{}]")
    lines = [f"{index.format(first + i)} = field_{i}({facts})" for i in range(len(fields))]
    return _made(fields, f"{facts}, {into}", lines)


def chooser(fields: Sequence[Field], facts: str) -> Any:
    """Make the kernel that writes only some fields of a table into a row of numbers.

    It is ``write(facts, column, places, row)`` of slots, or ``write(facts, places, row)`` of a context. ``places``,
    int64[fields], has the index of each field's first number in ``row``, or -1 for a field that is left out.
    """
    into, at = ("column, places, row", " + column") if fields[0].per != "context" else ("places, row", "")
    # An unsigned index is not checked.
    write = "if places[{i}] >= 0: row[np.uint64(places[{i}]{at})] = field_{i}({facts})"
    lines = [write.format(i=i, at=at, facts=facts) for i in range(len(fields))]
    return _made(fields, f"{facts}, {into}", lines)


def _made(fields: Sequence[Field], arguments: str, lines: Sequence[str]) -> Any:
    """The kernel ``write(arguments)`` of these lines, in which the i-th field's function is ``field_i``."""
    names: dict[str, Any] = {"__name__": __name__, "np": np}
    for i, field in enumerate(fields):
        _IN_TABLES[field.function.__module__, field.name] = field
        names[f"field_{i}"] = kernel(field.function)
    text = "\n    ".join([f"def write({arguments}):", *lines])
    exec(compile(text, generated(text), "exec"), names)
    return kernel(names["write"])


@kernel
def clear(places: NDArray[np.int64], occupied: int, entries: int, row: NDArray[np.floating[Any]]) -> None:
    """Write zeros for all slots but the first ``occupied`` of chosen slot fields, which have so many ``entries``."""
    for first in places:
        if first >= 0:
            for column in range(occupied, entries):
                row[np.uint64(first + column)] = 0.0


@kernel
def squash(g: float, reference: float) -> float:
    """Map a length g >= 0 to [0, 1] by g / (g + reference); 0 if both are 0."""
    return g / (g + max(reference, TINY))


@kernel
def ratio(g: Any, reference: Any) -> Any:
    """``squash`` for a reference > 0, in the precision of its arguments."""
    return g / (g + reference)


@kernel
def length(g: float, rows: NDArray[np.floating[Any]]) -> Any:
    """The length g in the precision of ``rows``, for ``ratio``."""
    return rows.dtype.type(g)


@kernel
def single(reference: float) -> Any:
    """The reference in single precision and > 0, for ``ratio``."""
    return np.float32(max(reference, TINY))


@kernel
def kept(number: float, numbers: NDArray[np.floating[Any]]) -> float:
    """The number, rounded as the array keeps numbers."""
    return float(numbers.dtype.type(number))
