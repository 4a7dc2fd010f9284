"""Figures on real sockets: a simulated run's messages pass live queues and links shaped like the simulated ones."""

import asyncio
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.model.qoi import Value
from bufgym.policies import Policy
from bufgym.sim import Senders
from bufgym_papers.figures.rows import FigureRows
from bufgym_robot.sender import Leaves
from bufgym_robot.validate import play

UNITS = ("_s", "_ms", "_hz")  # Suffixes of the columns that are compared


def received_s(
    policy: Policy, senders: Senders, value: Value, speed: float, until_s: float = math.inf
) -> NDArray[np.float64]:
    """Send the first sender's messages over sockets; return the receipt times in s, NaN for never, float64[messages].

    ``senders`` holds the simulated run. A program that awaits no acks sends the next message when the other end of its
    connection has the last. Messages after ``until_s`` are not awaited.
    """
    episode = senders.episodes[0]
    assert episode is not None
    bounded = replace(policy, unbounded=False)  # the queue has room for all messages
    leaves: Leaves = "acked" if policy.client.awaits_acks else "sent"
    settings: dict[str, Any] = {"topics": senders.topics, "leaves": leaves, "speed": speed, "until_s": until_s}
    came = asyncio.run(play(bounded, episode, senders.capacity, value, **settings))
    times_s = np.full(len(episode.arrivals), np.nan)
    for message in came:
        times_s[message.seq] = message.received_ns / 1e9 * speed
    return times_s


def apart(simulated: FigureRows, live: FigureRows) -> Iterator[str]:
    """How the rows differ, column by column."""
    for name in simulated[0]:
        if name.endswith(UNITS) and any(one[name] != other[name] for one, other in zip(simulated, live, strict=True)):
            before, after = simulated.column(name), live.column(name)
            both = np.isfinite(before) & np.isfinite(after) & (before > 0)
            if both.any():
                low, middle, high = np.percentile(after[both] / before[both], [0, 50, 100])
                yield f"  {name}: {middle:.2f} times the simulator's (median of {both.sum()}; {low:.2f} to {high:.2f})"
