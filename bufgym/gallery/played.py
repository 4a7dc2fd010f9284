"""What became of every message of one episode under one policy: what all pictures here are drawn from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, sim
from bufgym.policies import Policy
from bufgym.scenario import Episode, Scenario, Uplink
from bufgym.scenario.draws import shipped
from bufgym.sim import metrics
from bufgym.traces import Trace


@dataclass(frozen=True)
class Played:
    """One policy's run of one episode; arrays are by message, times in us, ``sim.NEVER`` where it did not happen."""

    policy: str
    """Its name."""
    h: float
    """QoI of what the server received."""
    arrival_us: NDArray[np.int64]
    """When it was taken."""
    x: NDArray[np.float64]
    """How far the scene had moved on by then."""
    dequeued_us: NDArray[np.int64]
    """When the socket took it."""
    received_us: NDArray[np.int64]
    """When the server had it."""
    dropped_us: NDArray[np.int64]
    """When it was dropped."""

    @property
    def received(self) -> NDArray[np.int64]:
        """Numbers of the messages that the server received."""
        return np.flatnonzero(self.received_us != sim.NEVER)

    @property
    def longest_gap_s(self) -> float:
        """Longest time between neighbouring messages received, s."""
        return float(np.diff(self.arrival_us[self.received]).max(initial=0)) / 1e6


def play(chosen: Sequence[str | Policy], episode: Episode, capacity: int, scenario: Scenario) -> list[Played]:
    """Each policy's run of the episode, in the order of ``chosen``."""
    runs = []
    for policy in map(policies.get, chosen):
        senders = sim.run(policy, [episode], capacity, scenario.value)
        arrivals, log = episode.arrivals, np.asarray(senders.batch.log[0])[: len(episode.arrivals)]
        crossed_us = log["transmitted_us"].copy()
        crossed_us[crossed_us != sim.NEVER] += episode.link.propagation_us
        runs.append(
            Played(
                policy.name,
                metrics.outcome(senders, 0).qoi,
                arrivals["arrival_us"].copy(),
                arrivals["x"].copy(),
                log["dequeued_us"].copy(),
                crossed_us,
                log["dropped_us"].copy(),
            )
        )
    return runs


def fading(top_bytes_per_s: float = 14e6, seconds: int = 12) -> Uplink:
    """A driving robot's camera over a link that fades to nothing and comes back, once, as cosine squared does."""
    steps = [(i + 0.5) / 20 for i in range(20 * seconds)]
    rates = [top_bytes_per_s * (0.5 + 0.5 * math.cos(2 * math.pi * t / seconds)) ** 2 for t in steps]
    link = Trace.steps([(0.05, rate) for rate in rates], name="fading")
    return Uplink((link,), motion=shipped()["motion"][:1], duration_s=seconds, random_offset=False, jitter=0.0)
