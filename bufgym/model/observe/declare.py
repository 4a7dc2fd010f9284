"""How a field is declared, and how a table of fields becomes a kernel.

A field is one function, declared with its group and unit; its name and meaning are the function's own. ``writer`` makes
the kernel that calls every function of a table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.ground.modules import first_line

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
    function: Function
    """Computes it. With a ``reference`` or a ``mean`` it gives the length g, of which g / (g + r) is observed."""
    reference: str = ""
    """r as an expression of the function's arguments; it may differ from slot to slot."""
    mean: str = ""
    """The same for an r of the whole queue."""


def declare(
    table: list[Field], per: str, group: str, unit: str, reference: str = "", mean: str = ""
) -> Callable[[Function], Function]:
    """Add the decorated function to ``table`` as the field of its name; it comes back as a kernel."""

    def add(function: Function) -> Function:
        name, text, made = function.__name__, first_line(function), kernel(function)
        table.append(Field(name, per, group, unit, text, function=made, reference=reference, mean=mean))
        return made

    return add


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
    of those too. An empty line leaves the field out. In a line {i} is the place, counted from ``first``, {f} the
    function, and {r} the reference or mean. ``module`` is the ``globals()`` that hold all that lines name.
    """
    lines = [f"def write({arguments}):"]
    for i, field in enumerate(fields, first):
        line = scaled if field.reference else mean if field.mean else plain
        line = plain if line is None else line
        if line:
            lines.append("    " + line.format(i=i, f=field.function.__name__, r=field.reference or field.mean))
    made: dict[str, Any] = {}
    exec("\n".join(lines), module, made)
    return kernel(made["write"])


@kernel
def squash(g: float, reference: float) -> float:
    """Map a length g >= 0 to [0, 1] by g / (g + reference); 0 if both are 0."""
    return g / (g + max(reference, TINY))


@kernel
def squash_row(row: NDArray[np.floating[Any]], reference: float) -> None:
    """Apply ``squash`` to every entry, in place and in single precision."""
    r = np.float32(max(reference, TINY))
    for k in range(len(row)):
        row[k] = row[k] / (row[k] + r)


@kernel
def divide_row(row: NDArray[np.floating[Any]], reference: float) -> None:
    """Apply ``squash`` to every entry, in place."""
    for k in range(len(row)):
        row[k] = squash(row[k], reference)


@kernel
def kept(number: float, numbers: NDArray[np.floating[Any]]) -> float:
    """The number, rounded as the array keeps numbers."""
    return float(numbers.dtype.type(number))
