"""The messages of an episode, MESSAGE[n]: how they are made, and the rules that they keep."""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import JIT, kernel, records, unchecked_item
from bufgym.model.buffer import MESSAGE
from bufgym.model.link import MAX_TIME_US
from bufgym.model.topics import MAX_TOPICS
from bufgym.utils.errors import BufgymError

MAX_TOTAL_BYTES = 2**60
"""Most bytes of all messages of an episode: with the link's bytes meanwhile they stay far below 2**63."""

_RULES = {
    "seq": "must be its place in the list of arrivals, {k}",
    "arrival_us": f"times must be >= 0, must not decrease, and must be at most {MAX_TIME_US} us",
    "size_bytes": f"must be at least 1 byte, and all messages together at most {MAX_TOTAL_BYTES}",
    "topic": "must be >= 0",
    "x": "must be a finite number, and not less than that of the message before it on its topic",
    "uniform": "must lie in [0, 1)",
}
"""Requirement for each field."""
_FIELDS = tuple(_RULES)
_SEQ, _TIME, _SIZE, _TOPIC, _X, _UNIFORM = range(len(_FIELDS))
_LARGEST = sys.float_info.max


def messages(
    arrival_us: NDArray[np.int64], size_bytes: NDArray[np.int64] | int, x: NDArray[np.float64] | None = None
) -> NDArray[Any]:
    """MESSAGE[n] from columns; x defaults to the frame index. An ``Episode`` checks them: ``_RULES``."""
    arrivals = records(len(arrival_us), MESSAGE)
    arrivals["seq"] = np.arange(len(arrival_us))
    arrivals["arrival_us"], arrivals["size_bytes"] = arrival_us, size_bytes
    arrivals["x"] = arrivals["seq"] if x is None else x
    return arrivals


def even(n: int, period_us: float, jitter: float, draws: NDArray[np.float64], size_bytes: int) -> NDArray[Any]:
    """MESSAGE[n] of one size, one a period from time 0 on; x is the frame index.

    ``draws``, uniform in [0, 1), shift each message by that share of ``jitter`` periods; empty for no shift.
    """
    arrivals = np.empty(n, MESSAGE) if JIT else records(n, MESSAGE)
    _fill(arrivals, period_us, jitter, draws, size_bytes)
    return arrivals


@kernel
def _fill(arrivals: NDArray[Any], period_us: float, jitter: float, draws: NDArray[np.float64], size_bytes: int) -> None:
    first_us = 0
    for k in range(len(arrivals)):
        shift = jitter * draws[k] if len(draws) > 0 else 0.0
        arrival_us = int((k + shift) * period_us)
        if k == 0:
            first_us = arrival_us
        message = unchecked_item(arrivals, k)
        message.seq, message.arrival_us, message.size_bytes, message.topic = k, arrival_us - first_us, size_bytes, 0
        message.x, message.uniform, message.gain = float(k), 0.0, 0.0


def read_only(arrivals: NDArray[Any]) -> NDArray[Any]:
    """The same array, handed over by its maker: nobody writes to it any more, so nobody needs a copy."""
    arrivals.flags.writeable = False
    return arrivals


def sealed(arrivals: Any) -> NDArray[Any]:
    """A read-only version of these messages: a copy, unless they and the array that they lie in are read-only."""
    if not isinstance(arrivals, np.ndarray) or arrivals.dtype != MESSAGE or arrivals.ndim != 1:
        raise BufgymError("arrivals: must be MESSAGE[n], as bufgym.scenario.messages makes it")
    memory = arrivals if arrivals.base is None else arrivals.base
    fixed = not arrivals.flags.writeable and isinstance(memory, np.ndarray) and not memory.flags.writeable
    return arrivals if fixed and arrivals.flags.c_contiguous else read_only(arrivals.copy())


def check_messages(arrivals: NDArray[Any]) -> tuple[int, bool]:
    """Check ``_RULES``; return (bytes of all messages, whether x never falls from one to the next).

    Kernels rely on them: they find a message's entries by its ``seq``, and count bytes and microseconds in 64 bits.
    """
    if len(arrivals) == 0:
        raise BufgymError("an episode needs at least one message")
    broken, k, total_bytes, rises = _checked(arrivals)
    if broken < 0 and not rises:
        broken, k = _checked_by_topic(arrivals, np.full(MAX_TOPICS, -_LARGEST))
    if broken >= 0:
        name = _FIELDS[broken]
        raise BufgymError(f"message {k}: {name} = {arrivals[k][name]}: {_RULES[name].format(k=k)}")
    return total_bytes, rises


@kernel
def _checked(arrivals: NDArray[Any]) -> tuple[int, int, int, bool]:
    """Find (the field that breaks its rule or -1, the message, bytes of all, whether x never falls)."""
    before_us, total_bytes, before_x, rises = 0, 0, -_LARGEST, True
    for k in range(len(arrivals)):
        message = unchecked_item(arrivals, k)
        at_us, size_bytes, x = message.arrival_us, message.size_bytes, message.x
        if message.seq != k:
            return _SEQ, k, 0, False
        if not before_us <= at_us <= MAX_TIME_US:
            return _TIME, k, 0, False
        if not 1 <= size_bytes <= MAX_TOTAL_BYTES - total_bytes:
            return _SIZE, k, 0, False
        if message.topic < 0:
            return _TOPIC, k, 0, False
        if not -_LARGEST <= x <= _LARGEST:  # NaN is not either
            return _X, k, 0, False
        if not 0.0 <= message.uniform < 1.0:
            return _UNIFORM, k, 0, False
        if x < before_x:
            rises = False
        before_us, before_x = at_us, x
        total_bytes += size_bytes
    return -1, 0, total_bytes, rises


@kernel
def _checked_by_topic(arrivals: NDArray[Any], latest_x: NDArray[np.float64]) -> tuple[int, int]:
    """Find (the field, the message) where x falls on one topic; -1 if nowhere.

    ``latest_x`` is of each topic that can have an x of its own; all other topics count as one, with the last entry.
    """
    for k in range(len(arrivals)):
        topic = min(unchecked_item(arrivals, k).topic, len(latest_x) - 1)
        if unchecked_item(arrivals, k).x < latest_x[topic]:
            return _X, k
        latest_x[topic] = unchecked_item(arrivals, k).x
    return -1, 0
