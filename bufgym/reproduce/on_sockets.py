"""Figures on real sockets: the messages of a simulated run through live queues, over links shaped as it has them."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.live.sender import Leaves
from bufgym.live.validate import play
from bufgym.model.qoi import Value
from bufgym.policies import Policy
from bufgym.reproduce.rows import Rows
from bufgym.sim import Senders

UNITS = ("_s", "_ms", "_hz")
"""Columns with these are compared."""


def received_s(
    policy: Policy, senders: Senders, value: Value, speed: float, until_s: float = math.inf
) -> NDArray[np.float64]:
    """float64[messages]: when each message of the first sender arrived, NaN for never; ``senders`` has simulated them.

    A program that awaits no acks sends the next message when the other end of its connection has the last. What arrives
    after ``until_s`` is not waited for.
    """
    episode = senders.episodes[0]
    assert episode is not None
    bounded = replace(policy, unbounded=False)  # there is room for all messages
    leaves: Leaves = "acked" if policy.client.awaits_acks else "sent"
    settings: dict[str, Any] = {"topics": senders.topics, "leaves": leaves, "speed": speed, "until_s": until_s}
    came = asyncio.run(play(bounded, episode, senders.capacity, value, **settings))
    times_s = np.full(len(episode.arrivals), np.nan)
    for message in came:
        times_s[message.seq] = message.received_ns / 1e9 * speed
    return times_s


def apart(simulated: Rows, live: Rows) -> Iterator[str]:
    """How the rows differ, column by column."""
    for name in simulated[0]:
        if name.endswith(UNITS) and any(one[name] != other[name] for one, other in zip(simulated, live, strict=True)):
            before, after = simulated.column(name), live.column(name)
            both = np.isfinite(before) & np.isfinite(after) & (before > 0)
            if both.any():
                low, middle, high = np.percentile(after[both] / before[both], [0, 50, 100])
                yield f"  {name}: {middle:.2f} times the simulator's (median of {both.sum()}; {low:.2f} to {high:.2f})"
