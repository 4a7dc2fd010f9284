"""Sizes and rates as people write them: ``4.6MB``, ``1e6``, ``512KiB``, ``20Mbit/s``, ``2.5MB/s``."""

import re
from fractions import Fraction

_NUMBER = r"([0-9]+\.?[0-9]*(?:[eE][0-9]{1,2})?)\s*"
_BYTES = re.compile(_NUMBER + r"(?:([kKMG]?)(i?)B)?")
_RATE = re.compile(_NUMBER + r"(?:([kKMG]?)(bit|B)/s|([kKMG]?)(b)ps)")
_POWERS = {"": 0, "k": 1, "K": 1, "M": 2, "G": 3}


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
    """Bytes per second of a rate with its unit (bit/s, bps or B/s, with k, M or G before it); None for other text."""
    match = _RATE.fullmatch(text)
    if match is None:
        return None
    count = Fraction(match[1]) * 1000 ** _POWERS[match[2] or match[4] or ""]
    return float(count if match[3] == "B" else count / 8)
