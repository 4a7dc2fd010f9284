"""What generators share: draws (uniform doubles of PCG64, sums of twelve of them for a normal distribution), checks.

A seed gives the same bytes on every machine: sums are taken in a fixed order, products and square roots are exact to
the last bit by IEEE 754, and results are rounded to whole bytes. Where a logarithm or a power is needed, its last bit
may differ between C libraries; the rounding removes the difference.
"""

import math
from typing import Final

import numpy as np

from bufgym.traces.trace import Float64Array
from bufgym.utils.errors import BufgymError

# Uniforms that make one nearly normal number: the variance of twelve is 1.
NORMAL_UNIFORMS: Final = 12


def stream(seed: int) -> np.random.Generator:
    """The random numbers of a seed."""
    if seed < 0:
        raise BufgymError(f"seed = {seed}: must be >= 0")
    return np.random.Generator(np.random.PCG64(seed))


def nearly_normal(uniforms: Float64Array) -> Float64Array:
    """float64[n, 12] of uniforms to float64[n] of mean 0 and standard deviation 1, within -6..6."""
    total = uniforms[:, 0].copy()
    # Column by column: `sum` may add in another order on another processor.
    for k in range(1, NORMAL_UNIFORMS):
        total += uniforms[:, k]
    return total - 6.0


def ar1(shocks: list[float], memory: float) -> list[float]:
    """An AR(1) process of variance 1 driven by `shocks`."""
    share = math.sqrt(1 - memory**2)
    value, values = shocks[0], []
    for k, shock in enumerate(shocks):
        value = memory * value + share * shock if k else shock
        values.append(value)
    return values


def checked(name: str, value: float, least: float, most: float) -> float:
    """`value` if it is a number from `least` to `most`."""
    if not (is_finite(value) and least <= value <= most):
        raise BufgymError(f"{name} = {value!r}: must be a number from {least:g} to {most:g}")
    return value


def whole_seconds(duration_s: float, most: int) -> None:
    """Check that a duration is a whole number of seconds from 1 to `most`."""
    if checked("duration_s", duration_s, 1, most) % 1:
        raise BufgymError(f"duration_s = {duration_s}: must be a whole number")


def is_finite(value: object) -> bool:
    """Whether `value` is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
