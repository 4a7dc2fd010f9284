"""Quantity of Information, a measure of how much of the scene the server has seen; AFR [wang2022afr], Eq. 2-6.

For the received messages in order, with coordinates x_1 <= x_2 <= ...,

    H = 1 + sum of V(x_i - x_{i-1}).

V(d) is the information that a message adds at distance d from its predecessor. V starts at V(0) = 0, never decreases,
never exceeds 1, and is concave. The coordinate is the frame index, for the paper's time-based QoI, or the accumulated
motion of the camera, for motion-based QoI. The same V serves both.
"""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.checks import is_number
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError

__all__ = ["Value", "exponential"]

EXPONENTIAL, SATURATING, TABULATED = 0, 1, 2


@kernel
def value(v: NDArray[np.float64], d: float) -> float:
    """V(d) in [0, 1], the information added at distance ``d >= 0`` from the message received before.

    ``v`` is ``Value.array``: the kind and its parameter, or for a table the number of points, distances and values.
    """
    if v[0] == EXPONENTIAL:
        return 1.0 - math.exp(d * v[1])  # b^d with v[1] = ln b
    if v[0] == SATURATING:
        return float(min(1.0, d / v[1]))
    points = int(v[1])
    if d >= v[1 + points]:
        return float(v[1 + 2 * points])
    k = 1
    while v[2 + k] < d:
        k += 1
    left, right = v[1 + k], v[2 + k]
    low, high = v[1 + points + k], v[2 + points + k]
    return float(low + (high - low) * (d - left) / (right - left))


@kernel
def merging_loss(v: NDArray[np.float64], a: float, value_a: float, b: float, value_b: float) -> float:
    """QoI lost when the message between gaps a and b goes, V(a) + V(b) - V(a + b), from V(a) and V(b); never < 0."""
    if v[0] == EXPONENTIAL:
        return value_a * value_b  # the same number: (1 - p) + (1 - q) - (1 - pq) = (1 - p)(1 - q)
    return value_a + value_b - value(v, a + b)


@kernel
def information(v: NDArray[np.float64], x: NDArray[np.float64]) -> float:
    """H of messages received with coordinates ``x``, float64[received], in order of receipt; 0 for none."""
    if len(x) == 0:
        return 0.0
    gained = 0.0
    for i in range(1, len(x)):
        gained += value(v, x[i] - x[i - 1])
    return 1.0 + gained


_value = getattr(value, "py_func", value)  # plain Python: compiling does not pay for a single number


@dataclass(frozen=True)
class Value:
    """A concave V with V(0) = 0, never decreasing, at most 1.

    ``exponential``, ``saturating`` and ``tabulated`` make one. Calling it returns V(d); BufgymError unless d >= 0.
    """

    name: str
    """Text that ``parse`` reads; for a table, a description."""
    array: NDArray[np.float64] = field(repr=False, compare=False)
    """Kind and parameters, as the kernel ``value`` reads them."""

    def __call__(self, d: float) -> float:
        if not d >= 0:
            raise BufgymError(f"V({d}): a distance must be a number >= 0")
        return float(_value(self.array, float(d)))

    def information(self, x: Sequence[float] | NDArray[np.float64]) -> float:
        """H of messages received with these coordinates, which must be finite and must not decrease."""
        coordinates = np.ascontiguousarray(x, np.float64)
        if not (np.isfinite(coordinates).all() and (np.diff(coordinates) >= 0).all()):
            raise BufgymError("H: the coordinates must be finite numbers and must not decrease")
        return float(information(self.array, coordinates))


def _checked(name: str, array: list[float], distances: NDArray[np.float64]) -> Value:
    """Make a ``Value`` and check Eq. 3-6 at the given distances; the error names the equation that it breaks."""
    v = Value(name, np.array(array, np.float64))
    v.array.flags.writeable = False
    levels = np.array([v(d) for d in distances])
    slopes = np.diff(levels) / np.diff(distances)
    if levels[0] != 0:
        raise BufgymError(f"V = {name}: V(0) = {levels[0]:g}, but V(0) must be 0 (Eq. 3)")
    if (slopes < 0).any():
        at = int(np.argmax(slopes < 0))
        raise BufgymError(f"V = {name}: V falls from d = {distances[at]:g} on, but must not decrease (Eq. 5)")
    if levels.max() > 1:
        raise BufgymError(f"V = {name}: V reaches {levels.max():g}, but must not exceed 1 (Eq. 4)")
    rising = np.diff(slopes) > 1e-9 * np.abs(slopes).max()
    if rising.any():
        at = int(np.argmax(rising)) + 1
        raise BufgymError(f"V = {name}: V grows faster after d = {distances[at]:g}, but must be concave (Eq. 6)")
    if levels.max() == 0:
        raise BufgymError(f"V = {name}: V is 0 everywhere, so no message is worth sending")
    return v


def exponential(base: float = 0.618) -> Value:
    """Make V(d) = 1 - base^d. The paper's Fig. 5 has base 0.618, for a camera moving back from a wall."""
    if not 0 < base < 1:
        raise BufgymError(f"V = exponential: base = {base}: must lie strictly between 0 and 1")
    scale = -1 / math.log(base)
    return _checked(f"exponential:{base:g}", [EXPONENTIAL, math.log(base)], np.linspace(0, 8 * scale, 33))


def saturating(distance: float) -> Value:
    """Make V(d) = min(1, d / distance), for turning in place or driving along a corridor."""
    if not 0 < distance < math.inf:
        raise BufgymError(f"V = saturating: distance = {distance}: must be a number > 0")
    return _checked(f"saturating:{distance:g}", [SATURATING, distance], np.linspace(0, 2 * distance, 33))


def tabulated(distances: Sequence[float], values: Sequence[float]) -> Value:
    """Make your own V, linear between the given points and constant after the last; Eq. 3-6 are checked."""
    d, levels = np.asarray(distances, np.float64), np.asarray(values, np.float64)
    if d.ndim != 1 or d.shape != levels.shape or len(d) < 2:
        raise BufgymError(f"V = tabulated: {d.shape} distances and {levels.shape} values: need two equal lists of 2+")
    if not (np.isfinite(d).all() and np.isfinite(levels).all()):
        raise BufgymError("V = tabulated: every distance and value must be a finite number")
    if d[0] != 0 or (np.diff(d) <= 0).any():
        raise BufgymError(f"V = tabulated: distances {d.tolist()}: must begin at 0 and increase")
    # V is constant after the table: one more point lets the check see that corner too.
    check = np.append(d, 2 * d[-1])
    return _checked(f"tabulated:{len(d)} points", [TABULATED, len(d), *d.tolist(), *levels.tolist()], check)


def of_function(v: Callable[[float], float], name: str = "") -> Value:
    """Make a table of ``POINTS`` points from your own V, denser near 0, up to where V hardly grows.

    The points are checked against Eq. 3-6. The table is straight between them, at most 0.002 too low for V = 1 - b^d.
    """
    name = name or getattr(v, "__name__", "function")

    def at(d: float) -> float:
        level = v(d)
        if not is_number(level) or not math.isfinite(level):
            raise BufgymError(f"V = {name}: V({d:g}) = {level!r}: must be a number")
        return float(level)

    until = _SMALLEST
    while until < _LARGEST:
        low, high = at(until), at(4 * until)
        if high < low:
            raise BufgymError(f"V = {name}: V falls from d = {until:g} on, but must not decrease (Eq. 5)")
        if high - low <= _FLAT * high:
            break
        until *= 2
    below, top = 0.0, at(until)
    for _ in range(60):  # if V ends in a corner, the table ends there
        middle = (below + until) / 2
        below, until = (below, middle) if at(middle) >= top * (1 - 1e-12) else (middle, until)
    distances = [0.0, *np.geomspace(until / 1e4, until, POINTS - 1).tolist()]
    return _checked(name, [TABULATED, POINTS, *distances, *map(at, distances)], np.append(distances, 2 * until))


POINTS = 65  # Points of a table made from a function
_SMALLEST, _LARGEST, _FLAT = 1e-3, 1e9, 1e-3
"""Where the search for a table's end starts and stops, and the relative growth of V that still counts as flat."""


def parse(text: str) -> Value:
    """Read a V from the command line: ``exponential:0.618``, ``saturating:4`` or ``tabulated:0=0,1=0.6,4=1``."""
    kinds: dict[str, Callable[..., Value]] = {"exponential": exponential, "saturating": saturating}
    kind, _, number = text.partition(":")
    if kind == "tabulated":
        try:
            pairs = [tuple(map(float, point.split("="))) for point in number.split(",")]
            distances, levels = zip(*pairs, strict=True)
        except ValueError:
            raise BufgymError(f"V = {text!r}: must be of the form tabulated:distance=V,distance=V,...") from None
        return tabulated(distances, levels)
    if kind not in kinds:
        known = f"{', '.join(kinds)} (as in exponential:0.618), tabulated (as in tabulated:0=0,1=0.6,4=1)"
        raise BufgymError(f"V = {text!r}: unknown kind {kind!r}; known: {known}")
    if kind == "exponential" and not number:
        return exponential()
    try:
        parameter = float(number)
    except ValueError:
        raise BufgymError(f"V = {text!r}: {number!r} is not a number") from None
    return kinds[kind](parameter)


def load(v: Any) -> Value:
    """Make a ``Value`` from a scenario's setting: a ``Value``, a function V(d), or text.

    The text is for ``parse``, or ``module:function`` names V(d), or a function without arguments that returns a V.
    """
    name = ""
    if isinstance(v, str):
        if not modules.is_named(v) or v.partition(":")[0] in ("exponential", "saturating", "tabulated"):
            return parse(v)
        name, v = v, modules.find(v)
        if callable(v) and not isinstance(v, Value) and modules.needs(v) == 0:
            v = v()
    if isinstance(v, Value):
        return replace(v, name=name or v.name)
    if not inspect.isroutine(v):
        raise BufgymError(
            f"value = {name or v!r}: must be a bufgym.model.qoi Value, a function V(d), or text: 'exponential:0.618',"
            " 'module:function'"
        )
    return of_function(v, name)
