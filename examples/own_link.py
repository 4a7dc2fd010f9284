"""A link of your own: a function that makes a trace of a seed, here a corridor with a dead spot.

python examples/own_link.py
cd examples && bufgym bench --trace own_link:corridor:0-3 --policies afr,drop-oldest
"""

import argparse

import gymnasium as gym
import numpy as np

import bufgym
from bufgym import scenario
from bufgym.traces import Trace


def corridor(seed: int) -> Trace:
    rng = np.random.default_rng(seed)
    walls_s, dead_s = rng.uniform(5, 15), rng.uniform(1, 8)
    return Trace.steps([(walls_s, 8e6), (dead_s, 0), (walls_s, 5e6)], name=f"corridor-{seed}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=900, help="decisions in the environment")
    parser.add_argument("--seeds", type=int, default=2, help="episodes of the benchmark on each link")
    options = parser.parse_args()

    # Trains on the links of seeds 0 to 99; the text stands in YAML files and env.spec.to_json() as well.
    env = gym.make("bufgym/Uplink-v1", traces="own_link:corridor:0-99")
    _, info = env.reset(seed=0)
    for _ in range(options.steps):
        _, _, ended, _, info = env.step(env.action_space.sample())
        if ended:
            print(f"at random: {info['delivered']} of {info['arrived']} delivered, QoI {info['qoi']:.1f}")
            _, info = env.reset()

    # Compares policies on others.
    test = scenario.get("lte", traces="own_link:corridor:100-103", duration_s=10.0)
    print(bufgym.compare(["afr", "drop-oldest"], test, seeds=options.seeds).table())


if __name__ == "__main__":
    main()
