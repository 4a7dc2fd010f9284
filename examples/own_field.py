"""Observation fields of your own, one for each message and one for the whole queue.

python examples/own_field.py
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import bufgym  # noqa: F401  (registers the environments)
from bufgym.model.observe import field


@field("waited_s", per="slot", high=1e4, compile=True)
def waited_s(buffer: Any, arrival: Any, k: int) -> float:
    """Seconds since message k arrived; k = len(buffer.slots) is the newcomer."""
    if k == len(buffer.slots):
        return 0.0
    return (buffer.now_us - buffer.slots[k].arrival_us) / 1e6


@field("standstill", per="context")
def standstill(buffer: Any, arrival: Any) -> float:
    """1 if the scene has not moved since the previous arrival."""
    return float(arrival.x == buffer.previous_x)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=200, help="decisions of each environment")
    parser.add_argument("--seeds", type=int, default=4, help="environments in the batch")
    options = parser.parse_args()

    fields = ["rank", "loss", "waited_s", "standstill"]
    envs = gym.make_vec("bufgym/Uplink-v1", num_envs=options.seeds, fields=fields, actions="slots")
    observation, _ = envs.reset(seed=0)
    print({name: array.shape for name, array in observation.items()})
    longest = 0.0
    for _ in range(options.steps):
        # Evict the oldest message; a queue without one accepts.
        observation, *_ = envs.step(np.zeros(options.seeds, np.int64))
        longest = max(longest, float(observation["waited_s"].max()))
    print(f"a message waited {longest:.2f} s at most")


if __name__ == "__main__":
    main()
