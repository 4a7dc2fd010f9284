"""Sizes and rates as people write them: ``4.6MB``, ``1e6``, ``512KiB``, ``20Mbit/s``, ``2.5MB/s``."""

import re
from fractions import Fraction

_NUMBER = r"([0-9]+\.?[0-9]*(?:[eE][0-9]{1,2})?)\s*"
_BYTES = re.compile(_NUMBER + r"(?:([kKMG]?)(i?)B)?")
_RATE = re.compile(_NUMBER + "([a-zA-Z/]+)")
_POWERS = {"": 0, "k": 1, "K": 1, "M": 2, "G": 3}
_PER_S = {"bit/s": 0.125, "bits/sec": 0.125, "bps": 0.125, "B/s": 1.0, "Bps": 1.0}

RATES = {
    "bytes_per_s": 1.0,
    **{letter + name: 1000.0 ** _POWERS[letter] * size for letter in _POWERS for name, size in _PER_S.items()},
    "mbps": 125_000.0,
    "mbit/s": 125_000.0,
}
"""Unit of a rate -> bytes per second. Case tells: b is a bit and B a byte; only m for mega has no other meaning."""


def bytes_of(text: str) -> int:
    """Bytes of a size; without a unit it is in bytes.

    Raises:
        ValueError: the text is no size, or no whole number of bytes.
    """
    match = _BYTES.fullmatch(text)
    if match is None:
        raise ValueError(f"{text}: must be a size such as 4.6MB")
    power = _POWERS[match[2] or ""]
    count = Fraction(match[1]) * (1024 if match[3] else 1000) ** power
    if count.denominator != 1:
        raise ValueError(f"{text}: must be a whole number of bytes")
    return int(count)


def rate_of(text: str) -> float | None:
    """Bytes per second of a rate with its unit, one of `RATES`; None for other text."""
    match = _RATE.fullmatch(text)
    return None if match is None or match[2] not in RATES else float(Fraction(match[1]) * Fraction(RATES[match[2]]))
