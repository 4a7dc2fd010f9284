"""Parameters and their ranges, stated once: `share: Annotated[float, Between(0, 1)] = 0.5` in a dataclass."""

from __future__ import annotations

import math
from typing import NamedTuple, get_type_hints

from bufgym.ground.errors import BufgymError


class Between(NamedTuple):
    """The range of a parameter.

    Attributes:
        least: the smallest value.
        most: the greatest value.
    """

    least: float
    most: float


def checked(name: str, value: float, least: float, most: float) -> float:
    """`value` if it is a number from `least` to `most`."""
    if not (is_finite(value) and least <= value <= most):
        raise BufgymError(f"{name} = {value!r}: must be a number from {least:g} to {most:g}")
    return value


def check_ranges(parameters: object) -> None:
    """Check each field of a dataclass that is annotated with a range."""
    for name, hint in get_type_hints(type(parameters), include_extras=True).items():
        for limits in getattr(hint, "__metadata__", ()):
            checked(name, getattr(parameters, name), *limits)


def is_finite(value: object) -> bool:
    """Whether `value` is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
