"""Rules for numbers that parameters share; each function raises a BufgymError that names the parameter and the rule."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from bufgym.errors import BufgymError

MAX_WINDOW = 10**6


def is_number(value: Any) -> bool:
    """Whether ``value`` is an int or a float, Python's or numpy's; True and False are not."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def above_0(name: str, number: Any) -> None:
    """``number`` is finite and > 0."""
    if not (is_number(number) and 0 < number <= sys.float_info.max):
        raise BufgymError(f"{name} = {number!r}: must be a number > 0")


def between(name: str, number: Any, low: float, high: float, unit: str = "") -> None:
    """``number`` lies in [low, high]; ``unit`` is added to the message."""
    if not is_number(number):
        raise BufgymError(f"{name} = {number!r}: must be a number")
    if not low <= number <= high:
        raise BufgymError(f"{name} = {number!r}: must lie between {low:g} and {high:g}{unit and f' ({unit})'}")


def whole(name: str, number: Any, least: int = 0, most: int | None = None, *, symbol: str = "") -> int:
    """``number`` as an int, from ``least`` to ``most``; ``symbol``: what it is called in formulas, for the message."""
    if type(number) is int and number >= least and (most is None or number <= most):
        return number  # nearly always, and environments draw thousands of episodes a second
    if (
        isinstance(number, bool)
        or not isinstance(number, int | np.integer)
        or number < least
        or (most is not None and number > most)
    ):
        bounds = f">= {least}" if most is None else f"from {least} to {most}"
        raise BufgymError(f"{name} = {number!r}: {symbol and f'{symbol} '}must be a whole number {bounds}")
    return int(number)


def check_window(window: Any) -> int:
    """n_T, messages on their way and not acked, or an error."""
    return whole("window", window, 1, MAX_WINDOW, symbol="n_T")


def check_name(what: str, name: Any) -> None:
    """``name`` can stand in lists of names with settings, as in ``"decimate:every=2,afr"``; ``what`` has it."""
    if not isinstance(name, str) or not name or any(c in ":,= \t\n" for c in name):
        raise BufgymError(f"{what} {name!r}: a name must be non-empty, without spaces, ':', ',' or '='")


def named_settings(what: str, spec: str) -> tuple[str, dict[str, float]]:
    """``"decimate:every=2"`` -> its name and its settings; ``what`` it is, for the message."""
    name, _, settings = spec.partition(":")
    numbers: dict[str, float] = {}
    for setting in filter(None, settings.split(",")):
        key, _, number = setting.partition("=")
        try:
            numbers[key.strip()] = float(number)
        except ValueError:
            raise BufgymError(f"{what} {spec!r}: {setting!r} is not of the form parameter=number") from None
    return name, numbers


def changed(what: str, parameters: Mapping[str, float], settings: Mapping[str, float]) -> dict[str, float]:
    """The ``parameters`` with these ``settings``; an error for an unknown name or an unusable number."""
    for name, number in settings.items():
        if name not in parameters:
            raise BufgymError(f"{what}: no parameter {name!r}; it has: {', '.join(parameters) or 'none'}")
        if not (isinstance(number, int | float) and math.isfinite(number) and number > 0):
            raise BufgymError(f"{what}: {name} = {number!r}: must be a number > 0")
    return {**parameters, **{name: float(number) for name, number in settings.items()}}
