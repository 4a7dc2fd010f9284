"""What a field is, and how a table of fields becomes a kernel.

A field's number is an expression of what the kernel that writes it has at hand. ``writer`` makes the kernel that has a
line for every field of a table.
"""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel

# So that 0 / (0 + reference) is 0 where nothing moved at all.
TINY = 1e-30

Function = Callable[..., float]


@dataclass(frozen=True)
class Field:
    """One observed quantity."""

    name: str
    """Unique over all tables."""
    per: str
    """"slot" for L + 1 entries, the newcomer's last; "context" for one."""
    group: str
    """Knowledge that it needs: queue (counting), time (a clock), motion (odometry), value (V), link (its own socket) or
    topic (the topics' settings and past)."""
    unit: str
    """Its unit, or how it is scaled to [0, 1]."""
    meaning: str
    """Meaning in words."""
    low: float = 0.0
    """Least value."""
    high: float = 1.0
    """Largest value."""
    _: KW_ONLY
    number: str = ""
    """Its number as an expression. With a ``reference`` or a ``mean`` it is the length g, of which g / (g + r) is
    observed."""
    reference: str = ""
    """r, which may differ from slot to slot, as an expression."""
    mean: str = ""
    """The same for an r of the whole queue."""


def writer(
    module: dict[str, Any],
    fields: Sequence[Field],
    arguments: str,
    plain: str,
    scaled: str | None = None,
    mean: str | None = None,
    first: int = 0,
) -> Any:
    """Make the kernel ``write(arguments)`` that has a line for each of ``fields``.

    ``scaled`` is the line of a field with a reference, ``mean`` of one with a mean, ``plain`` of others and by default
    of those too. An empty line leaves the field out. In a line {i} is the place, counted from ``first``, {n} the
    number, and {r} the reference or mean. ``module`` is the ``globals()`` that hold all that lines name.
    """
    lines = []
    for i, field in enumerate(fields, first):
        line = scaled if field.reference else mean if field.mean else plain
        lines.append((plain if line is None else line).format(i=i, n=field.number, r=field.reference or field.mean))
    return kernel(made(module, arguments, *filter(None, lines)))


def made(module: dict[str, Any], arguments: str, *lines: str) -> Function:
    """Make the function of these arguments and lines, whose globals are ``module``."""
    found: dict[str, Any] = {}
    exec("\n    ".join([f"def write({arguments}):", *lines]), module, found)
    function: Function = found["write"]
    return function


@kernel
def squash(g: float, reference: float) -> float:
    """Map a length g >= 0 to [0, 1] by g / (g + reference); 0 if both are 0."""
    return g / (g + max(reference, TINY))


@kernel
def squash_kept(g: float, reference: float, numbers: NDArray[np.floating[Any]]) -> Any:
    """Apply ``squash`` to ``g`` as the array keeps it, in single precision."""
    length, r = numbers.dtype.type(g), np.float32(max(reference, TINY))
    return length / (length + r)


@kernel
def squash_row(row: NDArray[np.floating[Any]], reference: float) -> None:
    """Apply ``squash_kept`` to every entry, in place."""
    for k in range(np.uint64(len(row))):  # an unsigned index is not checked, so many entries are divided at once
        row[k] = squash_kept(row[k], reference, row)


@kernel
def divide_row(row: NDArray[np.floating[Any]], reference: float) -> None:
    """Apply ``squash`` to every entry, in place."""
    for k in range(len(row)):
        row[k] = squash(row[k], reference)


@kernel
def kept(number: float, numbers: NDArray[np.floating[Any]]) -> float:
    """The number, rounded as the array keeps numbers."""
    return float(numbers.dtype.type(number))
