"""The best that anyone could do in one interruption whose length T is known (AFR paper, Sec. III-C).

Message 0 was sent before, message T + 1 is sent after, and L of the T between can be kept: L + 1 gaps that add up to
T + 1. V is concave, so equal gaps are best. Both numbers count the information gained after message 0, as the paper
does: they compare with H - 1 of a run.
"""

from __future__ import annotations

from bufgym.errors import BufgymError
from bufgym.qoi import Value


def _check(capacity: int, T: int) -> None:
    if capacity < 1 or T < 0:
        raise BufgymError(f"oracle: L = {capacity}, T = {T}: need L >= 1 and T >= 0")


def ideal(capacity: int, T: int, v: Value) -> float:
    """``oracle-ideal``: (L + 1) V((T + 1) / (L + 1)), as if gaps could be real numbers; T + 1 gaps of 1 for T <= L."""
    _check(capacity, T)
    gaps = min(capacity, T) + 1
    return gaps * v((T + 1) / gaps)


def integer(capacity: int, T: int, v: Value) -> float:
    """``oracle``: the best whole-numbered gaps, as equal as they can be (some q, the others q + 1)."""
    _check(capacity, T)
    gaps = min(capacity, T) + 1
    q, longer = divmod(T + 1, gaps)
    return longer * v(q + 1) + (gaps - longer) * v(q)
