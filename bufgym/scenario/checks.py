"""Rules that parameters of scenarios share; each function raises a BufgymError that names the parameter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.model.qoi import Value

MAX_RATE_HZ = 100_000
"""Arrivals are counted in whole microseconds: ten to a period at least."""


def positive(scenario: object, *names: str) -> None:
    for name in names:
        above_0(name, getattr(scenario, name))


def above_0(name: str, number: Any) -> None:
    if not (is_number(number) and math.isfinite(number) and number > 0):
        raise BufgymError(f"{name} = {number!r}: must be a number > 0")


def rate(rate_hz: Any) -> None:
    above_0("rate_hz", rate_hz)
    if rate_hz > MAX_RATE_HZ:
        raise BufgymError(f"rate_hz = {rate_hz}: must be at most {MAX_RATE_HZ}")


def is_number(given: Any) -> bool:
    return isinstance(given, int | float | np.number) and not isinstance(given, bool)


def natural(name: str, number: Any) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 0:
        raise BufgymError(f"{name} = {number!r}: must be a whole number >= 0")
    return int(number)


def check_value(scenario: object) -> None:
    given = getattr(scenario, "value")  # noqa: B009  (both kinds of scenario have it)
    if not isinstance(given, Value):
        raise BufgymError(f"value = {given!r}: must be a bufgym.model.qoi Value, such as qoi.exponential(0.618)")
