"""A scenario of your own: a robot drives from hall to hall, and between two of them its link is slow.

python examples/own_scenario.py
bufgym bench --scenario-file examples/own_scenario.py --policies afr,min-motion-gap,drop-oldest
"""

import argparse
from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np

import bufgym
from bufgym import scenario
from bufgym.model import Link, qoi
from bufgym.traces import Trace


@scenario.register("halls", "a robot drives from hall to hall; between them its link is slow")
@dataclass(frozen=True)
class Halls:
    rate_hz: float = 30.0
    duration_s: float = 20.0
    slow_bytes_per_s: float = 1e6
    value: qoi.Value = field(default_factory=qoi.exponential)
    topics = ()  # one queue

    @property
    def max_messages(self) -> int:
        return round(self.rate_hz * self.duration_s)

    def draw(self, streams: scenario.Streams) -> scenario.Episode:
        arrival_us = (np.arange(self.max_messages) * 1e6 / self.rate_hz).astype(np.int64)
        stays_s = streams.link.uniform(2, 6, size=10)
        link = Trace.steps([(stay, 9e6 if k % 2 else self.slow_bytes_per_s) for k, stay in enumerate(stays_s.tolist())])
        return scenario.Episode(scenario.messages(arrival_us, 230_000), Link(link))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=600, help="decisions in the environment")
    parser.add_argument("--seeds", type=int, default=5, help="episodes of the benchmark")
    options = parser.parse_args()

    env = gym.make("bufgym/Uplink-v1", scenario="halls", slow_bytes_per_s=2e6)
    _, info = env.reset(seed=0)
    for _ in range(options.steps):
        _, _, ended, _, info = env.step(env.action_space.sample())
        if ended:
            print(f"at random: {info['delivered']} of {info['arrived']} delivered, QoI {info['qoi']:.1f}")
            _, info = env.reset()

    print(bufgym.compare(["afr", "drop-oldest"], "halls", seeds=options.seeds))


if __name__ == "__main__":
    main()
