"""Shared rules for numbers; each function raises a BufgymError that names the parameter and the broken rule."""

import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.utils.errors import BufgymError, unknown

MAX_WINDOW = 10**6


def is_number(value: Any) -> bool:
    """Whether ``value`` is an int or a float of Python or numpy; True and False are not."""
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def above_0(name: str, number: Any, others: str = "") -> None:
    """Check that ``number`` is finite and > 0; the message appends ``others``, values that are checked elsewhere."""
    if not (is_number(number) and 0 < number <= sys.float_info.max):
        raise BufgymError(f"{name} = {number!r}: must be a number > 0{others}")


def between(name: str, number: Any, low: float, high: float, unit: str = "") -> None:
    """Check that ``number`` lies in [low, high]; the message appends ``unit``."""
    if not is_number(number):
        raise BufgymError(f"{name} = {number!r}: must be a number")
    if not low <= number <= high:
        raise BufgymError(f"{name} = {number!r}: must lie between {low:g} and {high:g}{unit and f' ({unit})'}")


def whole(name: str, number: Any, least: int = 0, most: int | None = None, *, symbol: str = "") -> int:
    """Check that ``number`` is whole and within the limits; return it as an int. The message shows ``symbol``."""
    if type(number) is int and number >= least and (most is None or number <= most):
        return number  # nearly always
    is_whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
    if not is_whole or number < least or (most is not None and number > most):
        bounds = f">= {least}" if most is None else f"from {least} to {most}"
        raise BufgymError(f"{name} = {number!r}: {symbol and f'{symbol} '}must be a whole number {bounds}")
    return int(number)


def flag(name: str, given: Any) -> None:
    """Check that ``given`` is True or False; a number is neither."""
    if not isinstance(given, bool | np.bool_):
        raise BufgymError(f"{name} = {given!r}: must be True or False")


def check_window(window: Any) -> int:
    """Check n_T, the most messages sent and not yet acked."""
    return whole("window", window, 1, MAX_WINDOW, symbol="n_T")


def check_name(what: str, name: Any) -> None:
    """Check a name that must fit into lists with settings, such as ``"decimate:every=2,afr"``."""
    if not isinstance(name, str) or not name or any(c in ":,= \t\n" for c in name):
        raise BufgymError(f"{what} {name!r}: a name must be non-empty, without spaces, ':', ',' or '='")


def constants(numbers: Iterable[float]) -> NDArray[np.float64]:
    """The numbers as a read-only array for kernels."""
    array = np.array(numbers if isinstance(numbers, np.ndarray) else list(numbers), np.float64)
    array.flags.writeable = False
    return array


def changed(what: str, parameters: Mapping[str, float], settings: Mapping[str, float]) -> dict[str, float]:
    """Replace ``parameters`` by the given ``settings``; raise for an unknown name or an unusable number."""
    for name, number in settings.items():
        if name not in parameters:
            raise unknown("parameter", name, parameters, place=what)
        if not (isinstance(number, int | float) and math.isfinite(number) and number > 0):
            raise BufgymError(f"{what}: {name} = {number!r}: must be a number > 0")
    return {**parameters, **{name: float(number) for name, number in settings.items()}}
